"""Distances of points from the surfaces of shapes about the origin, and the outward normals there.

The distance is negative inside, where the normal is that of the nearest face. A rounded shape is a smaller one within a
sphere that rolls around it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number, Pure
from torchdq.numbers.functions import absolute, below, clip, minimum, select, sqrt

NONE = 1e-24  # square of a length beside which that of none counts as zero [m^2]


class Nearest(NamedTuple):
    """Surface of a shape where it is nearest to a point."""

    normal: Pure  # outwards
    distance: Number  # negative inside [m]


def ball(radius: Number, p: Pure) -> Nearest:
    """Surface of a ball."""
    length = sqrt(quat.dot(p, p) + NONE)
    return Nearest(quat.scale(1.0 / length, p), length - radius)


def capsule(radius: Number, half: Number, p: Pure) -> Nearest:
    """Surface of a capsule about the z axis, whose end spheres have their centres at -half and half."""
    x, y, z = p
    return ball(radius, (x, y, z - clip(z, -half, half)))


def box(half: Sequence[Number], radius: Number, p: Pure) -> Nearest:
    """Surface of a box with these half lengths, its edges and corners rounded by a radius."""
    normal, distance = _convex([x - radius for x in half], p)
    return Nearest(tuple(normal), distance - radius)


def cylinder(radius: Number, half: Number, p: Pure) -> Nearest:
    """Surface of a cylinder about the z axis."""
    x, y, z = p
    across = sqrt(x * x + y * y + NONE)
    (out, up), distance = _convex((radius, half), (across, z))
    return Nearest((out / across * x, out / across * y, up), distance)


def _convex(half: Sequence[Number], p: Sequence[Number]) -> tuple[list[Number], Number]:
    """Outward normal and distance of the surface of a box in two or three dimensions."""
    beyond = [x - clip(x, -a, a) for x, a in zip(p, half, strict=True)]
    square = sum([x * x for x in beyond[1:]], beyond[0] * beyond[0])
    outside = below(NONE, square)
    length = sqrt(select(outside, square, 1.0))
    deep = [a - absolute(x) for x, a in zip(p, half, strict=True)]
    normal, left, least = [], 1.0, deep[-1]
    for x in reversed(deep[:-1]):
        least = minimum(x, least)
    for k, (x, d, b) in enumerate(zip(p, deep, beyond, strict=True)):
        # the first of the nearest faces
        nearest = left if k == len(deep) - 1 else left * (1.0 - below(least, d))
        left = left - nearest
        normal.append(select(outside, b / length, nearest * select(below(x, 0.0), -1.0, 1.0)))
    return normal, select(outside, length, -least)
