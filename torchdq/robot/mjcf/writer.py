"""MJCF text of a robot: the text that it was read from with the numbers that were changed since, or a new one."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

from torchdq.algebra.inertia import Six
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot.description import Base
from torchdq.robot.edit.changed import ChangedBody, ChangedJoint, Elements, Place, digits, rewritten
from torchdq.robot.mjcf import read as mjcf
from torchdq.robot.mjcf.composed import composed, principal
from torchdq.robot.mjcf.joints import actuators_at
from torchdq.robot.mjcf.links import body_of
from torchdq.robot.mjcf.read import Mjcf
from torchdq.robot.mjcf.source import MjcfText
from torchdq.robot.model import RobotModel

JOINTS = ("joint", "freejoint")
ATTRIBUTES = {"damping": "damping", "friction": "frictionloss", "armature": "armature"}
OTHER_AXES = ("fullinertia", "axisangle", "xyaxes", "zaxis", "euler")  # other ways to say quat and diaginertia


def to_mjcf(robot: RobotModel, original: Any = None) -> str:
    """MJCF text of a robot: of the file that it was read from, with the numbers of the robot, or a new one.

    Of the original, only masses, centres of mass, inertias, armature, damping, friction loss and ranges that differ
    from the file's are written, with all their digits, on the elements themselves even where a default class gave the
    number; all other elements and the comments stay. If nothing differs, the text is the original. A body that got its
    mass from geoms gets an <inertial>. A body that carries others without joints takes on all that changed of their
    common body, so that the others stay as they are: read again, the text gives the robot. Needs the package `mujoco`.

    A new text has every joint with its rotor inertia, every body and frame, collision shapes but meshes, and gravity,
    to rounding, and needs no package. Frames are bodies without joints. Read again, joints are those of one branch
    after the other. Limits of velocity, and of position where one is infinite, have no place and are left out, as is
    the tip. MuJoCo refuses links that move no mass.

    Args:
        robot: the robot, with all joints of the file.
        original: the file that it was read from, as in `from_mjcf`; None: a new text, as in `to_urdf`.

    Raises:
        MissingLibraryError: mujoco is not installed.
        ArgumentError: the robot has other links, joints or frames than the file (it was locked or cut), or numbers that
            have no place there: limits of velocity and effort, infinite limits, bodies in files that are included. A
            new text has no place for helical joints, closures, and couplings of joints that are not to one joint.
    """
    if original is None:
        return composed(robot)
    base: Base = "fixed" if robot.base_mass is None else "floating"
    first = mjcf.read(original, base)
    source = first.of.source

    def read(text: str) -> RobotModel:
        of = first if text is source.text else mjcf.read(MjcfText(text, source.folder), base)
        return type(robot)(**vars(of.description), gravity=None)

    return rewritten(robot, source.text, read, partial(MjcfElements, first))


class MjcfElements(Elements):
    """Elements of an MJCF file, from which a robot was read."""

    MASS, COM = ("", "mass"), ("", "pos")
    FIXED = "bodies without joints"

    def __init__(self, of: Mjcf, root: ET.Element, first: RobotModel):
        self.of, self.bodies, self.coupled = of, _bodies(root, of), first.joint_map is not None

    def places(self, changed: ChangedBody) -> list[Place]:
        """Body that a joint moves, and those without joints that are part of it."""
        links, link = self.of.bodies.of, changed.link
        name = links.frames[0].name if link == BASE else links.links[link].name
        # the body itself comes before those that it carries
        parts = [(i, X) for i, (at, X) in enumerate(links.places) if i and at == link]
        if self.of.of.weighed:
            raise ArgumentError(
                f"mass, com and inertia of link {name!r} must be those of its geoms, because the file says so by "
                "inertiafromgeom='true'; change that to 'auto' there, and <inertial> is written"
            )
        if not parts:
            raise ArgumentError(
                f"link {name!r} must stay without mass, since another joint lies between it and the body, "
                f"found {changed.body.mass:g} kg; change the link that the body's last joint carries"
            )
        return [Place(f"body {name!r}", self.bodies[i], body_of(self.of.of, i).moved(X)) for i, X in parts]

    def set_inertia(self, place: Place, inertial: ET.Element, moments: Six) -> None:
        """Write principal axes of an inertia."""
        for key in OTHER_AXES:
            inertial.attrib.pop(key, None)
        inertial.attrib.update(principal(moments))

    def set_joint(self, name: str, changes: Sequence[ChangedJoint]) -> None:
        """Write numbers of a joint; what a coordinate has is the sum over its joints and their actuators."""
        of, m = self.of.of, self.of.of.model
        if (ball := name[:-2]) in of.balls:
            raise ArgumentError(
                f"numbers of {name!r} must stay as they are: the file has the ball joint {ball!r} there"
            )
        (joint,) = (joint for joint in self.of.joints if joint.name == name)
        dof = int(m.jnt_dofadr[joint.row])
        element = [*_inside(self.bodies[joint.body], *JOINTS)][joint.row - int(m.body_jntadr[joint.body])]
        files = {"damping": m.dof_damping, "friction": m.dof_frictionloss, "armature": m.dof_armature}
        shared = self.coupled or bool(actuators_at(of, joint.row))
        words: dict[str, str] = {}
        ends: dict[str, float] = {}
        for field, old, new in changes:
            if field in ATTRIBUTES:
                words[ATTRIBUTES[field]] = repr(float(files[field][dof]) + (new - old) if shared else new)
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
            scale = 180 / math.pi if of.degrees and joint.kind == "revolute" else 1.0
            words["range"] = digits((low * scale, high * scale))
            if not m.jnt_limited[joint.row]:
                words["limited"] = "true"
        if "damping" in words and m.dof_dampingpoly[dof].any():
            words["damping"] = f"{words['damping']} {digits(m.dof_dampingpoly[dof].tolist())}"
        element.attrib.update(words)


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
