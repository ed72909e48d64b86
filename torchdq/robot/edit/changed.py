"""Files with other numbers: what differs between a robot and its file is written where the format has it."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.algebra.inertia import RigidBody, Six
from torchdq.dynamics.joints import HELICAL
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot import fields
from torchdq.robot.arrays import equal
from torchdq.robot.bodies import NOTHING, body_at, merged, without
from torchdq.robot.model import RobotModel, batches, followed, require_unchanged, sum_of, values
from torchdq.robot.xml_text import add, parsed, written

# fields that a writer writes; gravity, tip, name and notes are not part of a file's bodies and joints
WRITTEN = (*fields.BODIES, "limits", "damping", "friction", "armature")
UNWRITTEN = ("name", "gravity", "tip", "notes")
CLOSE = {torch.float64: 1e-12, torch.float32: 1e-6}  # as parts of the largest number of a field


class ChangedBody(NamedTuple):
    """Body of a link, or of a floating base, that was changed."""

    link: int
    body: RigidBody
    changed: tuple[bool, bool, bool]  # its mass, centre of mass and inertia


class ChangedJoint(NamedTuple):
    """Number of a joint that was changed."""

    field: str  # "damping", "friction", "armature" or a field of Limits
    old: float
    new: float


class Place(NamedTuple):
    """Element of a file with a body of its own: that of a link, or of something fixed to it."""

    name: str  # in words
    element: ET.Element
    body: RigidBody  # in the frame of the link


class Elements:
    """Elements of a file: each format says where they have a number."""

    MASS: tuple[str, str]  # child of an <inertial>, "" for itself, and its attribute
    COM: tuple[str, str]  # the same
    FIXED: str  # what is fixed to a link, in words

    def places(self, changed: ChangedBody) -> list[Place]:
        """Element that a changed link is named by, and those fixed to it."""
        raise NotImplementedError

    def set_inertia(self, place: Place, inertial: ET.Element, moments: Six) -> None:
        """Write an inertia in axes of the link."""
        raise NotImplementedError

    def set_joint(self, name: str, changes: Sequence[ChangedJoint]) -> None:
        """Write the numbers of a joint that were changed."""
        raise NotImplementedError

    def set_body(self, changed: ChangedBody) -> None:
        """Write a body, less what is fixed to its link."""
        place, *others = self.places(changed)
        carried = reduce(merged, (other.body for other in others), NOTHING)
        (mass, com, inertia), alone, inertial = changed.changed, carried == NOTHING, place.element.find("inertial")
        left, absent = changed.body if alone else without(changed.body, carried), inertial is None
        if mass and left.mass < 0:
            raise ArgumentError(
                f"mass of {place.name} must be at least that of the {self.FIXED} that it carries, {carried.mass:g} kg, "
                f"found {changed.body.mass:g} kg; change their masses in the file"
            )
        if inertial is None:
            inertial = add(place.element, "inertial")
        if inertia or not alone or absent:
            self.set_inertia(place, inertial, left.inertia)
        # what did not change stays without the rounding of a sum and a difference
        if mass or absent:
            set_in(inertial, *self.MASS, digits([left.mass if mass else place.body.mass]))
        if com or (mass and not alone) or absent:
            set_in(inertial, *self.COM, digits(left.com if mass or com else place.body.com))


def rewritten(
    robot: RobotModel,
    text: str,
    read: Callable[[str], RobotModel],
    elements: Callable[[ET.Element, RobotModel], Elements],
) -> str:
    """Text that a robot was read from with the robot's numbers; `elements` are those of a root and the robot in it."""
    first = read(text)
    require_same_tree(robot, first)
    bodies, joints = changed_bodies(robot, first), changed_joints(robot, first)
    if not bodies and not joints:
        return text
    root = parsed(text, whole=True)
    file = elements(root, first)
    for changed in bodies:
        file.set_body(changed)
    for name, changes in joints.items():
        file.set_joint(name, changes)
    result = written(root, text)
    require_read_back(robot, read(result))
    return result


def set_in(parent: ET.Element, tag: str, attribute: str, value: str) -> None:
    """Write an attribute of the first child with a tag, which may be missing; "": of the parent itself."""
    child = parent if not tag else parent.find(tag)
    (add(parent, tag) if child is None else child).set(attribute, value)


def require_one(robot: RobotModel) -> None:
    """Raise unless a robot has no batch axes."""
    require_unchanged(robot)
    for name, axes in batches(robot).items():
        raise ArgumentError(
            f"{name} of robot {robot.name!r} must have no batch axes to be written, found {axes}; write "
            "the robots one by one"
        )


def require_place(robot: RobotModel, file: str, others: Sequence[str] = ()) -> None:
    """Raise unless a kind of file has a place for the joints of one robot; `others` are things that have none."""
    require_one(robot)
    joints = {joint: followed(robot, joint) for joint in robot.every_joint}
    found = [f"the helical joint {x!r}" for x, kind in zip(joints, robot.kinds, strict=True) if kind == HELICAL]
    found += [f"joint {x!r}, which is {sum_of(row)}" for x, row in joints.items() if len(row) != 1]
    for x in robot.joint_names:
        if joints.get(x) not in ({x: 1.0}, {x: -1.0}):  # a joint that turns the other way has the opposite axis
            found.append(f"coordinate {x!r}, which no joint is")
    found += [*others, *(["closures"] if robot.closures else [])]
    if found:
        raise ArgumentError(f"robot {robot.name!r} cannot be written: {file} has no place for {'; '.join(found)}")


def require_same_tree(robot: RobotModel, original: RobotModel) -> None:
    """Raise unless a robot has the links, joints and frames of the original, and no batch axes."""
    require_one(robot)
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
    """Numbers with all their digits, with spaces between them; a negative zero is zero."""
    return " ".join(repr(x + 0.0) for x in numbers)


def changed_joints(robot: RobotModel, original: RobotModel) -> dict[str, list[ChangedJoint]]:
    """Numbers of joints that were changed, by joint; raises if one is not finite."""
    found: dict[str, list[ChangedJoint]] = {}
    for name, own, theirs in _pairs(robot, original, ("damping", "friction", "armature", "limits")):
        for i in (own != theirs.to(own)).nonzero().flatten().tolist():
            joint, old, new = robot.joint_names[i], float(theirs[i]), float(own[i])
            if not math.isfinite(new):
                raise ArgumentError(
                    f"{name} of joint {joint!r} must be finite to be written, found {new:g}, in the original {old:g}"
                )
            found.setdefault(joint, []).append(ChangedJoint(name, old, new))
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
