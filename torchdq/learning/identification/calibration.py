"""Widths of the intervals of predicted torques, from residuals of blocks that were left out."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdq.learning.evaluation.coverage import interval_factors
from torchdq.learning.identification.evidence import Evidence, Unseen
from torchdq.learning.identification.regression import chunks, columns

NORMAL = 1.96  # half-width of the interval that holds 95 % of normal numbers, in standard deviations
ROWS = 4096  # most rows that are used


def half_widths(evidence: Evidence, left_out: Sequence[Sequence[Unseen]], spread: Tensor, noise: Tensor) -> Tensor:
    """Half-widths [n] of intervals that hold 95 % of measured torques, in units of the errors of parameters and noise.

    Where there are few motions, regions of the states are left out, too; of the half-widths that blocks and regions ask
    for, the larger ones are taken.

    Args:
        evidence: of all rows, with the terms of the model.
        left_out: blocks of the rows, and regions. Where there are neither, the errors are assumed to be normal.
        spread: F [k, t], the covariance of the parameters being F F^T.
        noise: standard deviations of the noise [n].
    """
    kinds = [kind for kind in left_out if kind]
    if not kinds:
        return torch.full_like(noise, NORMAL)
    return torch.stack([_factors(evidence, kind, spread[evidence.at], noise) for kind in kinds]).amax(0)


def _factors(evidence: Evidence, left_out: Sequence[Unseen], F: Tensor, noise: Tensor) -> Tensor:
    ratios, few = [], -(-sum(len(part.rows) for part in left_out) // ROWS)
    for part in left_out:
        rows = part.rows[::few]
        some, own = evidence.recording.some(rows), evidence.own[rows]
        error = torch.empty_like(some.q)
        for chunk in chunks(slice(0, len(rows)), F.numel()):
            Z = columns(evidence.robot, some.q[chunk], some.qd[chunk], some.qdd[chunk], own[chunk])
            error[chunk] = torch.einsum("rjp,jpt->rjt", Z, F.to(Z)).norm(dim=-1)
        ratios.append(part.residual[::few] / torch.hypot(error, noise.to(error)))
    return interval_factors(ratios).cpu()
