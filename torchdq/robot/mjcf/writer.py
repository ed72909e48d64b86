"""MJCF text of a robot: the text that it was read from, with the numbers that were changed since."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from torchdq.algebra import quaternion as quat
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot.arrays import double, matrices
from torchdq.robot.bodies import NOTHING, merged
from torchdq.robot.description import Base
from torchdq.robot.edit.changed import (
    ChangedBody,
    ChangedJoint,
    changed_bodies,
    changed_joints,
    digits,
    require_read_back,
    require_same_tree,
)
from torchdq.robot.mjcf import read as mjcf
from torchdq.robot.mjcf.joints import MjcfJoint, actuators_at
from torchdq.robot.mjcf.links import body_of
from torchdq.robot.mjcf.read import Mjcf
from torchdq.robot.mjcf.source import MjcfText
from torchdq.robot.model import RobotModel
from torchdq.robot.xml_text import add, parsed, written

JOINTS = ("joint", "freejoint")
ATTRIBUTES = {"damping": "damping", "friction": "frictionloss", "armature": "armature"}
OTHER_AXES = ("fullinertia", "axisangle", "xyaxes", "zaxis", "euler")  # other ways to say quat and diaginertia


def to_mjcf(robot: RobotModel, original: Any) -> str:
    """Text of the MJCF file that a robot was read from, with the numbers of the robot.

    Only masses, centres of mass, inertias, armature, damping, friction loss and ranges that differ from the file's are
    written, with all their digits, on the elements themselves even where a default class gave the number; all other
    elements and the comments stay. If nothing differs, the text is the original. A body that got its mass from geoms
    gets an <inertial>. A body that carries others without joints takes on all that changed of their common body, so
    that the others stay as they are: read again, the text gives the robot. Needs the package `mujoco`.

    Args:
        robot: the robot, with all joints of the file.
        original: the file that it was read from, as in `from_mjcf`.

    Raises:
        MissingLibraryError: mujoco is not installed.
        ArgumentError: the robot has other links, joints or frames than the file (it was locked or cut), or numbers that
            have no place there: limits of velocity and effort, infinite limits, bodies in files that are included.
    """
    base: Base = "fixed" if robot.base_mass is None else "floating"
    first = mjcf.read(original, base)
    text = first.of.source.text
    before = _robot(robot, first)
    require_same_tree(robot, before)
    bodies, changes = changed_bodies(robot, before), changed_joints(robot, before)
    if not bodies and not changes:
        return text
    root = parsed(text, whole=True)
    elements = _bodies(root, first)
    for changed in bodies:
        _write_body(first, elements, changed)
    for joint in first.joints:
        own = [change for change in changes if change.joint == joint.name]
        if own:
            _write_joint(first, elements[joint.body], joint, own, before.joint_map is not None)
    result = written(root, text)
    again = mjcf.read(MjcfText(result, first.of.source.folder), base)
    require_read_back(robot, _robot(robot, again))
    return result


def _robot(robot: RobotModel, of: Mjcf) -> RobotModel:
    return type(robot)(**vars(of.description), gravity=None)


def _bodies(root: ET.Element, first: Mjcf) -> list[ET.Element]:
    """Elements of the bodies of a model, in its order; the first is that of the world."""
    m = first.of.model
    found: list[ET.Element] = [ET.Element("worldbody")]
    parents: list[int] = []

    def visit(element: ET.Element, parent: int) -> None:
        for body in _inside(element, "body"):
            found.append(body)
            parents.append(parent)
            visit(body, len(found) - 1)

    for world in root.findall("worldbody"):
        visit(world, 0)
    names = [element.get("name", "") for element in found[1:]]
    theirs = [m.body(i).name for i in range(1, m.nbody)], m.body_parentid[1:].tolist()
    if root.tag != "mujoco" or (names, parents) != theirs:
        raise ArgumentError(
            f"original must be an MJCF file that holds its bodies itself, one by one, found {len(names)} of "
            f"{m.nbody - 1} there; bodies of files that it includes, copies and URDF cannot be written"
        )
    return found


def _inside(element: ET.Element, *tags: str) -> Iterator[ET.Element]:
    """Elements of a body with one of these tags, in its frames too, but not in the bodies that it carries."""
    for child in element:
        if child.tag in tags:
            yield child
        elif child.tag != "body":
            yield from _inside(child, *tags)


def _write_body(first: Mjcf, elements: Sequence[ET.Element], changed: ChangedBody) -> None:
    """Write the body of a link, less the bodies without joints that are part of it."""
    links, link = first.bodies.of, changed.link
    placed = links.places
    name = links.frames[0].name if link == BASE else links.links[link].name
    parts = [i for i in range(1, len(placed)) if placed[i][0] == link]
    if first.of.weighed:
        raise ArgumentError(
            f"mass, com and inertia of link {name!r} must be those of its geoms, because the file says so by "
            "inertiafromgeom='true'; change that to 'auto' there, and <inertial> is written"
        )
    if not parts:
        raise ArgumentError(
            f"link {name!r} must stay without mass, since another joint lies between it and the body, "
            f"found {changed.body.mass:g} kg; change the link that the body's last joint carries"
        )
    # the body itself comes before those that it carries
    carrying, rest = parts[0], NOTHING
    for i in parts[1:]:
        rest = merged(rest, body_of(first.of, i).moved(placed[i][1]))
    inertial = elements[carrying].find("inertial")
    new = changed.written(
        body_of(first.of, carrying), rest, inertial is None, f"body {name!r}", "bodies without joints"
    )
    if inertial is None:
        inertial = add(elements[carrying], "inertial")
    if "com" in new:
        inertial.set("pos", digits(new["com"]))
    if "mass" in new:
        inertial.set("mass", repr(new["mass"]))
    if "inertia" in new:
        for key in OTHER_AXES:
            inertial.attrib.pop(key, None)
        inertial.attrib.update(_principal(new["inertia"]))


def _principal(inertia: Sequence[float]) -> dict[str, str]:
    """Attributes for an inertia: MuJoCo's own search for the principal axes of a full one stops at twelve digits."""
    moments, axes = np.linalg.eigh(matrices(double(inertia)).numpy())
    axes[:, 0] *= np.linalg.det(axes)
    rows = quat.from_rotation_rows(tuple(map(tuple, axes.tolist())))
    r = max(rows, key=quat.norm2)
    r = quat.scale(1.0 / math.sqrt(quat.norm2(r)), r)
    return {"quat": digits(r), "diaginertia": digits(moments.tolist())}


def _write_joint(
    first: Mjcf, body: ET.Element, joint: MjcfJoint, changes: Sequence[ChangedJoint], coupled: bool
) -> None:
    m, name, dof = first.of.model, joint.name, int(first.of.model.jnt_dofadr[joint.row])
    element = [*_inside(body, *JOINTS)][joint.row - int(m.body_jntadr[joint.body])]
    files = {"damping": m.dof_damping, "friction": m.dof_frictionloss, "armature": m.dof_armature}
    # what a coordinate has is the sum over the joints that follow it and their actuators
    shared = coupled or bool(actuators_at(first.of, joint.row))
    words: dict[str, str] = {}
    ends: dict[str, float] = {}
    for _, field, old, new in changes:
        if field in ATTRIBUTES:
            value = float(files[field][dof]) + (new - old) if shared else new
            words[ATTRIBUTES[field]] = repr(value)
        elif field in ("lower", "upper"):
            ends[field] = new
        else:
            raise ArgumentError(
                f"{field} limit of joint {name!r} has no place in an MJCF file, where actuators bound it, found "
                f"{new:g}, in the original {old:g}"
            )
    if ends:
        low, high = ends.get("lower", joint.lower), ends.get("upper", joint.upper)
        if not math.isfinite(high - low):
            raise ArgumentError(f"limits of joint {name!r} must both be finite, found {low:g} and {high:g}")
        scale = 180 / math.pi if first.of.degrees and joint.kind == "revolute" else 1.0
        words["range"] = digits((low * scale, high * scale))
        if not m.jnt_limited[joint.row]:
            words["limited"] = "true"
    if "damping" in words and m.dof_dampingpoly[dof].any():
        words["damping"] = f"{words['damping']} {digits(m.dof_dampingpoly[dof].tolist())}"
    element.attrib.update(words)
