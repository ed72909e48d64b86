"""Two integrators of high order for references, in the precision of what they are given.

Gragg-Bulirsch-Stoer extrapolation of order 16 chooses the steps; Gauss collocation of order 16 goes over the same mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import mpmath
import numpy as np

from accuracy.rows import LONG

Array = np.ndarray
Slope = Callable[[Array], Array]
COUNTS = np.arange(2, 18, 2)  # substeps of the rows of the extrapolation
FINEST = 2.0**40  # steps per second


def tolerance() -> float:
    """Error of a step that the machine's extended precision allows to ask for."""
    return max(1e-16, 200 * float(np.finfo(LONG).eps))


def extrapolated(slope: Slope, y: Array, T: float, first: float) -> tuple[Array, list[float]]:
    """State after T, and the steps that led there; all samples take the same."""
    t, h, taken = 0.0, min(first, T), []
    while t < T:
        # whole multiples of a power of two, so that their sum is the horizon exactly
        h = min(max(round(h * FINEST), 1) / FINEST, T - t)
        change, error = _gragg(slope, y, LONG(h))
        size = float((error / (1 + np.abs(y))).max())
        factor = min(max(0.9 * (tolerance() / max(size, 1e-40)) ** (1 / 15), 0.1), 4.0) if np.isfinite(size) else 0.1
        # an error that no step makes smaller is that of rounding, at a kink of the torques
        if size <= tolerance() or h * FINEST < 64:
            y, t = y + change, t + h
            taken.append(h)
        h *= factor
    return y, taken


def _gragg(slope: Slope, y: Array, h: Array) -> tuple[Array, Array]:
    """Change over a step and its estimated error: the modified midpoint rule in all rows at once, extrapolated."""
    steps = (h / COUNTS).reshape(-1, *(1,) * y.ndim)
    before = np.zeros((len(COUNTS), *y.shape), y.dtype)
    now = steps * slope(y)
    table: list[Array] = []
    for m in range(1, COUNTS[-1] + 1):
        k = len(table)  # rows before k have ended
        f = slope(y + now[k:])
        if m == COUNTS[k]:
            table.append((before[k] + now[k] + steps[k] * f[0]) / 2)
        before[k:], now[k:] = now[k:].copy(), before[k:] + 2 * steps[k:] * f
    for order in range(1, len(COUNTS)):
        last = table[-1]
        for j in reversed(range(order, len(COUNTS))):
            ratio = LONG(COUNTS[j]) / LONG(COUNTS[j - order])
            table[j] = table[j] + (table[j] - table[j - 1]) / (ratio * ratio - 1)
    return table[-1], np.abs(table[-1] - last)


@cache
def _gauss(stages: int) -> tuple[Array, Array]:
    """Coefficients of collocation in the roots of Legendre's polynomial: matrix and weights."""
    with mpmath.workdps(40):
        nodes = [mpmath.mpf(x) for x in np.polynomial.legendre.leggauss(stages)[0]]
        nodes = [mpmath.findroot(lambda x: mpmath.legendre(stages, x), x) for x in nodes]
        nodes = [(1 + x) / 2 for x in nodes]
        powers = mpmath.matrix(stages, stages)
        integrals = mpmath.matrix(stages + 1, stages)
        for k in range(stages):
            for i, c in enumerate(nodes):
                powers[i, k] = c**k
                integrals[i, k] = c ** (k + 1) / (k + 1)
            integrals[stages, k] = mpmath.mpf(1) / (k + 1)
        found = integrals * mpmath.inverse(powers)
        table = np.array([[LONG(mpmath.nstr(x, 30)) for x in found[i, :]] for i in range(stages + 1)])
    return table[:-1], table[-1]


def collocated(slope: Slope, y: Array, steps: list[float]) -> Array:
    """State after the steps, by collocation with 8 stages, iterated until nothing changes."""
    A, b = _gauss(8)
    for step in steps:
        h = LONG(step)
        k = np.broadcast_to(slope(y), (len(b), *y.shape))
        change, smallest = np.inf, np.inf
        for _ in range(100):
            new = slope(y + h * np.tensordot(A, k, 1))
            change, k = float(np.abs(new - k).max() / (1 + np.abs(new).max())), new
            if change == 0 or (change >= smallest and change < 1e-15):
                break
            smallest = min(smallest, change)
        y = y + h * np.tensordot(b, k, 1)
    return y
