"""Width of intervals that hold 95 % of the torques of motions that took no part in a fit."""

from collections.abc import Sequence

import torch
from torch import Tensor

COVERED = 0.95  # share of measured torques in an interval
WIDEST = 2.0  # most factor of the quantile: it holds a block that is unlike all others already


def interval_factors(ratios: Sequence[Tensor]) -> Tensor:
    """Half-widths [n] of intervals in units of the predicted errors.

    Rows of one block resemble each other, and a new motion is like one more block. So each block is compared with the
    quantile of the others, and the quantile of all blocks is widened by the factor with which these intervals of the
    others hold 95 % of all rows (a cross-conformal prediction, V. Vovk, Annals of Mathematics and Artificial
    Intelligence 74, 2015, of blocks instead of rows).

    Args:
        ratios: of each block that was left out, the residuals in units of the predicted errors [rows, n]; NaN: no row.

    >>> alike = torch.randn(6, 2000, 1, generator=torch.Generator().manual_seed(0)).double()
    >>> bool((interval_factors(list(alike)) - 1.96).abs() < 0.1)
    True
    """
    sizes = [ratio.abs() for ratio in ratios]
    quantile = torch.cat(sizes).nanquantile(COVERED, 0)
    if len(sizes) < 2:
        return quantile
    others = [torch.cat([*sizes[:k], *sizes[k + 1 :]]).nanquantile(COVERED, 0) for k in range(len(sizes))]
    beyond = torch.cat([size / other.clamp_min(1e-300) for size, other in zip(sizes, others, strict=True)])
    return quantile * beyond.nanquantile(COVERED, 0).clamp(1.0, WIDEST)
