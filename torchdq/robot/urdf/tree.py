"""Tree of a URDF file in numbers: its moving joints in order, and the place of every link on the link that carries it.

Joints come depth first, those on a link in the alphabetical order of their names: the order of Pinocchio.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from torchdq.algebra import dual_quaternion, screw
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import RigidBody
from torchdq.algebra.quaternion import Pure, Quaternion
from torchdq.dynamics.tree import BASE
from torchdq.robot.bodies import NOTHING, merged
from torchdq.robot.urdf.document import Document
from torchdq.robot.urdf.elements import MOVING, Inertial, Origin, UrdfJoint

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Place(NamedTuple):
    """Place of a link: the moving link that it is a part of, and its pose there."""

    link: int  # -1: the base
    X: DualQuaternion


class UrdfTree(NamedTuple):
    """Moving joints by name, and the places of all links."""

    joints: tuple[str, ...]
    parents: tuple[int, ...]
    X_PB: tuple[DualQuaternion, ...]  # poses of the joints' links in their parents at zero
    places: dict[str, Place]


def tree_of(document: Document, locked: Mapping[str, float]) -> UrdfTree:
    """Tree of a document; joints that are locked [rad or m] are fixed joints."""
    carries: dict[str, list[str]] = {}
    for name in sorted(document.joints, reverse=True):
        carries.setdefault(document.joints[name].parent, []).append(name)
    places = {document.base: Place(BASE, dual_quaternion.ONE)}
    found: list[tuple[str, int, DualQuaternion]] = []
    waiting = list(carries.get(document.base, ()))
    while waiting:
        name = waiting.pop()
        joint = document.joints[name]
        link, X = places[joint.parent]
        X = _unit(dual_quaternion.mul(X, pose(joint.origin)))
        if joint.kind in MOVING and name not in locked:
            places[joint.child] = Place(len(found), dual_quaternion.ONE)
            found.append((name, link, X))
        else:
            if name in locked:
                X = _unit(dual_quaternion.mul(X, _motion(joint, locked[name])))
            places[joint.child] = Place(link, X)
        waiting += carries.get(joint.child, ())
    joints, parents, X_PB = zip(*found, strict=True) if found else ((), (), ())
    return UrdfTree(joints, parents, X_PB, places)


def pose(origin: Origin) -> DualQuaternion:
    """Pose of an origin: roll, pitch and yaw about the fixed x, then y, then z axis."""
    r = quat.ONE
    for axis, angle in zip(AXES, origin["rpy"], strict=True):
        r = quat.mul(_turn(axis, angle), r)
    return dual_quaternion.from_pose(r, origin["xyz"])


def _turn(axis: Pure, angle: float) -> Quaternion:
    return (math.cos(0.5 * angle), *quat.scale(math.sin(0.5 * angle), axis))


def _motion(joint: UrdfJoint, value: float) -> DualQuaternion:
    """Motion of a joint to a position [rad or m]."""
    if MOVING[joint.kind] == "prismatic":
        return screw.exp_prismatic(joint.axis, value)
    return (_turn(joint.axis, value), dual_quaternion.ZERO)


def _unit(X: DualQuaternion) -> DualQuaternion:
    """Pose without the rounding of its norm, with w >= 0."""
    (r, d), n = X, math.sqrt(quat.norm2(X[0]))
    s = math.copysign(1.0 / n, r[0]) if r[0] else 1.0 / n
    return (quat.scale(s, r), quat.scale(s, d))


def lumped(places: Mapping[str, Place], bodies: Mapping[str, Inertial], n: int) -> list[RigidBody]:
    """Bodies of the n moving links and, last, of the base, with all bodies that are fixed to them."""
    found = [NOTHING] * (n + 1)
    for name, (link, X) in places.items():
        if (inertial := bodies.get(name)) is not None:
            X = dual_quaternion.mul(X, pose(inertial.origin))
            body = RigidBody(inertial.mass, quat.ZERO, inertial.inertia)
            found[link] = merged(found[link], body.moved(X))
    return found
