"""Numbers of a robot that are not those of a file, for the writers of files."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

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


class ChangedBody(NamedTuple):
    """Body of a link, or of a floating base, that was changed."""

    link: int
    body: RigidBody
    changed: tuple[bool, bool, bool]  # its mass, centre of mass and inertia

    def written(self, own: RigidBody, carried: RigidBody, whole: bool, name: str, parts: str) -> dict[str, Any]:
        """Mass, centre of mass and inertia that an element of a file must get, where it must get one.

        Args:
            own: body of the element in the file.
            carried: all others that are fixed to it.
            whole: whether the file gives the element no body.
            name, parts: the element, and those that it carries, in words.

        Raises:
            ArgumentError: the element would have less than no mass.
        """
        mass, com, inertia = self.changed
        alone = carried == NOTHING
        left = self.body if alone else without(self.body, carried)
        if mass and left.mass < 0:
            raise ArgumentError(
                f"mass of {name} must be at least that of the {parts} that it carries, {carried.mass:g} kg, found "
                f"{self.body.mass:g} kg; change their masses in the file"
            )
        # what did not change stays without the rounding of a sum and a difference
        new = {
            "mass": (mass, left.mass if mass else own.mass),
            "com": (com or (mass and not alone), left.com if mass or com else own.com),
            "inertia": (inertia or not alone, left.inertia),
        }
        return {part: x for part, (wanted, x) in new.items() if wanted or whole}


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
                "inertias, friction, damping and limits are written: a robot that was cut, moved, coupled, or locked "
                "elsewhere than at zero, has no place in the file; read it with all joints, and replace their bodies"
            )


def changed_bodies(robot: RobotModel, original: RobotModel) -> list[ChangedBody]:
    """Bodies that were changed."""
    found = []
    for link in [*range(len(robot.link_names)), *([BASE] if robot.floating else [])]:
        own, theirs = body_at(robot, link), body_at(original, link)
        changed = tuple(not equal(a.detach(), b.to(a)) for a, b in zip(own, theirs, strict=True))
        if any(changed):
            mass, com, inertia = (x.detach().double().tolist() for x in own)
            found.append(ChangedBody(link, RigidBody(mass, tuple(com), tuple(inertia)), changed))  # type: ignore[arg-type]
    return found


def digits(numbers: Iterable[float]) -> str:
    """Numbers with all their digits, with spaces between them."""
    return " ".join(map(repr, numbers))


def changed_joints(robot: RobotModel, original: RobotModel) -> list[ChangedJoint]:
    """Numbers of joints that were changed; raises if one is not finite."""
    found = []
    for name, own, theirs in _pairs(robot, original, ("damping", "friction", "armature", "limits")):
        for i in (own != theirs.to(own)).nonzero().flatten().tolist():
            joint, old, new = robot.joint_names[i], float(theirs[i]), float(own[i])
            if not math.isfinite(new):
                raise ArgumentError(
                    f"{name} of joint {joint!r} must be finite to be written, found {new:g}, in the original {old:g}"
                )
            found.append(ChangedJoint(joint, name, old, new))
    return found


def require_read_back(robot: RobotModel, again: RobotModel) -> None:
    """Raise unless a robot that was written and read again has the numbers of the robot."""
    for name, own, theirs in _pairs(robot, again, WRITTEN):
        if not _close(own.detach(), theirs.to(own)):
            raise ArgumentError(
                f"{name} of robot {robot.name!r} cannot be written: a robot that is read from the text would have "
                f"{theirs.tolist()} instead of {own.tolist()}"
            )


def _pairs(robot: RobotModel, other: RobotModel, names: Iterable[str]) -> Iterator[tuple[str, Tensor, Tensor]]:
    """Numbers of two robots, by field; those that only one of them has are zero in the other."""
    for name in names:
        own, theirs = getattr(robot, name), getattr(other, name)
        if name == "limits":
            yield from zip(own._fields, own, theirs, strict=True)
        elif own is not None or theirs is not None:
            zero = torch.zeros_like(theirs if own is None else own)
            yield name, zero if own is None else own, zero if theirs is None else theirs


def _close(a: Tensor, b: Tensor) -> bool:
    finite = a.isfinite()
    scale = float(a[finite].abs().max()) if bool(finite.any()) else 0.0
    return bool(((a == b) | ((a - b).abs() <= CLOSE[a.dtype] * scale)).all())
