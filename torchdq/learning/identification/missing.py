"""Lacks of a fit: constant torques, and a lag of the torques, sought as further unknowns beside all that it has.

With the residual r = Z dphi + E x + noise about the fit, E being the torque per unit of what was not sought, least
squares for both dphi and x say how large x is. What the fitted parameters explain in its place, friction above all, is
then no part of it. A lag s of torques, tau(t) = Z(t - s) phi, has the torque per unit (Z(t - s) - Z(t)) phi / s, so
that it is found in a few rounds; beside friction that remembers, which is late, too, it comes out too small.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.learning.identification.evidence import Evidence
from torchdq.learning.identification.regression import columns
from torchdq.learning.identification.solution import Solution
from torchdq.learning.identification.terms import OFFSET
from torchdq.learning.logs.correlation import correlation_times
from torchdq.robot import Robot

ROWS = 2000  # most rows that are looked at
FEW = 100  # rows below which nothing is said
SURE = 5.0  # standard errors from which something is there
MATTERS = 0.1  # part of the squared residuals, of a joint or a motion, that an unknown must take away to matter
EXACT = 1e-6  # least variance of what is left, relative to that of the residual
ROUNDS = 5  # in which a lag is found
ALIKE = 0.3  # difference of the lags of motions, relative to their mean, that one lag for all of them explains
FOLLOWED = 0.9  # part of the changes of the positions that the velocities explain, where rows follow each other


class TorqueLag(NamedTuple):
    """Lag of the torques of a motion."""

    motion: int
    seconds: float
    error: float  # standard error [s]
    rows: float  # the same lag in rows


def missing(
    evidence: Evidence, found: Solution, prior: float, residual: Tensor
) -> tuple[dict[int, float], list[TorqueLag]]:
    """Constant torques of joints [N m or N], and lags of motions, that a fit lacks and that matter.

    Args:
        evidence: of all terms that were sought.
        found: the fit.
        prior: weight of its prior.
        residual: its residuals [rows, n].
    """
    rows, n, at = evidence.recording, evidence.robot.n, evidence.at
    if len(residual) < FEW:
        return {}, []
    step = -(-len(residual) // ROWS)
    some = slice(None, None, step)
    q, qd, qdd, own = rows.q[some], rows.qd[some], rows.qdd[some], evidence.own[some]
    Z = torch.einsum("rjp,jpt->rjt", columns(evidence.robot, q, qd, qdd, own), found.near.S[at].to(q)).cpu()
    r = residual[some].cpu()
    motion = torch.repeat_interleave(torch.arange(len(rows.lengths)), torch.tensor(rows.lengths))
    lengths = motion[some].bincount(minlength=len(rows.lengths)).tolist()
    slope, curvature = (prior / 2 * x for x in found.near.slopes(found.y))

    def sought(E: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Unknowns [e] of torques per unit [rows, n, e], their errors, and the residuals [rows, n] that they leave."""
        left, A, t = r, torch.cat([Z, E], -1), Z.shape[-1]
        for _ in range(2):  # what is noise is seen beside the unknowns
            weight = 1 / (left.square().mean(0).clamp_min(EXACT * square) * correlation_times(left, lengths))
            b = torch.einsum("rjk,rj->k", A, r * weight)
            H = torch.einsum("rjk,rjl->kl", A, A * weight[:, None])
            H[:t, :t] += curvature
            b[:t] -= slope / step
            size = H.diagonal().clamp_min(torch.finfo(H.dtype).tiny).sqrt()
            inverse = torch.linalg.pinv(H / size / size[:, None], rtol=1e-12, hermitian=True) / size / size[:, None]
            x = inverse @ b
            left = r - A @ x
        return x[t:], inverse.diagonal()[t:].clamp_min(0).sqrt(), left

    square = r.square().mean(0).clamp_min(torch.finfo(r.dtype).tiny)
    constant: dict[int, float] = {}
    if OFFSET not in evidence.terms:
        x, error, left = sought(torch.eye(n, dtype=r.dtype).expand(len(r), n, n))
        told = (x.abs() > SURE * error) & (left.square().mean(0) < (1 - MATTERS) * square) & (error > 0)
        constant = {j: float(x[j]) for j in _places(told)}

    run, seconds = _runs(evidence)
    if run is None:
        return constant, []
    fitted, shift = (rows.measured - residual).cpu(), torch.ones(len(lengths), dtype=r.dtype)
    for _ in range(ROUNDS):
        late = _shifted(fitted, run, shift[motion]) - fitted
        x, error, left = sought((late / shift[motion, None])[some, :, None] * _one_hot(motion[some], shift))
        shift = torch.where(x.abs() > 1, x, torch.where(x < 0, -1.0, 1.0))
    none = torch.zeros_like(shift)
    after, before = (none.index_add(0, motion[some], (y.square() / square).sum(1)) for y in (left, r))
    told = (x.abs() > SURE * error) & (after < (1 - MATTERS) * before) & (error > 0)
    lags = [(k, float(x[k]), float(error[k])) for k in _places(told)]
    return constant, [TorqueLag(k, seconds * late, seconds * off, late) for k, late, off in lags]


def _places(told: Tensor) -> list[int]:
    return [int(k) for k in told.nonzero()[:, 0]]


def _one_hot(motion: Tensor, of: Tensor) -> Tensor:
    """One where a row is of a motion [rows, 1, motions]."""
    return torch.nn.functional.one_hot(motion, len(of)).to(of)[:, None]


def _shifted(x: Tensor, run: Tensor, late: Tensor) -> Tensor:
    """Signals [rows, n] as they were some rows before [rows], fractions of them included; as they are at ends of runs.

    Rows of the same run [rows] follow each other in time.
    """
    at = torch.arange(len(x)).to(late) - late
    first = at.floor().long().clamp(0, len(x) - 1)
    second = (first + 1).clamp_max(len(x) - 1)
    inside = (run[first] == run) & (run[second] == run)
    between = torch.lerp(x[first], x[second], (at - first).clamp(0, 1)[:, None])
    return torch.where(inside[:, None], between, x)


def _runs(evidence: Evidence) -> tuple[Tensor | None, float]:
    """Numbers of the runs of rows that follow each other [rows], None where rows are no motion, and their step [s]."""
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


def offset_missing(robot: Robot, constant: Mapping[int, float]) -> list[str]:
    """Words for constant torques that were not sought, by joint."""
    if not constant:
        return []
    names = zip(robot.joint_names, robot.joint_types, strict=True)
    units = [(name, "N m" if kind.turns else "N") for name, kind in names]
    found = ", ".join(f"about {x:.2g} {units[j][1]} at {units[j][0]}" for j, x in constant.items())
    return [
        f"a constant torque is missing: {found}; offset=True seeks it, and friction that differs by direction has one, "
        "too. Without, masses and friction are biased beyond their errors"
    ]


def lagging(names: Sequence[str], lags: Sequence[TorqueLag]) -> list[str]:
    """Words for torques that lag the motion."""
    if not lags:
        return []
    weight = sum(1 / lag.error**2 for lag in lags)
    mean = sum(lag.seconds / lag.error**2 for lag in lags) / weight
    alike = len(lags) > 1 and all(abs(lag.seconds - mean) < ALIKE * abs(mean) for lag in lags)
    found = []
    for lag in [TorqueLag(-1, mean, weight**-0.5, mean / lags[0].seconds * lags[0].rows)] if alike else lags:
        of = f"{len(lags)} motions" if lag.motion < 0 else (names and names[lag.motion]) or f"motion {lag.motion + 1}"
        cure = f"smooth(log, delay={lag.seconds:.2g})" if names else f"moving them {abs(lag.rows):.1f} rows"
        cure += "" if names else (" up" if lag.seconds > 0 else " down")
        way = "after" if lag.seconds > 0 else "before"
        size = f"{1e3 * abs(lag.seconds):.1f} +- {1e3 * lag.error:.1f} ms"
        found.append(f"torques come about {size} {way} the motion in {of}; {cure} mends it")
    return [f"{'; '.join(found)}; were they filtered or stamped by another clock? Friction is biased beyond its errors"]
