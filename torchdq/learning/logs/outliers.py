"""Outliers of a log: rows in which a signal leaps far away and back, by faults of a sensor or a bus."""

from collections.abc import Sequence

import numpy as np

from torchdq.findings import Finding

REACH = 3  # rows to both sides that a row is compared with: an outlier is shorter
FAR = 20.0  # times the usual distance from these rows, from which a row is an outlier
BEYOND = 3.0  # least distance of an outlier from the usual range, relative to its size
OUTER = 0.01  # part of the rows below the usual range, and above it
LEAST = 0.1  # least size of that range, relative to the largest of all joints: a joint at rest has noise alone
SHOWN = 5  # most rows that a message names


def outliers(x: np.ndarray) -> np.ndarray:
    """Whether a row of signals [rows, n] leaps from those before and after it [rows, n].

    An outlier is far from both neighbours in the same direction, which steps such as those of dry friction are not. It
    is also outside the usual range of the signal by three times the size of that range. Both follow from the median of
    all distances and the range of most rows, which a few outliers do not change.

    >>> x = np.sin(np.linspace(0, 6, 200))[:, None]
    >>> x[[50, 120]] = 1000.0
    >>> np.flatnonzero(outliers(x)[:, 0]).tolist()
    [50, 120]
    """
    found = np.zeros(x.shape, dtype=bool)
    if len(x) <= 4 * REACH:
        return found
    before = x[REACH:-REACH] - x[: -2 * REACH]
    after = x[REACH:-REACH] - x[2 * REACH :]
    nearest = np.minimum(abs(before), abs(after))
    # 1.4826: standard deviation of normal numbers over the median of their sizes
    found[REACH:-REACH] = (before * after > 0) & (nearest > FAR * 1.4826 * np.median(nearest, axis=0))
    low, high = np.quantile(x, (OUTER, 1 - OUTER), axis=0)
    reach = BEYOND * np.maximum(high - low, LEAST * (high - low).max())
    return found & ((x > high + reach) | (x < low - reach))


def outlier_findings(names: Sequence[str], x: np.ndarray, first: int = 0) -> list[Finding]:
    """Findings about the outliers of torques [rows, n], a joint or column each; rows are numbered from `first`."""
    found, findings = outliers(x), []
    for j in np.flatnonzero(found.any(0)).tolist():
        rows = np.flatnonzero(found[:, j])
        some = ", ".join(f"{x[i, j]:.3g} in row {first + i}" for i in rows[:SHOWN].tolist())
        more = f" and {len(rows) - SHOWN} more rows" if len(rows) > SHOWN else ""
        size = f"{some}{more}, elsewhere up to {np.quantile(abs(x[:, j]), 1 - OUTER):.2g}"
        cure = "least squares follow a few such rows more than all the others; delete these rows from the log"
        claim = "tau must not leap in single rows"
        findings.append(Finding("torque.outliers", names[j], claim, size, cure, value=len(rows)))
    return findings
