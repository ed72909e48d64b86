"""Lags of measured torques behind the motion, found together with changes of all parameters of a fit.

Torques delayed by s are tau(t) = Z(t - s) phi. Friction fitted without the lag explains a part of it, above all
friction with memory. So the search iterates: the model is shifted by the present estimate, and least squares estimate
the parameters again together with the remaining lag, whose torque per unit is -d/dt Z(t - s) phi, until none remains.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.findings import Finding
from torchdq.learning.identification.augmented import MATTERS, SURE, AugmentedFit
from torchdq.learning.identification.evidence import Evidence

ROUNDS = 12  # most times that the model is moved
FARTHEST = 10.0  # most rows that it is moved at a time
ALIKE = 0.3  # difference of the lags of motions, relative to their mean, that one lag for all of them explains
FOLLOWED = 0.9  # part of the changes of the positions that the velocities explain, where rows follow each other


class _Lag(NamedTuple):
    """Lag of the torques of a motion."""

    of: str  # the motion
    rows: float
    error: float  # standard error in rows
    settled: bool  # whether the search came to its end; if not, the lag is longer


def lag_findings(fit: AugmentedFit) -> list[Finding]:
    """Findings about torques that lag the motion, with the lag in seconds: one for all motions that share it."""
    run, seconds = _runs(fit.evidence)
    if run is None:
        return []
    names = fit.evidence.recording.names or ("",) * len(fit.lengths)
    found = zip(names, *(x.tolist() for x in _search(fit, run)), strict=True)
    lags = [
        _Lag(name or f"motion {k + 1}", late, error, settled)
        for k, (name, late, error, settled, matters) in enumerate(found)
        if matters and abs(late) > SURE * error > 0 and (settled or abs(late) > ROUNDS * FARTHEST / 2)
    ]
    if len(lags) > 1:
        weight = sum(1 / lag.error**2 for lag in lags)
        mean = sum(lag.rows / lag.error**2 for lag in lags) / weight
        if all(abs(lag.rows - mean) < ALIKE * abs(mean) for lag in lags):
            lags = [_Lag(f"{len(lags)} motions", mean, weight**-0.5, all(lag.settled for lag in lags))]
    return [_finding(lag, seconds, bool(fit.evidence.recording.names)) for lag in lags]


def _finding(lag: _Lag, step: float, named: bool) -> Finding:
    """Finding about a lag of rows with a step [s], in motions that have names or not."""
    seconds, least = step * lag.rows, "about" if lag.settled else "at least"
    size = f"{1e3 * abs(seconds):.1f} +- {1e3 * step * lag.error:.1f} ms"
    claim = "torques should not lag behind the motion, which biases friction beyond its errors"
    found = f"torques {least} {size} {'after' if seconds > 0 else 'before'} the motion"
    cause = "were they filtered, stamped by another clock, or late by friction that remembers (effects.LuGre)?"
    cure = f"smooth(log, delay={seconds:.2g}) removes it; {cause}"
    if not named:
        cure = f"moving them {abs(lag.rows):.1f} rows {'up' if seconds > 0 else 'down'} removes it; {cause}"
    option = f"--delay {seconds:.2g} removes it; {cause}"
    return Finding("torque.lag", lag.of, claim, found, cure, option, value=seconds)


def _search(fit: AugmentedFit, run: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lags [motions] in rows by Gauss-Newton, their standard errors, which of them settled, and which matter."""
    measured = fit.evidence.recording.measured.cpu()[fit.rows]
    late = torch.zeros(len(fit.lengths), dtype=measured.dtype)
    y, one = torch.zeros_like(fit.slope), torch.nn.functional.one_hot(fit.motion, len(late)).to(late)[:, None]

    def squares(left: Tensor) -> Tensor:
        return torch.zeros_like(late).index_add(0, fit.motion, (left.square() / fit.square).sum(1))

    before = late
    for k in range(ROUNDS):
        Z, tau, slope, inside = _moved(fit, run, late[fit.motion], y)
        Z, r = Z * inside[..., None], (measured - tau) * inside
        if not k:
            before = squares(fit.solve(Z, r, Z[..., :0]).left)
        found = fit.solve(Z, r, (slope * inside)[..., None] * one)
        y, x = found.y, found.x.clamp(-FARTHEST, FARTHEST)
        late = late + x
        settled = x.abs() < 0.02 * found.error.clamp_min(1.0)
        if bool(settled.all()):
            break
    return late, found.error, settled, squares(found.left) < (1 - MATTERS) * before


def _moved(fit: AugmentedFit, run: Tensor, late: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Columns and torques of the fit `late` rows before, change of torques at y by one more, and 1 for known rows."""
    recording, all_late = fit.evidence.recording, torch.cat([late, late - 0.5, late + 0.5])
    at = fit.rows.repeat(3) - all_late
    first = at.floor().long().clamp(0, len(run) - 1)
    second = (first + 1).clamp_max(len(run) - 1)
    rows = fit.rows.repeat(3)
    inside = ((run[first] == run[rows]) & (run[second] == run[rows])).reshape(3, -1).all(0)

    def drawn(x: Tensor) -> Tensor:
        share = (at - first).to(x).reshape(-1, *[1] * (x.ndim - 1))
        return torch.lerp(x[first], x[second], share)

    states = [drawn(x) for x in (recording.q, recording.qd, recording.qdd, fit.evidence.own)]
    Z, tau = fit.linear(lambda y: fit.torques(y, *(x[: len(late)] for x in states)))
    before, after = fit.torques(y, *(x[len(late) :] for x in states)).chunk(2)
    return Z, tau, after - before, inside[:, None].to(tau)


def _runs(evidence: Evidence) -> tuple[Tensor | None, float]:
    """Numbers of the runs of rows that follow each other [rows], None where rows are not motion, and their step [s]."""
    rows = evidence.recording
    change, speed = rows.q.diff(dim=0).cpu(), (0.5 * (rows.qd[1:] + rows.qd[:-1])).cpu()
    follows = torch.ones(len(change), dtype=torch.bool)
    follows[torch.tensor(rows.lengths).cumsum(0)[:-1] - 1] = False
    if rows.time is not None:
        step = rows.time.diff().cpu()
        seconds = float(step.median())
        follows &= (step > 0) & (step < 1.5 * seconds)
    else:
        change, speed = change[follows], speed[follows]
        seconds = float((change * speed).sum() / speed.square().sum().clamp_min(1e-300))
        left = (change - seconds * speed).square().sum()
        if not seconds > 0 or float(left) > (1 - FOLLOWED) * float(change.square().sum()):
            return None, 0.0
    return torch.cat([follows.new_zeros(1), ~follows]).cumsum(0), seconds
