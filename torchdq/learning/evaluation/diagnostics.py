"""Diagnostics of measurements against a robot's description: wrong units, signs and orders of columns, by joint.

A description that is off by tens of percent still explains most of a joint's torque, once friction, rotor inertia and
an offset are allowed for. Where it does not, the measurements are tried with usual faults of logs undone: a sign, two
joints exchanged, all joints reversed or sorted by name, in some of the signals. The fault that explains them far better
is named. Other faults are looked for before that: outliers, motions beyond the limits of the description, a torque that
never changes, another unit, currents without a gain, and torques from which the drives have taken gravity away.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.dynamics.friction import smooth_sign
from torchdq.findings import Finding
from torchdq.learning.logs.outliers import outlier_findings
from torchdq.robot import Robot


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of the diagnostics, chosen together.

    They were set on robots with masses off by 30 % and dry friction of 30 % of the torque, of which none may have a
    finding (tests/learning/evaluation/test_diagnostics.py), and on the recordings of benchmarks/splits.py.
    """

    rows: int = 400  # rows that are used
    few: int = 100  # rows below which nothing is reported: five coefficients a joint fit a few rows whatever they are
    unit: float = 45.0  # ratio of measured to described torques from which the unit is wrong; a payload makes one of 31
    current: float = 3.0  # ratio of described to measured torques, at most joints, from which they may be currents
    shared: float = 15.0  # the same ratio, of a joint that is named with one whose unit is wrong
    trusted: float = 0.2  # least part of a joint's torque that only the description explains, to trust its factor
    alike: float = 10.0  # most of that ratio for other readings: torques that compensate friction are not reversed
    loaded: float = 0.1  # least variance of a joint's gravity, relative to that of its torque, for gravity to be missed
    weightless: float = 0.15  # most variance left, relative to that of gravity, where torques are without gravity
    beaten: float = 1.5  # times less that they must leave unexplained than the description with gravity does
    unexplained: float = 0.08  # part of a joint's torque left unexplained, from which other readings are tried
    gain: float = 0.15  # least sum of these parts that another reading must explain
    better: float = 3.0  # times less that it must leave unexplained
    still: float = 1e-6  # change of a torque, relative to its size, that is none
    moving: float = 0.1  # least part of the rows in which a joint must move to be judged by a fit
    faint: float = 1e-4  # variance of a torque, relative to the largest, below which it may be noise alone
    poor: float = 0.5  # part of a joint's torque that a fit leaves unexplained, from which it is named
    shaped: float = 0.9  # part of the residual left by dry friction of other widths, from which the shape is another
    seen: float = 0.02  # residual that they explain, relative to the joint's torques, below which it does not matter
    often: float = 0.01  # part of the rows in which a joint must be beyond its limits
    past: float = 1.0  # farthest beyond a limit of position that is accepted, relative to the range between both limits
    turns: float = 4 * math.pi  # the same of joints that may make a full turn, which often have no limit [rad]
    faster: float = 3.0  # times the limit of velocity that are accepted: simulated motions do not keep it


AT = Thresholds()
WIDTHS = (0.1, 1.0, 3.0, 10.0, 30.0)  # widths of dry friction that are tried, in multiples of the one assumed
WIDE = 12  # most joints of which every pair is tried; of more, neighbours alone
SIGNALS = ("q", "qd", "qdd", "tau")
GROUPS = {  # signals that a reading changes
    "torques": ("tau",),
    "positions": ("q",),
    "velocities and accelerations": ("qd", "qdd"),
    "positions, velocities and accelerations": ("q", "qd", "qdd"),
    "columns of all signals": SIGNALS,
}
TIMES = "{:.2g} times the described torque"
Torques = Callable[[Tensor, Tensor, Tensor], Tensor]


class _Reading(NamedTuple):
    """Another reading of the measurements: columns of some signals in another order, and times other factors."""

    finding: Finding
    signals: tuple[str, ...]
    order: Tensor  # [n]
    factor: Tensor  # [n] signs, or changes of the unit

    def applied(self, rows: Sequence[Tensor]) -> list[Tensor]:
        """Rows as this reading takes them."""
        return [
            self.factor * x[:, self.order] if name in self.signals else x for name, x in zip(SIGNALS, rows, strict=True)
        ]


class _Explained(NamedTuple):
    """Fit of every joint's torque by that of the description, rotor inertia, friction and an offset."""

    left: Tensor  # [n] part of the variance that the fit leaves
    alone: Tensor  # [n] part that it leaves without the description
    factor: Tensor  # [n] factor of the description

    @property
    def trusted(self) -> Tensor:
        """Joints whose factor can be trusted [n]."""
        return (self.alone - self.left > AT.trusted) & (self.left < AT.poor)


def sampled(rows: Sequence[Tensor]) -> list[Tensor]:
    """Evenly spaced rows, a few hundred at most."""
    at = torch.linspace(0, len(rows[0]) - 1, min(AT.rows, len(rows[0])), device=rows[0].device).round().long()
    return [x[at] for x in rows]


def diagnose(robot: Robot, torques: Torques, rows: Sequence[Tensor], sign_width: float) -> list[Finding]:
    """Findings about measurements that the description of the robot does not explain.

    Args:
        robot: the robot as described.
        torques: its torques as a function of q, qd and qdd.
        rows: measured q, qd, qdd and tau, [rows, n] each.
        sign_width: velocity below which dry friction is viscous [rad/s or m/s].
    """
    if len(rows[0]) < AT.few:
        return []
    names, few = robot.joint_names, sampled(rows)
    leaps = outlier_findings(names, rows[3].detach().cpu().numpy())
    if far := beyond_limits(robot, few[0], few[1]):
        return [*leaps, *far]
    fit = _compared(torques, few, sign_width)
    found = _units(names, fit) or _currents(names, fit)
    weightless = [] if found else _weightless(torques, few, sign_width, fit.left)
    if not weightless and bool((fit.left > AT.unexplained).any()):
        found += _misread(torques, robot, few, sign_width, fit.left)
    return [*leaps, *_constant(torques, names, few, sign_width), *found, *weightless]


def beyond_limits(robot: Robot, q: Tensor, qd: Tensor | None) -> list[Finding]:
    """Findings about joints that positions and velocities [rows, n] take far beyond the limits of the description."""
    lower, upper, velocity, _ = (x.double().cpu() for x in robot.limits)
    q, qd = q.cpu(), torch.zeros_like(q).cpu() if qd is None else qd.cpu()
    reach = upper - lower
    past = torch.maximum(lower - q, q - upper)
    turns = torch.tensor([kind.turns for kind in robot.joint_types]) & (reach > 1.99 * math.pi)
    far = ((past > torch.where(turns, AT.turns, AT.past * reach)).double().mean(0) > AT.often) & (reach > 0)
    fast = ((qd.abs() > AT.faster * velocity).double().mean(0) > AT.often) & (velocity > 0)
    found = []
    for j in (far | fast).nonzero()[:, 0].tolist():
        place, other = "rad", "degrees (multiply by pi/180)"
        if not robot.joint_types[j].turns:
            place, other = "m", "millimetres (multiply by 0.001)"
        code, value = "velocity.limits", float(qd[:, j].abs().max())
        expected, moves = f"its limit is {velocity[j]:.3g} {place}/s", f"speeds up to {value:.3g}"
        if far[j]:
            code, value = "position.limits", float(q[:, j].abs().max())
            expected = f"its limits are {lower[j]:.3g} and {upper[j]:.3g} {place}"
            moves = f"positions from {q[:, j].min():.3g} to {q[:, j].max():.3g}"
        cure = f"are these {other}, or of other joints?"
        found.append(Finding(code, robot.joint_names[j], expected, moves, cure, value=value))
    return found


def unexplained(names: Sequence[str], rows: Sequence[Tensor], fitted: Tensor, sign_width: float) -> list[Finding]:
    """Findings about joints that move, whose measured torques a fit hardly explains."""
    _, qd, _, tau = rows
    if len(tau) < AT.few:
        return []
    size = tau.var(0)
    part = (tau - fitted).var(0) / size.clamp_min(1e-12 * float(size.max()) + 1e-30)
    poor = _moves(qd, sign_width) & (size > AT.faint * size.max()) & (part > AT.poor)
    claim = "the fit must explain most of the torque's variance"
    cure = "are units, signs, order of joints and the robot itself as described, and torques measured at the joints?"
    return _of_joints(names, poor, Finding("torque.unexplained", "", claim, "{:.0%}", cure), (1 - part).clamp_min(0))


def misshapen(
    names: Sequence[str], rows: Sequence[Tensor], fitted: Tensor, sign_width: float, direction: Tensor | None
) -> list[Finding]:
    """Findings about joints whose dry friction has another shape than was fitted.

    Functions of the velocity that change their sign more or less sharply explain the residuals there. `direction` is
    the sign that was fitted; None: that of `sign_width`.
    """
    _, qd, qdd, tau = (x.cpu() for x in rows)
    if len(tau) < AT.few:
        return []
    left, found = tau - fitted.cpu(), []
    own = smooth_sign(qd, sign_width) if direction is None else direction.cpu()
    cure = "if the torques were filtered, give identify the motions of smooth(log), which hold the filtered sign"
    option = None
    if direction is not None:
        cure = "where it is rounder, as in a simulation, give smooth(log) its sign_width"
        option = "where it is rounder, as in a simulation, give its --sign-width"
    claim = "the shape of its dry friction must be the one fitted, or it biases dry and viscous friction"
    for j in _moves(qd, sign_width).nonzero()[:, 0].tolist():
        v, known = qd[:, j], [own[:, j], qd[:, j], qdd[:, j], torch.ones_like(qd[:, j])]
        # an offset or a rotor that was not estimated is not friction
        before = _rest(left[:, j], known)
        after = _rest(left[:, j], [*known, *(smooth_sign(v, k * sign_width) for k in WIDTHS)])
        explained = math.sqrt(max(0.0, before**2 - after**2))
        if after < AT.shaped * before and explained > AT.seen * float(tau[:, j].std()):
            better = f"a residual of {before:.2g}, {after:.2g} with another shape"
            found.append(Finding("friction.shape", names[j], claim, better, cure, option, value=explained))
    return found


def _of_joints(names: Sequence[str], joints: Tensor, finding: Finding, values: Tensor) -> list[Finding]:
    """Findings about some joints [n], the same but for the value [n] of each."""
    return [
        finding._replace(subject=names[j], found=finding.found.format(x), value=x)
        for j, x in enumerate(values.tolist())
        if joints[j]
    ]


def _rest(x: Tensor, columns: Sequence[Tensor]) -> float:
    """Standard deviation of what columns leave of x in least squares."""
    A = torch.stack([column / column.norm().clamp_min(1e-30) for column in columns], 1)
    return float((x - A @ torch.linalg.lstsq(A, x[:, None], driver="gelsd").solution[:, 0]).std())


def _moves(qd: Tensor, sign_width: float) -> Tensor:
    """Joints that move in enough of the rows [n]."""
    return (qd.abs() > sign_width).double().mean(0) > AT.moving


def _constant(torques: Torques, names: Sequence[str], rows: Sequence[Tensor], sign_width: float) -> list[Finding]:
    """Findings about joints that move, whose measured torque never changes although the described one does."""
    q, qd, qdd, tau = rows
    varies = torques(q, qd, qdd).std(0)
    still = tau.amax(0) - tau.amin(0) <= AT.still * tau.abs().amax(0)
    dead = still & _moves(qd, sign_width) & (varies.square() > AT.faint * varies.square().max())
    cure = "is the sensor connected, and is it the right column? leave the log out, or measure again"
    claim = "the measured torque must change with the motion, as the described one does"
    return _of_joints(names, dead, Finding("torque.constant", "", claim, "{:.3g} in all rows", cure), tau[0])


def _weightless(torques: Torques, rows: Sequence[Tensor], sign_width: float, left: Tensor) -> list[Finding]:
    """Finding about torques that are explained without the gravity of the description; it leaves parts [n] of them."""
    # motion, rotor inertia and friction explain a joint's torque so well that gravity, of which they explain little,
    # cannot be in it; most joints that gravity loads must show it
    q, _, _, tau = rows
    still = torch.zeros_like(q)
    gravity = torques(q, still, still)

    def motion(q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        return torques(q, qd, qdd) - torques(q, still, still)

    fit, without = _compared(motion, rows, sign_width), _compared(motion, [*rows[:3], gravity], sign_width)
    size, weight = tau.var(0).cpu(), without.left * gravity.var(0).cpu()
    loaded = weight > AT.loaded * size
    shown = loaded & (fit.left * size < AT.weightless * weight) & (fit.factor > 1 / AT.alike) & (fit.factor < AT.alike)
    shown &= fit.left * AT.beaten < left
    if not 2 * int(shown.sum()) > int(loaded.sum()):
        return []
    cure = "add torchdq.inverse_dynamics(robot, q) to them"
    return [Finding("torque.weightless", "tau", "torques must include gravity", "torques explained without", cure)]


def _compared(torques: Torques, rows: Sequence[Tensor], sign_width: float) -> _Explained:
    """Best fit of every joint's torque by subsets of these terms and an offset, of which none but it is negative."""
    q, qd, qdd, tau = rows
    terms = torch.stack([torques(q, qd, qdd), qdd, qd, smooth_sign(qd, sign_width)], -1).double().cpu()
    scale = terms.std(0, correction=0).clamp_min(1e-30)
    X, y = (terms - terms.mean(0)) / scale, (tau - tau.mean(0)).double().cpu()  # [samples, n, 4], [samples, n]
    A = torch.einsum("sjk,sjl->jkl", X, X)
    b, total = torch.einsum("sjk,sj->jk", X, y), y.square().sum(0)
    known = total > 1e-8 * total.max()  # a joint whose torque does not change shows nothing
    total = torch.where(known, total, 1.0)
    none = torch.zeros_like(total)
    left, alone, factor = none + 1, none + 1, none
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
    return _Explained(torch.where(known, torch.minimum(left, alone), none), torch.where(known, alone, none), factor)


def _units(names: Sequence[str], fit: _Explained) -> list[Finding]:
    """Findings about joints whose torques are in another unit than those of the description."""
    wrong, factor = torch.zeros_like(fit.trusted), fit.factor
    if bool((fit.trusted & (factor * AT.unit <= 1)).any()):
        wrong |= (factor > 0) & (factor * AT.shared <= 1)
    if bool((fit.trusted & (factor >= AT.unit)).any()):
        wrong |= factor >= AT.shared
    claim = "the unit of tau must be N m (N for a joint that slides), measured at the joint"
    cure = "is the unit right? give tau in N m"
    return _of_joints(names, wrong, Finding("torque.unit", "", claim, TIMES, cure), factor)


def _currents(names: Sequence[str], fit: _Explained) -> list[Finding]:
    """Findings about torques that are small parts of the described ones at most joints, as currents are."""
    sure = (fit.factor > 0) & fit.trusted
    small = sure & (fit.factor * AT.current <= 1)
    if not 2 * int(small.sum()) > int(sure.sum()):
        return []
    claim = "tau must be a torque, not a current of a drive whose gain is missing"
    cure = "give Layout(gain=...), torque per ampere at the joints, or gain=None and Model(gains=True) to identify"
    option = "give --gains, torque per ampere at the joints, or --estimate-gains"
    return _of_joints(names, small, Finding("torque.current", "", claim, TIMES, cure, option), fit.factor)


def _misread(torques: Torques, robot: Robot, rows: Sequence[Tensor], sign_width: float, left: Tensor) -> list[Finding]:
    """Finding about the reading of the measurements that explains them far better."""
    bad, best, found = left > AT.unexplained, float(left.sum()) - AT.gain, list[Finding]()
    for reading in _readings(torques, robot, rows, sign_width, left):
        parts = _left(torques, reading.applied(rows), sign_width, left)
        tried = float(parts.sum())
        if tried < best and AT.better * float(parts[bad].sum()) < float(left[bad].sum()):
            best, found = 0.9 * tried, [reading.finding]  # the first of equals
    return found


def _left(torques: Torques, rows: Sequence[Tensor], sign_width: float, left: Tensor) -> Tensor:
    """Parts that another reading leaves [n]; `left` where its torques are not of the size of those described."""
    fit = _compared(torques, rows, sign_width)
    return torch.where((fit.factor > 1 / AT.alike) & (fit.factor < AT.alike), fit.left, torch.maximum(fit.left, left))


def _readings(
    torques: Torques, robot: Robot, rows: Sequence[Tensor], sign_width: float, left: Tensor
) -> Iterator[_Reading]:
    """Readings to try, the likeliest first."""
    n, names, device = robot.n, robot.joint_names, rows[0].device
    same, plain = torch.arange(n, device=device), torch.ones(n, dtype=rows[0].dtype, device=device)
    bad = (left > AT.unexplained).tolist()
    # signs of torques do not touch other joints: each is chosen by itself
    flipped = (left - _left(torques, [*rows[:3], -rows[3]], sign_width, left) > AT.gain / 2).to(device)
    if bool(flipped.any()):
        of = ", ".join(name for name, f in zip(names, flipped.tolist(), strict=True) if f)
        yield _Reading(_sign("torques", of), ("tau",), same, torch.where(flipped, -plain, plain))
    orders = [("columns.reversed", ", ".join(names), "with all joints in reverse", same.flip(0))] if n > 1 else []
    by_name = torch.tensor(sorted(range(n), key=lambda j: names[j]), device=device).argsort()
    if not torch.equal(by_name, same):
        orders.append(("columns.sorted", ", ".join(names), "with the joints sorted by their names", by_name))
    pairs = [pair for pair in combinations(range(n), 2) if n <= WIDE or pair[1] == pair[0] + 1]
    for i, j in (pair for pair in pairs if bad[pair[0]] or bad[pair[1]]):
        order = same.clone()
        order[[i, j]] = order[[j, i]]
        orders.append(("columns.swapped", f"{names[i]}, {names[j]}", "with both exchanged", order))
    for group, signals in GROUPS.items():
        for code, subject, other, order in orders:
            claim = f"the {group} must be in the order of the robot's joints"
            fault = Finding(code, subject, claim, f"a far better fit {other}", "reorder the columns")
            yield _Reading(fault, signals, order, plain)
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
    for unit, other, times, factor, joints in (
        ("radians", "degrees", "pi/180", math.pi / 180, turns),
        ("metres", "millimetres", "0.001", 0.001, ~turns),
    ):
        if bool(joints.any()):
            of = ", ".join(name for name, yes in zip(robot.joint_names, joints.tolist(), strict=True) if yes)
            fault = Finding("motion.unit", of, f"the {group} must be in {unit}", f"a far better fit in {other}")
            fault = fault._replace(cure=f"multiply them by {times}", value=factor)
            yield _Reading(fault, signals, same, torch.where(joints, factor * plain, plain))


def _sign(group: str, of: str) -> Finding:
    claim = f"the {group} must have the signs of the description"
    code = "torque.sign" if group == "torques" else "motion.sign"
    return Finding(code, of, claim, "a far better fit with the opposite", "reverse them in the log")
