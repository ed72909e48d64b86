"""Robots from MJCF files, read from the model that MuJoCo's own compiler makes of them.

A body may have several joints there: each but the last carries a link without mass. Bodies without joints, and those
whose joints are locked, are lumped with the body that carries them and stay as frames. Couplings of joints by linear
equality constraints become the robot's map from coordinates to joints.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_choice
from torchdq.base.findings import Finding
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError, DescriptionError
from torchdq.robot.arrays import MOST, double, matrices
from torchdq.robot.bodies import NOTHING
from torchdq.robot.check import consistency
from torchdq.robot.description import NO_TIP, JointMap, Limits, RobotDescription, Unsimulated
from torchdq.robot.edit.couplings import Follows, JointCoupling, solved
from torchdq.robot.edit.locking import lock_notes, positions, require_free, to_keep, warn_beyond_limits
from torchdq.robot.mjcf import notes as mjcf_notes
from torchdq.robot.mjcf.joints import BALL, FREE, MjcfJoint, equalities, joints_of
from torchdq.robot.mjcf.links import Links, links_of
from torchdq.robot.mjcf.source import MjcfModel, compiled

MjcfBase = Literal["file", "fixed", "floating"]


class Mjcf(NamedTuple):
    """Contents of a file."""

    description: RobotDescription
    faults: list[Finding]
    gravity: Any  # [m/s^2], as it was given or as the file has it; None: none
    of: MjcfModel
    joints: list[MjcfJoint]
    links: Links
    doubts: list[str]  # about units
    ignored: list[Unsimulated]  # notes on what changes the accelerations in MuJoCo and not here


def read(source: Any, base: MjcfBase, kept: Any, lock: Any, gravity: Any = "file") -> Mjcf:
    """Contents of a file; `Robot.from_mjcf` says what is expected."""
    require_choice("base", base, ("file", "fixed", "floating"))
    of = compiled(source)
    joints = joints_of(of)
    found = equalities(of, joints)
    held = _given(of, joints, base, lock)
    moves, freely = (solved(len(joints), at, found.couplings) for at in (held, {}))
    _require_motion(joints, freely, found.couplings)
    if kept is not None:
        moves = _kept(joints, moves, kept, lock)
    at = {j.name: j.home + moves[j.row].offset for j in joints if j.single and moves[j.row].root is None}
    require_free([joint.name for joint in joints if joint.single], at)
    free = _free_base(joints, moves, base)
    links = links_of(of, joints, moves, free)
    still = {j.name: at[j.name] for j in joints if j.name in at and freely[j.row].root is None and j.row not in held}
    locked = {name: x for name, x in at.items() if name not in still}
    told_of = lock_notes(locked, {j.name: (j.lower, j.upper) for j in joints if j.name in locked})
    notes = [*mjcf_notes.notes(of, joints, moves, links, found.others), *_held(joints, moves), *told_of]
    standing = ", ".join(f"{name} at {x:g}" for name, x in still.items())
    notes += [f"held by equality constraints: {standing}"] if standing else []
    if len(links.leaves) > 1:
        notes.append(f"{NO_TIP} {', '.join(links.leaves)}; name one with tip=")
    given = mjcf_notes.gravity(of) if isinstance(gravity, str) and gravity == "file" else gravity
    ignored = mjcf_notes.ignored(of, joints, moves, links, given is not None)
    description = _description(of.name, joints, moves, links, free is not None, (*ignored, *notes))
    _require_numbers(joints, description)
    faults = consistency.bodies(description.link_names, description.mass, matrices(description.inertia))
    doubts = mjcf_notes.doubts(of, joints)
    return Mjcf(description, faults, given, of, joints, links, doubts, ignored)


# --- joints that move ------------------------------------------------------------------------------------------------


def _given(of: MjcfModel, joints: Sequence[MjcfJoint], base: MjcfBase, lock: Any) -> dict[int, float]:
    """Displacements [rad or m] of the joints that arguments hold."""
    by_name = {joint.name: joint for joint in joints}
    held = {joint.row: 0.0 for joint in joints if joint.kind == FREE and base == "fixed"}
    asked = positions(() if lock is None else lock, by_name)
    warn_beyond_limits(of.name, asked, {joint.name: (joint.lower, joint.upper) for joint in joints}, stacklevel=4)
    for name, value in asked.items():
        joint = by_name[name]
        if value is not None and not joint.single:
            raise ArgumentError(
                f"lock[{name!r}] must be left out, found {value:g}: a {joint.kind} joint has no single "
                f"position; name it without one, as in lock=[{name!r}], which locks it at home"
            )
        held[joint.row] = 0.0 if value is None else value - joint.home
    return held


def _require_motion(joints: Sequence[MjcfJoint], freely: Sequence[Follows], couplings: Sequence[JointCoupling]) -> None:
    """Raise if couplings alone hold every joint."""
    if couplings and all(freely[joint.row].root is None for joint in joints):
        names = " and ".join(repr(coupling.name) for coupling in couplings)
        raise DescriptionError(
            f"equality constraints must leave a joint free, found that {names} hold all joints still; leave one of "
            "them out"
        )


def _kept(joints: Sequence[MjcfJoint], moves: Sequence[Follows], names: Any, lock: Any) -> list[Follows]:
    """Displacements of the joints when only those that are named, and those that follow them, move."""
    locked = positions(() if lock is None else lock, [joint.name for joint in joints])
    chosen = to_keep(names, [joint.name for joint in joints if joint.single], locked)
    roots = {moves[joint.row].root for joint in joints if joint.name in chosen or joint.kind == FREE}
    return [x if x.root in roots else Follows(None, 0.0, x.offset) for x in moves]


def _free_base(joints: Sequence[MjcfJoint], moves: Sequence[Follows], base: MjcfBase) -> int | None:
    """Body that is a free base, if there is one; raises if more than one is free or another joint has no coordinate."""
    left = [joint for joint in joints if moves[joint.row].root is not None]
    if balls := [joint.name for joint in left if joint.kind == BALL]:
        raise DescriptionError(
            f"joints must have one coordinate each, found the ball joints {', '.join(balls)}, whose "
            "positions are quaternions; describe each by three hinges, or lock it by its name"
        )
    free = [joint for joint in left if joint.kind == FREE]
    if len(free) > 1:
        names = ", ".join(joint.name for joint in free)
        raise DescriptionError(
            f"one body may be free, found the free joints {names}; lock all but one by their names, "
            "or load the file of one robot alone"
        )
    if base == "floating" and not free:
        raise ArgumentError(
            "base='floating' needs a body with a free joint, found none in the file; add <freejoint/> "
            "to the body that is the base"
        )
    return free[0].body if free else None


def _held(joints: Sequence[MjcfJoint], moves: Sequence[Follows]) -> list[str]:
    held = [joint.name for joint in joints if not joint.single and moves[joint.row].root is None]
    return [f"held where the file puts them: {', '.join(held)}"] if held else []


def _require_numbers(joints: Sequence[MjcfJoint], description: RobotDescription) -> None:
    """Raise unless all numbers are numbers: MuJoCo only prints a warning."""
    faults = []
    for joint in joints:
        for name in ("home", "damping", "friction", "armature"):
            x = getattr(joint, name)
            if not abs(x) <= MOST or (name != "home" and x < 0):
                sign = "" if name == "home" else " and not negative"
                faults.append(f"joint {joint.name!r}: {name} must be finite{sign}, at most {MOST:g}, found {x:g}")
        if not joint.lower <= joint.upper:
            faults.append(
                f"joint {joint.name!r}: range must be two numbers in order, found {joint.lower}, {joint.upper}"
            )
    tensors = {name: x for name, x in vars(description).items() if isinstance(x, Tensor)}
    if description.joint_map is not None:
        tensors["couplings of joints"] = description.joint_map.S
    for name, x in tensors.items():
        if not bool((x.abs() <= MOST).all()):
            faults.append(f"{name} must be finite, at most {MOST:g} in size, found {x.tolist()}")
    if faults:
        raise DescriptionError("the robot description cannot be used:\n  " + "\n  ".join(faults))


# --- numbers ---------------------------------------------------------------------------------------------------------


def _description(
    name: str, joints: Sequence[MjcfJoint], moves: Sequence[Follows], of: Links, floating: bool, notes: tuple[str, ...]
) -> RobotDescription:
    carrying = [link.joint for link in of.links]
    roots = [joint for joint in carrying if moves[joint.row].root == joint.row]
    n, masses = len(carrying), [of.bodies.get(i, NOTHING) for i in range(len(of.links))]
    S = double([[moves[j.row].factor * (moves[j.row].root == root.row) for root in roots] for j in carrying])
    S = S.reshape(n, len(roots))
    # at q, a joint that follows is displaced by factor (q - home of its root) + offset = (S q) - home
    home = S @ double([root.home for root in roots]) - double([moves[j.row].offset for j in carrying])
    mapped = len(roots) < n
    base = of.bodies.get(BASE, NOTHING)
    armature = S.square().mT @ double([joint.armature for joint in carrying])
    return RobotDescription(
        name=name,
        joint_names=tuple(root.name for root in roots),
        link_names=tuple(link.name for link in of.links),
        parents=tuple(link.parent for link in of.links),
        kinds=tuple(joint.kind for joint in carrying),
        X_PB_home=double([(*link.X_PB[0], *link.X_PB[1]) for link in of.links]).reshape(n, 8),
        screw=double([(*joint.screw[0], *joint.screw[1]) for joint in carrying]).reshape(n, 6),
        mass=double([mass for mass, _, _ in masses]),
        com=double([com for _, com, _ in masses]).reshape(n, 3),
        inertia=double([inertia for _, _, inertia in masses]).reshape(n, 6),
        limits=_limits(carrying, roots, moves, S),
        damping=S.square().mT @ double([joint.damping for joint in carrying]),
        friction=S.abs().mT @ double([joint.friction for joint in carrying]),
        frames=tuple(of.frames),
        tip=of.leaves[0] if len(of.leaves) == 1 else None,
        home=home if bool(home.any()) else None,
        armature=armature if bool(armature.any()) else None,
        base_mass=double(base[0]) if floating else None,
        base_com=double(base[1]) if floating else None,
        base_inertia=double(base[2]) if floating else None,
        joint_map=JointMap(tuple(joint.name for joint in carrying), S) if mapped else None,
        notes=notes,
    )


def _limits(carrying: Sequence[MjcfJoint], roots: Sequence[MjcfJoint], moves: Sequence[Follows], S: Tensor) -> Limits:
    """Limits of the coordinates: within those of every joint that follows, and what all their actuators reach."""
    lower, upper, effort = [], [], []
    for root in roots:
        among = [joint for joint in carrying if moves[joint.row].root == root.row]
        bounds = [_bounds(joint, root, moves[joint.row]) for joint in among]
        lower.append(max(low for low, _ in bounds))
        upper.append(min(high for _, high in bounds))
        shares = [abs(moves[joint.row].factor) * joint.effort for joint in among if joint.effort is not None]
        effort.append(sum(shares) if shares else math.inf)
    return Limits(double(lower), double(upper), torch.full((len(roots),), math.inf, dtype=S.dtype), double(effort))


def _bounds(joint: MjcfJoint, root: MjcfJoint, x: Follows) -> tuple[float, float]:
    """Positions of a root at which a joint that follows it is at its limits."""
    ends = [root.home + (bound - joint.home - x.offset) / x.factor for bound in (joint.lower, joint.upper)]
    return (joint.lower, joint.upper) if joint is root else (min(ends), max(ends))
