"""MJCF text of a robot: the text that it was read from, with the numbers that were changed since."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from torchdq.algebra import quaternion as quat
from torchdq.algebra.inertia import RigidBody
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot.arrays import double, matrices
from torchdq.robot.bodies import NOTHING, merged
from torchdq.robot.edit.changed import (
    ChangedJoint,
    changed_bodies,
    changed_joints,
    digits,
    grouped,
    own_body,
    require_read_back,
    require_same_tree,
)
from torchdq.robot.mjcf import read as mjcf
from torchdq.robot.mjcf.joints import actuators_at
from torchdq.robot.mjcf.links import body_of
from torchdq.robot.mjcf.read import Mjcf
from torchdq.robot.mjcf.source import MjcfText
from torchdq.robot.model import RobotModel
from torchdq.robot.xml_text import Element, XmlText

JOINTS = ("joint", "freejoint")
ATTRIBUTES = {"damping": "damping", "friction": "frictionloss", "armature": "armature"}
OTHER_AXES = ("fullinertia", "axisangle", "xyaxes", "zaxis", "euler")  # other ways to say quat and diaginertia


def to_mjcf(robot: RobotModel, original: Any) -> str:
    """Text of the MJCF file that a robot was read from, with the numbers of the robot.

    Only masses, centres of mass, inertias, armature, damping, friction loss and ranges that differ from the file's are
    written, with all their digits, on the elements themselves even where a default class gave the number; everything
    else stays byte for byte. If nothing differs, the text is the original. A body that got its mass from geoms gets an
    <inertial>. A body that carries others without joints takes on all that changed of their common body, so that the
    others stay as they are: read again, the text gives the robot. Needs the package `mujoco`.

    Args:
        robot: the robot, with all joints of the file.
        original: the file that it was read from, as in `from_mjcf`.

    Raises:
        MissingLibraryError: mujoco is not installed.
        ArgumentError: the robot has other links, joints or frames than the file (it was locked or cut), or numbers that
            have no place there: limits of velocity and effort, infinite limits, bodies in files that are included.
    """
    base: mjcf.MjcfBase = "fixed" if robot.base_mass is None else "floating"
    first = mjcf.read(original, base, None, None)
    text = first.of.source.text
    before = _robot(robot, first)
    require_same_tree(robot, before)
    bodies = [*changed_bodies(robot, before)]
    joints = grouped(changed_joints(robot, before))
    if not bodies and not joints:
        return text
    xml = XmlText(text)
    elements = _bodies(xml, first)
    for link, body, changed in bodies:
        _write_body(xml, first, elements, link, body, changed)
    for name, changes in joints.items():
        _write_joint(xml, first, elements, before, name, changes)
    written = str(xml)
    again = mjcf.read(MjcfText(written, first.of.source.folder), base, None, None)
    require_read_back(robot, _robot(robot, again))
    return written


def _robot(robot: RobotModel, of: Mjcf) -> RobotModel:
    return type(robot)(**vars(of.description), gravity=None)


def _bodies(xml: XmlText, first: Mjcf) -> list[Element]:
    """Elements of the bodies of a model, in its order; the first is that of the world."""
    m = first.of.model
    worlds = [element for element in xml.root.children if element.tag == "worldbody"]
    found = [element for world in worlds for element in world.under("body")]
    place = {element: i + 1 for i, element in enumerate(found)}
    parents = [place.get(_carrier(element), 0) for element in found]
    names = [element.attributes.get("name", "") for element in found]
    theirs = [m.body(i).name for i in range(1, m.nbody)], m.body_parentid[1:].tolist()
    if xml.root.tag != "mujoco" or (names, parents) != theirs:
        raise ArgumentError(
            f"original must be an MJCF file that holds its bodies itself, one by one, found {len(found)} of "
            f"{m.nbody - 1} there; bodies of files that it includes, copies and URDF cannot be written"
        )
    return [*worlds[:1], *found]


def _carrier(element: Element) -> Any:
    """Element of the body around another."""
    around = element.parent
    while around is not None and around.tag not in ("body", "worldbody"):
        around = around.parent
    return around


# --- bodies ----------------------------------------------------------------------------------------------------------


def _write_body(
    xml: XmlText, first: Mjcf, elements: Sequence[Element], link: int, body: RigidBody, changed: tuple[bool, bool, bool]
) -> None:
    """Write the body of a link, less the bodies without joints that are part of it."""
    placed = first.links.placed
    name = first.links.frames[0].name if link == BASE else first.links.links[link].name
    parts = [i for i in range(1, len(placed)) if placed[i][0] == link]
    if first.of.weighed:
        raise ArgumentError(
            f"mass, com and inertia of link {name!r} must be those of its geoms, because the file says so by "
            "inertiafromgeom='true'; change that to 'auto' there, and <inertial> is written"
        )
    if not parts:
        raise ArgumentError(
            f"link {name!r} must stay without mass, since another joint lies between it and the body, "
            f"found {body[0]:g} kg; change the link that the body's last joint carries"
        )
    # the body itself comes before those that it carries
    carrying, rest = parts[0], NOTHING
    for i in parts[1:]:
        rest = merged(rest, body_of(first.of, i).moved(placed[i][1]))
    own = body_of(first.of, carrying)
    new, alone = own_body(own, rest, body, changed, f"body {name!r}", "bodies without joints")
    words: dict[str, str | None] = {"pos": digits(new[1])} if changed[1] or (changed[0] and not alone) else {}
    words |= {"mass": repr(new[0])} if changed[0] else {}
    words |= _principal(new[2]) if changed[2] or not alone else {}
    inertial = elements[carrying].find("inertial")
    if inertial is not None:
        xml.set(inertial, {key: x for key, x in words.items() if x is not None or key in inertial.attributes})
        return
    words = {"pos": digits(new[1]), "mass": repr(new[0]), **_principal(new[2])}
    xml.add(elements[carrying], "<inertial " + " ".join(f'{key}="{x}"' for key, x in words.items() if x) + "/>")


def _principal(inertia: Sequence[float]) -> dict[str, str | None]:
    """Attributes for an inertia: MuJoCo's own search for the principal axes of a full one stops at twelve digits."""
    moments, axes = np.linalg.eigh(matrices(double(inertia)).numpy())
    axes[:, 0] *= np.linalg.det(axes)
    rows = quat.from_rotation_rows(tuple(map(tuple, axes.tolist())))
    r = max(rows, key=quat.norm2)
    r = quat.scale(1.0 / math.sqrt(quat.norm2(r)), r)
    return {"quat": digits(r), "diaginertia": digits(moments.tolist()), **dict.fromkeys(OTHER_AXES)}


# --- joints ----------------------------------------------------------------------------------------------------------


def _write_joint(
    xml: XmlText,
    first: Mjcf,
    elements: Sequence[Element],
    before: RobotModel,
    name: str,
    changes: Sequence[ChangedJoint],
) -> None:
    m, joint = first.of.model, next(joint for joint in first.joints if joint.name == name)
    own = [x for x in elements[joint.body].under(*JOINTS) if _carrier(x) is elements[joint.body]]
    element = own[joint.row - int(m.body_jntadr[joint.body])]
    dof = int(m.jnt_dofadr[joint.row])
    files = {"damping": m.dof_damping, "friction": m.dof_frictionloss, "armature": m.dof_armature}
    # what a coordinate has is the sum over the joints that follow it and their actuators
    shared = bool(actuators_at(first.of, joint.row)) or before.joint_map is not None
    words: dict[str, str | None] = {}
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
    xml.set(element, words)
