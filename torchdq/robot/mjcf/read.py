"""Robots from MJCF files, read from the model that MuJoCo's own compiler makes of them.

A body may have several joints there: each but the last carries a link without mass. Bodies without joints, and those
whose joints are locked, are lumped with the body that carries them and stay as frames. Couplings of joints by linear
equality constraints become the robot's map from coordinates to joints.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, get_args

from torch import Tensor

from torchdq.base.checks import require_choice
from torchdq.errors import ArgumentError, DescriptionError
from torchdq.findings import Finding
from torchdq.robot.arrays import MOST, matrices
from torchdq.robot.assembly import described
from torchdq.robot.check import consistency
from torchdq.robot.description import Base, RobotDescription, note, require_usable
from torchdq.robot.edit.couplings import Follows, solved
from torchdq.robot.edit.locking import lock_notes, positions, require_free, to_keep
from torchdq.robot.mjcf import notes as mjcf_notes
from torchdq.robot.mjcf.joints import FREE, MjcfJoint, equalities, joints_of
from torchdq.robot.mjcf.links import ModelLinks, closures_of, links_of
from torchdq.robot.mjcf.source import MjcfModel, compiled


class Mjcf(NamedTuple):
    """Contents of a file."""

    description: RobotDescription
    gravity: Any  # [m/s^2], as it was given or as the file has it; None: none
    of: MjcfModel
    joints: list[MjcfJoint]
    bodies: ModelLinks


def read(source: Any, base: Base, kept: Any = None, lock: Any = None, gravity: Any = "file") -> Mjcf:
    """Contents of a file; `Robot.from_mjcf` says what is expected."""
    require_choice("base", base, get_args(Base))
    of = compiled(source)
    joints = joints_of(of)
    found = equalities(of, joints)
    asked = positions(() if lock is None else lock, [joint.name for joint in joints])
    held = _given(joints, base, asked)
    moves, freely = (solved(len(joints), at, found.couplings) for at in (held, {}))
    if found.couplings and all(freely[joint.row].leader is None for joint in joints):
        names = " and ".join(repr(name) for name, *_ in found.couplings)
        raise DescriptionError(
            f"equality constraints must leave a joint free, found that {names} hold all joints still; leave one of "
            "them out"
        )
    if kept is not None:
        moves = _kept(joints, moves, kept, asked)
    at = {j.name: j.home + moves[j.row].offset for j in joints if j.single and moves[j.row].leader is None}
    require_free([joint.name for joint in joints if joint.single], at)
    free = _free_base(joints, moves, base)
    bodies = links_of(of, joints, moves, free)
    still = {j.name: at[j.name] for j in joints if j.name in at and freely[j.row].leader is None and j.row not in held}
    locked = {name: x for name, x in at.items() if name not in still}
    given = mjcf_notes.gravity(of) if isinstance(gravity, str) and gravity == "file" else gravity
    frames, closures, others = closures_of(bodies.of, found.others)
    notes = mjcf_notes.diagnostics(of, joints, moves, bodies, others, given is not None)
    notes += lock_notes(of.name, asked, locked, {j.name: (j.lower, j.upper) for j in joints}, stacklevel=3)
    if still:
        standing = ", ".join(f"{name} at {x:g}" for name, x in still.items())
        notes.append(note("joint.stuck", [*still], f"held by equality constraints: {standing}"))
    _require_numbers(joints, moves)
    description = described(of.name, bodies.of, moves, free is not None, notes)
    description = replace(description, frames=(*description.frames, *frames), closures=tuple(closures))
    _require_finite(description)
    faults = consistency.bodies(description.link_names, description.mass, matrices(description.inertia))
    return Mjcf(replace(description, notes=(*faults, *description.notes)), given, of, joints, bodies)


# --- joints that move ------------------------------------------------------------------------------------------------


def _given(joints: Sequence[MjcfJoint], base: Base, asked: Mapping[str, float | None]) -> dict[int, float]:
    """Displacements [rad or m] of the joints that arguments hold."""
    by_name = {joint.name: joint for joint in joints}
    held = {joint.row: 0.0 for joint in joints if joint.kind == FREE and base == "fixed"}
    for name, value in asked.items():
        joint = by_name[name]
        if value is not None and not joint.single:
            raise ArgumentError(
                f"lock[{name!r}] must be left out, found {value:g}: a {joint.kind} joint has no single "
                f"position; name it without one, as in lock=[{name!r}], which locks it at home"
            )
        held[joint.row] = 0.0 if value is None else value - joint.home
    return held


def _kept(
    joints: Sequence[MjcfJoint], moves: Sequence[Follows], names: Any, asked: Mapping[str, float | None]
) -> list[Follows]:
    chosen = to_keep(names, [joint.name for joint in joints if joint.single], asked)
    roots = {moves[joint.row].leader for joint in joints if joint.name in chosen or joint.kind == FREE}
    return [x if x.leader in roots else Follows(None, 0.0, x.offset) for x in moves]


def _free_base(joints: Sequence[MjcfJoint], moves: Sequence[Follows], base: Base) -> int | None:
    """Body that is the floating base; None: the base is fixed. Raises for two of them."""
    left = [joint for joint in joints if moves[joint.row].leader is not None]
    free = [joint for joint in left if joint.kind == FREE]
    if len(free) > 1:
        names = ", ".join(joint.name for joint in free)
        raise DescriptionError(
            f"one body may be free, found the free joints {names}; lock all but one by their names, or hold all with "
            "base='fixed' and read them by torchdq.objects.from_mjcf, as objects of scenes"
        )
    if base == "floating" and not free:
        raise ArgumentError(
            "base='floating' needs a body with a free joint, found none in the file; add <freejoint/> "
            "to the body that is the base"
        )
    return free[0].body if free else None


def _require_numbers(joints: Sequence[MjcfJoint], moves: Sequence[Follows]) -> None:
    """Raise unless all numbers of joints are numbers: MuJoCo only prints a warning."""
    faults = []
    for joint in joints:
        subject = f"joint {joint.name!r}"
        for name in ("home", "damping", "friction", "armature"):
            x = getattr(joint, name)
            if not abs(x) <= MOST or (name != "home" and x < 0):
                expected = f"{name} must be finite{'' if name == 'home' else ' and not negative'}, at most {MOST:g}"
                faults.append(Finding("number.invalid", subject, expected, f"{x:g}"))
        if not joint.lower <= joint.upper:
            expected = "range must be two numbers in order"
            faults.append(Finding("limits.reversed", subject, expected, f"{joint.lower}, {joint.upper}"))
        if not all(abs(x) <= MOST for x in moves[joint.row][1:]):
            expected, found = f"couplings of joints must be finite, at most {MOST:g}", f"{moves[joint.row][1:]}"
            faults.append(Finding("number.invalid", subject, expected, found))
    require_usable(faults)


def _require_finite(description: RobotDescription) -> None:
    """Raise unless all numbers of a description are finite, and not too large to be multiplied."""
    tensors = {name: x for name, x in vars(description).items() if isinstance(x, Tensor)}
    expected = f"must be finite, at most {MOST:g} in size"
    require_usable(
        [
            Finding("number.invalid", "", f"{name} {expected}", f"{x.tolist()}")
            for name, x in tensors.items()
            if not bool((x.abs() <= MOST).all())
        ]
    )
