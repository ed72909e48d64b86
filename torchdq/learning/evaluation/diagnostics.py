"""Diagnostics of measurements against a robot's description: wrong units, signs and orders of columns, by joint.

A description that is off by tens of percent still explains most of a joint's torque, once friction, rotor inertia and
an offset are allowed for. Where it does not, the measurements are tried with usual faults of logs undone: a sign, a
zero, two joints exchanged, all joints reversed or sorted by name, in some of the signals. The fault that explains them
far better is reported. Other faults are checked first: outliers, motions beyond the limits of the description, constant
torques, wrong units, currents without a gain, and torques from which the drives have removed gravity.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, compress, product
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchdq.dynamics.friction import smooth_sign
from torchdq.findings import Finding
from torchdq.learning.logs.checks import UNITS, beyond_limits, scales
from torchdq.learning.logs.outliers import outlier_findings
from torchdq.robot import Robot


@dataclass(frozen=True)
class Thresholds:
    """Thresholds of the diagnostics, chosen together, on the robots of their tests and recordings of real arms."""

    # robots with masses off by 30 % and dry friction of 30 % of the torque have no finding

    rows: int = 400  # rows that are used
    few: int = 100  # rows below which nothing is reported: five coefficients a joint fit a few rows whatever they are
    unit: float = 45.0  # ratio of measured to described torques from which the unit is wrong; a payload makes one of 31
    common: float = 3.0  # the same ratio, of all joints that tell, from which no payload makes it
    spread: float = 3.0  # most ratio of these, as a payload loads the last joints most
    several: int = 3  # least number of these joints
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
    equal: float = 0.7  # part of what it leaves from which another one explains as much
    still: float = 1e-6  # change of a torque, relative to its size, that is none
    moving: float = 0.1  # least part of the rows in which a joint must move to be judged by a fit
    faint: float = 1e-4  # variance of a torque, relative to the largest, below which it may be noise alone
    driven: float = 0.05  # the same, relative to that described: a joint that swings freely has less
    poor: float = 0.5  # part of a joint's torque that a fit leaves unexplained, from which it is named
    shaped: float = 0.9  # part of the residual left by dry friction of other widths, from which the shape is another
    uneven: float = 4.0  # ratio of the residuals of a quarter of the rows to those of the next from which it is named
    matters: float = 0.1  # least of these residuals, relative to the joint's torques, to be named
    seen: float = 0.02  # residual that they explain, relative to the joint's torques, below which it does not matter


AT = Thresholds()
WIDTHS = (0.1, 1.0, 3.0, 10.0, 30.0)  # widths of dry friction that are tried, in multiples of the one assumed
WIDE = 12  # most joints of which every pair is tried; of more, neighbours alone
QUARTERS = (math.pi / 2, -math.pi / 2, math.pi)  # of a turn, that a zero is often off by
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


class _Explained(NamedTuple):
    """Fit of every joint's torque by the described one, rotor inertia, friction and an offset."""

    left: Tensor  # [n] part of the variance that the fit leaves
    factor: Tensor  # [n] factor of the described torque
    trusted: Tensor  # [n] bool: whether nothing else explains as much as that factor
    alike: Tensor  # [n] bool: whether both torques have the same size


def sampled(rows: Sequence[Tensor]) -> list[Tensor]:
    """Evenly spaced rows, a few hundred at most."""
    at = torch.linspace(0, len(rows[0]) - 1, min(AT.rows, len(rows[0])), device=rows[0].device).round().long()
    return [x[at] for x in rows]


def diagnose(robot: Robot, torques: Torques, rows: Sequence[Tensor], sign_width: float) -> list[Finding]:
    """Findings about measured q, qd, qdd and tau [rows, n] that the torques of a described robot do not explain."""
    if len(rows[0]) < AT.few:
        return []
    names, few = robot.joint_names, sampled(rows)
    leaps = outlier_findings(names, rows[3].detach().cpu().numpy())
    if far := beyond_limits(robot, few[0], few[1]):
        return [*leaps, *far]
    described = torques(*few[:3])
    fit = _compared(described, few, sign_width)
    found = _units(names, fit)
    weightless = [] if found else _weightless(torques, few, sign_width, fit.left)
    if not weightless and bool((fit.left > AT.unexplained).any()):
        found += _misread(torques, robot, few, sign_width, fit.left)
    return [*leaps, *_constant(described, names, few, sign_width), *found, *weightless]


def unexplained(
    names: Sequence[str], rows: Sequence[Tensor], fitted: Tensor, described: Tensor, sign_width: float
) -> list[Finding]:
    """Findings about joints that move and are driven, whose measured torques a fit hardly explains."""
    _, qd, _, tau = rows
    if len(tau) < AT.few:
        return []
    size = tau.var(0)
    part = (tau - fitted).var(0) / size.clamp_min(1e-12 * float(size.max()) + 1e-30)
    driven = (size > AT.faint * size.max()) & (size > AT.driven * described.var(0))
    poor = _moves(qd, sign_width) & driven & (part > AT.poor)
    claim = "the fit should explain most of the torque's variance"
    cure = "are units, signs, order of joints and the robot itself as described, and torques measured at the joints?"
    return of_joints(names, poor, Finding("torque.unexplained", "", claim, "{:.0%}", cure), (1 - part).clamp_min(0))


def uneven(names: Sequence[str], residual: Tensor, tau: Tensor) -> list[Finding]:
    """Findings about joints whose residuals [rows, n] are far larger in a quarter of the rows than in the others."""
    if len(residual) < AT.few:
        return []
    sizes = torch.stack([part.square().mean(0).sqrt() for part in residual.chunk(4)])
    ratio = sizes.amax(0) / sizes.sort(0).values[-2].clamp_min(1e-30)
    far = (ratio > AT.uneven) & (sizes.amax(0) > AT.matters * tau.std(0))
    claim = "residuals should be alike throughout"
    cure = "did something change there: the load, a contact, a sensor? look at its picture, and leave these rows out"
    finding = Finding("residual.uneven", "", claim, "{:.2g} times the others in quarter {:.0f} of the rows", cure)
    return of_joints(names, far, finding, ratio, sizes.argmax(0) + 1)


def misshapen(
    names: Sequence[str], rows: Sequence[Tensor], fitted: Tensor, sign_width: float, direction: Tensor | None
) -> list[Finding]:
    """Findings about joints whose residuals functions of the velocity explain that are more or less sharp than fitted.

    `direction` is the sign that was fitted; None: that of `sign_width`.
    """
    _, qd, qdd, tau = (x.cpu() for x in rows)
    if len(tau) < AT.few:
        return []
    cure = "where it is rounder, as in a simulation, give smooth(log) its sign_width"
    option: str | None = "where it is rounder, as in a simulation, give its --sign-width"
    if direction is None:
        direction = smooth_sign(qd, sign_width)
        cure = "if the torques were filtered, give identify the motions of smooth(log), which hold the filtered sign"
        option = None
    # an offset or a rotor that was not estimated is not friction
    known = [direction.cpu(), qd, qdd, torch.ones_like(qd)]
    shapes = [smooth_sign(qd, k * sign_width) for k in WIDTHS]
    before, after = (_rest(tau - fitted.cpu(), columns) for columns in (known, known + shapes))
    explained = (before.square() - after.square()).clamp_min(0).sqrt()
    other = _moves(qd, sign_width) & (after < AT.shaped * before) & (explained > AT.seen * tau.std(0))
    claim = "the shape of its dry friction should be the one fitted; another biases dry and viscous friction"
    fault = Finding("friction.shape", "", claim, "a residual of {1:.2g}, {2:.2g} with another shape", cure, option)
    return of_joints(names, other, fault, explained, before, after)


def of_joints(names: Sequence[str], joints: Tensor, finding: Finding, *values: Tensor | Sequence[str]) -> list[Finding]:
    """Findings about some joints [n], with the values [n] of each formatted in `found`; the first one is its value."""
    of_each = zip(names, *(x.tolist() if isinstance(x, Tensor) else x for x in values), strict=True)
    return [
        finding._replace(subject=name, found=finding.found.format(*found), value=found[0])
        for name, *found in compress(of_each, joints)
    ]


def _rest(x: Tensor, columns: list[Tensor]) -> Tensor:
    """Standard deviations [n] of the least-squares residuals of x by columns, [rows, n] each."""
    A, b = normalize(torch.stack(columns, -1), dim=0, eps=1e-30).transpose(0, 1), x.T[..., None]
    return (b - A @ torch.linalg.lstsq(A, b, driver="gelsd").solution).std((1, 2))


def _moves(qd: Tensor, sign_width: float) -> Tensor:
    """Joints [n] that move in enough of the rows."""
    return (qd.abs() > sign_width).double().mean(0) > AT.moving


def _constant(described: Tensor, names: Sequence[str], rows: Sequence[Tensor], sign_width: float) -> list[Finding]:
    """Findings about joints that move, whose measured torque never changes although the described one does."""
    _, qd, _, tau = rows
    varies = described.var(0)
    still = tau.amax(0) - tau.amin(0) <= AT.still * tau.abs().amax(0)
    dead = still & _moves(qd, sign_width) & (varies > AT.faint * varies.max())
    cure = "is the sensor connected, and is it the right column? leave the log out, or measure again"
    claim = "the measured torque should change with the motion, as the described one does"
    return of_joints(names, dead, Finding("torque.constant", "", claim, "{:.3g} in all rows", cure), tau[0])


def _weightless(torques: Torques, rows: Sequence[Tensor], sign_width: float, left: Tensor) -> list[Finding]:
    """Finding about torques that are explained without the gravity of the description; it leaves parts [n] of them."""
    # motion, rotor inertia and friction explain a joint's torque so well that gravity, of which they explain little,
    # cannot be in it; most joints that gravity loads must show it
    q, qd, qdd, tau = rows
    gravity = torques(q, torch.zeros_like(q), torch.zeros_like(q))
    motion = torques(q, qd, qdd) - gravity
    fit, without = _compared(motion, rows, sign_width), _compared(motion, [q, qd, qdd, gravity], sign_width)
    size, weight = tau.var(0).cpu(), without.left * gravity.var(0).cpu()
    loaded = weight > AT.loaded * size
    shown = loaded & (fit.left * size < AT.weightless * weight) & fit.alike & (fit.left * AT.beaten < left)
    if not 2 * int(shown.sum()) > int(loaded.sum()):
        return []
    cure = "add torchdq.inverse_dynamics(robot, q) to them"
    return [
        Finding(
            "torque.weightless",
            "tau",
            "torques should include gravity",
            "torques without it",
            cure,
        )
    ]


def _compared(described: Tensor, rows: Sequence[Tensor], sign_width: float) -> _Explained:
    """Best fit of each joint's torque by subsets of non-negative terms and an offset."""
    _, qd, qdd, tau = rows
    terms = torch.stack([described, qdd, qd, smooth_sign(qd, sign_width)], -1).double().cpu()
    scale = terms.std(0, correction=0).clamp_min(1e-30)
    X, y = (terms - terms.mean(0)) / scale, (tau - tau.mean(0)).double().cpu()  # [rows, n, 4], [rows, n]
    A, b = torch.einsum("sjk,sjl->jkl", X, X), torch.einsum("sjk,sj->jk", X, y)
    total = y.square().sum(0)
    known = total > 1e-8 * total.max()  # a joint whose torque does not change shows nothing
    used = torch.tensor(list(product((0.0, 1.0), repeat=4))).double()[:, None]  # [16, 1, 4]
    ridge = (1 - used + 1e-9 * len(X) * used).diag_embed()  # terms that are not used have the coefficient zero
    x = torch.linalg.solve(used[..., None] * A * used[..., None, :] + ridge, used * b)
    rest = 1 - (b * x).sum(-1) / total.where(known, 1.0)
    rest = rest.clamp_min(0).where((x >= 0).all(-1), 1.0).where(known, 0.0)  # [16, n]
    left, alone = rest.amin(0), rest[:8].amin(0)  # the first eight are without the described torque
    factor = x[rest.argmin(0), torch.arange(len(total)), 0] / scale[:, 0]
    trusted = (alone - left > AT.trusted) & (left < AT.poor)
    return _Explained(left, factor, trusted, (factor > 1 / AT.alike) & (factor < AT.alike))


def _units(names: Sequence[str], fit: _Explained) -> list[Finding]:
    """Findings about joints whose torques are in another unit than described, or small at most joints, as currents."""
    factor, sure = fit.factor, fit.factor[fit.trusted]
    small = (factor > 0) & (factor * AT.shared <= 1) & (sure * AT.unit <= 1).any()
    common = len(sure) >= AT.several and bool(sure.min() >= AT.common) and bool(sure.max() <= AT.spread * sure.min())
    large = (factor >= AT.shared) & (sure >= AT.unit).any() | (fit.trusted & common)
    if bool((small | large).any()):
        claim = "the unit of tau should be N m (N for a joint that slides), measured at the joint"
        cure, option = (f"is the unit right? {way} multiplies tau" for way in ("Layout(gain=...)", "--gains"))
        return of_joints(names, small | large, Finding("torque.unit", "", claim, TIMES, cure, option), factor)
    small = fit.trusted & (factor * AT.current <= 1)
    if not 2 * int(small.sum()) > int(fit.trusted.sum()):
        return []
    claim = "tau should be a torque, not a current of a drive whose gain is missing"
    cure = "give Layout(gain=...), torque per ampere at the joints, or gain=None and Model(gains=True) to identify"
    option = "give --gains, torque per ampere at the joints, or --estimate-gains"
    return of_joints(names, small, Finding("torque.current", "", claim, TIMES, cure, option), factor)


def _misread(torques: Torques, robot: Robot, rows: Sequence[Tensor], sign_width: float, left: Tensor) -> list[Finding]:
    """Finding about another reading of the measurements that explains them far better."""
    bad, most, found = left > AT.unexplained, float(left.sum()) - AT.gain, list[tuple[float, Finding]]()
    for finding, reading in _readings(torques, robot, rows, sign_width, left):
        parts = _left(torques, reading, sign_width, left)
        tried = float(parts.sum())
        if tried < most and AT.better * float(parts[bad].sum()) < float(left[bad].sum()):
            found.append((tried, finding))
    return first_of_equals(found, "a far better fit")


def first_of_equals(found: Sequence[tuple[float, Finding]], better: str) -> list[Finding]:
    """First finding of those that leave least unexplained, or nearly; it names a sign or zero among the others."""
    equals = [one for left, one in found if AT.equal * left <= min(left for left, _ in found)]
    others = {one.code: one for one in reversed(equals) if one.code in ("joint.zero", "motion.sign")}
    also = [f"or at {one.subject} {one.found}" for one in others.values() if one.code != equals[0].code]
    return [one._replace(found=f"{better} {', '.join([one.found, *also])}") for one in equals[:1]]


def _left(torques: Torques, rows: Sequence[Tensor], sign_width: float, left: Tensor) -> Tensor:
    """Parts [n] that another reading leaves unexplained; at least `left` where its torques have another size."""
    fit = _compared(torques(*rows[:3]), rows, sign_width)
    return torch.where(fit.alike, fit.left, torch.maximum(fit.left, left))


def _readings(
    torques: Torques, robot: Robot, rows: Sequence[Tensor], sign_width: float, left: Tensor
) -> Iterator[tuple[Finding, list[Tensor]]]:
    """Faults of a log with the corrected rows, the likeliest first."""
    n, names, device = robot.n, robot.joint_names, rows[0].device
    same, plain = torch.arange(n, device=device), torch.ones(n, dtype=rows[0].dtype, device=device)
    turns = torch.tensor([kind.turns for kind in robot.joint_types], device=device)
    bad = (left > AT.unexplained).tolist()

    def read(signals: Sequence[str], factor: Tensor, order: Tensor = same) -> list[Tensor]:
        return [factor * x[:, order] if name in signals else x for name, x in zip(SIGNALS, rows, strict=True)]

    # signs of torques do not touch other joints: each is chosen by itself
    flipped = (left - _left(torques, [*rows[:3], -rows[3]], sign_width, left) > AT.gain / 2).to(device)
    if bool(flipped.any()):
        of = ", ".join(compress(names, flipped))
        yield sign_finding("torques", of), read(("tau",), torch.where(flipped, -plain, plain))
    by_name = torch.tensor(sorted(same.tolist(), key=lambda j: names[j]), device=device).argsort()
    orders = [
        ("columns.reversed", ", ".join(names), "with all joints in reverse", same.flip(0)),
        ("columns.sorted", ", ".join(names), "with the joints sorted by their names", by_name),
    ]
    for i, j in combinations(range(n), 2):
        if (n <= WIDE or j == i + 1) and (bad[i] or bad[j]):
            order = same.clone()
            order[[i, j]] = order[[j, i]]
            orders.append(("columns.swapped", f"{names[i]}, {names[j]}", "with both exchanged", order))
    for group, signals in GROUPS.items():
        for code, subject, other, order in orders:
            claim = f"the {group} should be in the order of the robot's joints"
            fault = Finding(code, subject, claim, other, "reorder the columns")
            yield fault, read(signals, plain, order)
        if signals != ("tau",):
            for j, name in compress(enumerate(names), bad):
                yield sign_finding(group, name), read(signals, torch.where(same == j, -plain, plain))
        for turn, (_, unit, other, times, factor) in () if "tau" in signals else UNITS.items():
            joints, claim = turns == turn, f"the {group} should be in {unit}"
            found, (way, option) = f"in {other}", scales(signals, turn)
            cure, subject = f"multiply them by {times}, as {way} does", ", ".join(compress(names, joints))
            fault = Finding("motion.unit", subject, claim, found, cure, f"{option} reads them", value=factor)
            yield fault, read(signals, torch.where(joints, factor * plain, plain))
    for j, off in product(compress(range(n), torch.tensor(bad) & turns.cpu()), QUARTERS):
        q = rows[0] - off * (same == j)
        yield zero_finding(names[j], off, True), [q, *rows[1:]]


def zero_finding(of: str, off: float, turns: bool) -> Finding:
    """Finding about the zero of a joint that turns, or slides."""
    off = math.remainder(off, 2 * math.pi) if turns else off
    found = f"with {off:.3g} {'rad' if turns else 'm'} taken from q"
    cure, option = (f"correct q in the log, by {way}" for way in ("Layout(zero=...)", "--zero"))
    claim = "the zero of q should be that of the description"
    return Finding("joint.zero", of, claim, found, cure, option, value=off)


def sign_finding(group: str, of: str) -> Finding:
    """Finding about joints whose signals of a group have the wrong sign."""
    claim = f"the {group} should have the signs of the description"
    code = "torque.sign" if group == "torques" else "motion.sign"
    return Finding(code, of, claim, "with opposite signs", "negate them in the log")
