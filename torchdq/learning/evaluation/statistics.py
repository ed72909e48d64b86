"""Statistics of residuals whose neighbouring rows are correlated: correlation times, and widths of intervals."""

from collections.abc import Sequence

import torch
from torch import Tensor

CLEAR = 2.0  # correlations below so many standard errors of none are taken for none
COVERED = 0.95  # share of measured torques in an interval


def correlation_times(residual: Tensor, lengths: Sequence[int], clear: float = CLEAR) -> Tensor:
    """Correlation times [n] in rows, at least one: 1 + 2 (sum of the correlations up to the first that is not clear).

    Residuals [rows, n] are those of motions of these lengths, one after the other. `clear` is in standard errors of no
    correlation; 0 is for seconds of motion, where few are.
    """
    size = 1 << (2 * max(lengths) - 1).bit_length()
    power = torch.zeros(size // 2 + 1, residual.shape[1], dtype=torch.float64)
    for part in residual.cpu().split(list(lengths)):
        power += torch.fft.rfft(part, size, dim=0).abs().square()
    products = torch.fft.irfft(power, size, dim=0)[: max(lengths)]
    correlation = products / products[:1].clamp_min(torch.finfo(torch.float64).tiny)
    summed = (correlation >= clear / len(residual) ** 0.5).cummin(0).values
    times = 1 + 2 * (correlation * summed)[1:].sum(0)
    return times.clamp(1.0, max(1.0, len(residual) / 4))


def interval_factors(ratios: Sequence[Tensor]) -> Tensor:
    """Half-widths [n] of intervals in units of the predicted errors.

    Rows of one block resemble each other, and a new motion is like one more block. So each block is compared with the
    quantile of the others, and the quantile of all blocks is widened by the factor with which these intervals of the
    others hold 95 % of all rows (a cross-conformal prediction, V. Vovk, Annals of Mathematics and Artificial
    Intelligence 74, 2015, of blocks instead of rows).

    `ratios` of each block that was left out are the residuals in units of the predicted errors [rows, n]; NaN: no row.
    """
    sizes = [ratio.abs() for ratio in ratios]
    quantile = torch.cat(sizes).nanquantile(COVERED, 0)
    if len(sizes) < 2:
        return quantile
    others = [torch.cat([*sizes[:k], *sizes[k + 1 :]]).nanquantile(COVERED, 0) for k in range(len(sizes))]
    beyond = torch.cat([size / other.clamp_min(1e-300) for size, other in zip(sizes, others, strict=True)])
    # twice the quantile covers a block that is unlike all others already
    return quantile * beyond.nanquantile(COVERED, 0).clamp(1.0, 2.0)
