"""Positions of the joints of a URDF file that are locked: those that are named, and those that mimic them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchdq.errors import ArgumentError
from torchdq.robot.arrays import MOST
from torchdq.robot.edit.locking import lock_notes, positions, require_free, to_keep, warn_beyond_limits
from torchdq.robot.urdf.document import Document
from torchdq.robot.urdf.elements import MOVING, Mimic


def locked(document: Document, joints: Any, lock: Any) -> dict[str, float]:
    """Position [rad or m] of every joint to lock; `Robot.from_urdf` says what is expected.

    A joint that mimics a locked one is locked where the file puts it, unless it is named itself. If the document has
    followers, these are locked with their drivers only.
    """
    movable = [name for name, joint in document.joints.items() if joint.kind in MOVING and name not in document.stuck]
    wanted = positions(() if lock is None else lock, movable)
    bounds = {name: document.joints[name].limits for name in wanted}
    limits = {name: (x["lower"], x["upper"]) for name, x in bounds.items()}
    warn_beyond_limits(document.name, wanted, limits, stacklevel=4)
    given = {name: value or 0.0 for name, value in wanted.items()}
    chosen = () if joints is None else to_keep(joints, movable, given)
    drivers = [name for name in movable if name not in document.followers]
    at = given if joints is None else {name: 0.0 for name in drivers if name not in chosen} | given
    named = {*given, *chosen}
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
    for argument, names in (("lock", given), ("joints", chosen)):
        for name in names:
            driver = document.followers[name].driver if name in document.followers else name
            if (driver in at) != (name in at):
                raise ArgumentError(
                    f"{argument} must not name {name!r} without {driver!r}, which it follows by <mimic>; name "
                    f"{driver!r}, or pass mimic='independent'"
                )
    require_free(movable, at)
    for name, value in at.items():
        if not abs(value) <= MOST:
            raise ArgumentError(f"lock[{name!r}] must not exceed {MOST:g} in size, found {value:g}")
    return {name: at[name] for name in movable if name in at}


def notes_of(document: Document, lock: Mapping[str, float]) -> list[str]:
    """Notes about locked joints: their positions, those beyond their limits, and those that should follow others."""
    limits = {name: document.joints[name].limits for name in lock}
    notes = lock_notes(lock, {name: (x["lower"], x["upper"]) for name, x in limits.items()})
    held = {*lock, *document.stuck}
    moving = {name for name, joint in document.joints.items() if joint.kind in MOVING and name not in held}
    mimics = ((name, document.joints[name].mimics) for name in lock)
    apart = [name for name, mimic in mimics if mimic and mimic.joint in moving]
    return [*notes, f"locked although the joints that they mimic move: {', '.join(apart)}"] if apart else notes
