"""URDF text of a robot: the text that it was read from with the numbers that were changed since, or a new one."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from functools import partial
from typing import Any

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.inertia import RigidBody, Six
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot.check import consistency
from torchdq.robot.description import Base
from torchdq.robot.edit.changed import ChangedBody, ChangedJoint, Elements, Place, rewritten, set_in
from torchdq.robot.model import RobotModel, factors
from torchdq.robot.urdf.composed import composed
from torchdq.robot.urdf.document import text_of
from torchdq.robot.urdf.elements import ENTRIES, Inertial, elements
from torchdq.robot.urdf.read import physical, read
from torchdq.robot.urdf.segments import body_of, pose
from torchdq.robot.xml_text import parsed, written


def to_urdf(robot: RobotModel, original: Any = None) -> str:
    """URDF text of a robot: of the file that it was read from, with the numbers of the robot, or a new one.

    Of the original, only masses, centres of mass, inertias, damping, friction and limits that differ from the file's
    are written, with all their digits; all other elements and the comments stay. If nothing differs, the text is the
    original. A link that carries others on fixed joints takes on all that changed of their common body, so that the
    others stay as they are; inertias that were repaired are each written on their own link. Read again, the text gives
    the robot, with mimic="independent" if it was read so: <mimic> stays in the text; and with the same `joints` if it
    was read with some of them, links beyond the others being carried as on fixed joints at zero. Gravity and the tip
    are not part of a URDF file.

    A new text has every joint, body, frame and shape of the robot, to rounding. Frames are links on fixed joints. Where
    a joint's axis misses the frame of its link, as in the standard convention of Denavit and Hartenberg, the joint
    moves a link NAME_axis without a frame in the robot, and the link itself is fixed to it. A joint whose coordinate
    turns it backwards (`couple`) has the opposite axis, and zero is that of the coordinates. Read again, joints are in
    the order of `from_urdf`: from the base on, those on one link by their names. A floating base is read with
    base="floating". Joints without limits of position are continuous; many other readers need limits of velocity and
    effort with them.

    Args:
        robot: the robot, with all joints of the file, or those that it was read with.
        original: the file that it was read from, as in `from_urdf`; None: a new text, for a robot from a table, from
            screws or from another format, or one that was locked, cut or put together.

    Raises:
        ArgumentError: the robot has other links, joints or frames than the original (it was cut, or locked elsewhere
            than at zero), or numbers that have no place there: rotor inertia, infinite limits, less mass than the
            links on fixed joints alone. A new text has no place for helical joints, rotor inertia, closures, and
            couplings of joints that are not to one joint.

    >>> import torchdq
    >>> text = (
    ...     "<robot name='r'><link name='a'/><link name='b'><inertial><mass value='2'/>"
    ...     "</inertial></link><joint name='j' type='prismatic'><parent link='a'/>"
    ...     "<child link='b'/><limit upper='1'/></joint></robot>"
    ... )
    >>> robot = torchdq.Robot.from_urdf(text)
    >>> print(robot.replace(mass=1.5 * robot.mass).to_urdf(text)[33:89])
    <link name="b"><inertial><mass value="3.0" /></inertial>
    >>> arm = torchdq.Robot.from_dh(a=[0.4], alpha=[0.0], d=[0.1], theta=[0.0])
    >>> torchdq.Robot.from_urdf(arm.to_urdf(), on_unphysical="ignore").frame_names
    ('base', 'link1_axis', 'link1', 'tip')
    """
    if original is None:
        return composed(robot)
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
    return rewritten(robot, text, partial(read_as, **options), UrdfElements)


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
            _set_moments(link.find("inertial"), new.inertia)
    return written(root, text)


class UrdfElements(Elements):
    """Elements of a URDF file, from which a robot was read."""

    MASS, COM = ("mass", "value"), ("origin", "xyz")
    FIXED = "links on fixed joints"

    def __init__(self, root: ET.Element, first: RobotModel):
        self.first, self.described = first, elements(root).links
        self.links, self.joints = ({x.get("name", ""): x for x in root.findall(tag)} for tag in ("link", "joint"))

    def places(self, changed: ChangedBody) -> list[Place]:
        """Link that a joint moves, and those on fixed joints that are part of it."""
        link, first = changed.link, self.first
        parts = {x.name: tuple(x.X_BF.tolist()) for x in first.frames if x.link == link and x.name in self.links}
        carrying = next(iter(parts)) if link == BASE else first.link_names[link]
        X_BF = {carrying: dual_quaternion.ONE} | {name: (X[:4], X[4:]) for name, X in parts.items() if name != carrying}
        bodies = {name: _in_link(self.described[name]).moved(X) for name, X in X_BF.items()}
        return [Place(f"link {name!r}", self.links[name], body) for name, body in bodies.items()]

    def set_inertia(self, place: Place, inertial: ET.Element, moments: Six) -> None:
        """Write an inertia in the axes of its origin."""
        own = self.described[place.element.get("name", "")]
        if own is not None and (r := pose(own.origin)[0]) != quat.ONE:
            moments = RigidBody(0.0, quat.ZERO, moments).moved((quat.conj(r), (0.0,) * 4)).inertia
        _set_moments(inertial, moments)

    def set_joint(self, name: str, changes: Sequence[ChangedJoint]) -> None:
        """Write numbers of a joint; what a coordinate has is the sum over the joints that share it."""
        joint, shared = self.joints[name], int((factors(self.first)[:, self.first.joint_index(name)] != 0).sum()) > 1
        for field, old, new in changes:
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
            set_in(joint, tag, field, repr(own + (new - old) if shared and tag == "dynamics" else new))


def _in_link(inertial: Inertial | None) -> RigidBody:
    body, X = body_of(inertial)
    return body.moved(X)


def _set_moments(inertial: Any, moments: Six) -> None:
    for entry, x in zip(ENTRIES, moments, strict=True):
        set_in(inertial, "inertia", entry, repr(x))
