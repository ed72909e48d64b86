"""Signed distances of spheres of a robot from the surfaces of objects, from the ground, and from each other.

Pairs are in the order of things: every object with all spheres, then the ground, then spheres on different links.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number, Pure
from torchdq.dynamics import shapes
from torchdq.functions.parametric import TENSOR
from torchdq.functions.posed import frame
from torchdq.functions.recipe import RecipeInputs, Results
from torchdq.robot import ContactPoint, Robot

GROUND = "ground"
Points = Sequence[ContactPoint]
Objects = Sequence[Any]  # templates of `torchdq.objects`


def pairs(robot: Robot, points: Points, objects: Objects, ground: str, own: str) -> tuple[tuple[str, str], ...]:
    """Frame of the sphere, and object, "ground" or frame of the other sphere, of every pair."""
    others = [*(body.name for body in objects), *[GROUND] * bool(ground)]
    between = [(a.frame, b.frame) for a, b in _between(robot, points) if own]
    return (*((point.frame, name) for name in others for point in points), *between)


def _between(robot: Robot, points: Points) -> list[tuple[ContactPoint, ContactPoint]]:
    """Spheres on different links."""
    return [(a, b) for a, b in combinations(points, 2) if robot.frame(a.frame).link != robot.frame(b.frame).link]


def sizes(objects: Objects) -> int:
    """Numbers of all objects that are arguments."""
    return sum(math.prod(axes) for body in objects for _, axes in _arguments(body))


def _arguments(body: Any) -> list[tuple[str, Any]]:
    """Parameters of an object that are arguments, with their axes."""
    return [(name, axes) for name, axes in body.SHAPES.items() if getattr(body, name) is TENSOR]


def distances(x: RecipeInputs, points: Points, objects: Objects, ground: str, own: str) -> Results:
    """Distances of all pairs."""
    robot, at = x.bodies(), dict[ContactPoint, Pure]()
    for point in points:
        link, X_BF = frame(x.robot, point.frame)
        at[point] = robot.position(link, robot.point(link, dq.mul(X_BF, dq.from_pose(quat.ONE, point.center))).position)
    found: list[Number] = []
    for body, (axes, origin) in zip(_bound(objects, x.arguments.get("sizes", ())), _frames(x, objects), strict=True):
        for point in points:
            arm = quat.sub(at[point], origin)
            found.append(body.nearest(tuple(quat.dot(e, arm) for e in axes)).distance - point.radius)
    if ground:
        normal, (height,) = tuple(x.arguments.get("normal", (0.0, 0.0, 1.0))), x.arguments.get("height", (0.0,))
        found += [quat.dot(normal, at[point]) - height - point.radius for point in points]
    if own:
        for a, b in _between(x.robot, points):
            found.append(shapes.ball(a.radius + b.radius, quat.sub(at[a], at[b])).distance)
    return {"distance": found}


def _bound(objects: Objects, row: Sequence[Number]) -> list[Any]:
    """Objects with the numbers of a row instead of their tensors."""
    found, k = [], 0
    for body in objects:
        own = {}
        for name, axes in _arguments(body):
            own[name], k = row[k : k + math.prod(axes)], k + math.prod(axes)
        found.append(body.bound(own))
    return found


def _frames(x: RecipeInputs, objects: Objects) -> list[tuple[Sequence[Pure], Pure]]:
    """Axes and origins of the frames of objects in the world."""
    row = x.arguments.get("X_WO", (1.0, *(0.0,) * 7) * len(objects))
    poses = [(tuple(row[k : k + 4]), tuple(row[k + 4 : k + 8])) for k in range(0, 8 * len(objects), 8)]
    return [(quat.rotation_columns(X[0]), dq.translation(X)) for X in poses]
