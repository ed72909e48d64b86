"""URDF text of a robot: the text that it was read from, with the numbers that were changed since."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any

from torchdq.algebra import quaternion as quat
from torchdq.algebra.inertia import RigidBody, Six
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot.bodies import NOTHING, merged
from torchdq.robot.check import consistency
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
from torchdq.robot.model import RobotModel, factors
from torchdq.robot.urdf.document import text_of
from torchdq.robot.urdf.elements import ENTRIES, Inertial, elements
from torchdq.robot.urdf.read import physical, read
from torchdq.robot.urdf.segments import body_of, pose
from torchdq.robot.xml_text import add, parsed, written


def to_urdf(robot: RobotModel, original: Any) -> str:
    """Text of the URDF file that a robot was read from, with the numbers of the robot.

    Only masses, centres of mass, inertias, damping, friction and limits that differ from the file's are written, with
    all their digits; all other elements and the comments stay. If nothing differs, the text is the original. A link
    that carries others on fixed joints takes on all that changed of their common body, so that the others stay as they
    are; inertias that were repaired are each written on their own link. Read again, the text gives the robot, with
    mimic="independent" if it was read so: <mimic> stays in the text; and with the same `joints` if it was read with
    some of them, links beyond the others being carried as on fixed joints at zero. Gravity and the tip are not part of
    a URDF file.

    Args:
        robot: the robot, with all joints of the file, or those that it was read with.
        original: the file that it was read from, as in `from_urdf`.

    Raises:
        ArgumentError: the robot has other links, joints or frames than the file (it was cut, or locked elsewhere than
            at zero), or numbers that have no place there: rotor inertia, infinite limits, less mass than the links on
            fixed joints alone.

    >>> import torchdq
    >>> text = "<robot name='r'><link name='a'/><link name='b'><inertial><mass value='2'/></inertial></link>" + (
    ...     "<joint name='j' type='prismatic'><parent link='a'/><child link='b'/><limit upper='1'/></joint></robot>")
    >>> robot = torchdq.Robot.from_urdf(text)
    >>> print(robot.replace(mass=1.5 * robot.mass).to_urdf(text)[33:89])
    <link name="b"><inertial><mass value="3.0" /></inertial>
    """
    text = _with_repairs(robot, text_of(original))

    def read_as(text: str, **options: Any) -> RobotModel:
        base: Base = "fixed" if robot.base_mass is None else "floating"
        return type(robot)(**vars(read(text, base=base, **options)), gravity=None)

    options: dict[str, Any] = {}
    first = read_as(text)
    if first.joint_map is not None and robot.joint_map is None:
        options["mimic"] = "independent"
        first = read_as(text, **options)
    if robot.joint_map is None and set(robot.joint_names) < set(first.joint_names):
        options["kept"] = robot.joint_names
        first = read_as(text, **options)
    require_same_tree(robot, first)
    bodies, joints = changed_bodies(robot, first), changed_joints(robot, first)
    if not bodies and not joints:
        return text
    root, file = parsed(text, whole=True), elements(parsed(text))
    links, named = ({x.get("name", ""): x for x in root.findall(tag)} for tag in ("link", "joint"))
    for changed in bodies:
        _write_body(links, file.links, first, changed)
    shared = (factors(first) != 0).sum(0) > 1  # by several joints, whose numbers are the coordinate's together
    for change in joints:
        _write_joint(named[change.joint], change, bool(shared[first.joint_index(change.joint)]))
    result = written(root, text)
    require_read_back(robot, read_as(result, **options))
    return result


def _with_repairs(robot: RobotModel, text: str) -> str:
    """Text with the inertias that were repaired when the robot was read, those of links on fixed joints, too."""
    subjects = {x.subject for x in robot.notes if x.code == consistency.REPAIRED}
    if not subjects:
        return text
    root, file = parsed(text, whole=True), elements(parsed(text))
    repaired = physical(file, repair=True)[0].links
    for link in root.findall("link"):
        name = link.get("name", "")
        if f"link {name!r}" in subjects and (new := repaired[name]) is not None and new != file.links[name]:
            _set_inertia(link.find("inertial"), new.inertia)
    return written(root, text)


def _write_body(
    links: Mapping[str, ET.Element], described: Mapping[str, Inertial | None], first: RobotModel, changed: ChangedBody
) -> None:
    """Write the body of a link, less the links on fixed joints that are part of it."""
    link = changed.link
    parts = {frame.name: frame.X_BF.tolist() for frame in first.frames if frame.link == link and frame.name in links}
    carrying = next(iter(parts)) if link == BASE else first.link_names[link]
    rest = NOTHING
    for name, X in parts.items():
        if name != carrying:
            rest = merged(rest, _in_link(described[name]).moved((tuple(X[:4]), tuple(X[4:]))))
    own, inertial = described[carrying], links[carrying].find("inertial")
    new = changed.written(_in_link(own), rest, inertial is None, f"link {carrying!r}", "links on fixed joints")
    if inertial is None:
        inertial = add(links[carrying], "inertial")
    if "inertia" in new:
        moments = new["inertia"]
        if own is not None and (r := pose(own.origin)[0]) != quat.ONE:  # axes of the inertia
            moments = RigidBody(0.0, quat.ZERO, moments).moved((quat.conj(r), (0.0,) * 4)).inertia
        _set_inertia(inertial, moments)
    if "mass" in new:
        _set(inertial, "mass", {"value": repr(new["mass"])})
    if "com" in new:
        _set(inertial, "origin", {"xyz": digits(new["com"])})


def _in_link(inertial: Inertial | None) -> RigidBody:
    """Body of an <inertial> element in the frame of its link."""
    body, X = body_of(inertial)
    return body.moved(X)


def _set(parent: ET.Element, tag: str, attributes: Mapping[str, str]) -> None:
    """Write attributes of the first child with a tag, which may be missing."""
    child = parent.find(tag)
    (add(parent, tag) if child is None else child).attrib.update(attributes)


def _set_inertia(inertial: Any, moments: Six) -> None:
    """Write the inertia of an <inertial>, in its axes."""
    _set(inertial, "inertia", dict(zip(ENTRIES, map(repr, moments), strict=True)))


def _write_joint(joint: ET.Element, change: ChangedJoint, shared: bool) -> None:
    """Write a number of a joint; what a coordinate has is the sum over the joints that share it."""
    name, field, old, new = change
    if field == "armature":
        raise ArgumentError(f"armature of joint {name!r} has no place in a URDF file, found {new:g}")
    if field in ("lower", "upper") and joint.get("type") == "continuous":
        raise ArgumentError(
            f"{field} limit of joint {name!r} has no place in the file, where it is continuous, "
            f"found {new:g}; make it a revolute joint there"
        )
    tag = "dynamics" if field in ("damping", "friction") else "limit"
    element = joint.find(tag)
    own = 0.0 if element is None else float(element.get(field, 0.0))
    _set(joint, tag, {field: repr(own + (new - old) if shared and tag == "dynamics" else new)})
