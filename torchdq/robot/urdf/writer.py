"""URDF text of a robot: the text that it was read from, with the numbers that were changed since."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torchdq.algebra import quaternion as quat
from torchdq.algebra.inertia import RigidBody
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
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
from torchdq.robot.urdf.document import text_of
from torchdq.robot.urdf.tree import pose
from torchdq.robot.xml_text import Element, XmlText

if TYPE_CHECKING:
    from torchdq.robot.robot import Robot

ATTRIBUTES = {"damping": "dynamics", "friction": "dynamics"}  # elements of attributes; the others are limits
SIX = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")


def to_urdf(robot: Robot, original: Any) -> str:
    """Text of the URDF file that a robot was read from, with the numbers of the robot.

    Only masses, centres of mass, inertias, damping, friction and limits that differ from the file's are written, with
    all their digits; everything else stays byte for byte. If nothing differs, the text is the original. A link that
    carries others on fixed joints takes on all that changed of their common body, so that the others stay as they are:
    read again, the text gives the robot, with mimic="independent" if it was read so: <mimic> stays in the text; and
    with the same `joints` if it was read with some of them, links beyond the others being carried as on fixed joints at
    zero. Gravity and the tip are no part of a URDF file.

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
    >>> print(robot.replace(mass=1.5 * robot.mass).to_urdf(text)[32:87])
    <link name='b'><inertial><mass value="3.0"/></inertial>
    """
    text = text_of(original)
    options: dict[str, Any] = {"on_unphysical": "ignore", "base": "fixed" if robot.base_mass is None else "floating"}
    first = type(robot).from_urdf(text, **options)
    if first.joint_map is not None and robot.joint_map is None:
        options["mimic"] = "independent"
        first = type(robot).from_urdf(text, **options)
    if robot.joint_map is None and set(robot.joint_names) < set(first.joint_names):
        options["joints"] = robot.joint_names
        first = type(robot).from_urdf(text, **options)
    require_same_tree(robot, first)
    xml = XmlText(text)
    links = {element.attributes.get("name", ""): element for element in xml.root.children if element.tag == "link"}
    joints = {element.attributes.get("name", ""): element for element in xml.root.children if element.tag == "joint"}
    for link, body, changed in changed_bodies(robot, first):
        _write_body(xml, first, links, link, body, changed)
    coupled = set() if first.joint_map is None else _leaders(first)
    for joint, changes in grouped(changed_joints(robot, first)).items():
        _write_joint(xml, joints[joint], changes, joint in coupled)
    written = str(xml)
    if written != text:
        require_read_back(robot, type(robot).from_urdf(written, **options))
    return written


# --- bodies ----------------------------------------------------------------------------------------------------------


def _write_body(
    xml: XmlText,
    first: Robot,
    links: dict[str, Element],
    link: int,
    body: RigidBody,
    changed: tuple[bool, bool, bool],
) -> None:
    """Write the body of a link, less the links on fixed joints that are part of it."""
    poses = {f.name: (tuple(f.X_BF[:4].tolist()), tuple(f.X_BF[4:].tolist())) for f in first.frames if f.link == link}
    carrying = _root(first, links) if link == BASE else first.link_names[link]
    rest = NOTHING
    for name, X in poses.items():
        if name != carrying and name in links:
            rest = merged(rest, _read(links[name].find("inertial"))[0].moved(X))
    inertial = links[carrying].find("inertial")
    own, r = _read(inertial)
    new, alone = own_body(own, rest, body, changed, f"link {carrying!r}", "links on fixed joints")
    turned = new[2] if r == quat.ONE else RigidBody(0.0, quat.ZERO, new[2]).moved((quat.conj(r), (0.0,) * 4)).inertia
    words = {
        "origin": {"xyz": digits(new[1])} if changed[1] or (changed[0] and not alone) else {},
        "mass": {"value": repr(new[0])} if changed[0] or inertial is None else {},
        "inertia": dict(zip(SIX, map(repr, turned), strict=True)) if changed[2] or not alone else {},
    }
    _write(xml, links[carrying], inertial, words)


def _root(first: Robot, links: dict[str, Element]) -> str:
    return next(frame.name for frame in first.frames if frame.link == BASE and frame.name in links)


def _write(xml: XmlText, link: Element, inertial: Element | None, words: dict[str, dict[str, str]]) -> None:
    """Write attributes of the children of <inertial>, all of which may be missing."""
    if inertial is None:
        words = {**words, "inertia": words["inertia"] or dict.fromkeys(SIX, "0")}
        words["origin"] = words["origin"] or {"xyz": "0 0 0"}
        xml.add(link, "<inertial>", *(f"  {_tag(tag, x)}" for tag, x in words.items()), "</inertial>")
        return
    for tag, attributes in words.items():
        child = inertial.find(tag)
        if not attributes:
            continue
        if child is None:
            xml.add(inertial, _tag(tag, attributes))
        else:
            old = child.attributes
            xml.set(child, {key: x for key, x in attributes.items() if key not in old or not _same(old[key], x)})


def _same(old: str, new: str) -> bool:
    return [*map(float, old.split())] == [*map(float, new.split())]


def _tag(tag: str, attributes: dict[str, str]) -> str:
    return f"<{tag} " + " ".join(f'{key}="{x}"' for key, x in attributes.items()) + "/>"


def _read(inertial: Element | None) -> tuple[RigidBody, quat.Quaternion]:
    """Body of an <inertial> element in the frame of its link, and the rotation of the axes of its inertia there."""
    if inertial is None:
        return NOTHING, quat.ONE
    mass, origin, inertia = (inertial.find(tag) for tag in ("mass", "origin", "inertia"))
    values = {} if origin is None else origin.attributes
    X = pose({key: tuple(map(float, values.get(key, "0 0 0").split())) for key in ("xyz", "rpy")})
    moments = tuple(0.0 if inertia is None else float(inertia.attributes[key]) for key in SIX)
    body = RigidBody(0.0 if mass is None else float(mass.attributes["value"]), quat.ZERO, moments)
    return body.moved(X), X[0]


# --- joints ----------------------------------------------------------------------------------------------------------


def _leaders(first: Robot) -> set[str]:
    """Joints that others follow, whose numbers are those of all of them together."""
    S = first.joint_map.S  # type: ignore[union-attr]
    return {name for k, name in enumerate(first.joint_names) if int((S[:, k] != 0).sum()) > 1}


def _write_joint(xml: XmlText, joint: Element, changes: Sequence[ChangedJoint], leads: bool) -> None:
    words: dict[str, dict[str, str]] = {"dynamics": {}, "limit": {}}
    for name, field, old, new in changes:
        tag = ATTRIBUTES.get(field, "limit")
        if field == "armature":
            raise ArgumentError(f"armature of joint {name!r} has no place in a URDF file, found {new:g}")
        if field in ("lower", "upper") and joint.attributes.get("type") == "continuous":
            raise ArgumentError(
                f"{field} limit of joint {name!r} has no place in the file, where it is continuous, "
                f"found {new:g}; make it a revolute joint there"
            )
        element = joint.find(tag)
        given = None if element is None else element.attributes.get(field)
        own = float(given) if given is not None else 0.0
        # what a coordinate has is the sum over the joints that follow it
        words[tag][field] = repr(own + (new - old) if leads and tag == "dynamics" else new)
    for tag, attributes in words.items():
        if attributes and (element := joint.find(tag)) is not None:
            xml.set(element, attributes)
        elif attributes:
            xml.add(joint, _tag(tag, attributes))
