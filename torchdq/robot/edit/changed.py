"""Numbers of a robot that are not those of a file, for the writers of files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.algebra.inertia import RigidBody
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot import fields
from torchdq.robot.arrays import equal
from torchdq.robot.bodies import NOTHING, body_at, without
from torchdq.robot.model import RobotModel, batches, require_unchanged, values

# fields that a writer writes; gravity, tip, name and notes are not part of a file's bodies and joints
WRITTEN = (*fields.BODIES, "limits", "damping", "friction", "armature")
UNWRITTEN = ("name", "gravity", "tip", "notes")
CLOSE = {torch.float64: 1e-12, torch.float32: 1e-6}  # as parts of the largest number of a field


class ChangedJoint(NamedTuple):
    """Number of a joint that was changed."""

    joint: str
    field: str  # "damping", "friction", "armature" or a field of Limits
    old: float
    new: float


def require_same_tree(robot: RobotModel, original: RobotModel) -> None:
    """Raise unless a robot has the links, joints and frames of the original, and no batch axes."""
    require_unchanged(robot)
    for name, axes in batches(robot).items():
        raise ArgumentError(
            f"{name} of robot {robot.name!r} must have no batch axes to be written, found {axes}; write "
            "the robots one by one"
        )
    theirs = values(original.to(robot.mass.dtype, robot.mass.device))
    for name, own in values(robot).items():
        if name not in (*WRITTEN, *UNWRITTEN) and not equal(own, theirs[name]):
            found = f", found {own}, in the original {theirs[name]}" if name in ("joint_names", "link_names") else ""
            raise ArgumentError(
                f"{name} of robot {robot.name!r} must be that of the original{found}; only masses, centres of mass, "
                "inertias, friction, damping and limits are written: a robot that was cut or moved, or locked "
                "elsewhere than at zero, has no place in the file that it came from; read it with all joints"
            )


def changed_bodies(robot: RobotModel, original: RobotModel) -> Iterator[tuple[int, RigidBody, tuple[bool, bool, bool]]]:
    """Links whose bodies were changed: the link or BASE, the new body, and whether each of its parts was changed."""
    links = [*range(len(robot.link_names)), *([BASE] if robot.floating else [])]
    for link in links:
        own, theirs = body_at(robot, link), body_at(original, link)
        changed = tuple(not equal(a.detach(), b.to(a)) for a, b in zip(own, theirs, strict=True))
        if any(changed):
            mass, com, inertia = (x.detach().double().tolist() for x in own)
            yield link, RigidBody(mass, tuple(com), tuple(inertia)), changed  # type: ignore[misc]


def own_body(
    own: RigidBody, carried: RigidBody, new: RigidBody, changed: tuple[bool, bool, bool], name: str, parts: str
) -> tuple[RigidBody, bool]:
    """Body that an element of a file must have, and whether it carries no others.

    Args:
        own: body of the element in the file.
        carried: all others that are fixed to it.
        new: the common body to be written.
        changed: whether the mass, the centre of mass and the inertia differ from the file's.
        name: the element, in words.
        parts: those that it carries, in words.

    Raises:
        ArgumentError: the element would have less than no mass.
    """
    alone = carried == NOTHING
    left = new if alone else without(new, carried)
    # what did not change stays without the rounding of a sum and a difference
    mass = left.mass if changed[0] else own.mass
    if mass < 0:
        raise ArgumentError(
            f"mass of {name} must be at least that of the {parts} that it carries, {carried.mass:g} kg, found "
            f"{new.mass:g} kg; change their masses in the file"
        )
    return RigidBody(mass, left.com if any(changed[:2]) else own.com, left.inertia), alone


def digits(numbers: Iterable[float]) -> str:
    """Numbers with all their digits, with spaces between them."""
    return " ".join(map(repr, numbers))


def changed_joints(robot: RobotModel, original: RobotModel) -> Iterator[ChangedJoint]:
    """Numbers of joints that were changed; raises if one is not finite."""
    for name, own, theirs in _per_joint(robot, original):
        for joint, old, new, differs in zip(
            robot.joint_names, theirs.tolist(), own.detach().double().tolist(), own != theirs.to(own), strict=True
        ):
            if not differs:
                continue
            if not math.isfinite(new):
                raise ArgumentError(
                    f"{name} of joint {joint!r} must be finite to be written, found {new:g}, in the original {old:g}"
                )
            yield ChangedJoint(joint, name, old, new)


def grouped(changes: Iterable[ChangedJoint]) -> dict[str, list[ChangedJoint]]:
    """Changes by the name of their joint."""
    found: dict[str, list[ChangedJoint]] = {}
    for change in changes:
        found.setdefault(change.joint, []).append(change)
    return found


def _per_joint(robot: RobotModel, original: RobotModel) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Name, own numbers and those of the original of every field with a number per joint."""
    for name in ("damping", "friction", "armature"):
        own, theirs = getattr(robot, name), getattr(original, name)
        if own is not None or theirs is not None:
            zero = original.damping * 0
            yield name, zero if own is None else own, zero if theirs is None else theirs
    for name, own, theirs in zip(robot.limits._fields, robot.limits, original.limits, strict=True):
        yield name, own, theirs


def require_read_back(robot: RobotModel, again: RobotModel) -> None:
    """Raise unless a robot that was written and read again has the numbers of the robot."""
    for name in WRITTEN:
        own, theirs = getattr(robot, name), getattr(again, name)
        pairs = zip(own, theirs, strict=True) if name == "limits" else [(own, theirs)]
        for a, b in pairs:
            a = b * 0 if a is None and b is not None else a
            b = a * 0 if b is None and a is not None else b
            if a is None or _close(a.detach(), b.to(a)):
                continue
            raise ArgumentError(
                f"{name} of robot {robot.name!r} cannot be written: a robot that is read from the text would have "
                f"{b.tolist()} instead of {a.tolist()}"
            )


def _close(a: Tensor, b: Tensor) -> bool:
    finite = a.isfinite()
    scale = float(a[finite].abs().max()) if bool(finite.any()) else 0.0
    return bool(((a == b) | ((a - b).abs() <= CLOSE[a.dtype] * scale)).all())
