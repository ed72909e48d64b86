"""Choosing link frames in which a program costs least: joint axes along z, and most other constants zero.

The frame of a link lies on its joint's axis, its x axis along the common normal to the axis of its main child (the one
with the most links beyond it), as in the modified Denavit-Hartenberg placement. Any frames give the same torques; what
is chosen here only decides how many constants vanish.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from torchdq.algebra import dual_quaternion, screw
from torchdq.dynamics.aligned.tree import Turn
from torchdq.dynamics.tree import BASE
from torchdq.robot.robot import Robot

NEAR = 16 * np.finfo(float).eps  # a direction cosine this close to 0 or 1 is meant to be that
PARALLEL = 1e-6  # axes closer to parallel than this have no common normal worth using
FAR = 10.0  # nor one that lies this many times the robot's size away


class Placement(NamedTuple):
    """Where an aligned frame L lies: on its parent's aligned frame, and in the link's own frame B."""

    gamma: Turn
    alpha: Turn
    offset: float  # added to the joint angle [rad]
    p: tuple[float, ...]  # of L in the parent's aligned frame at home [m]
    pitch: float  # [m/rad]
    R_BL: tuple[tuple[float, ...], ...]  # rows
    p_BL: tuple[float, ...]  # [m]


class Line(NamedTuple):
    """A joint axis in the base frame, at home."""

    point: np.ndarray
    direction: np.ndarray


def clean(x: np.ndarray | float, scale: float = 1.0):
    """x with entries within rounding of 0 or of +-scale made exact."""
    y = np.where(np.abs(x) < NEAR * scale, 0.0, x)
    return np.where(np.abs(np.abs(y) - scale) < NEAR * scale, np.sign(y) * scale, y)


def turn(angle: float) -> Turn:
    """Cosine and sine of an angle, exact where they are meant to be 0 or 1."""
    c, s = clean(np.array([math.cos(angle), math.sin(angle)]))
    return float(c), float(s)


def align(robot: Robot) -> tuple[Placement, ...]:
    """Placement of an aligned frame on every link of a robot without batch axes on its geometry."""
    R_WB, p_WB = _home_poses(robot)
    lines = [_axis(robot, i, R_WB[i], p_WB[i]) for i in range(robot.n)]
    size = max([float(np.linalg.norm(p)) for p in p_WB] + [1e-3])
    main = _main_children(robot)
    R_WL: list[np.ndarray] = []
    p_WL: list[np.ndarray] = []
    result = []
    for i, parent in enumerate(robot.parents):
        R_P, p_P = (np.eye(3), np.zeros(3)) if parent == BASE else (R_WL[parent], p_WL[parent])
        x, origin = _frame(lines, i, main.get(i), R_P[:, 0], p_P, R_WB[i], p_WB[i], size)
        z = lines[i].direction
        R = np.stack([x, np.cross(z, x), z], axis=1)
        R_WL.append(R)
        p_WL.append(origin)
        gamma, alpha, theta = _euler(R_P.T @ R)
        p = clean(R_P.T @ (origin - p_P), size)
        R_BL = clean(R_WB[i].T @ R)
        p_BL = clean(R_WB[i].T @ (origin - p_WB[i]), size)
        s = robot.screw.tolist()[i]
        pitch = sum(a * b for a, b in zip(s[:3], s[3:], strict=True)) if robot.kinds[i] == "helical" else 0.0
        result.append(
            Placement(
                turn(gamma),
                turn(alpha),
                theta,
                tuple(map(float, p)),
                pitch,
                tuple(tuple(map(float, row)) for row in R_BL),
                tuple(map(float, p_BL)),
            )
        )
    return tuple(result)


def _home_poses(robot: Robot) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Rotations and positions of the link frames in the base frame, at home."""
    rotations: list[np.ndarray] = []
    positions: list[np.ndarray] = []
    for parent, x in zip(robot.parents, robot.X_PB_home.tolist(), strict=True):
        a_p, _ = screw.columns((tuple(x[:4]), tuple(x[4:])))
        R: np.ndarray = np.array(a_p).T
        p: np.ndarray = np.array(dual_quaternion.translation((tuple(x[:4]), tuple(x[4:]))))
        if parent != BASE:
            R, p = rotations[parent] @ R, positions[parent] + rotations[parent] @ p
        rotations.append(R)
        positions.append(p)
    return rotations, positions


def _axis(robot: Robot, i: int, R: np.ndarray, p: np.ndarray) -> Line:
    """Axis of joint i in the base frame; a prismatic joint's is laid through its link's origin."""
    s = np.array(robot.screw.tolist()[i])
    if robot.kinds[i] == "prismatic":
        return Line(p, _unit(R @ s[3:]))
    return Line(p + R @ np.cross(s[:3], s[3:]), _unit(R @ s[:3]))


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def _main_children(robot: Robot) -> dict[int, int]:
    """For every link that has children, the one with the most links beyond it."""
    beyond = [1] * robot.n
    for i in reversed(range(robot.n)):
        if robot.parents[i] != BASE:
            beyond[robot.parents[i]] += beyond[i]
    main: dict[int, int] = {}
    for i, parent in enumerate(robot.parents):
        if parent != BASE and (parent not in main or beyond[i] > beyond[main[parent]]):
            main[parent] = i
    return main


def _frame(
    lines: list[Line],
    i: int,
    child: int | None,
    x_P: np.ndarray,
    p_P: np.ndarray,
    R_B: np.ndarray,
    p_B: np.ndarray,
    size: float,
) -> tuple[np.ndarray, np.ndarray]:
    """x axis and origin of link i's aligned frame, in the base frame."""
    line = lines[i]
    z = line.direction
    # unless the child's axis says otherwise: the parent's x axis if it is perpendicular, and no shift along z
    fallback = x_P if abs(x_P @ z) < NEAR else min(np.eye(3), key=lambda e: abs(float(e @ z)))
    x = _unit(fallback - (fallback @ z) * z)
    origin = _foot(line, Line(p_P, x_P))
    if child is not None:
        other = lines[child]
        normal = np.cross(z, other.direction)
        if np.linalg.norm(normal) > PARALLEL:
            foot = _foot(line, other)
            if foot is not None and np.linalg.norm(foot - p_B) < FAR * size:
                return _unit(normal), foot
        else:
            between = other.point - line.point
            between = between - (between @ z) * z
            if np.linalg.norm(between) > NEAR * size:
                x = _unit(between)
    if origin is None or np.linalg.norm(origin - p_B) > FAR * size:
        origin = line.point + ((p_B - line.point) @ z) * z
    return x, origin


def _foot(line: Line, other: Line) -> np.ndarray | None:
    """Point of a line closest to another; None if they are parallel."""
    a, b = line.direction, other.direction
    cross = np.cross(a, b)
    n2 = float(cross @ cross)
    if n2 < PARALLEL**2:
        return None
    return line.point + (np.cross(other.point - line.point, b) @ cross) / n2 * a


def _euler(M: np.ndarray) -> tuple[float, float, float]:
    """Angles of M = R_z(gamma) R_x(alpha) R_z(theta), gamma zero wherever it can be."""
    M = clean(M)
    sine = math.hypot(M[0, 2], M[1, 2])
    if sine == 0.0:
        # R_x(0 or pi) R_z(theta)
        return 0.0, 0.0 if M[2, 2] > 0 else math.pi, math.atan2(-M[0, 1], M[0, 0])
    gamma, alpha = math.atan2(M[0, 2], -M[1, 2]), math.atan2(sine, M[2, 2])
    if abs(gamma) > math.pi / 2:
        gamma, alpha = gamma - math.copysign(math.pi, gamma), -alpha
    # theta is what the other two leave of M, so that it makes up for a gamma that a small alpha leaves ill-defined
    (c, s), (ca, sa) = turn(gamma), turn(alpha)
    theta = math.atan2(ca * (c * M[1, 0] - s * M[0, 0]) + sa * M[2, 0], c * M[0, 0] + s * M[1, 0])
    return gamma, alpha, theta
