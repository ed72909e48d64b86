"""URDF text of a robot without a file of its own: links, joints, bodies and shapes from its numbers alone."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from typing import Any, NamedTuple

import torch

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import ONE, DualQuaternion
from torchdq.algebra.quaternion import ZERO, Pure
from torchdq.dynamics.joints import KINDS, REVOLUTE, Coordinate
from torchdq.dynamics.tree import BASE
from torchdq.robot.arrays import IDENTITY, unused
from torchdq.robot.bodies import body_at
from torchdq.robot.description import Frame, Shape
from torchdq.robot.edit.changed import digits, require_place
from torchdq.robot.model import RobotModel, followed
from torchdq.robot.tree import plain
from torchdq.robot.urdf.elements import ENTRIES

NEAR = 1e-12  # distance of an axis from the frame of its link that is rounding [m]
POLE = 1e-15  # cosine of a pitch whose yaw is rounding
SIZES = {"sphere": ("radius",), "capsule": ("radius", "length"), "cylinder": ("radius", "length"), "box": ()}


class Stem(NamedTuple):
    """Element that carries what is fixed to a link, and the joints of the links that hang on it."""

    name: str
    X_BS: DualQuaternion  # its pose in the frame of the link


def composed(robot: RobotModel) -> str:
    """Text of a robot, as `to_urdf` says, with an element for each frame."""
    turns = robot.armature is not None and bool(robot.armature.any())
    require_place(robot, "URDF", ["armature, which robot.replace(armature=None) leaves out"] if turns else [])
    robot = robot.to(torch.float64, "cpu")
    root = ET.Element("robot", name=robot.name)
    taken, stems = {*robot.frame_names, *robot.every_joint}, dict[int, Stem]()
    for link in (BASE, *range(len(robot.link_names))):
        stems[link] = _add(root, robot, link, stems, taken)
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _add(root: ET.Element, robot: RobotModel, link: int, stems: dict[int, Stem], taken: set[str]) -> Stem:
    """Add a link with its joint and everything that is fixed to it; the joint's axis passes its frame."""
    frames = {x.name: x for x in robot.frames if x.link == link}
    at_origin = [x.name for x in frames.values() if torch.equal(x.X_BF, IDENTITY)]
    point, name = ZERO, at_origin[0] if link == BASE and at_origin else "base"
    if link != BASE:
        s, name = plain(robot, "screw")[link], robot.link_names[link]
        joint = KINDS[robot.kinds[link]]((s[:3], s[3:]))
        if joint.turns and max(map(abs, joint.point)) > NEAR:
            point = joint.point
    own, X_BL = name if name in at_origin else None, dual_quaternion.from_pose(quat.ONE, point)
    first = name if own and point == ZERO else unused(name if point == ZERO else f"{name}_axis", taken)
    element = _element(root, first, frames.pop(first, None))
    if link != BASE or robot.floating:
        _add_body(element, robot, link, point)
    if link != BASE:
        parent, x = stems[robot.parents[link]], 0.0 if robot.home is None else -float(robot.home[link])
        moved = joint.motion(Coordinate(x, math.cos(0.5 * x), math.sin(0.5 * x)))
        X_PB = dual_quaternion.mul(_pose(robot.X_PB_home[link]), moved)
        X_SL = dual_quaternion.mul(dual_quaternion.conj(parent.X_BS), dual_quaternion.mul(X_PB, X_BL))
        element = _joint(root, robot.every_joint[link], robot.kinds[link], parent.name, first, X_SL)
        sign = followed(robot, robot.every_joint[link]).get(robot.every_joint[link], 1.0)  # -1: the opposite axis
        ET.SubElement(element, "axis", xyz=digits(quat.scale(sign, joint.direction)))
        _add_numbers(element, robot, link)
    stem = Stem(first, X_BL)
    for frame in sorted(frames.values(), key=lambda x: x.name != own):
        _element(root, frame.name, frame)
        X_SF = dual_quaternion.mul(dual_quaternion.conj(stem.X_BS), _pose(frame.X_BF))
        _joint(root, unused(f"{frame.name}_fixed", taken), "fixed", stem.name, frame.name, X_SF)
        if frame.name == own:
            stem = Stem(own, ONE)
    return stem


def _element(root: ET.Element, name: str, frame: Frame | None) -> ET.Element:
    """New link with the shapes of its frame."""
    link = ET.SubElement(root, "link", name=name)
    if frame is not None:
        drawn = frame.drawing.shapes
        for tag, shapes in (("visual", () if drawn == frame.shapes else drawn), ("collision", frame.shapes)):
            for shape in shapes:
                _add_shape(link, tag, shape)
    return link


def _add_shape(link: ET.Element, tag: str, shape: Shape) -> None:
    """Add a shape; one that the format has no element for is left out."""
    if not shape.mesh and shape.kind not in SIZES:
        return
    element = ET.SubElement(link, tag, {"name": shape.name} if shape.name else {})
    _origin(element, shape.X_FS)
    geometry = ET.SubElement(element, "geometry")
    if shape.mesh:
        ET.SubElement(
            geometry, "mesh", {"filename": shape.mesh} | ({"scale": digits(shape.size)} if shape.size else {})
        )
    elif shape.kind == "box":
        ET.SubElement(geometry, "box", size=digits(2 * x for x in shape.size))
    else:
        lengths = zip(SIZES[shape.kind], shape.size, (1, 2), strict=False)
        ET.SubElement(geometry, shape.kind, {key: repr(factor * x) for key, x, factor in lengths})


def _add_body(link: ET.Element, robot: RobotModel, i: int, point: Pure) -> None:
    """Add the body of a link, seen from a point of it."""
    mass, com, inertia = (x.tolist() for x in body_at(robot, i))
    if mass or any(inertia):
        inertial = ET.SubElement(link, "inertial")
        ET.SubElement(inertial, "origin", xyz=digits(quat.sub(com, point)))
        ET.SubElement(inertial, "mass", value=repr(mass))
        ET.SubElement(inertial, "inertia", {key: repr(x) for key, x in zip(ENTRIES, inertia, strict=True)})


def _joint(root: ET.Element, name: str, kind: str, parent: str, child: str, X: DualQuaternion) -> ET.Element:
    """New joint between two links."""
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    _origin(joint, X)
    return joint


def _add_numbers(joint: ET.Element, robot: RobotModel, link: int) -> None:
    """Add limits, damping and friction of the coordinate of a joint, or the joint that it follows."""
    ((leader, factor),) = followed(robot, name := robot.every_joint[link]).items()
    k = robot.joint_index(leader)
    factor = 1.0 if leader == name else factor  # the sign of its own is that of the axis
    lower, upper, velocity, effort = (float(x[k]) for x in robot.limits)
    low, high = sorted((factor * lower, factor * upper))
    bounds = {"lower": low, "upper": high, "velocity": abs(factor) * velocity, "effort": effort}
    if joint.get("type") == REVOLUTE and -low == high == math.inf:
        joint.set("type", "continuous")
        del bounds["lower"], bounds["upper"]
    if any(map(math.isfinite, bounds.values())):
        limit = {key: repr(x) for key, x in bounds.items() if math.isfinite(x) or key in ("lower", "upper")}
        ET.SubElement(joint, "limit", limit)
    dynamics = {"damping": float(robot.damping[k]), "friction": float(robot.friction[k])}
    if leader != name:
        ET.SubElement(joint, "mimic", joint=leader, multiplier=repr(factor))
    elif any(dynamics.values()):
        ET.SubElement(joint, "dynamics", {key: repr(x) for key, x in dynamics.items()})


def _origin(parent: ET.Element, X: DualQuaternion) -> None:
    """Add a placement, with roll, pitch and yaw of which those after the yaw make up for its rounding."""
    (x, y, z), b, c = quat.rotation_columns(X[0])
    yaw = math.atan2(y, x) if math.hypot(x, y) > POLE else 0.0
    cos, sin = math.cos(yaw), math.sin(yaw)
    pitch, roll = math.atan2(-z, cos * x + sin * y), math.atan2(sin * c[0] - cos * c[1], cos * b[1] - sin * b[0])
    ET.SubElement(parent, "origin", xyz=digits(dual_quaternion.translation(X)), rpy=digits((roll, pitch, yaw)))


def _pose(x: Any) -> DualQuaternion:
    row = tuple(x.tolist())
    return row[:4], row[4:]
