"""Motions of the joints of a URDF file: those that are locked stand still, and those that mimic others follow them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.robot.arrays import MOST
from torchdq.robot.edit.couplings import STILL, Follows
from torchdq.robot.edit.locking import lock_notes, positions, require_free, to_keep
from torchdq.robot.urdf.elements import Elements, UrdfJoint, listed


def motions(
    joints: Mapping[str, UrdfJoint],
    coupled: bool,
    faults: list[Finding],
    held: Mapping[str, float] | None = None,
    kept: Collection[str] | None = None,
) -> list[Follows]:
    """Displacement of every joint by those that move freely, where a follower of a follower follows the first driver.

    Args:
        joints: joints by name.
        coupled: whether joints follow others by <mimic>; otherwise only those of joints that stand still do.
        faults: list to which joints that follow themselves are added.
        held: positions [rad or m] of joints that are locked.
        kept: names of the joints that move; others, unless they follow one, stand at zero; None: all move.
    """
    held = held or {}
    found = {name: STILL for name, joint in joints.items() if not joint.moves}
    leaders = {}  # a joint whose driver is not in the file follows none, and a fixed joint drives at zero
    for joint in joints.values():
        leader = joint.mimic and joints.get(joint.mimic.leader)
        if joint.moves and leader and (leader.moves or coupled):
            leaders[joint.name] = leader.name
    for start in joints:
        path: dict[str, None] = {}
        name: str | None = start
        while name is not None and name not in found and name not in path:
            path[name] = None
            name = None if name in held else leaders.get(name)
        if coupled and name in path:
            circle = [*path][[*path].index(name) :]
            expected, shown = "it must not follow itself by <mimic>", f"the circle {listed(circle)}"
            faults.append(Finding("mimic.circle", f"joint {name!r}", expected, shown))
        for follower in reversed(path):
            joint, by = joints[follower], found.get(leaders.get(follower, ""))
            if follower in held:
                x = Follows(None, 0.0, held[follower])
            elif joint.mimic and by and (coupled or (by.leader is None and follower not in (kept or ()))):
                x = joint.mimic.after(by)
                if coupled and not max(map(abs, x[1:])) <= MOST:
                    expected = f"it must not follow {joint.mimic.leader!r} by more than {MOST:g} times"
                    faults.append(Finding("mimic.large", f"joint {follower!r}", expected))
            else:
                x = Follows(joint.row, 1.0, 0.0) if kept is None or follower in kept else STILL
            found[follower] = x
    return [found[name] for name in joints]


def locked(
    file: Elements, free: Sequence[Follows], coupled: bool, joints: Any, lock: Any
) -> tuple[list[Follows], list[Finding]]:
    """Displacements with some joints locked, as `Robot.from_urdf` says, and notes; `free` are those without.

    A joint that mimics a locked one is locked where the file puts it, unless it is named itself.
    """
    movable = [name for name, x in zip(file.joints, free, strict=True) if x.leader is not None]
    wanted = positions(() if lock is None else lock, movable)
    limits = {name: (file.joints[name].lower, file.joints[name].upper) for name in movable}
    given = {name: value or 0.0 for name, value in wanted.items()}
    kept = None if joints is None else to_keep(joints, movable, given)
    moves = motions(file.joints, coupled, [], given, kept)
    known = [*file.joints.values()]
    for argument, names in (("lock", given), ("joints", kept or ())):
        for name in names:
            row = file.joints[name].row
            driver = known[free[row].leader or 0].name
            apart = moves[free[row].leader or 0].leader is not None if argument == "lock" else moves[row].leader is None
            if apart:
                raise ArgumentError(
                    f"{argument} must not name {name!r} without {driver!r}, which it follows by <mimic>; name "
                    f"{driver!r}, or pass mimic='independent'"
                )
    stand = {name: moves[file.joints[name].row] for name in movable}
    at = {name: x.offset for name, x in stand.items() if x.leader is None}
    require_free(movable, at)
    for name, value in at.items():
        if not abs(value) <= MOST:
            raise ArgumentError(f"lock[{name!r}] must not exceed {MOST:g} in size, found {value:g}")
    return moves, lock_notes(file.name, wanted, at, limits, stacklevel=4)
