"""Correlation time of residuals: the number of rows that say as much as one independent row would."""

from collections.abc import Sequence

import torch
from torch import Tensor

CLEAR = 2.0  # correlations below so many standard errors of none are taken for none


def correlation_times(residual: Tensor, lengths: Sequence[int], clear: float = CLEAR) -> Tensor:
    """Correlation times [n] in rows, at least one: 1 + 2 (sum of the correlations up to the first that is not clear).

    Residuals [rows, n] are those of motions of these lengths, one after the other. `clear` is in standard errors of no
    correlation; 0 is for seconds of motion, where few are.

    >>> white = torch.randn(1000, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    >>> held = white.repeat_interleave(4, 0)  # in runs of four equal rows
    >>> bool(correlation_times(white, [1000]) < 1.2), bool((correlation_times(held, [4000]) - 4).abs() < 0.5)
    (True, True)
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
