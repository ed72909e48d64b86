"""Positions of the joints of a URDF file that are locked: those that are named, and those that mimic them."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence, Set
from typing import Any

from torchdq.checks import matching, require_number
from torchdq.errors import ArgumentError
from torchdq.robot.arrays import MOST
from torchdq.robot.urdf_document import Document
from torchdq.robot.urdf_elements import MOVING, Mimic

KIND = "movable joint"
NEAR = 1e-6  # [rad or m] a position that close to a limit is within: files are printed with about six digits


def positions(lock: Any, movable: Iterable[str]) -> dict[str, float | None]:
    """Position [rad or m] of every joint that `lock` names.

    Args:
        lock: positions by name or pattern, where a name goes before a pattern, or names or patterns alone.
        movable: names of the joints.

    Returns:
        Positions by name; None: home, where only the name was given.
    """
    movable = tuple(movable)
    if not isinstance(lock, Mapping | Sequence | Set):
        expected = "positions by name, e.g. {'finger': 0.0}, or names of joints to lock at zero"
        raise ArgumentError(f"lock must hold {expected}, found {lock!r}; known: {', '.join(movable)}")
    if not isinstance(lock, Mapping):
        return dict.fromkeys(matching("lock", lock, movable, f"{KIND} to lock"))
    found: dict[str, float | None] = {}
    for pattern in sorted(lock, key=lambda pattern: pattern in movable):
        require_number(f"lock[{pattern!r}]", lock[pattern])
        for name in matching("lock", pattern, movable, f"{KIND} to lock"):
            found[name] = float(lock[pattern])
    return found


def locked(document: Document, joints: Any, lock: Any) -> dict[str, float]:
    """Position [rad or m] of every joint to lock; `Robot.from_urdf` says what is expected.

    A joint that mimics a locked one is locked where the file puts it, unless it is named itself. If the document has
    followers, these are locked with their drivers only.
    """
    movable = [name for name, joint in document.joints.items() if joint.kind in MOVING and name not in document.stuck]
    wanted = positions(() if lock is None else lock, movable)
    bounds = {name: document.joints[name].limits for name in wanted}
    limits = {name: (x["lower"], x["upper"]) for name, x in bounds.items()}
    tell_if_beyond(document.name, wanted, limits, stacklevel=4)
    given = {name: value or 0.0 for name, value in wanted.items()}
    kept = () if joints is None else matching("joints", joints, movable, KIND)
    if both := [name for name in kept if name in given]:
        raise ArgumentError(f"joints and lock must not name the same joint, found {', '.join(both)} in both")
    drivers = [name for name in movable if name not in document.followers]
    at = given if joints is None else {name: 0.0 for name in drivers if name not in kept} | given
    named = {*given, *kept}
    followers: dict[str, list[tuple[str, Mimic]]] = {}
    for name in movable:
        if (mimic := document.joints[name].mimics) is not None and name not in named:
            followers.setdefault(mimic.joint, []).append((name, mimic))
    following = {name for driver in at for name, _ in followers.get(driver, ())}
    leading = [name for name in at if name not in following]
    while leading:
        driver = leading.pop()
        for name, mimic in followers.pop(driver, ()):
            at[name] = mimic.multiplier * at[driver] + mimic.offset
            leading.append(name)
    for argument, names in (("lock", given), ("joints", kept)):
        for name in names:
            driver = document.followers[name].driver if name in document.followers else name
            if (driver in at) != (name in at):
                raise ArgumentError(
                    f"{argument} must not name {name!r} without {driver!r}, which it follows by <mimic>; name "
                    f"{driver!r}, or pass mimic='independent'"
                )
    if movable and joints is not None and not kept:
        raise ArgumentError(f"joints must name at least one joint to keep, found none; known: {', '.join(movable)}")
    require_free(movable, at)
    for name, value in at.items():
        if not abs(value) <= MOST:
            raise ArgumentError(f"lock[{name!r}] must not exceed {MOST:g} in size, found {value:g}")
    return {name: at[name] for name in movable if name in at}


def require_free(movable: Iterable[str], locked: Iterable[str]) -> None:
    """Raise if every joint is locked; a robot that has none to begin with has nothing to lock."""
    movable, locked = tuple(movable), tuple(locked)
    if movable and set(movable) <= set(locked):
        raise ArgumentError(
            f"lock must leave at least one joint free, found that it locks {', '.join(movable)}, which are all (a "
            f"joint that mimics a locked one is locked too); name fewer, or a joint to keep in `joints`"
        )


def notes_of(document: Document, lock: Mapping[str, float]) -> list[str]:
    """Notes about locked joints: their positions, those beyond their limits, and those that should follow others."""
    limits = {name: document.joints[name].limits for name in lock}
    notes = told(lock, {name: (x["lower"], x["upper"]) for name, x in limits.items()})
    held = {*lock, *document.stuck}
    moving = {name for name, joint in document.joints.items() if joint.kind in MOVING and name not in held}
    mimics = ((name, document.joints[name].mimics) for name in lock)
    apart = [name for name, mimic in mimics if mimic and mimic.joint in moving]
    return [*notes, f"locked although the joints that they mimic move: {', '.join(apart)}"] if apart else notes


def told(lock: Mapping[str, float], limits: Mapping[str, tuple[float, float]]) -> list[str]:
    """Notes about positions [rad or m] of locked joints, and about those beyond their limits."""
    if not lock:
        return []
    notes = [f"locked: {', '.join(f'{name} at {value:g}' for name, value in lock.items())}"]
    beyond = _beyond(lock, limits)
    return [*notes, f"locked beyond their limits: {beyond}"] if beyond else notes


def tell_if_beyond(
    robot: str,
    lock: Mapping[str, float | None],
    limits: Mapping[str, tuple[float, float]],
    stacklevel: int,
) -> None:
    """Warn of positions that were asked for and are beyond the limits; None, home, was not asked for."""
    asked = {name: value for name, value in lock.items() if value is not None}
    if beyond := _beyond(asked, {name: limits[name] for name in asked}):
        warnings.warn(
            f"robot {robot!r} is locked beyond its limits: {beyond}; positions are in rad or m, not in degrees",
            stacklevel=stacklevel + 1,
        )


def _beyond(lock: Mapping[str, float], limits: Mapping[str, tuple[float, float]]) -> str:
    """Joints whose positions are beyond their limits, in words; "": none."""
    outside = {name: (low, high) for name, (low, high) in limits.items() if not low - NEAR <= lock[name] <= high + NEAR}
    return "; ".join(f"{name} at {lock[name]:g}, limits [{a:g}, {b:g}]" for name, (a, b) in outside.items())
