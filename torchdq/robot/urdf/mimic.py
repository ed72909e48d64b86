"""Mimic joints of a URDF file, which follow others, and the coordinates that are left."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from torchdq.robot.arrays import MOST, double
from torchdq.robot.description import JointMap
from torchdq.robot.urdf.elements import MOVING, UrdfJoint, listed

NEAR = 1e-6  # difference of limits that is not told: files are printed with about six digits


class Driven(NamedTuple):
    """Joint that follows a driver, at factor times its position plus offset; the driver follows none."""

    driver: str
    factor: float
    offset: float  # [rad or m]


def followers(joints: Mapping[str, UrdfJoint], faults: list[str]) -> dict[str, Driven]:
    """Moving joints that follow others, by name, where a follower of a follower follows the first driver.

    A driver that is a fixed joint stays at zero, and a joint whose driver is not in the file follows none.
    """
    known = {name: Driven(name, 1.0, 0.0) for name, joint in joints.items() if not _follows(joint, joints)}
    lost: set[str] = set()  # joints that lead to a circle
    for name in joints:
        path: dict[str, None] = {}
        while name not in known and name not in lost and name not in path:
            path[name] = None
            name = joints[name].mimics.joint  # type: ignore[union-attr]
        if name not in known:
            if name in path:
                circle = [*path][[*path].index(name) :]
                faults.append(
                    f"joint {name!r}: it must not follow itself by <mimic>, found the circle {listed(circle)}"
                )
            lost.update(path)
            continue
        for follower in reversed(path):
            _, multiplier, offset = joints[follower].mimics  # type: ignore[misc]
            driver = known[name]
            known[follower] = Driven(driver.driver, multiplier * driver.factor, multiplier * driver.offset + offset)
            if not max(map(abs, known[follower][1:])) <= MOST:
                faults.append(f"joint {follower!r}: it must not follow {driver.driver!r} by more than {MOST:g} times")
            name = follower
    return {name: follows for name, follows in known.items() if follows.driver != name}


def _follows(joint: UrdfJoint, joints: Mapping[str, UrdfJoint]) -> bool:
    return joint.kind in MOVING and joint.mimics is not None and joint.mimics.joint in joints


def stuck(joints: Mapping[str, UrdfJoint], follow: Mapping[str, Driven]) -> dict[str, float]:
    """Positions [rad or m] of followers that never move: their factor is zero, or their driver is a fixed joint."""
    return {
        name: follows.offset
        for name, follows in follow.items()
        if follows.factor == 0 or joints[follows.driver].kind not in MOVING
    }


class Coordinates(NamedTuple):
    """Coordinates of a robot, one per driver."""

    joints: dict[str, UrdfJoint]  # limits, damping and friction are those of the coordinate
    joint_map: JointMap | None
    home: tuple[float, ...] | None  # [links] in the order of the map
    notes: list[str]


def coordinates(joints: Mapping[str, UrdfJoint], follow: Mapping[str, Driven]) -> Coordinates:
    """Coordinates of the moving joints, given in their order; no driver is missing among them."""
    reduced = {name: joint for name, joint in joints.items() if name not in follow}
    if len(reduced) == len(joints):
        return Coordinates(reduced, None, None, [])
    column = {name: k for k, name in enumerate(reduced)}
    rows = [follow.get(name, Driven(name, 1.0, 0.0)) for name in joints]
    S = [[0.0] * len(reduced) for _ in rows]
    left_out = []
    for row, (name, joint), (driver, factor, offset) in zip(S, joints.items(), rows, strict=True):
        row[column[driver]] = factor
        if name != driver:
            own = reduced[driver]
            limits = _narrowed(own.limits, joint.limits, factor, offset)
            if _room(own.limits) and not _room(limits):
                left_out.append(name)
                limits = own.limits
            reduced[driver] = own._replace(
                limits=limits,
                damping=own.damping + factor * factor * joint.damping,
                friction=own.friction + abs(factor) * joint.friction,
            )
    narrowed = [change for name, joint in reduced.items() for change in _changes(joints[name], joint, name)]
    notes = {
        "mimic joints follow others": [_told(name, follow[name]) for name in joints if name in follow],
        "limits narrowed to those of followers": narrowed,
        "limits of followers that leave their drivers no room, left out": left_out,
    }
    home = tuple(0.0 - follows.offset for follows in rows)
    return Coordinates(
        reduced,
        JointMap(tuple(joints), double(S)),
        home if any(home) else None,
        [f"{note}: {', '.join(found)}" for note, found in notes.items() if found],
    )


def _told(name: str, follows: Driven) -> str:
    offset = f" {'-' if follows.offset < 0 else '+'} {abs(follows.offset):g}" if follows.offset else ""
    return f"{name} = {follows.factor:g} {follows.driver}{offset}"


def _narrowed(limits: dict[str, float], others: dict[str, float], factor: float, offset: float) -> dict[str, float]:
    """Limits of a driver that its follower keeps to its own as well."""
    low, high = sorted((others[key] - offset) / factor for key in ("lower", "upper"))
    return limits | {
        "lower": max(limits["lower"], low),
        "upper": min(limits["upper"], high),
        "velocity": min(limits["velocity"], others["velocity"] / abs(factor)),
    }


def _changes(before: UrdfJoint, after: UrdfJoint, name: str) -> list[str]:
    """Limits that are narrower than before, in words."""
    pairs = ((key, before.limits[key], value) for key, value in after.limits.items())
    return [f"{name} {key} {old:g} to {new:g}" for key, old, new in pairs if not math.isclose(old, new, abs_tol=NEAR)]


def _room(limits: dict[str, float]) -> bool:
    return limits["lower"] < limits["upper"] and limits["velocity"] > 0
