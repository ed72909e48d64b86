"""Lacks of a fit: constant torques, and lags of the torques, sought as further unknowns beside all that it has."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from torchdq.learning.identification.augmented import Beside
from torchdq.learning.identification.evidence import Evidence
from torchdq.learning.identification.lags import TorqueLag, lags
from torchdq.learning.identification.solution import Solution
from torchdq.learning.identification.terms import OFFSET
from torchdq.robot import Robot

FEW = 100  # rows below which nothing is said
SURE = 5.0  # standard errors from which something is there
MATTERS = 0.1  # part of a joint's squared residuals that a constant torque must take away to matter


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
    if len(residual) < FEW:
        return {}, []
    fit = Beside.of(evidence, found, prior, residual)
    return _constant(fit), lags(fit)


def _constant(fit: Beside) -> dict[int, float]:
    """Constant torques of joints [N m or N] that a fit lacks."""
    if OFFSET in fit.evidence.terms:
        return {}
    rows, n, evidence = fit.evidence.recording, fit.evidence.robot.n, fit.evidence
    Z, _ = fit.columns(*(x[fit.rows] for x in (rows.q, rows.qd, rows.qdd, evidence.own)))
    found = fit.sought(Z, fit.residual, torch.eye(n, dtype=Z.dtype).expand(len(Z), n, n))
    less = found.left.square().mean(0) < (1 - MATTERS) * fit.square
    told = (found.x.abs() > SURE * found.error) & less & (found.error > 0)
    return {j: float(found.x[j]) for j in told.nonzero()[:, 0].tolist()}


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
