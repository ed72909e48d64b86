"""Checks of logs: times that run on, finite numbers, radians, and signals that agree with each other."""

import math
from itertools import pairwise

import numpy as np

from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.signals import Signals
from torchdq.learning.logs.tables import rows_option

GAP = 0.1  # [s] longest time between two rows; beyond it the motion in between is unknown
UNLIKE, ALIKE = 0.5, 0.95  # correlations of signals that have nothing to do with each other, and that follow each other
JUMP = 0.05  # [rad or m] change of a position between two rows that may stay unexplained by the velocities
FAR = 10.0  # times the usual unexplained change from which one is a jump
FOLLOWED = 0.01  # [rad or rad/s] least standard deviation of a signal that is compared with its rate
PARTS = 3  # most parts of a log that are named
AROUND = "read the rows before it or after it, by "
ELSEWHERE = f"{AROUND}rows=(first, last)", f"{AROUND}--rows FIRST LAST"  # for Python, and for the command line


def require_numbers(table: Signals) -> None:
    """Refuse cells that are not finite numbers."""
    for row, column in np.argwhere(~np.isfinite(table.values))[:1]:
        cure = ELSEWHERE
        if row == 0 and np.isnan(table.values[0]).all() and len(table.values) > 1:
            python, option = rows_option(table.before + 1, "last")
            words = "a row of words or units must be removed, or left out by"
            cure = f"{words} {python}", f"{words} {option}"
        claim = f"{table.cell(row, column)} is not a finite number"
        table.refuse(row, table.name(column), Finding("cell.number", "", claim, "", *cure))


def require_times(table: Signals) -> None:
    """Refuse times that run backwards, leave gaps, or are not in seconds."""
    step, name = np.diff(table.time), table.name(0)
    if (step < 0).any():
        i = int((step < 0).argmax())
        cure, option = _parts(table)
        claim = f"{-step[i]:.4g} s before the row above"
        fault = Finding("time.backwards", "", claim, "", cure, option, value=float(step[i]))
        table.refuse(i + 1, name, fault)
    if (step > GAP).any():
        i = int((step > GAP).argmax())
        fault = Finding("time.gap", "", f"{step[i]:.4g} s after the row above, more than {GAP} s", value=float(step[i]))
        if np.median(step) <= GAP:
            cure, option = _parts(table)
            table.refuse(i + 1, name, fault._replace(cure=cure, option=option))
        cure = "times must be in seconds; divide milliseconds by 1000, nanoseconds by 1e9"
        table.refuse(i + 1, name, fault._replace(code="time.unit", cure=cure))
    if not step.any():
        table.refuse(1, name, Finding("time.still", "", "the same time in all rows"))


def _parts(table: Signals) -> tuple[str, str]:
    """Cures: the parts of a log in which time runs on, at most three, the longest ones."""
    step = np.diff(table.time)
    ends = [0, *((step < 0) | (step > GAP)).nonzero()[0] + 1, len(table.time)]
    parts = [(first, last) for first, last in pairwise(ends) if table.time[last - 1] > table.time[first]]
    if not parts:
        return ELSEWHERE
    longest = sorted(sorted(parts, key=lambda part: part[0] - part[1])[:PARTS])
    seconds = [f" of {table.time[last - 1] - table.time[first]:.3g} s" for first, last in longest]
    ways = [rows_option(table.before + first, table.before + last) for first, last in longest]
    more = f", the {PARTS} longest of {len(parts)} parts" if len(parts) > PARTS else ""
    python, option = (" or ".join(way[k] + size for way, size in zip(ways, seconds, strict=True)) for k in (0, 1))
    words = "read a part of it in which time runs on:"
    return f"{words} {python}{more}", f"{words} {option}{more}"


def jumps(table: Signals) -> list[Finding]:
    """The first jump of a position that its velocities do not explain.

    Where velocities were not recorded, those two rows before and after stand for them.
    """
    time, q, qd = table.time, table.blocks["q"], table.blocks.get("qd")
    step, change = np.diff(time), np.diff(q, axis=0)
    if qd is None:
        if len(step) < 5:
            return []
        rate = np.pad(abs(change) / np.maximum(step, np.median(step))[:, None], ((2, 2), (0, 0)), mode="reflect")
        fastest = np.maximum(rate[:-4], rate[4:])
    else:
        fastest = np.maximum(abs(qd[1:]), abs(qd[:-1]))
    # stamps may be rounded, or late by a row
    explained = fastest * (step + np.median(step))[:, None]
    unexplained = np.maximum(abs(change) - explained, 0.0)
    far = unexplained > np.maximum(JUMP, FAR * np.quantile(unexplained, 0.9, axis=0))
    if not far.any():
        return []
    i, joint = np.argwhere(far)[0]
    rows = int(far.any(1).sum())
    others = f", the first of {rows} such jumps" if rows > 1 else ""
    claim = (
        f"in row {table.first + i + 1} it changes by {abs(change[i, joint]):.3g} within {step[i]:.3g} s, of which its "
        f"velocity explains {explained[i, joint]:.2g} at most{others}"
    )
    cure, option = (f"is a number wrong, or does an angle turn over at pi? {way}" for way in ELSEWHERE)
    subject = f"column {table.names['q'][joint]!r}"
    return [Finding("position.jump", subject, claim, "", cure, option, value=float(change[i, joint]))]


def require_radians(table: Signals) -> None:
    """Refuse columns in degrees, by their size, and signals that do not change as their rates say."""
    n, layout, blocks = table.layout.joints, table.layout, table.blocks
    for signal, limit, unit, field in (
        ("q", layout.farthest, "rad", "farthest"),
        ("qd", layout.fastest, "rad/s", "fastest"),
    ):
        if signal not in blocks:
            continue
        row, joint = divmod(int(abs(blocks[signal]).argmax()), n)
        if abs(blocks[signal][row, joint]) > limit:
            others = "are these degrees (multiply by pi/180), or millimetres of a joint that slides (by 0.001)?"
            motors = "are these motors before their gears? give the gears' ratios by"
            goes = "if the joint does go there,"
            cure = f"{others} {motors} Layout(transmission=...); {goes} pass a Layout that allows it, by {field}"
            option = f"{others} {motors} --transmission; {goes} pass --{field}"
            x = float(blocks[signal][row, joint])
            fault = Finding(f"{signal}.unit", "", f"{x:.6g} {unit}, more than {limit:.3g}", "", cure, option, value=x)
            table.refuse(row, table.names[signal][joint], fault)
    for signal, rate in (("q", "qd"), ("qd", "qdd")):
        for joint in range(n) if {signal, rate} <= blocks.keys() else ():
            _require_rate(table, signal, rate, joint)


def _require_rate(table: Signals, signal: str, rate: str, joint: int) -> None:
    """Refuse a signal that changes by another factor than its rate says, or as the rate of another joint says."""
    blocks, name, other = table.blocks, table.names[signal][joint], table.names[rate][joint]
    ratio, correlation = _followed(table.time, blocks[signal][:, joint], blocks[rate][:, joint])
    if abs(correlation) < UNLIKE:
        for k in range(table.layout.joints):
            factor, alike = _followed(table.time, blocks[signal][:, joint], blocks[rate][:, k])
            if k != joint and alike > ALIKE and 0.5 < factor < 2:
                claim = f"it changes as {table.names[rate][k]} says, not as {other}"
                cure = "the columns of both signals must be in the same order of joints"
                raise LogError(Finding("columns.order", f"column {name!r}", claim, "", cure), where=table.path)
    if not abs(correlation) >= ALIKE or 0.5 < ratio < 2:
        return
    cure = "the two must agree in unit, sign and joint"
    for column, factor in ((name, ratio), (other, 1 / ratio)):
        if 0.5 < factor * math.pi / 180 < 2:
            cure = f"{column} seems to be in degrees; multiply the column by pi/180"
    claim = f"{name} changes {ratio:.3g} times as much as {other} says"
    raise LogError(Finding("columns.rate", f"column {name!r}", claim, "", cure, value=ratio), where=table.path)


def _followed(time: np.ndarray, x: np.ndarray, rate: np.ndarray) -> tuple[float, float]:
    """Changes of a signal over the integral of a rate, and the correlation of both; NaN where one is at rest."""
    integral = np.concatenate([[0.0], np.cumsum(np.diff(time) * (rate[1:] + rate[:-1]) / 2)])
    x, integral = x - x.mean(), integral - integral.mean()
    if x.std() < FOLLOWED or integral.std() < FOLLOWED:
        return math.nan, math.nan
    product = float(x @ integral)
    return product / float(integral @ integral), product / math.sqrt((x @ x) * (integral @ integral))
