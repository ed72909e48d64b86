"""Torques per unit of effort, where drives give currents: found with the inertial parameters.

An effort is e = h Y pi + friction + noise, with h one over the gain, and friction in the unit of the effort.
Gauss-Newton linearises in pi and h about the last values: the torque Y pi there is the column of h, and the sums of
`regression.gram` suffice. A common factor of all gains cannot be distinguished from one of all masses, and comes from
the description; their ratios come from bodies that load several joints. Friction and rotors have no described torque:
where they make nearly all of a joint's efforts, its gain is not identifiable, and stays at its expectation.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.learning.evaluation.diagnostics import of_joints
from torchdq.learning.identification.evidence import Evidence, bodies
from torchdq.learning.identification.feasible import Neighbourhood
from torchdq.learning.identification.regression import by_chunks, places
from torchdq.learning.identification.solution import Solution, solve
from torchdq.learning.identification.terms import Term
from torchdq.robot import Robot

SPREAD = 0.3  # standard deviation of a gain that is given, relative to it, before the samples
WIDE = 1.0  # the same of one that is not given, relative to a first guess
STRENGTH = 100.0  # prior of the bodies, whose described masses set the factor of all gains
TRUST = 0.1  # relative standard error of the described masses together
FLAT = 0.5  # relative standard error of a first guess, above which the mean of the other joints takes its place
SHOWN = 0.1  # least effort that only bodies explain, relative to all of the joint's, for its gain to be identifiable
RESTS = f"Their common factor rests on the described masses, taken to be right within {TRUST:.0%}."

GAIN = Term("gain", ("1", "1"), signed=True)


class Gains(NamedTuple):
    """Torque per unit of effort of every joint."""

    value: Tensor  # [n]
    error: Tensor  # [n] standard error
    identifiable: Tensor  # [n] bool: whether the efforts show the bodies; if not, the value is the expected one


def drive_gains(evidence: Evidence, known: Tensor) -> tuple[Gains, Tensor]:
    """Gains of the drives, from evidence of their efforts, and L [n, n], their covariance being L L^T.

    The evidence has all terms of friction, and the rotors if the robot has any; `known` are joints whose efforts are
    torques but for a factor near one [n].
    """
    robot, sums, n = evidence.robot, evidence.total, evidence.robot.n
    terms, p = (*evidence.terms, GAIN), evidence.at.shape[1]
    at, start = places(len(robot.link_names), len(terms), n), bodies(robot, p)
    inertial = torch.arange(p) < 10 * len(robot.link_names)
    guessed = sums, start, int(inertial.sum()), evidence.samples
    first, shown = _guess(*guessed, known)
    opposite = (first + 1).abs() < 2 * SPREAD
    centre = torch.where(known, torch.where(opposite, -1.0, 1.0), _guess(*guessed, ~known)[0])
    width = torch.where(known, SPREAD, WIDE)
    scale, estimated = width * centre.abs(), torch.ones(len(terms), n, dtype=torch.bool)
    estimated[-1] = shown
    h, phi, correlation = centre, start, torch.ones(n, dtype=start.dtype)
    for _ in range(30):
        T = torch.zeros(n, p + 1, p + 2, dtype=start.dtype)
        T[:, :p, :p] = torch.diag_embed(torch.where(inertial, h[:, None], 1.0))
        T[:, :p, p] = phi
        T[:, :p, -1] = (1 - h)[:, None] * start + (h - centre)[:, None] * phi
        T[:, -1, -1] = 1
        torque = evidence.squares.sqrt()
        unit = torch.cat([evidence.unit, (torque / scale)[None]])
        near = Neighbourhood(robot, terms, estimated, torque, unit, STRENGTH)
        independent = T.mT @ sums @ T / correlation[:, None, None]
        found = solve(near, independent, evidence.squares, evidence.samples / correlation, at)
        change = found.change(at)
        before, phi = h, start + change[:, :-1] * inertial
        h = h.sign() * (h.sign() * (centre + change[:, -1])).maximum(h.abs() / 3)
        if float((h / before - 1).abs().max()) < 1e-4:
            break
        own = change[:, :-1] * ~inertial
        correlation = evidence.correlation(h[:, None] * phi - start + own)
    if bool((lost := h.abs() * 100.0 < centre.abs()).any()):
        names = ", ".join(name for name, yes in zip(robot.joint_names, lost.tolist(), strict=True) if yes)
        claim = "the efforts must show the bodies, to identify gains of the drives"
        cure = "give Layout(gain=...) for it, or leave the log out"
        raise ArgumentError(Finding("gains.lost", names, claim, "efforts that no torque explains", cure))
    relative = torch.cat([-found.spread(1.0)[at[:, -1]] / h[:, None], torch.full_like(h[:, None], TRUST)], 1)
    relative = torch.cat([relative, (width * ~shown).diag()], 1)
    spread = torch.linalg.qr(relative.T / h).R.T  # as many columns as gains
    return Gains(1 / h, spread.norm(dim=1), shown), spread


def negative_gains(robot: Robot, gains: Gains) -> list[Finding]:
    """Findings about gains that are clearly negative."""
    claim, cure = "the gain of a drive should be positive", "its efforts are counted against the joint's direction"
    finding = Finding("gain.negative", "", claim, "{:.3g} +- {:.2g}", cure)
    return of_joints(robot.joint_names, gains.value < -3 * gains.error, finding, gains.value, gains.error)


def spread_of_gains(
    evidence: Evidence,  # about torques by the gains
    found: Solution,  # fit to them
    correlation: Tensor,  # [n] correlation times of the residuals in rows, as in the fit
    prior: float,  # weight of its prior
    gains: Gains,
    spread: Tensor,  # [n, n] from `drive_gains`
) -> Tensor:
    """Factor F [k, n] of the covariance F F^T of the parameters that errors of the gains make."""
    near, facts = found.near, found.facts
    moments = torch.zeros(evidence.at.shape, dtype=spread.dtype)  # sums of Z^T tau
    for part, Z in by_chunks(evidence.robot, evidence.recording, evidence.own, moments.numel()):
        moments += torch.einsum("rjp,rj->jp", Z, evidence.recording.measured[part]).cpu()
    per_gain = moments / gains.value[:, None]
    right = torch.einsum("jp,jpt->tj", per_gain / (correlation * facts.noise**2)[:, None], near.S[evidence.at])
    return near.S @ facts.V @ ((facts.V.T @ right) / (facts.e + prior)[:, None]) @ spread


def _guess(sums: Tensor, start: Tensor, inertial: int, samples: int, estimated: Tensor) -> tuple[Tensor, Tensor]:
    """Efforts per described torque [n], each with friction alone; the mean of the others where a joint shows none.

    And whether it shows them [n], which friction and rotors do not explain as well.
    """
    n, p = start.shape
    M = torch.zeros(n, p, 1 + p - inertial, dtype=start.dtype)
    M[:, :, 0] = start
    M[:, inertial:, 1:] = torch.eye(p - inertial, dtype=start.dtype)
    A, b, c = sums[:, :-1, :-1], sums[:, :-1, -1], sums[:, -1, -1]
    right = (M.mT @ (A @ start[..., None] + b[..., None]))[..., 0]
    total = torch.einsum("jp,jpr,jr->j", start, A, start) + 2 * (start * b).sum(1) + c
    inverse = torch.linalg.pinv(M.mT @ A @ M, rtol=1e-10, hermitian=True)
    x = (inverse @ right[..., None])[..., 0]
    left = (total - (x * right).sum(1)).clamp_min(0) / samples
    shown = x[:, 0].square() > SHOWN**2 * total * inverse[:, 0, 0]
    clear = estimated & shown & ((inverse[:, 0, 0] * left).sqrt() < FLAT * x[:, 0].abs())
    middle = x[clear, 0].abs().log().mean().exp() if bool(clear.any()) else x.new_ones(())
    return torch.where(clear, x[:, 0], middle), shown
