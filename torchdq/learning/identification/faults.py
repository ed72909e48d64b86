"""Faults of a log or a description with a few unknowns: a joint's zero, a drive's constant, a tilted base.

A fit that lacks such a fault biases masses and friction. So the search starts from the description: each fault adds one
or two unknowns x to the model tau = Z(x) phi, which Gauss-Newton estimates together with phi and constant torques. The
fault that explains most of the squared residual is reported, with others that explain as much.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.findings import Finding
from torchdq.functional import regressor
from torchdq.learning.evaluation.blocks import MotionRows
from torchdq.learning.evaluation.diagnostics import QUARTERS, first_of_equals, sign_finding, zero_finding
from torchdq.learning.identification.augmented import SURE, AugmentedFit, AugmentedSolution
from torchdq.learning.identification.evidence import Evidence
from torchdq.learning.logs.checks import CLOCK
from torchdq.robot import Robot

LEFT = 0.4  # most of the squared residual that a fault may leave, to be named; real arms without one leave .59 or more
TRIED = 0.7  # the same after one linear step, to be searched further
LEAST = 1e-4  # part of the torques' variance that a fit must leave for a fault to be looked for
STEP = 1e-3  # of differences, in the units of the unknowns
FARTHEST = 0.8  # most tilt, and twice the most change of a zero at a time [rad or m]
FACTOR = 3.0  # most factor of a torque, or of times
PARTS = 20  # parts of the rows, at whose ends a payload may change

Torques = Callable[[Tensor, Tensor], Tensor]  # [..., rows, n] of unknowns x, and of changes y [..., t] of the fit


class _Fault(NamedTuple):
    """Fault that a few unknowns describe."""

    torques: Torques
    unknowns: int
    finding: Callable[[Tensor], Finding]
    least: float  # value of the finding from which, and up to which, it is this fault
    most: float
    added: bool = False  # whether its torques do not depend on the fit
    step: float = FARTHEST / 2  # most change of an unknown at a time
    start: float | None = None  # of the unknowns, if they are not near zero


def fault_findings(evidence: Evidence, estimated: Tensor) -> list[Finding]:
    """Finding about the fault that explains most of what the bodies and these coefficients [terms, n] do not."""
    near, recording = evidence.near(estimated), evidence.recording
    fit = AugmentedFit.of(evidence, near, torch.zeros(near.S.shape[1]).double(), 1.0, recording.measured, 300)
    some = recording.some(fit.rows)
    measured = some.measured.cpu()
    size = measured.var(0)
    moved = size > 0
    offsets = torch.eye(len(size)).double().expand(len(fit.rows), -1, -1)
    body = _held(evidence.robot, some)
    besides = torch.cat([offsets, torch.diag_embed(some.qdd.cpu()), body], -1)  # rotors and payloads are no fault
    Z, tau = fit.linear(lambda y: fit.torques(y, some.q, some.qd, some.qdd, evidence.own[fit.rows]))
    plain = fit.solve(Z, measured - tau, besides, rounds=3)
    further, settled = (fit.solve(Z, measured - tau, besides, rounds=k, left=plain.left) for k in (1, 7))

    def left(found: AugmentedSolution) -> float:
        return float((found.left.square().mean(0) / size)[moved].sum())

    def step(fault: _Fault, x: Tensor, last: AugmentedSolution) -> AugmentedSolution:
        units = STEP * torch.eye(fault.unknowns).double()
        changes = [fault.torques(x + unit, last.y) - fault.torques(x - unit, last.y) for unit in units]
        columns = torch.stack(changes, -1) / (2 * STEP)
        if last is plain and fault.start is None:
            return further.with_more(columns)
        of_x, at_zero = (Z, fault.torques(x, 0 * last.y)) if fault.added else fit.linear(partial(fault.torques, x))
        return fit.solve(of_x, measured - at_zero, torch.cat([besides, columns], -1), rounds=1, left=last.left)

    before = min(left(plain), left(settled))  # weights that settle may give up joints that a fault explains
    if before < LEAST * int(moved.sum()):
        return []
    named = list[tuple[float, Finding]]()
    for fault in (*_faults(fit, some, _affine(Z, tau)), *_over_time(fit, some, _affine(Z, tau), body)):
        x = torch.full((fault.unknowns,), fault.start or 0.0).double()
        found = step(fault, x, plain)
        if not left(found) < TRIED * before:
            continue
        for _ in range(8):
            change = found.x[-fault.unknowns :]
            if not bool(change.isfinite().all()):
                break
            x = x + change.clamp(-fault.step, fault.step)
            found = step(fault, x, found)
            if float(change.abs().max()) < 1e-3:
                break
        one = fault.finding(x)
        sure = one.value is None or bool((x.abs() > SURE * found.error[-fault.unknowns :]).any())
        if left(found) < LEFT * before and sure and fault.least < (one.value or 0.0) < fault.most:
            named.append((left(found), one))
    smaller = math.sqrt(before / min((some for some, _ in named), default=before))
    return first_of_equals(named, f"residuals {smaller:.2g} times smaller")


def _sized(finding: Finding, size: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Finding]:
    """Finding with the size of unknowns in its text, and as its value."""
    return lambda x: finding._replace(found=finding.found.format(float(size(x))), value=float(size(x)))


def _affine(Z: Tensor, tau: Tensor) -> Callable[[Tensor], Tensor]:
    """Torques tau + Z y as a function of y [..., t]."""
    return lambda y: tau + torch.einsum("rjt,...t->...rj", Z, y)


def _faults(fit: AugmentedFit, rows: MotionRows, whole: Callable[[Tensor], Tensor]) -> Iterator[_Fault]:
    """Faults that are tried: zero and torque factor of every joint, and the direction of gravity."""
    robot, own = fit.evidence.robot, fit.evidence.own[fit.rows]
    q, qd, qdd = rows.q, rows.qd, rows.qdd
    bodies = _affine(*fit.linear(lambda y: fit.torques(y, q, qd, qdd, 0 * own)))
    joints = [*zip(robot.joint_names, robot.joint_types, torch.eye(robot.n).double(), strict=True)]
    for sign, (name, joint, unit) in product((-1.0, 1.0), joints):

        def named(x: Tensor, name: str = name, turns: bool = joint.turns, negated: bool = sign < 0) -> Finding:
            return sign_finding("columns of all signals", name) if negated else zero_finding(name, float(x), turns)

        for start in (0.0,) if sign < 0 else (None, *QUARTERS) if joint.turns else (None,):
            yield _Fault(_misread(fit, rows, unit, sign), 1, named, -math.inf, math.inf, start=start)
    for name, _, unit in joints if robot.n > 1 else ():

        def factor(x: Tensor, y: Tensor, unit: Tensor = unit) -> Tensor:
            return whole(y) + x * unit * bodies(y)

        found = "with those of this one divided by {:.3g}"
        ways = ("Model(gains=True) estimates them", "--estimate-gains estimates them")
        cure, option = (f"check its torque constant and gear ratio; {way}" for way in ways)
        fault = Finding("torque.factor", name, "the torques of all joints should be in one unit", found, cure, option)
        yield _Fault(factor, 1, _sized(fault, lambda x: 1 + x), 1 / FACTOR, FACTOR)
    if robot.gravity is not None and bool(robot.gravity.any()):
        gravity = robot.gravity.double().cpu()

        def tilt(x: Tensor, y: Tensor) -> Tensor:
            return fit.torques(y, q, qd, qdd, own, other=robot.replace(gravity=_tilted(gravity, x).to(robot.mass)))

        def of_tilt(x: Tensor) -> Finding:
            numbers = ", ".join(f"{float(g):.3g}" for g in _tilted(gravity, x))
            claim, angle = "gravity should have the direction of the description", float(x.norm())
            found = f"with the base tilted by {math.degrees(angle):.2g} degrees"
            return Finding("base.tilt", "", claim, found, f"robot.replace(gravity=[{numbers}]) has it", value=angle)

        yield _Fault(tilt, 2, of_tilt, -FARTHEST, FARTHEST)


def _misread(fit: AugmentedFit, rows: MotionRows, unit: Tensor, sign: float) -> Torques:
    """Torques of a fit where a joint [n] has another zero, and this sign in all signals."""
    s, own = torch.where(unit > 0, sign, 1.0).to(rows.q), fit.evidence.own[fit.rows]

    def torques(x: Tensor, y: Tensor) -> Tensor:
        q = s * rows.q - (x * unit).to(rows.q)
        return s.cpu() * fit.torques(y, q, s * rows.qd, s * rows.qdd, s[:, None] * own)

    return torques


def _held(robot: Robot, rows: MotionRows) -> Tensor:
    """Torques [rows, n, 4] per unit of mass and first moments of the last link."""
    last = 10 * len(robot.link_names) - 10
    return regressor(robot, rows.q, rows.qd, rows.qdd)[..., last : last + 4].cpu()


def _over_time(
    fit: AugmentedFit, rows: MotionRows, whole: Callable[[Tensor], Tensor], body: Tensor
) -> Iterator[_Fault]:
    """Faults of times: steps of the wrong length, and a payload, of torques `body` per unit, that changes."""

    own = fit.evidence.own[fit.rows]

    def steps(x: Tensor, y: Tensor) -> Tensor:
        s = float(1 + x)
        return fit.torques(y, rows.q, s * rows.qd, s * s * rows.qdd, own)

    found = "with steps {:.3g} times as long"
    finding = _sized(Finding("time.scale", "", "times should be in seconds", found, *CLOCK), lambda x: 1 / (1 + x))
    for start in (None, 1.0, -0.5):
        yield _Fault(steps, 1, finding, 1 / FACTOR, FACTOR, start=start)
    for k in range(1, PARTS):
        after = body * (torch.arange(len(body)) >= len(body) * k // PARTS)[:, None, None]

        def held(x: Tensor, y: Tensor, after: Tensor = after) -> Tensor:
            return whole(y) + after @ x

        claim, cure = "what the arm holds should stay the same", "use the rows before that, or after it, alone"
        found = f"with {{:.3g}} kg more at its end after {k / PARTS:.0%} of the rows"
        fault = Finding("payload.changed", "", claim, found, cure)
        yield _Fault(held, 4, _sized(fault, lambda x: x[0]), -math.inf, math.inf, added=True, step=math.inf)


def _tilted(gravity: Tensor, x: Tensor) -> Tensor:
    """Gravity [3] turned by x [2] radians towards two directions across it."""
    down = gravity / gravity.norm()
    across = torch.linalg.qr(torch.stack([down, *torch.eye(3).double()[down.abs().argsort()[:2]]], 1)).Q[:, 1:]
    angle = x.norm()
    return gravity.norm() * (angle.cos() * down + torch.sinc(angle / math.pi) * (across @ x))
