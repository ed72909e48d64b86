"""Robots with some joints locked, and chains between two frames of a robot.

Masses, centres of mass and inertias keep their batch axes and gradients, so a batch of robots is reduced as a whole.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

from torchdq import dq
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.robot.arrays import IDENTITY
from torchdq.robot.edit.locking import lock_notes, positions, require_free
from torchdq.robot.edit.rebuilt import rebuilt
from torchdq.robot.fields import BASE_BODY
from torchdq.robot.model import AnyRobot, RobotModel, batches, factors, followed, sum_of


def lock(robot: AnyRobot, lock: Mapping[str, float] | Sequence[str] | str) -> AnyRobot:
    """Robot with some joints fixed, whose links become parts of those before them, or of a floating base.

    Joints that follow only locked coordinates are fixed with them.

    Args:
        robot: the robot.
        lock: positions [rad or m] of the joints, by name or pattern ("finger*"), or names or patterns alone: at home.
            Positions beyond the limits are warned of. Joints that mimic a locked one are locked with it, unless the
            robot was loaded with mimic="independent".

    >>> import torchdq
    >>> torchdq.robots.load("two_link").lock({"joint2": 0.5}).joint_names
    ('joint1',)
    """
    _require_constant_geometry(robot)
    _require_coordinates(robot, lock)
    given = positions(lock, robot.joint_names)
    require_free(robot.joint_names, given)
    S = factors(robot)
    fixed = [name for name in robot.joint_names if name in given]
    at = {name: _home_of(robot, name) if (x := given[name]) is None else x for name in fixed}
    placed = S @ S.new_tensor([at.get(name, 0.0) for name in robot.joint_names])  # by the locked coordinates alone
    coordinates = [k for k, name in enumerate(robot.joint_names) if name not in given]
    own = IDENTITY.to(robot.screw)
    places, links = {BASE: (BASE, own)}, list[int]()
    for i, parent in enumerate(robot.parents):
        if S[i, coordinates].any():
            places[i] = len(links), own
            links.append(i)
        else:
            carrier, X = places[parent]
            displacement = placed[i] if robot.home is None else placed[i] - robot.home[i]
            moved = dq.exp(0.5 * displacement * robot.screw[i])
            places[i] = carrier, dq.mul(dq.mul(X, robot.X_PB_home[i]), moved)
    stand = {name: float(placed[i]) for i, name in enumerate(robot.every_joint) if i not in links} | at
    lower, upper = (x.reshape(-1, robot.n) for x in robot.limits[:2])  # the narrowest, if robots differ
    ranges = dict(zip(robot.joint_names, zip(lower.amax(0).tolist(), upper.amin(0).tolist(), strict=True), strict=True))
    limits = {name: ranges[name] for name in at}
    changes: dict[str, Any] = {"notes": (*robot.notes, *lock_notes(robot.name, given, stand, limits, stacklevel=2))}
    if (shift := placed[links]).any():
        changes["home"] = (0.0 if robot.home is None else robot.home[links]) - shift
    return rebuilt(robot, places, links, coordinates, **changes)


def subchain(robot: AnyRobot, base: str, tip: str) -> AnyRobot:
    """Chain of the joints between two frames, as a robot fixed at the first of them; all other links are left out.

    Gravity is turned into the axes of the new base, which stands where it is with all joints at home and a floating
    base at the origin.

    Args:
        robot: the robot.
        base: name of the frame that becomes the base.
        tip: name of the frame of the end effector.

    >>> import torchdq
    >>> torchdq.robots.load("panda").subchain("panda_link3", "panda_link6").joint_names
    ('panda_joint4', 'panda_joint5', 'panda_joint6')
    """
    _require_constant_geometry(robot)
    first, last = robot.frame(base), robot.frame(tip)
    chain: list[int] = []
    link = last.link
    while link not in (first.link, BASE):
        chain.insert(0, link)
        link = robot.parents[link]
    if link != first.link or not chain:
        raise ArgumentError(f"tip must be a frame that joints carry from the frame {base!r} on, found {tip!r}")
    before: list[int] = []
    X_WF = first.X_BF  # pose of the new base in the old one at home
    while link != BASE:
        before.append(link)
        X_WF, link = dq.mul(robot.X_PB_home[link], X_WF), robot.parents[link]
    own = IDENTITY.to(robot.screw)
    places = {first.link: (BASE, dq.conj(first.X_BF))} | {old: (i, own) for i, old in enumerate(chain)}
    left_out = ", ".join(name for i, name in enumerate(robot.every_joint) if i not in chain)
    cut = f"chain from {base!r} to {tip!r}, without the joints {left_out}"
    notes = [Finding("robot.cut", "", cut, severity="note")] if left_out else []
    if robot.floating:
        notes.append(Finding("base.fixed", "", "the base, which was free, is fixed", severity="note"))
    gravity = None if robot.gravity is None else dq.rotate(dq.conj(X_WF[:4]), robot.gravity)
    changes = {"gravity": gravity, "tip": tip, "notes": (*robot.notes, *notes), **dict.fromkeys(BASE_BODY)}
    return rebuilt(robot, places, chain, _coordinates_of(robot, chain, before), **changes)


def _coordinates_of(robot: RobotModel, chain: Sequence[int], before: Sequence[int]) -> list[int]:
    """Coordinates that the joints of a chain follow; raises if one moves joints before it, or belongs to others."""
    S, known = factors(robot), robot.every_joint
    found = [k for k in range(robot.n) if S[chain, k].any()]
    for k in found:
        name = robot.joint_names[k]
        moved = next(known[i] for i in chain if S[i, k])
        ahead = [known[i] for i in before if S[i, k]]
        if ahead:
            raise ArgumentError(
                f"base must be a frame that stands still while the chain moves, but coordinate {name!r} moves both "
                f"joint {moved!r} of the chain and {ahead[0]!r} before it; choose a base before {ahead[0]!r}"
            )
        if name in known and known.index(name) not in chain:
            raise ArgumentError(
                f"tip must be a frame whose joints follow joints of the chain, but {moved!r} follows {name!r}, which "
                f"would be left out; choose a tip that {name!r} moves"
            )
    return found


def _require_constant_geometry(robot: RobotModel) -> None:
    for name in ("X_PB_home", "screw", "home"):
        if name in robot._arguments:
            several = name in batches(robot)
            way = "change the robots one by one and stack them afterwards" if several else "use bake() first"
            raise ArgumentError(f"{name} of robot {robot.name!r} must be constant, as its frames are; {way}")


def _require_coordinates(robot: RobotModel, lock: Any) -> None:
    """Raise if joints to lock are named that follow coordinates."""
    for name in (lock,) if isinstance(lock, str) or not isinstance(lock, Collection) else lock:
        if name in robot.every_joint and name not in robot.joint_names:
            leaders = followed(robot, name)
            raise ArgumentError(
                f"lock must not name joint {name!r}, which is not a coordinate: it follows {sum_of(leaders)}; lock "
                f"{' and '.join(map(repr, leaders))}, which {'hold' if len(leaders) > 1 else 'holds'} it too"
            )


def _home_of(robot: RobotModel, name: str) -> float:
    """Position at home [rad or m] of a coordinate: of the joint with its name if it moves that one alone, else zero."""
    if robot.home is None or name not in robot.every_joint:
        return 0.0
    return float(robot.home[robot.every_joint.index(name)]) if followed(robot, name) == {name: 1.0} else 0.0
