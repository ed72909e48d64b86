"""Defaults of an environment: its effects, and the model that its controller knows."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdq import effects as kinds
from torchdq.effects import Effect
from torchdq.functions.parametric import owned
from torchdq.functions.posed import no_dynamics
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.model import batches
from torchdq.robot.tree import massless
from torchdq.scene.model import SceneModel

ROTOR = 0.1  # where a description has none; common for geared arms [kg m^2 or kg]
DAMPING = 1.0  # likewise [N m s/rad or N s/m]


def default_effects(robot: Robot, motors: Collection[str] | None = None) -> tuple[Effect, ...]:
    """Default effects of an arm: gravity, and joints with rotors, friction, limits and motors.

    Parameters are those of the description. Missing rotor inertia and damping are `ROTOR` and `DAMPING`, because small
    joints without them would exceed realistic speeds. Motors have a torque-speed limit if torque and velocity limits of
    all joints are known; otherwise torques are only saturated. A torque limit of zero, as in many files, is none.
    Raises `SingularInertiaError` for a robot without mass, whose motion would be that of these rotors alone.

    Args:
        motors: names of the joints that have motors; at others, nothing is added that is missing. None: all.
    """
    if massless(robot):
        raise no_dynamics(robot.name)
    limits, rotors = robot.limits, owned(robot, robot.armature)
    moved = [float(motors is None or name in motors) for name in robot.joint_names]
    torque = limits.effort.where(limits.effort > 0, math.inf)
    found: list[Effect] = [
        kinds.Gravity(),
        kinds.RotorInertia(tuple([ROTOR * x for x in moved]) if rotors is None else rotors),
        kinds.Viscous(owned(robot, robot.damping.where(robot.damping > 0, DAMPING * robot.damping.new_tensor(moved)))),
    ]
    if bool((robot.friction > 0).any()):
        found.append(kinds.Coulomb())
    if bool((limits.lower.isfinite() | limits.upper.isfinite()).any()):
        found.append(kinds.JointLimits())
    both = torch.stack([limits.effort, limits.velocity])
    if bool((both.isfinite() & (both > 0)).all()):
        found.append(kinds.TorqueSpeed())
    elif bool(torque.isfinite().any()):
        found.append(kinds.Saturation(owned(robot, torque)))
    return tuple(found)


def nominal_robot(scene: SceneModel) -> Robot:
    """Rigid bodies as a controller may know them: as described, with the scene's gravity and rotors.

    It does not know friction, payloads, or what differs between episodes or robots.
    """
    known: dict[str, Any] = {"gravity": None, "armature": None}
    for effect in scene.effects:
        if effect.SLOT == "model":
            known.update({source: _mean(getattr(effect, name), 1) for name, source in effect.DESCRIBED.items()})
    return mean_robot(scene.robot).replace(**known).bake()


def mean_robot(robot: Robot) -> Robot:
    """Robot without batch axes: of several, the mean of every tensor."""
    means: dict[str, Any] = {name: _mean(getattr(robot, name), len(SHAPES[name])) for name in batches(robot)}
    return robot.replace(**means) if means else robot


def _mean(x: Tensor | Sequence[float], axes: int) -> Tensor:
    """One value of a parameter with some trailing axes; the mean of those that differ from sample to sample."""
    x = torch.as_tensor(x, dtype=torch.float64)
    return x.reshape(-1, *x.shape[x.ndim - axes :]).mean(0)
