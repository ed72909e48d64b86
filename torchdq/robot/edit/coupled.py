"""Robots in other coordinates, each of which may move several joints: differentials, motor-coupled wrists, mimics."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdq.base.checks import is_number, require_number
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot.arrays import double, numbers, table, words
from torchdq.robot.check import consistency, faults
from torchdq.robot.description import JointMap, Limits
from torchdq.robot.model import AnyRobot, RobotModel
from torchdq.robot.model import factors as factors_of

SAME = 1e-12  # part of the largest number below which a number of S is rounding


def couple(
    robot: AnyRobot,
    S: Mapping[str, Mapping[str, float]] | Any,
    names: Sequence[str] | None = None,
    offset: Mapping[str, float] | None = None,
    *,
    limits: Sequence[Any] | float | None = None,
    damping: Any = None,
    friction: Any = None,
    armature: Any = None,
) -> AnyRobot:
    """Robot in other coordinates z, which move those of before linearly: q = S z + offset.

    A joint that follows one coordinate hands it its damping and armature, times the factor squared, and its friction,
    times the factor's magnitude; they add up. Of the limits of position and velocity the narrowest count. The effort
    limit is that of the joint with the coordinate's name, whose motor moves the others; without one, those of all
    joints add up, as if each had its motor. A joint that follows several coordinates hands nothing on: its damping,
    friction, armature and limits must be absent, or those of all new coordinates be given here.

    Args:
        robot: the robot.
        S: factors by name, {joint: {coordinate: factor}}, where a joint that is not named stays a coordinate; or a
            matrix [n, coordinates] with `names`.
        names: names of the coordinates of a matrix.
        offset: positions [rad or m] of joints where the coordinates are zero, by name; None: zero.
        limits: those of the new coordinates, four rows (lower, upper, velocity, effort) as in `Robot.limits`, each
            [coordinates], infinite where there is none; math.inf: there are none; None: those that are handed on.
        damping, friction, armature: those of the new coordinates, [coordinates], or one number for all of them; None:
            those that are handed on.

    >>> import torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> # a forearm that keeps its direction
    >>> robot.couple({"joint2": {"joint1": -1.0}}).joint_names
    ('joint1',)
    >>> robot.couple([[0.5, 0.5], [0.5, -0.5]], ["left", "right"]).joint_names  # a differential
    ('left', 'right')
    """
    known = robot.joint_names
    factors, names = _by_name(robot, S) if isinstance(S, Mapping) else _matrix(robot, S, names)
    shift = double([0.0] * robot.n)
    for name, value in ({} if offset is None else offset).items():
        require_number(f"offset[{name!r}]", value)
        shift[robot.joint_index(name)] = value
    inert = [name for name, column in zip(names, factors.T, strict=True) if not bool(column.any())]
    if inert:
        raise ArgumentError(f"S must have a factor for every coordinate, found none for {', '.join(inert)}")
    _require_independent(factors, names)
    several = [name for name, row in zip(known, factors, strict=True) if int(row.count_nonzero()) > 1]
    alone = factors * (factors.count_nonzero(-1) == 1).unsqueeze(-1)
    given: dict[str, Any] = {"damping": damping, "friction": friction, "armature": armature}
    new: dict[str, Any] = {}
    for name, value in given.items():
        before, weights = getattr(robot, name), alone.abs() if name == "friction" else alone.square()
        if value is not None:
            every = [value] * len(names) if is_number(value) else value
            new[name] = table(name, every, len(names), error=ArgumentError).to(robot.mass)
        elif before is not None:
            _require_absent(robot, name, before != 0, several)
            new[name] = before @ weights.to(before)
    if limits is None:
        for bound in Limits._fields:
            _require_absent(robot, f"limits.{bound}", getattr(robot.limits, bound).isfinite(), several, "limits")
        new["limits"] = _limits(robot, alone, shift, names)
    else:
        if is_number(limits) and limits == math.inf:
            limits = [[x] * len(names) for x in (-math.inf, math.inf, math.inf, math.inf)]
        rows = numbers("limits", limits, ArgumentError).to(robot.mass)
        if rows.ndim < 2 or (rows.shape[0], rows.shape[-1]) != (len(Limits._fields), len(names)):
            expected = f"(lower, upper, velocity, effort), each of {len(names)} numbers"
            raise ArgumentError(f"limits must be four rows {expected}, found the shape {tuple(rows.shape)}")
        new["limits"] = Limits(*rows)
    before = factors_of(robot).to(factors)
    if bool(shift.any()):
        home, moved = robot.home, (before @ shift).to(robot.mass)
        new["home"] = (0.0 if home is None else home) - moved
    new["joint_map"] = JointMap(robot.every_joint, (before @ factors).to(robot.mass))
    made = dataclasses.replace(robot, joint_names=names, **new, _constants=None, _storages=())
    faults.require_structure(made, {name: getattr(made, name) for name in ("joint_names", *new)})
    consistency.complain(robot.name, faults.faults(made, new), "error")
    return made


def _require_independent(factors: Tensor, names: Sequence[str]) -> None:
    """Raise if some of the coordinates together move no joint: accelerations would be undefined everywhere."""
    if not factors.numel() or not bool(factors.isfinite().all()):
        return
    # neither the units nor the sizes of the coordinates matter
    scaled = factors / torch.linalg.vector_norm(factors, dim=0)
    _, sizes, directions = torch.linalg.svd(scaled)
    rank = int((sizes > SAME * sizes[0]).sum())
    if rank < len(names):
        still = directions[-1]
        moved = [(name, x) for name, x in zip(names, still.tolist(), strict=True) if abs(x) > SAME * still.abs().max()]
        raise ArgumentError(
            f"S must have independent columns, found that a motion of {', '.join(name for name, _ in moved)} together "
            "moves no joint; leave out one of these coordinates"
        )


def _by_name(robot: RobotModel, S: Mapping[str, Mapping[str, float]]) -> tuple[Tensor, tuple[str, ...]]:
    """Factors [n, coordinates], and names of the coordinates."""
    for joint, row in S.items():
        if joint not in robot.joint_names:
            raise UnknownNameError(f"joint of robot {robot.name!r}", joint, robot.joint_names)
        if not isinstance(row, Mapping):
            raise ArgumentError(f"S[{joint!r}] must hold factors by coordinate, found {row!r}")
        for name, factor in row.items():
            require_number(f"S[{joint!r}][{name!r}]", factor)
            if name in S and name not in S[name]:
                raise ArgumentError(
                    f"S[{joint!r}] must name coordinates, found {name!r}, a joint that follows others itself; name "
                    "those, or couple twice"
                )
    rows = [S.get(name, {name: 1.0}) for name in robot.joint_names]
    names = tuple(dict.fromkeys(name for row in rows for name in row))
    return double([[float(row.get(name, 0.0)) for name in names] for row in rows]), names


def _matrix(robot: RobotModel, S: Any, names: Sequence[str] | None) -> tuple[Tensor, tuple[str, ...]]:
    factors = numbers("S", S, ArgumentError)
    factors = table("S", factors, robot.n, factors.shape[-1] if factors.ndim else 1, error=ArgumentError)
    count = factors.shape[1]
    return factors, words("names", names, count, ", one per column of S", ArgumentError, distinct=True)


def _require_absent(
    robot: RobotModel, what: str, there: Tensor, several: Sequence[str], argument: str | None = None
) -> None:
    """Raise if a quantity is there at a joint that follows several coordinates."""
    for name in several:
        if bool(there[..., robot.joint_index(name)].any()):
            raise ArgumentError(
                f"{what} of joint {name!r} of robot {robot.name!r} must be absent, since the joint follows several "
                f"coordinates and none of them would have it alone; pass {argument or what}= for the new coordinates"
            )


def _limits(robot: RobotModel, alone: Tensor, shift: Tensor, names: Sequence[str]) -> Limits:
    """Limits of the coordinates of joints that follow one each."""
    lower, upper, velocity, effort = robot.limits
    moved, factor, shift = alone != 0, alone.sum(-1).to(lower), shift.to(lower)
    a, b = (lower - shift) / factor, (upper - shift) / factor
    low, high = torch.where(factor > 0, a, b), torch.where(factor > 0, b, a)
    motors = moved.clone()
    for k, name in enumerate(names):
        if name in robot.joint_names and moved[i := robot.joint_index(name), k]:
            motors[:, k] = False
            motors[i, k] = True

    def of(x: Tensor, which: Tensor, none: float) -> Tensor:
        return x.unsqueeze(-1).where(which, none)

    found = Limits(
        of(low, moved, -math.inf).amax(-2),
        of(high, moved, math.inf).amin(-2),
        of(velocity / factor.abs(), moved, math.inf).amin(-2),
        of(effort * factor.abs(), motors, 0.0).sum(-2).where(moved.any(0), math.inf),
    )
    for k, name in enumerate(names):
        if bool((found.lower[..., k] > found.upper[..., k]).any()):
            joints = ", ".join(robot.joint_names[i] for i in moved[:, k].nonzero())
            raise ArgumentError(f"limits of the joints {joints} leave no position to coordinate {name!r}; pass limits=")
    return found
