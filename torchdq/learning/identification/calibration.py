"""Widths of the intervals of predicted torques, from residuals of blocks that were left out."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdq.learning.evaluation.coverage import interval_factors
from torchdq.learning.identification.evidence import Evidence, Unseen
from torchdq.learning.identification.regression import by_chunks

NORMAL = 1.96  # half-width of the interval that holds 95 % of normal numbers, in standard deviations
ROWS = 4096  # most rows that are used


def half_widths(evidence: Evidence, left_out: Sequence[Sequence[Unseen]], spread: Tensor, noise: Tensor) -> Tensor:
    """Half-widths [n] of intervals that hold 95 % of measured torques, in units of the errors of parameters and noise.

    Of the half-widths that blocks and regions of the states that were left out ask for, the larger ones are taken;
    where there are neither, the errors are assumed to be normal. The covariance of the parameters is `spread` [k, t]
    times its transpose, `noise` are standard deviations [n].
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
        for chunk, Z in by_chunks(evidence.robot, some, own, F.numel()):
            error[chunk] = torch.einsum("rjp,jpt->rjt", Z, F.to(Z)).norm(dim=-1)
        ratios.append(part.residual[::few] / torch.hypot(error, noise.to(error)))
    return interval_factors(ratios).cpu()
