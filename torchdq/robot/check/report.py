"""Report of a robot: the content of its description, and how each part is used."""

from __future__ import annotations

from typing import NamedTuple

from torchdq.base.tables import table
from torchdq.dynamics.friction import COLUMNS, SPEEDS, STATED
from torchdq.findings import Finding
from torchdq.robot.model import RobotModel, followed, require_unchanged, sum_of

HEADER = ("joint", "kind", "link", "mass", "limits (not enforced)")
MOTORS = ("joint", "velocity [rad/s or m/s]", "torque [N m or N]")
BOUNDED = "limits of velocity and torque (not enforced)"


class Report(NamedTuple):
    """Report of a robot; `str` lays it out as a table."""

    summary: str
    joints: tuple[tuple[str, ...], ...]
    notes: tuple[Finding, ...]
    friction: tuple[tuple[str, ...], ...] = ()  # rows of `COLUMNS`, if any joint has friction
    motors: tuple[tuple[str, ...], ...] = ()  # rows of `MOTORS`, if a velocity or a torque is limited

    def __str__(self) -> str:
        motors = f"\n\n{BOUNDED}:\n{table(MOTORS, self.motors)}" if self.motors else ""
        friction = f"\n\n{STATED}:\n{table(COLUMNS, self.friction)}" if self.friction else ""
        notes = "".join(["\n\nnotes:"] * bool(self.notes) + [f"\n- {note}" for note in self.notes])
        return f"{self.summary}\n\n{table(HEADER, self.joints)}{motors}{friction}{notes}"


def report(robot: RobotModel) -> Report:
    """Report of what is used and not used of the description, and of unphysical bodies; `print` it."""
    require_unchanged(robot)
    used = ["mass, centre of mass and inertia of the links", "joint axes and placements"]
    used += [] if robot.gravity is None else [f"gravity {robot.gravity.tolist()} m/s^2"]
    used += [] if robot.armature is None else ["rotor inertia"]
    base = robot.base_mass
    used += [] if base is None else [f"a floating base of {float(base.detach().mean()):.4g} kg"]
    loops = ", ".join(f"{x.frame_a} and {x.frame_b} ({x.kind})" for x in robot.closures)
    used += [f"closures of {loops}"] if loops else []
    joints = tuple(
        (name, kind, link, f"{float(robot.mass.detach()[..., i].mean()):.4g} kg", _range(robot, name))
        for i, (name, kind, link) in enumerate(zip(robot.every_joint, robot.kinds, robot.link_names, strict=True))
    )
    return Report(f"{robot!r}\nused: {'; '.join(used)}", joints, robot.notes, _friction(robot), _motors(robot))


def _motors(robot: RobotModel) -> tuple[tuple[str, ...], ...]:
    limits = (robot.limits.velocity, robot.limits.effort)
    if not any(bool(x.isfinite().any()) for x in limits):
        return ()
    return tuple(
        (name, *(f"{float(x.detach()[..., i].max()):.4g}" for x in limits)) for i, name in enumerate(robot.joint_names)
    )


def _friction(robot: RobotModel) -> tuple[tuple[str, ...], ...]:
    if not bool((robot.damping != 0).any() | (robot.friction != 0).any()):
        return ()
    torques = [robot.friction + speed * robot.damping for speed in SPEEDS]
    return tuple(
        (name, *(f"{float(torque.detach()[..., i].mean()):.4g}" for torque in torques))
        for i, name in enumerate(robot.joint_names)
    )


def _range(robot: RobotModel, joint: str) -> str:
    """Limits of a joint that is a coordinate; of another one, the coordinates that it follows."""
    leaders = followed(robot, joint)
    if leaders != {joint: 1.0}:
        return f"follows {sum_of(leaders)}"
    i = robot.joint_index(joint)
    return f"[{float(robot.limits.lower[..., i].min()):.4g}, {float(robot.limits.upper[..., i].max()):.4g}]"
