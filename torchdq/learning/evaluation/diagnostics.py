"""Measurements held against the description: wrong units, signs and orders of columns, named with their joints.

A description that is off by tens of percent still explains most of a joint's torque, once friction, rotor inertia and
an offset are allowed for. Where it does not, the measurements are tried with what goes wrong in logs undone: a sign,
two joints exchanged, all joints reversed or sorted by name, in some of the signals. What explains them far better is
named. Other mistakes are looked for before that: rows far away from those beside them, motions beyond the limits of the
description, a torque that never changes, another unit, currents without a gain, and torques from which the drives have
taken gravity away.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations, product
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.dynamics.friction import smooth_sign
from torchdq.learning.evaluation.nominal_range import beyond_limits
from torchdq.learning.logs.outliers import spikes_told
from torchdq.robot import Robot

ROWS = 400  # rows that are looked at
FACTOR = 45.0  # ratio of measured to described torques beyond which the unit is doubted; a payload makes one of 31
CURRENT = 3.0  # ratio of described to measured torques, at most joints, from which they may be currents
SHARED = 15.0  # the same ratio, of a joint that is named beside one whose unit is doubted
LOADED = 0.1  # least variance of a joint's gravity, relative to that of its torque, for gravity to be missed
WEIGHTLESS = 0.15  # most variance that is left, relative to that of gravity, where torques are without gravity
LIKE = 10.0  # the same ratio, for other readings: torques that compensate friction alone are not of the opposite sign
DOUBTFUL = 0.08  # part of a joint's torque that is left unexplained, from which other readings are tried
GAIN = 0.15  # least sum of these parts that another reading must explain
BETTER = 3.0  # times less that it must leave unexplained
SHARE = 0.2  # least part of a joint's torque that only the description explains, for its factor to be trusted
STILL = 1e-6  # change of a torque, relative to its size, that is none
FEW = 100  # rows below which nothing is doubted: five coefficients a joint fit a few rows whatever they are
MOVING = 0.1  # least part of the rows in which a joint must move to be judged by a fit
FAINT = 1e-4  # variance of a torque, relative to the largest, below which it may be noise alone
WIDTHS = (0.1, 1.0, 3.0, 10.0, 30.0)  # widths of dry friction that are tried, in multiples of the one assumed
SHAPED = 0.9  # part of the residual torque left by dry friction of these widths, below which another shape is told
SEEN = 0.02  # residual that they explain, relative to the joint's torques, below which the shape does not matter
POOR = 0.5  # part of a joint's torque that a fit leaves unexplained, from which it is named
WIDE = 12  # most joints of which every pair is tried; of more, neighbours alone

SIGNALS = ("q", "qd", "qdd", "tau")
GROUPS = {  # signals that a reading changes
    "torques": ("tau",),
    "positions": ("q",),
    "velocities and accelerations": ("qd", "qdd"),
    "positions, velocities and accelerations": ("q", "qd", "qdd"),
    "columns of all signals": SIGNALS,
}
Torques = Callable[[Tensor, Tensor, Tensor], Tensor]


class LogWarning(UserWarning):
    """Measurements that the description of the robot cannot explain: a wrong unit, sign or order of columns, perhaps.

    Silenced by `warnings.simplefilter("ignore", torchdq.learning.LogWarning)`.
    """


class _Reading(NamedTuple):
    """Another reading of the measurements: columns of some signals in another order, and times other factors."""

    words: str
    signals: tuple[str, ...]
    order: Tensor  # [n]
    factor: Tensor  # [n] signs, or changes of the unit

    def applied(self, rows: Sequence[Tensor]) -> list[Tensor]:
        """Rows as this reading takes them."""
        return [
            self.factor * x[:, self.order] if name in self.signals else x for name, x in zip(SIGNALS, rows, strict=True)
        ]


def sampled(rows: Sequence[Tensor]) -> list[Tensor]:
    """At most `ROWS` of the rows, evenly spaced."""
    at = torch.linspace(0, len(rows[0]) - 1, min(ROWS, len(rows[0])), device=rows[0].device).round().long()
    return [x[at] for x in rows]


def doubts(robot: Robot, torques: Torques, rows: Sequence[Tensor], width: float) -> str:
    """Words for what is probably wrong with rows (q, qd, qdd, tau), [samples, n] each; "" if nothing seems to be.

    `torques` are those of the description.
    """
    if len(rows[0]) < FEW:
        return ""
    names, few = robot.joint_names, sampled(rows)
    leaps = spikes_told([f"tau of {name}" for name in names], rows[3].detach().cpu().numpy())
    if far := beyond_limits(robot, few[0], few[1]):
        return "; ".join([*leaps, *far])
    left, alone, factor = _compared(torques, few, width)
    found = _scaled(names, left, alone, factor) or _currents(names, left, alone, factor)
    weightless = [] if found else _weightless(torques, few, width)
    if not weightless and bool((left > DOUBTFUL).any()):
        found += _misread(torques, robot, few, width, left)
    return "; ".join([*leaps, *_dead(torques, names, few, width), *found, *weightless])


def unexplained(names: Sequence[str], rows: Sequence[Tensor], fitted: Tensor, width: float) -> str:
    """Words for joints that move, whose measured torques a fit hardly explains; "" if there are none."""
    _, qd, _, tau = rows
    if len(tau) < FEW:
        return ""
    size = tau.var(0)
    part = (tau - fitted).var(0) / size.clamp_min(1e-12 * float(size.max()) + 1e-30)
    told = _moves(qd, width) & (size > FAINT * size.max()) & (part > POOR)
    poor = [
        f"{name} ({max(0.0, 1 - p):.0%})"
        for name, p, bad in zip(names, part.tolist(), told.tolist(), strict=True)
        if bad
    ]
    if not poor:
        return ""
    cure = "are units, signs and the order of the joints those of the robot, and are torques measured at the joints?"
    return f"the fit explains only these parts of the torques' variance: {', '.join(poor)}; {cure}"


def misshapen(
    names: Sequence[str], rows: Sequence[Tensor], fitted: Tensor, width: float, direction: Tensor | None
) -> str:
    """Words for joints whose dry friction has another shape than was fitted; "" if there are none.

    Residuals that functions of the velocity around zero explain, which change their signs more or less sharply, are
    those of friction whose sign does. `direction` is the sign that was fitted; None: that of `width`.
    """
    _, qd, qdd, tau = (x.cpu() for x in rows)
    if len(tau) < FEW:
        return ""
    left, told = tau - fitted.cpu(), []
    own = smooth_sign(qd, width) if direction is None else direction.cpu()
    for j in _moves(qd, width).nonzero()[:, 0].tolist():
        v, known = qd[:, j], [own[:, j], qd[:, j], qdd[:, j], torch.ones_like(qd[:, j])]
        # an offset or a rotor that was not sought is no friction
        before = _rest(left[:, j], known)
        after = _rest(left[:, j], [*known, *(smooth_sign(v, k * width) for k in WIDTHS)])
        explained = math.sqrt(max(0.0, before**2 - after**2))
        if after < SHAPED * before and explained > SEEN * float(tau[:, j].std()):
            told.append(f"{names[j]} (residual {before:.2g}, {after:.2g} with another)")
    if not told:
        return ""
    cure = "if the torques were filtered, give direction=directions(motion) of smooth(log)"
    if direction is not None:
        cure = (
            "where it is rounder, as in a simulation, give smooth(log) its width; unless tau was filtered, no direction"
        )
    found = f"dry friction of {', '.join(told)} has another shape than the one fitted"
    return f"{found}, which biases it and viscous friction; {cure}"


def _rest(x: Tensor, columns: Sequence[Tensor]) -> float:
    """Standard deviation of what columns leave of x in least squares."""
    A = torch.stack([column / column.norm().clamp_min(1e-30) for column in columns], 1)
    return float((x - A @ torch.linalg.lstsq(A, x[:, None], driver="gelsd").solution[:, 0]).std())


def _moves(qd: Tensor, width: float) -> Tensor:
    """Joints that move in enough of the rows [n]."""
    return (qd.abs() > width).double().mean(0) > MOVING


def _dead(torques: Torques, names: Sequence[str], rows: Sequence[Tensor], width: float) -> list[str]:
    """Words for joints that move, whose measured torque never changes although the described one does."""
    q, qd, qdd, tau = rows
    varies = torques(q, qd, qdd).std(0)
    still = tau.amax(0) - tau.amin(0) <= STILL * tau.abs().amax(0)
    told = still & _moves(qd, width) & (varies.square() > FAINT * varies.square().max())
    joints = zip(names, tau[0].tolist(), varies.tolist(), told.tolist(), strict=True)
    off = [f"{name} ({x:.3g} in all rows, described as varying by {v:.2g})" for name, x, v, dead in joints if dead]
    if not off:
        return []
    cure = "is the sensor connected, and is it the right column? leave the log out, or measure again"
    return [f"measured torques never change although the joints move: {', '.join(off)}; {cure}"]


def _weightless(torques: Torques, rows: Sequence[Tensor], width: float) -> list[str]:
    """Words for torques that are explained without the gravity of the description.

    A joint tells it when motion, rotor inertia and friction explain its torque so well that gravity, of which they
    explain little, cannot be in it. Most joints that gravity loads must tell it.
    """
    q, qd, qdd, tau = rows
    still = torch.zeros_like(q)
    gravity = torques(q, still, still)

    def motion(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        return torques(q, qd, qdd) - torques(q, still, still)

    left, _, factor = _compared(motion, rows, width)
    apart, _, _ = _compared(motion, (q, qd, qdd, gravity), width)
    size, weight = tau.var(0).cpu(), apart * gravity.var(0).cpu()
    loaded = weight > LOADED * size
    told = loaded & (left * size < WEIGHTLESS * weight) & (factor > 1 / LIKE) & (factor < LIKE)
    if not 2 * int(told.sum()) > int(loaded.sum()):
        return []
    cure = "add torchdq.inverse_dynamics(robot, q) to them"
    return [f"the torques seem to be without gravity; {cure}"]


def _compared(torques: Torques, rows: Sequence[Tensor], width: float) -> tuple[Tensor, Tensor, Tensor]:
    """Parts of the torques' variances that the description leaves, and that friction alone leaves, and its factor [n].

    Every joint's torque is fitted by that of the description, rotor inertia and friction, none of them negative, and an
    offset. A least squares of four such terms is the best of those of all their subsets that come out positive.
    """
    q, qd, qdd, tau = rows
    terms = torch.stack([torques(q, qd, qdd), qdd, qd, smooth_sign(qd, width)], -1).double()  # [samples, n, 4]
    X, y = terms - terms.mean(0), (tau - tau.mean(0)).double()
    X = (X / X.square().mean(0).sqrt().clamp_min(1e-30)).cpu()
    scale = terms.std(0, correction=0).clamp_min(1e-30).cpu()
    y = y.cpu()
    A = torch.einsum("sjk,sjl->jkl", X, X)
    b, total = torch.einsum("sjk,sj->jk", X, y), y.square().sum(0)
    known = total > 1e-8 * total.max()  # a joint whose torque does not change tells nothing
    total = torch.where(known, total, 1.0)
    left, alone, factor = (torch.ones_like(total), torch.ones_like(total), torch.zeros_like(total))
    for subset in product((False, True), repeat=4):
        use = [k for k in range(4) if subset[k]]
        if not use:
            continue
        part = A[:, use][:, :, use] + 1e-9 * len(X) * torch.eye(len(use)).double()
        x = torch.linalg.solve(part, b[:, use, None])[..., 0]
        rest = (1 - (b[:, use] * x).sum(1) / total).clamp_min(0)
        good = (x >= 0).all(1) & (rest < (left if subset[0] else alone))
        if not subset[0]:
            alone = torch.where(good, rest, alone)
        left = torch.where(good & (rest < left), rest, left)
        if subset[0]:
            factor = torch.where(good, x[:, 0] / scale[:, 0], factor)
    none = torch.zeros_like(left)
    return torch.where(known, torch.minimum(left, alone), none), torch.where(known, alone, none), factor


def _scaled(names: Sequence[str], left: Tensor, alone: Tensor, factor: Tensor) -> list[str]:
    """Words for joints whose torques are in another unit than those of the description."""
    sure = (alone - left > SHARE) & (left < POOR)
    small, large = factor * FACTOR <= 1, factor >= FACTOR
    told = torch.zeros_like(sure)
    if bool((sure & small).any()):
        told |= (factor > 0) & (factor * SHARED <= 1)
    if bool((sure & large).any()):
        told |= factor >= SHARED
    off = [f"{name} ({x:.2g})" for name, x, one in zip(names, factor.tolist(), told.tolist(), strict=True) if one]
    if not off:
        return []
    cure = "give tau in N m (N for a joint that slides), measured at the joints"
    return [f"measured torques are multiples of the described ones, of {', '.join(off)}; is the unit right? {cure}"]


def _currents(names: Sequence[str], left: Tensor, alone: Tensor, factor: Tensor) -> list[str]:
    """Words for torques that are small parts of the described ones at most joints, as currents are."""
    sure = (factor > 0) & (left < POOR) & (alone - left > SHARE)
    small = sure & (factor * CURRENT <= 1)
    if not 2 * int(small.sum()) > int(sure.sum()):
        return []
    off = [f"{name} ({x:.2g})" for name, x, one in zip(names, factor.tolist(), small.tolist(), strict=True) if one]
    cure = "give Layout(gain=...), torque per ampere at the joints, or gain=None and identify(..., gains=True)"
    return [
        f"measured torques are small parts of the described ones, of {', '.join(off)}; are they currents of drives "
        f"whose gain is missing? {cure}"
    ]


def _misread(torques: Torques, robot: Robot, rows: Sequence[Tensor], width: float, left: Tensor) -> list[str]:
    """Words for the reading of the measurements that explains them far better."""
    bad, best, words = left > DOUBTFUL, float(left.sum()) - GAIN, ""
    for reading in _readings(torques, robot, rows, width, left):
        found = _left(torques, reading.applied(rows), width, left)
        tried = float(found.sum())
        if tried < best and BETTER * float(found[bad].sum()) < float(left[bad].sum()):
            best, words = 0.9 * tried, reading.words  # the first of equals
    return [words] if words else []


def _left(torques: Torques, rows: Sequence[Tensor], width: float, left: Tensor) -> Tensor:
    """Parts that another reading leaves [n]; `left` where its torques are not of the size of those described."""
    found, _, factor = _compared(torques, rows, width)
    return torch.where((factor > 1 / LIKE) & (factor < LIKE), found, torch.maximum(found, left))


def _readings(torques: Torques, robot: Robot, rows: Sequence[Tensor], width: float, left: Tensor) -> Iterator[_Reading]:
    """Readings to try, the likeliest first."""
    n, names = robot.n, robot.joint_names
    same, plain = torch.arange(n), torch.ones(n, dtype=rows[0].dtype)
    same, plain = same.to(rows[0].device), plain.to(rows[0].device)
    bad = (left > DOUBTFUL).tolist()
    # signs of torques do not touch other joints: each is chosen by itself
    flipped = (left - _left(torques, [*rows[:3], -rows[3]], width, left) > GAIN / 2).to(same.device)
    if bool(flipped.any()):
        of = ", ".join(name for name, f in zip(names, flipped.tolist(), strict=True) if f)
        yield _Reading(_sign("torques", of), ("tau",), same, torch.where(flipped, -plain, plain))
    orders = [("all joints in reverse", same.flip(0))] if n > 1 else []
    by_name = torch.tensor(sorted(range(n), key=lambda j: names[j])).argsort().to(same.device)
    if not torch.equal(by_name, same):
        orders.append(("the joints sorted by their names", by_name))
    pairs = [pair for pair in combinations(range(n), 2) if n <= WIDE or pair[1] == pair[0] + 1]
    for i, j in (pair for pair in pairs if bad[pair[0]] or bad[pair[1]]):
        order = same.clone()
        order[[i, j]] = order[[j, i]]
        orders.append((f"{names[i]} and {names[j]} exchanged", order))
    for group, signals in GROUPS.items():
        for what, order in orders:
            fits = f"the description fits far better with {what} in the {group}"
            yield _Reading(f"{fits}; are they in the order of the robot's joints?", signals, order, plain)
        if signals != ("tau",):
            for j in (j for j in range(n) if bad[j]):
                sign = plain.clone()
                sign[j] = -1.0
                yield _Reading(_sign(group, names[j]), signals, same, sign)
        if "tau" not in signals:
            yield from _in_other_units(robot, group, signals, same, plain)


def _in_other_units(
    robot: Robot, group: str, signals: tuple[str, ...], same: Tensor, plain: Tensor
) -> Iterator[_Reading]:
    """Readings of motions in degrees, or in millimetres where joints slide."""
    turns = torch.tensor([kind.turns for kind in robot.joint_types], device=plain.device)
    for unit, times, factor, joints in (
        ("degrees", "pi/180", math.pi / 180, turns),
        ("millimetres", "0.001", 0.001, ~turns),
    ):
        if bool(joints.any()):
            of = ", ".join(name for name, yes in zip(robot.joint_names, joints.tolist(), strict=True) if yes)
            words = f"the description fits far better with the {group} of {of} in {unit}; multiply them by {times}"
            yield _Reading(words, signals, same, torch.where(joints, factor * plain, plain))


def _sign(group: str, of: str) -> str:
    return f"the description fits far better with the opposite sign in the {group} of {of}; reverse it in the log"
