"""Choice of aligned link frames for programs with few operations: joint axes along z, most other constants zero.

The origin of a link frame lies on the joint axis, and its x axis along the common normal to the joint axis of the main
child (the child with the most links beyond it), as in the modified Denavit-Hartenberg convention. Torques do not depend
on this choice; it only decides how many constants are zero.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.elementary import Angle
from torchdq.dynamics.aligned.placement import Alignment, Placement
from torchdq.dynamics.general import kinematics
from torchdq.dynamics.tree import Tree

NEAR = 32 * np.finfo(float).eps  # direction cosines this close to 0 or 1 are set to 0 or 1
PARALLEL = 1e-6  # sine of the angle between axes below which their common normal is not used
SMALLEST = 1e-9  # size of a robot in m below which all of its link frames are at one point
FAR = 10.0  # distance of a common normal, in sizes of the robot, above which it is not used


class Axis(NamedTuple):
    """Axis at home, in the link frame of the description."""

    point: np.ndarray
    direction: np.ndarray


class HomeFrame(NamedTuple):
    """Frame at home, in another frame."""

    R: np.ndarray  # its axes are the columns
    p: np.ndarray  # its origin


def clean(x: np.ndarray | float, scale: float = 1.0):
    """Array x with entries set to 0 or to +-scale where they are within rounding of it."""
    y = np.where(np.abs(x) < NEAR * scale, 0.0, x)
    return np.where(np.abs(np.abs(y) - scale) < NEAR * scale, np.sign(y) * scale, y)


def cos_sin(angle: float) -> Angle:
    """Cosine and sine of an angle, set to 0, 1 or -1 where they are within rounding of it."""
    c, s = clean(np.array([math.cos(angle), math.sin(angle)]))
    return float(c), float(s)


def align(tree: Tree) -> tuple[Alignment, ...]:
    """Constants of the moving links, in aligned frames, of a tree in link frames with floats as numbers.

    Every frame is found in the axes of its link, from the parent and the main child alone: positions in the base frame
    of a robot far from it have fewer digits than those of its links relative to each other.
    """
    X_WB = kinematics.link_poses(tree, [link.placement for link in tree.links])
    X_PB = [HomeFrame(np.eye(3), np.zeros(3)), *(_frame_of(link.placement) for link in tree.links[1:])]
    lines = [Axis(np.zeros(3), np.array([0.0, 0.0, 1.0]))]  # the base keeps its frame
    lines += [Axis(np.array(link.joint.point), _unit(np.array(link.joint.direction))) for link in tree.links[1:]]
    size, main = _size(tree, X_PB), _main_children(tree)
    X_BL, result = [HomeFrame(np.eye(3), np.zeros(3))], []
    for i, link in enumerate(tree.links[1:], 1):
        at, above = X_PB[i], X_BL[link.parent]
        from_above = at.p - above.p  # from the origin of the parent's aligned frame to that of the link frame
        far = max(size, float(np.linalg.norm(from_above)))
        beyond = None
        if i in main:  # the axis of the main child, in this link
            child, line = X_PB[main[i]], lines[main[i]]
            beyond = Axis(child.p + child.R @ line.point, child.R @ line.direction)
        x_above = Axis(-at.R.T @ from_above, at.R.T @ above.R[:, 0])
        x, origin = _frame(lines[i], beyond, x_above, _frame_of(X_WB[i]).R, size)
        z = lines[i].direction
        x = _across(x, z)
        R = np.stack([x, np.cross(z, x), z], axis=1)
        X_BL.append(HomeFrame(R, origin))
        gamma, alpha, theta = _euler(above.R.T @ at.R @ R)
        p, shift = _along_axes(clean(above.R.T @ (from_above + at.R @ origin), far), gamma, alpha, size)
        R_BL, p_BL = clean(R), clean(origin, size)
        result.append(
            Alignment(
                Placement(p, cos_sin(gamma), cos_sin(alpha), shift),
                Placement(p, cos_sin(gamma / 2), cos_sin(alpha / 2), shift),
                theta,
                cos_sin(theta),
                tuple(tuple(map(float, row)) for row in R_BL),
                tuple(map(float, p_BL)),
                type(link.joint)(screw.ad(screw.columns(X_WB[i]), link.joint.screw)),  # in the base frame
                _pose(R_BL.T, -R_BL.T @ p_BL),
                X_WB[i],
            )
        )
    return tuple(result)


def _frame_of(x: DualQuaternion) -> HomeFrame:
    r = tuple(_unit(np.array(x[0])).tolist())
    return HomeFrame(np.array(quat.rotation_columns(r)).T, np.array(dq.translation(x)))


def _size(tree: Tree, X_PB: list[HomeFrame]) -> float:
    """Largest distance of a link frame from that of the first link of its branch; a metre if there is none.

    The distance of the first links from the base is not part of the robot's size.
    """
    own = [HomeFrame(np.eye(3), np.zeros(3))] * len(X_PB)
    for i, link in enumerate(tree.links[1:], 1):
        if link.parent:
            above = own[link.parent]
            own[i] = HomeFrame(above.R @ X_PB[i].R, above.p + above.R @ X_PB[i].p)
    size = max(float(np.linalg.norm(frame.p)) for frame in own)
    return size if size > SMALLEST else 1.0


def _pose(R: np.ndarray, p: np.ndarray) -> DualQuaternion:
    """Pose of a rotation matrix and a position, exact for rotations by quarter turns."""
    # in numpy, since robots are also aligned within transforms of torch
    candidates: np.ndarray = np.array(quat.from_rotation_rows(R.tolist()))
    r = _unit(candidates[np.argmax(np.diagonal(candidates))])
    return dq.from_pose(tuple(map(float, clean(r))), tuple(map(float, p)))


def _along_axes(p: np.ndarray, gamma: float, alpha: float, size: float) -> tuple[tuple[float, ...], float]:
    """Translation in the parent's axes, and along the joint axis, that together are p.

    The second one saves operations unless the axes are parallel or perpendicular.
    """
    s, c = math.sin(alpha), math.cos(alpha)
    (cg, sg), whole = cos_sin(gamma), tuple(map(float, p))
    across = cg * p[1] - sg * p[0]
    if abs(s) < NEAR or abs(c) < NEAR or abs(across) > FAR * size * abs(s) or across == 0:
        return whole, 0.0
    shift = -float(across) / s
    rest = p - shift * np.array([sg * s, -cg * s, c])
    return tuple(map(float, clean(np.where(np.abs(rest) < 4 * NEAR * size, 0.0, rest), size))), shift


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def _across(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Unit vector perpendicular to z up to rounding, near x.

    A common normal of axes that are close together is a small difference, whose rounding error is not perpendicular.
    """
    for _ in range(2):
        x = _unit(x - (x @ z) * z)
    return x


def _main_children(tree: Tree) -> dict[int, int]:
    """Main child of every moving link that has children: the one with the most links beyond it."""
    links = tree.links
    beyond = [1] * len(links)
    for i in reversed(range(1, len(links))):
        beyond[links[i].parent] += beyond[i]
    main: dict[int, int] = {}
    for i, link in enumerate(links):
        parent = link.parent
        if parent > 0 and (parent not in main or beyond[i] > beyond[main[parent]]):
            main[parent] = i
    return main


def _frame(
    line: Axis, beyond: Axis | None, x_above: Axis, base: np.ndarray, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Direction of the x axis and origin of a link's aligned frame, in its link frame.

    From the axis of its joint, that of its main child's joint, the x axis above, and the axes of the base, as rows.
    """
    z, x_P = line.direction, x_above.direction
    # without a common normal to the child's axis: the parent's x axis if it is perpendicular, and no shift along z
    fallback = x_P if abs(x_P @ z) < NEAR else min(base, key=lambda e: abs(float(e @ z)))
    x = _unit(fallback - (fallback @ z) * z)
    origin = _foot(line, x_above)
    if beyond is not None:
        normal = np.cross(z, beyond.direction)
        if np.linalg.norm(normal) > PARALLEL:
            foot = _foot(line, beyond)
            if foot is not None and np.linalg.norm(foot) < FAR * size:
                return _unit(normal), foot
        else:
            between = beyond.point - line.point
            between = between - (between @ z) * z
            if np.linalg.norm(between) > NEAR * size:
                x = _unit(between)
    if origin is None or np.linalg.norm(origin) > FAR * size:
        origin = line.point - (line.point @ z) * z
    return x, origin


def _foot(line: Axis, other: Axis) -> np.ndarray | None:
    """Point of a line closest to another line; None if they are parallel."""
    a, b = line.direction, other.direction
    cross = np.cross(a, b)
    n2 = float(cross @ cross)
    if n2 < PARALLEL**2:
        return None
    return line.point + (np.cross(other.point - line.point, b) @ cross) / n2 * a


def _euler(M: np.ndarray) -> tuple[float, float, float]:
    """Angles of M = R_z(gamma) R_x(alpha) R_z(theta), with gamma = 0 if possible."""
    M = clean(M)
    sine = math.hypot(M[0, 2], M[1, 2])
    if sine == 0.0:
        # R_x(0 or pi) R_z(theta)
        return 0.0, 0.0 if M[2, 2] > 0 else math.pi, math.atan2(-M[0, 1], M[0, 0])
    gamma, alpha = math.atan2(M[0, 2], -M[1, 2]), math.atan2(sine, M[2, 2])
    if abs(gamma) > math.pi / 2:
        gamma, alpha = gamma - math.copysign(math.pi, gamma), -alpha
    # theta from M and the other two, which corrects the error of gamma where a small alpha makes it ill-conditioned
    (c, s), (ca, sa) = cos_sin(gamma), cos_sin(alpha)
    theta = math.atan2(ca * (c * M[1, 0] - s * M[0, 0]) + sa * M[2, 0], c * M[0, 0] + s * M[1, 0])
    return gamma, alpha, theta
