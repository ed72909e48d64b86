"""Points at which robots touch the ground: given, or those of the collision shapes of a description."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import product
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.base.checks import matching, require_number, require_object
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot.model import RobotModel

DIGITS = 12  # of a centre [m]
MOST_NAMED = 5  # shapes that are left out, and frames
ROUND = ("sphere", "capsule")  # shapes whose points have a radius


class ContactPoint(NamedTuple):
    """Sphere fixed to a frame of a robot, which can touch the ground; without a radius it is a point."""

    frame: str  # name
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)  # in the frame [m]
    radius: float = 0.0  # [m]
    mobility: Any = ()  # of the robot there, 3 rows in axes of the frame or a number, which scenes compute [1/kg]


def contact_points(robot: RobotModel, pattern: str | Sequence[str]) -> tuple[ContactPoint, ...]:
    """Contact points of the collision elements of a URDF file, or of the geoms of an MJCF file, on some frames.

    A sphere is one point with its radius, a capsule two at its ends, a box its eight corners, and a cylinder four on
    each of its rims. Where a frame has spheres, boxes and cylinders beside them are left out: every point costs time.
    Only geoms that take part in contacts count. What lies between the points does not touch. A warning names what was
    left out, meshes and other shapes without such points, too, and the frames that have no point then.

    Args:
        robot: the robot.
        pattern: name of a frame (a link, also one on a fixed joint, or a body) or of a collision element (a geom), a
            pattern such as "*_foot", or a sequence of them.

    Raises:
        UnknownNameError: no frame with collision elements has such a name.
        ArgumentError: all of these collision elements are meshes, or other shapes that have no such points.

    >>> import torchdq
    >>> sphere = '<collision><origin xyz="0 0 -0.1"/><geometry><sphere radius="0.02"/></geometry></collision>'
    >>> ends = '<joint name="j" type="prismatic"><parent link="base"/><child link="foot"/></joint>'
    >>> text = f'<robot name="leg"><link name="base"/><link name="foot">{sphere}</link>{ends}</robot>'
    >>> torchdq.Robot.from_urdf(text).contact_points("foot")
    (ContactPoint(frame='foot', center=(0.0, 0.0, -0.1), radius=0.02, mobility=()),)
    """
    known = {frame.name for frame in robot.frames if frame.shapes}
    known |= {shape.name for frame in robot.frames for shape in frame.shapes if shape.name}
    chosen = matching("pattern", pattern, sorted(known), f"frame with collision elements of robot {robot.name!r}")
    found: list[ContactPoint] = []
    others: dict[str, str] = {}  # shapes that are left out, and their frames
    for frame in robot.frames:
        own = [x for x in frame.shapes if frame.name in chosen or x.name in chosen]
        kinds = ROUND if any(x.kind == "sphere" for x in own) else (*ROUND, "box", "cylinder")
        taken = [x for x in own if x.kind in kinds]
        others |= {f"{x.kind} on {frame.name!r}": frame.name for x in own if x not in taken}
        for shape in taken:
            radius = shape.size[0] if shape.kind in ROUND else 0.0
            found += [
                ContactPoint(frame.name, _placed(shape.X_FS, p), radius)
                for p in points_of_shape(shape.kind, shape.size)
            ]
    shown, bare = _listed([*others]), [*dict.fromkeys(others.values())]
    bare = [name for name in bare if name not in {point.frame for point in found}]
    points = f"points instead, as in ContactPoint({bare[0]!r}, center=(0.0, 0.0, 0.0), radius=0.02)" if bare else ""
    if not found:
        raise ArgumentError(
            f"collision elements of {pattern!r} of robot {robot.name!r} must be spheres, capsules, boxes or cylinders, "
            f"whose points can touch, found {shown}; put a sphere into the file, or give {points}"
        )
    if others:
        warnings.warn(
            f"contact points of robot {robot.name!r} ({len(found)}) leave out {shown}: meshes have no points, and "
            "spheres serve for boxes and cylinders beside them"
            + (f"; {_listed(bare)} cannot touch without a sphere in the file, or {points}" if bare else ""),
            stacklevel=2,
        )
    return tuple(found)


def _listed(names: Sequence[str]) -> str:
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def points_of(robot: RobotModel, points: Any) -> tuple[ContactPoint, ...]:
    """Contact points as they are, or of names and patterns: of frames without collision elements, their origins."""
    found: list[ContactPoint] = []
    for one in points if isinstance(points, tuple | list) and not isinstance(points, ContactPoint) else (points,):
        if not isinstance(one, str):
            require_contact_point(robot, one)
            found.append(one)
            continue
        try:
            found += contact_points(robot, one)
        except UnknownNameError:
            found += map(ContactPoint, matching("points", one, robot.frame_names, "frame"))
    if not found:
        raise ArgumentError("points must be at least one, found none")
    return tuple(found)


def points_of_shape(kind: str, size: Sequence[Number]) -> list[Pure]:
    """Points at which a shape touches, in its own axes; `size` as of `Shape`, numbers of any kind."""
    if kind == "sphere":
        return [quat.ZERO]
    if kind == "capsule":
        return [(0.0, 0.0, z) for z in (-size[1], size[1])]
    if kind == "box":
        return [*product(*((-x, x) for x in size))]
    a, h = size  # of a cylinder
    return [(x, y, z) for z in (-h, h) for x, y in ((-a, 0.0), (0.0, -a), (0.0, a), (a, 0.0))]


def _placed(X: DualQuaternion, p: Pure) -> Pure:
    """Point in the axes that a pose is given in, without rounding, which programs would multiply by."""
    x, y, z = quat.add(dual_quaternion.translation(X), quat.rotate(X[0], p))
    return (round(x, DIGITS) + 0.0, round(y, DIGITS) + 0.0, round(z, DIGITS) + 0.0)


def require_contact_point(robot: RobotModel, point: ContactPoint) -> None:
    """Raise unless a contact point lies on a frame of a robot, and has the numbers of a sphere."""
    require_object("points", point, ContactPoint, "torchdq.robot.ContactPoint", "ContactPoint('foot', radius=0.02)")
    robot.frame(point.frame)
    what = f"of the contact point on {point.frame!r}"
    if not isinstance(point.center, tuple) or len(point.center) != 3:
        raise ArgumentError(f"center {what} must be a tuple of three numbers [m], found {point.center!r}")
    for x in point.center:
        require_number(f"center {what}", x)
    require_number(f"radius {what}", point.radius, least=0.0)
