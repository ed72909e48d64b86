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
            f"lock would fix all joints ({', '.join(movable)}), also those that mimic a locked one; name fewer, or a "
            "joint to keep in `joints`"
        )


def lock_notes(
    robot: str,
    asked: Mapping[str, float | None],
    stand: Mapping[str, float],
    limits: Mapping[str, tuple[float, float]],
    stacklevel: int,
) -> list[Finding]:
    """Notes about locked joints and those beyond their limits, with a warning of what was asked for beyond them.

    Positions are in rad or m; None is home, which was not chosen. `stand` has those of all locked joints.
    """
    if beyond := _beyond({name: x for name, x in asked.items() if x is not None}, limits):
        warnings.warn(
            f"robot {robot!r} is locked beyond its limits: {beyond}; positions are in rad or m, not in degrees",
            stacklevel=stacklevel + 1,
        )
    held = ", ".join(f"{name} at {x:g}" for name, x in stand.items())
    notes = {"lock": f"locked: {held}" if held else ""}
    if beyond := _beyond(stand, limits):
        notes["lock.beyond_limits"] = f"locked beyond their limits: {beyond}"
    return [Finding(code, "", text, severity="note") for code, text in notes.items() if text]


def _beyond(lock: Mapping[str, float], limits: Mapping[str, tuple[float, float]]) -> str:
    """Joints whose positions are beyond their limits, in words; "": none."""
    at = [(name, x, *limits[name]) for name, x in lock.items() if name in limits]
    return "; ".join(f"{n} at {x:g}, limits [{a:g}, {b:g}]" for n, x, a, b in at if not a - NEAR <= x <= b + NEAR)
