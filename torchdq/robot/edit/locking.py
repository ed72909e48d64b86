"""Positions of joints that are locked: read, checked and noted, whatever the robot comes from."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence, Set
from typing import Any

from torchdq.base.checks import matching, require_number
from torchdq.errors import ArgumentError
from torchdq.findings import Finding

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


def to_keep(joints: Any, movable: Collection[str], lock: Collection[str]) -> list[str]:
    """Names of the joints to keep, from names or patterns; raises if there is none, or if `lock` names one of them."""
    found = list(matching("joints", joints, movable, KIND))
    if both := [name for name in found if name in lock]:
        raise ArgumentError(f"joints and lock must not name the same joint, found {', '.join(both)} in both")
    if movable and not found:
        raise ArgumentError(f"joints must name at least one joint to keep, found none; known: {', '.join(movable)}")
    return found


def require_free(movable: Iterable[str], locked: Iterable[str]) -> None:
    """Raise if every joint is locked; a robot that has none to begin with has nothing to lock."""
    movable, locked = tuple(movable), tuple(locked)
    if movable and set(movable) <= set(locked):
        raise ArgumentError(
            f"lock must leave at least one joint free, found that it locks {', '.join(movable)}, which are all (a "
            f"joint that mimics a locked one is locked too); name fewer, or a joint to keep in `joints`"
        )


def lock_notes(lock: Mapping[str, float], limits: Mapping[str, tuple[float, float]]) -> list[Finding]:
    """Notes about positions [rad or m] of locked joints, and about those beyond their limits."""
    if not lock:
        return []
    held = f"locked: {', '.join(f'{name} at {value:g}' for name, value in lock.items())}"
    notes = [Finding("lock", "", held, severity="note")]
    beyond = _beyond(lock, limits)
    if beyond:
        notes.append(Finding("lock.beyond_limits", "", f"locked beyond their limits: {beyond}", severity="note"))
    return notes


def warn_beyond_limits(
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
