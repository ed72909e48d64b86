"""MJCF text of a robot without a file of its own: bodies, joints, couplings and shapes from its numbers alone."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence

import numpy as np
import torch

from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion, translation
from torchdq.algebra.inertia import Six
from torchdq.dynamics.joints import KINDS
from torchdq.dynamics.tree import BASE
from torchdq.robot.arrays import IDENTITY, double, matrices, unused
from torchdq.robot.bodies import body_at
from torchdq.robot.edit.changed import digits, require_place
from torchdq.robot.mjcf.links import SIZES
from torchdq.robot.model import RobotModel, followed
from torchdq.robot.tree import plain

WORLD = "world"  # name of the body that MuJoCo has by itself


def composed(robot: RobotModel) -> str:
    """Text of a robot, as `to_mjcf` says, with a body for each frame."""
    require_place(robot, "MJCF")
    robot = robot.to(torch.float64, "cpu")
    root = ET.Element("mujoco", model=robot.name)
    ET.SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
    ET.SubElement(root, "option", gravity=digits([0.0] * 3 if robot.gravity is None else robot.gravity.tolist()))
    world, equality = ET.SubElement(root, "worldbody"), ET.Element("equality")
    taken, bodies = {*robot.frame_names}, {BASE: world}
    for link in (BASE, *range(len(robot.link_names))):
        frames = {x.name: x for x in robot.frames if x.link == link}
        at_origin = [name for name, x in frames.items() if torch.equal(x.X_BF, IDENTITY)]
        if link != BASE or robot.floating:
            name = robot.link_names[link] if link != BASE else at_origin[0] if at_origin else "base"
            name = name if name in at_origin else unused(name, taken)
            X = IDENTITY if link == BASE else robot.X_PB_home[link]
            parent = world if link == BASE else bodies[robot.parents[link]]
            bodies[link] = _body(parent, name, X.tolist())
            _add_inertia(bodies[link], robot, link)
            if link == BASE:
                ET.SubElement(bodies[link], "freejoint")
            else:
                _add_joint(bodies[link], equality, robot, link)
        for name, frame in frames.items():
            at = bodies[link]
            if name not in (at.get("name"), WORLD):
                at = _body(at, name, frame.X_BF.tolist())
            for shape in frame.shapes:
                if shape.kind in SIZES:
                    words = {"name": shape.name} if shape.name else {}
                    words |= {"type": shape.kind, "size": digits(shape.size)}
                    ET.SubElement(at, "geom", words | _placed(shape.X_FS))
    root.extend([equality] if len(equality) else [])
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _body(parent: ET.Element, name: str, X: Sequence[float]) -> ET.Element:
    """New body with a pose in that of its parent."""
    return ET.SubElement(parent, "body", {"name": name} | _placed((tuple(X[:4]), tuple(X[4:]))))


def _placed(X: DualQuaternion) -> dict[str, str]:
    return {"pos": digits(translation(X)), "quat": digits(X[0])}


def _add_inertia(body: ET.Element, robot: RobotModel, link: int) -> None:
    """Add the inertia of a link."""
    mass, com, inertia = (x.tolist() for x in body_at(robot, link))
    if mass or any(inertia):
        words = {"pos": digits(com), "mass": repr(mass)}
        ET.SubElement(body, "inertial", words | principal(inertia))


def principal(moments: Six) -> dict[str, str]:
    """Principal axes and moments of an inertia; MuJoCo's own search for those of a full one stops at twelve digits."""
    values, axes = np.linalg.eigh(matrices(double(moments)).numpy())
    axes[:, 0] *= np.linalg.det(axes)
    r = max(quat.from_rotation_rows(tuple(map(tuple, axes.tolist()))), key=quat.norm2)
    r = quat.scale(1.0 / math.sqrt(quat.norm2(r)), r)
    return {"quat": digits(r), "diaginertia": digits(values.tolist())}


def _add_joint(body: ET.Element, equality: ET.Element, robot: RobotModel, link: int) -> None:
    """Add the joint that carries a link, with the numbers of its coordinate, or the coordinate that it follows."""
    s, name = plain(robot, "screw")[link], robot.every_joint[link]
    joint, ((leader, factor),) = KINDS[robot.kinds[link]]((s[:3], s[3:])), followed(robot, name).items()
    homes = dict.fromkeys(robot.every_joint, 0.0)
    if robot.home is not None:
        homes = dict(zip(homes, robot.home.tolist(), strict=True))
    k, sign = robot.joint_index(leader), followed(robot, leader)[leader]
    turned = sign if leader == name else 1.0  # a coordinate that turns the other way is about the opposite axis
    words = {"name": name, "type": "hinge" if joint.turns else "slide", "ref": repr(turned * homes[name])}
    words["axis"] = digits(quat.scale(turned, joint.direction))
    if joint.turns:
        words["pos"] = digits(joint.point)
    if leader != name:
        shift = factor * sign * homes[leader] - homes[name]
        coefficients = digits((shift, factor, 0.0, 0.0, 0.0))
        ET.SubElement(equality, "joint", joint1=name, joint2=leader, polycoef=coefficients)
    else:
        lower, upper, _, effort = (float(x[k]) for x in robot.limits)
        words |= {"range": digits((lower, upper))} if math.isfinite(upper - lower) else {}
        words |= {"actuatorfrcrange": digits((-effort, effort))} if math.isfinite(effort) else {}
        numbers = {"damping": robot.damping, "frictionloss": robot.friction, "armature": robot.armature}
        words |= {key: repr(float(x[k])) for key, x in numbers.items() if x is not None and x[k]}
    ET.SubElement(body, "joint", words)
