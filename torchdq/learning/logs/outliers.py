"""Faults of a sensor, a drive or a bus: signals that leap far away and back, are cut off, or stop to change."""

from collections.abc import Sequence

import numpy as np

from torchdq.findings import Finding

REACH = 3  # rows to both sides that a row is compared with: an outlier is shorter
FAR = 20.0  # times the usual distance from these rows, from which a row is an outlier
BEYOND = 3.0  # least distance of an outlier from the usual range, relative to its size
OUTER = 0.01  # part of the rows below the usual range, and above it
LEAST = 0.1  # least size of that range, relative to the largest of all joints: a joint at rest has noise alone
SHOWN = 5  # most rows that a message names
OFTEN = 0.01  # part of the rows at the least or largest value from which torques are cut off there
CROWDED = 4.0  # times as many as at the next value: steps of a coarse sensor are about as many
FROZEN = 0.25  # [s] from which a signal that repeats its value stands still
CHANCE = 1e-6  # expected number of such runs by chance, below which they are none
TRAVEL = 0.05  # part of its range that a joint travels meanwhile


def outliers(x: np.ndarray) -> np.ndarray:
    """Whether a row of signals [rows, n] leaps from those before and after it [rows, n].

    An outlier is far from both neighbours in the same direction, which steps such as those of dry friction are not. It
    is also outside the usual range of the signal by three times the size of that range. Both follow from the median of
    all distances and the range of most rows, which a few outliers do not change.
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
        claim = "tau should not leap in single rows"
        findings.append(Finding("torque.outliers", names[j], claim, size, cure, value=len(rows)))
    return findings


def clipped_findings(names: Sequence[str], x: np.ndarray) -> list[Finding]:
    """Findings about torques [rows, n] that are cut off: many rows at the largest or least value, few next to it."""
    findings = []
    for name, column in zip(names, x.T, strict=True):
        for sign, word in ((1.0, "largest"), (-1.0, "least")):
            y = sign * column
            most = y.max()
            rest = y[y < most]
            share, next = float((y == most).mean()), float((rest == rest.max(initial=-np.inf)).sum() / len(y))
            if most and len(rest) and share > OFTEN and share > CROWDED * next:
                claim = "torques should not be cut off"
                found = f"{share:.1%} of the rows at {sign * most:.3g}, the {word} value"
                cure = "raise the limit of the drive or of the recording, or move more slowly"
                findings.append(Finding("torque.clipped", name, claim, found, cure, value=share))
    return findings


def frozen_findings(names: Sequence[str], x: np.ndarray, q: np.ndarray, time: np.ndarray, first: int) -> list[Finding]:
    """Finding about the longest time in which signals [rows, n] repeat their values, while the joints [rows, n] move.

    A signal counts that usually changes from row to row, one joint by itself or all together.
    """
    same = np.diff(x, axis=0) == 0
    travel, findings = TRAVEL * np.ptp(q, axis=0), list[Finding]()
    for joints, equal in (*(([j], same[:, j]) for j in range(x.shape[1])), (list(range(x.shape[1])), same.all(1))):
        ends = np.flatnonzero(np.diff(equal, prepend=False, append=False)).reshape(-1, 2)
        if not len(ends):
            continue
        start, end = ends[np.argmax(time[ends[:, 1]] - time[ends[:, 0]])].tolist()  # rows of the same value, inclusive
        if len(joints) == 1 and x[start, joints[0]] in (x[:, joints[0]].min(), x[:, joints[0]].max()):  # cut off
            continue
        usual = max((equal.sum() - (end - start)) / len(equal), 1 / len(equal))
        if time[end] - time[start] < FROZEN or usual > 0.5 or len(equal) * usual ** (end - start - 1) > CHANCE:
            continue
        if (np.ptp(q[start : end + 1, joints], axis=0) > np.maximum(travel[joints], 1e-3)).any():
            claim, of = "it should change while the joint moves", ", ".join(names[j] for j in joints)
            seconds = float(time[end] - time[start])
            found = f"the same value for {seconds:.2g} s from row {first + start} on"
            cure = "leave these rows out, or the log"
            findings.append(Finding("signal.frozen", of, claim, found, cure, value=seconds))
    return findings[-1:] if len(findings) > 1 else findings
