"""What a robot's description asks for that a scene leaves out."""

from collections.abc import Sequence

import torch

from torchdq import effects as kinds
from torchdq.effects import Effect
from torchdq.robot import Robot


def left_out(robot: Robot, effects: Sequence[Effect]) -> tuple[str, ...]:
    """One line per thing."""

    def has(*types: type) -> bool:
        return any(isinstance(effect, types) for effect in effects)

    def joints(of: torch.Tensor) -> str:
        return ", ".join(name for name, there in zip(robot.joint_names, of.tolist(), strict=True) if there)

    limits = robot.limits
    ranged = limits.lower.isfinite() | limits.upper.isfinite()
    asked = [
        (robot.gravity is not None, (kinds.Gravity,), "gravity", "effects.Gravity()"),
        (robot.armature is not None, (kinds.RotorInertia, kinds.Elastic), "rotor inertia", "effects.RotorInertia()"),
        (
            bool((robot.damping > 0).any()),
            (kinds.Viscous,),
            f"damping of {joints(robot.damping > 0)}",
            "effects.Viscous()",
        ),
        (
            bool((robot.friction > 0).any()),
            (kinds.Coulomb, kinds.Stribeck),
            f"dry friction of {joints(robot.friction > 0)}",
            "effects.Coulomb()",
        ),
        (bool(ranged.any()), (kinds.Limits,), f"position limits of {joints(ranged)}", "effects.Limits()"),
        (
            bool(limits.effort.isfinite().any()),
            (kinds.Saturation, kinds.TorqueSpeed),
            f"torque limits of {joints(limits.effort.isfinite())}",
            "effects.Saturation()",
        ),
        (
            bool(limits.velocity.isfinite().any()),
            (kinds.TorqueSpeed,),
            f"velocity limits of {joints(limits.velocity.isfinite())}",
            "effects.TorqueSpeed(), which takes the torque away there",
        ),
    ]
    lines = [f"{what}: {how}" for there, by, what, how in asked if there and not has(*by)]
    return (*lines, *[f"mimic joints are independent: {note}" for note in robot.notes if "mimic" in note])
