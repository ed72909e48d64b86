"""Effects that a fit lacks: constant torques, and lags of the torques, as unknowns of augmented least squares."""

from __future__ import annotations

import torch
from torch import Tensor

from torchdq.findings import Finding
from torchdq.learning.identification.augmented import AugmentedFit
from torchdq.learning.identification.evidence import Evidence
from torchdq.learning.identification.lags import lag_findings, lags
from torchdq.learning.identification.solution import Solution
from torchdq.learning.identification.terms import OFFSET

FEW = 100  # rows below which nothing is reported
SURE = 5.0  # standard errors from which something is there
MATTERS = 0.1  # part of a joint's squared residuals that a constant torque must take away to matter


def missing_effects(
    evidence: Evidence, found: Solution, prior: float, residual: Tensor, offsets: bool
) -> list[Finding]:
    """Findings about lags of the torques, and constant torques of joints, that a fit lacks and that matter.

    Args:
        evidence: of all terms that were estimated.
        found: the fit.
        prior: weight of its prior.
        residual: its residuals [rows, n].
        offsets: whether constant torques are looked for.
    """
    if len(residual) < FEW:
        return []
    fit = AugmentedFit.of(evidence, found, prior, residual)
    return [*lag_findings(evidence.recording.names, lags(fit)), *(_constant_torques(fit) if offsets else ())]


def _constant_torques(fit: AugmentedFit) -> list[Finding]:
    """Findings about constant torques of joints that a fit lacks."""
    if OFFSET in fit.evidence.terms:
        return []
    rows, robot, evidence = fit.evidence.recording, fit.evidence.robot, fit.evidence
    Z, _ = fit.columns(*(x[fit.rows] for x in (rows.q, rows.qd, rows.qdd, evidence.own)))
    found = fit.solve(Z, fit.residual, torch.eye(robot.n, dtype=Z.dtype).expand(len(Z), robot.n, robot.n))
    less = found.left.square().mean(0) < (1 - MATTERS) * fit.square
    clear = (found.x.abs() > SURE * found.error) & less & (found.error > 0)
    claim = "a constant torque is missing in the model, which biases masses and friction beyond their errors"
    cure = "Model(offset=True) estimates it, and friction that differs by direction has one, too"
    option = "--offset estimates it"
    return [
        Finding(
            "torque.offset",
            robot.joint_names[j],
            claim,
            f"about {found.x[j]:.2g} {'N m' if robot.joint_types[j].turns else 'N'}",
            cure,
            option,
            value=float(found.x[j]),
        )
        for j in clear.nonzero()[:, 0].tolist()
    ]
