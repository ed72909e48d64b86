"""Checks of logs: times that run on, numbers that are numbers, radians, and signals that agree with each other."""

import math
from itertools import pairwise

import numpy as np

from torchdq.learning.logs.layouts import LogError
from torchdq.learning.logs.tables import Table

GAP = 0.1  # [s] longest time between two rows; beyond it the motion in between is unknown
UNLIKE, ALIKE = 0.5, 0.95  # correlations of signals that have nothing to do with each other, and that follow each other
JUMP = 0.05  # [rad or m] change of a position between two rows that may stay unexplained by the velocities
FAR = 10.0  # times the usual unexplained change from which one is a jump
FOLLOWED = 0.01  # [rad or rad/s] least standard deviation of a signal that is compared with its rate
PARTS = 3  # most parts of a log that are named
ELSEWHERE = "read the rows before it or after it, by rows=(first, last)"


def require_numbers(table: Table) -> None:
    """Refuse cells that are not finite numbers."""
    for row, column in np.argwhere(~np.isfinite(table.values))[:1]:
        fault = f"{table.cell(row, column)} is not a finite number; {_cure(table, row, column)}"
        table.refuse(row, table.name(column), fault)


def _cure(table: Table, row: int, column: int) -> str:
    """Advice about a cell that is not a finite number."""
    if '"' in str(table.cell(row, column)):
        return "quotation marks must be removed"
    if row == 0 and np.isnan(table.values[0]).all() and len(table.values) > 1:
        start = table.first - table.layout.header
        return f"a row of words or units must be removed, or left out by rows=({start}, last)"
    return ELSEWHERE


def require_times(table: Table) -> None:
    """Refuse times that run backwards, leave gaps, or are not in seconds."""
    step, name = np.diff(table.time), table.name(0)
    if (step < 0).any():
        i = int((step < 0).argmax())
        table.refuse(i + 1, name, f"{-step[i]:.4g} s before the row above; {_repeated(table, i + 1)}{_parts(table)}")
    if (step > GAP).any():
        i = int((step > GAP).argmax())
        seconds = np.median(step) <= GAP
        cure = _parts(table) if seconds else "times must be in seconds; divide milliseconds by 1000, nanoseconds by 1e9"
        table.refuse(i + 1, name, f"{step[i]:.4g} s after the row above, more than {GAP} s; {cure}")
    if not step.any():
        table.refuse(1, name, "the same time in all rows")


def _parts(table: Table) -> str:
    """Words for the parts of a log whose times run on, at most three, the longest ones."""
    step = np.diff(table.time)
    ends = [0, *((step < 0) | (step > GAP)).nonzero()[0] + 1, len(table.time)]
    parts = [(first, last) for first, last in pairwise(ends) if table.time[last - 1] > table.time[first]]
    if not parts:
        return ELSEWHERE
    longest = sorted(sorted(parts, key=lambda part: part[0] - part[1])[:PARTS])
    words = [
        f"rows=({table.before + first}, {table.before + last}) of {table.time[last - 1] - table.time[first]:.3g} s"
        for first, last in longest
    ]
    more = f", the {PARTS} longest of {len(parts)} parts" if len(parts) > PARTS else ""
    return f"read a part of it in which time runs on: {' or '.join(words)}{more}"


def _repeated(table: Table, row: int) -> str:
    """Words for rows from one on that are the same as earlier ones; "" if they are others."""
    same = (table.values[:row] == table.values[row]).all(1).nonzero()[0]
    if not len(same):
        return ""
    first, count = int(same[0]), 0
    while row + count < len(table.values) and first + count < row:
        if not (table.values[first + count] == table.values[row + count]).all():
            break
        count += 1
    number, before, end = table.first, table.before, table.before + len(table.values)
    repeats = f"rows {number + row} to {number + row + count - 1} repeat rows {number + first} to "
    parts = f"rows=({before}, {before + row}) and rows=({before + row + count}, {end})"
    return f"{repeats}{number + first + count - 1}; leave them out: read {parts}, and give identify both motions; or "


def jump(table: Table) -> str:
    """Words for the first jump of a position that its velocities do not explain; "" for none.

    Where velocities were not recorded, those two rows before and after stand for them.
    """
    time, q, qd = table.time, table.blocks["q"], table.blocks.get("qd")
    step, change = np.diff(time), np.diff(q, axis=0)
    if qd is None:
        if len(step) < 5:
            return ""
        rate = np.pad(abs(change) / np.maximum(step, np.median(step))[:, None], ((2, 2), (0, 0)), mode="reflect")
        fastest = np.maximum(rate[:-4], rate[4:])
    else:
        fastest = np.maximum(abs(qd[1:]), abs(qd[:-1]))
    # stamps may be rounded, or late by a row
    explained = fastest * (step + np.median(step))[:, None]
    unexplained = np.maximum(abs(change) - explained, 0.0)
    jumps = unexplained > np.maximum(JUMP, FAR * np.quantile(unexplained, 0.9, axis=0))
    if not jumps.any():
        return ""
    i, joint = np.argwhere(jumps)[0]
    rows = int(jumps.any(1).sum())
    others = f", the first of {rows} such jumps" if rows > 1 else ""
    return (
        f"row {table.first + i + 1}, column {table.names['q'][joint]!r}: it changes by {abs(change[i, joint]):.3g} "
        f"within {step[i]:.3g} s, of which its velocity explains {explained[i, joint]:.2g} at most{others}; is a "
        f"number wrong, or does an angle turn over at pi? {ELSEWHERE}"
    )


def require_radians(table: Table) -> None:
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
            cure = f"if the joint does go there, pass a Layout that allows it, by {field}"
            found = f"{blocks[signal][row, joint]:.6g} {unit}, more than {limit:.3g}"
            table.refuse(row, table.names[signal][joint], f"{found}; {others} {cure}")
    for signal, rate in (("q", "qd"), ("qd", "qdd")):
        for joint in range(n) if {signal, rate} <= blocks.keys() else ():
            ratio, correlation = _followed(table.time, blocks[signal][:, joint], blocks[rate][:, joint])
            name, other = table.names[signal][joint], table.names[rate][joint]
            if abs(correlation) < UNLIKE:
                _require_no_other_rate(table, signal, rate, joint)
            if not abs(correlation) >= ALIKE or 0.5 < ratio < 2:
                continue
            cure = "the two must agree in unit, sign and joint"
            for column, factor in ((name, ratio), (other, 1 / ratio)):
                if 0.5 < factor * math.pi / 180 < 2:
                    cure = f"{column} seems to be in degrees; multiply the column by pi/180"
            found = f"{name} changes {ratio:.3g} times as much as {other} says"
            raise LogError(f"{table.path}, column {name!r}: {found}; {cure}")


def _require_no_other_rate(table: Table, signal: str, rate: str, joint: int) -> None:
    """Raise if a signal, which does not follow its own rate, follows that of another joint."""
    blocks, names = table.blocks, table.names
    for other in range(table.layout.joints):
        ratio, correlation = _followed(table.time, blocks[signal][:, joint], blocks[rate][:, other])
        if other != joint and correlation > ALIKE and 0.5 < ratio < 2:
            raise LogError(
                f"{table.path}, column {names[signal][joint]!r}: it changes as {names[rate][other]} says, not as "
                f"{names[rate][joint]}; the columns of both signals must be in the same order of joints"
            )


def _followed(time: np.ndarray, x: np.ndarray, rate: np.ndarray) -> tuple[float, float]:
    """Changes of a signal over the integral of a rate, and the correlation of both; NaN where one is at rest."""
    integral = np.concatenate([[0.0], np.cumsum(np.diff(time) * (rate[1:] + rate[:-1]) / 2)])
    x, integral = x - x.mean(), integral - integral.mean()
    if x.std() < FOLLOWED or integral.std() < FOLLOWED:
        return math.nan, math.nan
    product = float(x @ integral)
    return product / float(integral @ integral), product / math.sqrt((x @ x) * (integral @ integral))
