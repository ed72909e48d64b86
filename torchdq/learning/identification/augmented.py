"""Augmented least squares: unknowns that a fit lacks, estimated together with changes of all its parameters.

The residual of the fit is r = Z dphi + E x + noise, with the torques per unit E of unknowns x that were not estimated,
such as constant torques. Least squares for dphi and x together show how large x is, even where the fitted parameters,
above all friction, have taken its place.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.findings import Finding
from torchdq.learning.evaluation.diagnostics import of_joints
from torchdq.learning.evaluation.statistics import correlation_times
from torchdq.learning.identification.evidence import Evidence
from torchdq.learning.identification.feasible import Neighbourhood
from torchdq.learning.identification.regression import columns
from torchdq.learning.identification.terms import OFFSET, ROTOR
from torchdq.robot import Robot

SURE = 5.0  # standard errors from which something is there
MATTERS = 0.1  # part of the squared residuals of a joint or motion that it must take away to matter


class AugmentedSolution(NamedTuple):
    """Further unknowns, and the change of the parameters that goes with them."""

    y: Tensor  # [t] change of the fit
    x: Tensor  # [e]
    error: Tensor  # [e] standard errors of x
    left: Tensor  # [rows, n] residuals
    A: Tensor  # [rows n, t + e] torques per unit of y and x
    weight: Tensor  # [rows n, 1]
    covariance: Tensor  # [t + e, t + e]

    def with_more(self, E: Tensor) -> AugmentedSolution:
        """Solution with unknowns of torques per unit E [rows, n, e] alone as x, by elimination of all others."""
        columns = E.flatten(0, 1)
        others = self.covariance @ (self.A.T @ (self.weight * columns))
        own = columns - self.A @ others  # what the others do not explain
        inverse = _inverse(columns.T @ (self.weight * own))
        x = inverse @ (columns.T @ (self.weight * self.left.reshape(-1, 1)))[:, 0]
        left, y = self.left - (own @ x).reshape(self.left.shape), self.y - (others @ x)[: len(self.y)]
        return self._replace(y=y, x=x, error=inverse.diagonal().clamp_min(0).sqrt(), left=left)


class AugmentedFit(NamedTuple):
    """Rows of a fit that are used, and its prior."""

    evidence: Evidence
    near: Neighbourhood
    parameters: Tensor  # [k] of the fit
    rows: Tensor  # [rows] numbers of the rows
    motion: Tensor  # [rows] numbers of their motions
    residual: Tensor  # [rows, n] of the fit
    slope: Tensor  # [t] of the prior
    curvature: Tensor  # [t, t] of the prior

    @classmethod
    def of(
        cls, evidence: Evidence, near: Neighbourhood, y: Tensor, prior: float, residual: Tensor, most: int = 2000
    ) -> AugmentedFit:
        """Some rows of a fit y [t] with evidence of its terms, this weight of its prior, and residuals [rows, n]."""
        lengths, samples = evidence.recording.lengths, evidence.samples
        rows = torch.arange(0, samples, -(-samples // most))
        motion = torch.repeat_interleave(torch.arange(len(lengths)), torch.tensor(lengths))[rows]
        slope, curvature = (prior / 2 * part for part in near.slopes(y))
        parameters = near.described + near.S @ y
        return cls(evidence, near, parameters, rows, motion, residual[rows].cpu(), slope, curvature)

    @property
    def lengths(self) -> list[int]:
        """Rows of each motion that are used."""
        return self.motion.bincount(minlength=len(self.evidence.recording.lengths)).tolist()

    @property
    def square(self) -> Tensor:
        """Mean squares of the residuals [n]."""
        return self.residual.square().mean(0).clamp_min(torch.finfo(self.residual.dtype).tiny)

    def torques(
        self, y: Tensor, q: Tensor, qd: Tensor, qdd: Tensor, own: Tensor, *, other: Robot | None = None
    ) -> Tensor:
        """Torques [..., rows, n] of the fit with changes y [..., t], in some states; or of another robot."""
        robot = other or self.evidence.robot
        phi = (self.parameters + y @ self.near.S.T)[..., self.evidence.at].to(q)
        tau = torch.einsum("rjp,...jp->...rj", columns(robot, q, qd, qdd, own), phi)
        if ROTOR not in self.evidence.terms and robot.armature is not None:
            tau = tau + robot.armature.to(q) * qdd
        return tau.cpu()

    def linear(self, torques: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Torques per unit of y [rows, n, t] of a linear function of y, and its torques [rows, n] at zero."""
        zero = torch.zeros_like(self.slope)
        found = torques(torch.cat([zero[None], torch.eye(len(zero), dtype=zero.dtype)]))
        return (found[1:] - found[0]).movedim(0, -1).contiguous(), found[0]

    def solve(self, Z: Tensor, r: Tensor, E: Tensor, rounds: int = 2, left: Tensor | None = None) -> AugmentedSolution:
        """Unknowns of torques per unit [rows, n, e] that explain residuals [rows, n], with a change of the fit.

        Rows are weighted by what was `left` before, or by the residuals.
        """
        left, A, t = r if left is None else left, torch.cat([Z, E], -1).flatten(0, 1), Z.shape[-1]
        step = len(self.evidence.own) / len(self.rows)
        for _ in range(rounds):  # what is noise depends on the unknowns
            variance = left.square().mean(0).maximum(1e-6 * self.square)  # beyond rounding
            weight = (1 / (variance * correlation_times(left, self.lengths))).repeat(len(r))[:, None]
            weighted = A * weight
            b, H = weighted.T @ r.flatten(), weighted.T @ A
            H[:t, :t] += self.curvature / step
            b[:t] -= self.slope / step
            inverse = _inverse(H)
            x = inverse @ b
            left = r - (A @ x).reshape(r.shape)
        return AugmentedSolution(x[:t], x[t:], inverse.diagonal()[t:].clamp_min(0).sqrt(), left, A, weight, inverse)


def _inverse(H: Tensor) -> Tensor:
    """Pseudo-inverse of an information matrix."""
    size = H.diagonal().clamp_min(torch.finfo(H.dtype).tiny).sqrt()
    return torch.linalg.pinv(H / size / size[:, None], rtol=1e-12, hermitian=True) / size / size[:, None]


def offset_findings(fit: AugmentedFit) -> list[Finding]:
    """Findings about constant torques of joints that a fit lacks."""
    if OFFSET in fit.evidence.terms:
        return []
    rows, robot, evidence = fit.evidence.recording, fit.evidence.robot, fit.evidence
    states = [x[fit.rows] for x in (rows.q, rows.qd, rows.qdd, evidence.own)]
    Z, _ = fit.linear(lambda y: fit.torques(y, *states))
    found = fit.solve(Z, fit.residual, torch.eye(robot.n, dtype=Z.dtype).expand(len(Z), robot.n, robot.n))
    less = found.left.square().mean(0) < (1 - MATTERS) * fit.square
    clear = (found.x.abs() > SURE * found.error) & less & (found.error > 0)
    claim = "a constant torque is missing in the model, which biases masses and friction beyond their errors"
    cure = "Model(offset=True) estimates it, and friction that differs by direction has one, too"
    option = "--offset estimates it"
    units = ["N m" if joint.turns else "N" for joint in robot.joint_types]
    finding = Finding("torque.offset", "", claim, "about {:.2g} {}", cure, option)
    return of_joints(robot.joint_names, clear, finding, found.x, units)
