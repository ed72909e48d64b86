"""Checks of logs: increasing times, finite numbers, radians, signals that agree with each other and with a robot."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.signals import Signals
from torchdq.learning.logs.tables import rows_option
from torchdq.robot import Robot

GAP = 0.1 * (1 + 1e-9)  # [s] longest time between two rows; beyond it the motion in between is unknown
SLOW = 1.1 * GAP  # [s] median of these times from which they are hardly in seconds
UNLIKE, ALIKE = 0.5, 0.95  # correlations of signals that have nothing to do with each other, and that follow each other
FOLLOWS, SLIP = 0.99, 0.02  # correlation of positions with velocities that are compared, and their usual difference
JUMP = 0.05  # [rad or m] change of a position between two rows that may stay unexplained by the velocities
FAR = 10.0  # times the usual unexplained change from which one is a jump
FOLLOWED = 0.01  # [rad or rad/s] least standard deviation of a signal that is compared with its rate
OFTEN = 0.01  # part of the rows in which a joint must be beyond its limits
MOST_TURNS = 4 * math.pi  # the same of joints that may make a full turn, which often have no limit [rad]
FASTER = 3.0  # times the limit of velocity that are accepted: simulated motions do not keep it
UNITS = {  # of joints that turn or slide: symbol, name, the other unit that logs are in, and the factor to multiply by
    True: ("rad", "radians", "degrees", "pi/180", math.pi / 180),
    False: ("m", "metres", "millimetres", "0.001", 0.001),
}
CLOCK = (  # cures, in Python's words and in options
    "check their unit, or the rate of the rows, Layout(rate=...); Layout(scale={'time': ...}) corrects it",
    "check their unit, or the rate of the rows, --rate; --scale time corrects it",
)
PARTS = 3  # most parts of a log that are named
AROUND = "read the rows before it or after it, by "
SECONDS = "write stamps in seconds or, if rows are at an even rate, leave them out by "
STAMPS = f"{SECONDS}Layout(rate=...)", f"{SECONDS}--rate"
ELSEWHERE = f"{AROUND}rows=(first, last)", f"{AROUND}--rows FIRST LAST"  # for Python, and for the command line
TOO_FAR = (
    "are these degrees, or millimetres of a joint that slides? {} reads degrees; are these motors before their gears? "
    "give the gears' ratios by {}; if the joint does go there, pass {}"
)


def scales(signals: Sequence[str], turns: bool = True) -> tuple[str, str]:
    """Layout and option that read signals in degrees, or in millimetres of joints that slide."""
    symbol, factor = UNITS[turns][3:]
    python = ", ".join(f"'{signal}': {symbol}" for signal in signals)
    option = " ".join(f"{signal} {factor:.6g}" for signal in signals)
    return f"Layout(scale={{{python}}})", "--degrees" if turns and len(signals) > 1 else f"--scale {option}"


def require_numbers(table: Signals) -> None:
    """Raise unless there are two rows at least, of finite numbers."""
    if len(table.time) < 2:
        fault = Finding("log.rows", "", "at least two rows of numbers are needed", str(len(table.time)))
        raise LogError(fault, where=table.path)
    values = np.column_stack([table.time, *table.blocks.values()])
    for row, column in np.argwhere(~np.isfinite(values))[:1]:
        cell = str(table.cell(row, column))
        cure, claim = STAMPS if cell.count(":") == 2 else ELSEWHERE, f"{cell} is not a finite number"
        name = [name for names in table.names.values() for name in names][column]
        table.refuse(row, name, Finding("cell.number", "", claim, "", *cure))


def require_times(table: Signals) -> None:
    """Raise for decreasing times, gaps, and times that are not in seconds."""
    step = np.diff(table.time)
    usual, longest = np.median(step), _longest(step)
    i = int((step < 0 if (step < 0).any() else step > longest).argmax())
    late = f"{step[i]:.4g} s after the row above, more than {longest:.3g} s"
    if step[i] < 0:
        fault = Finding("time.backwards", "", f"{-step[i]:.4g} s before the row above", "", *_parts(table))
    elif usual >= SLOW:
        words = "times must be in seconds; {} 1e-3{} reads milliseconds, 1e-9 nanoseconds"
        cure, option = words.format("Layout(scale={'time':", "})"), words.format("--scale time", "")
        fault = Finding("time.unit", "", late, "", cure, option)
    elif step[i] > longest:
        fault = Finding("time.gap", "", late, "", *_parts(table))
    elif not step.any():
        fault = Finding("time.still", "", "the same time in all rows")
    else:
        return
    table.refuse(i + 1, table.names["time"][0], fault._replace(value=float(step[i])))


def _longest(step: np.ndarray) -> float:
    """Longest time between two rows that is no gap [s], in a log of ten rows a second, too."""
    usual = float(np.median(step))
    return max(GAP, 1.5 * usual) if usual < SLOW else GAP


def _parts(table: Signals) -> tuple[str, str]:
    """Cures: the longest parts of a log with increasing times, at most three."""
    step = np.diff(table.time)
    ends = [0, *((step < 0) | (step > _longest(step))).nonzero()[0] + 1, len(table.time)]
    parts = [(first, last) for first, last in pairwise(ends) if table.time[last - 1] > table.time[first]]
    if not parts:
        return ELSEWHERE
    longest = sorted(sorted(parts, key=lambda part: part[0] - part[1])[:PARTS])
    seconds = [f" of {table.time[last - 1] - table.time[first]:.3g} s" for first, last in longest]
    ways = [rows_option(table.before + first, table.before + last) for first, last in longest]
    more = f", the {PARTS} longest of {len(parts)} parts" if len(parts) > PARTS else ""
    python, option = (" or ".join(way[k] + size for way, size in zip(ways, seconds, strict=True)) for k in (0, 1))
    words = "read a part in which time increases:"
    return f"{words} {python}{more}", f"{words} {option}{more}"


def jumps(table: Signals) -> list[Finding]:
    """Finding about the first jump of a position that the velocities, or the rates two rows away, do not explain."""
    time, q, qd = table.time, table.blocks["q"], table.blocks.get("qd")
    step, change = np.diff(time), np.diff(q, axis=0)
    if qd is not None:
        fastest = np.maximum(abs(qd[1:]), abs(qd[:-1]))
    elif len(step) < 5:
        return []
    else:
        rate = np.pad(abs(change) / np.maximum(step, np.median(step))[:, None], ((2, 2), (0, 0)), mode="reflect")
        fastest = np.maximum(rate[:-4], rate[4:])
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
    """Raise for columns in degrees, by their size, and signals that contradict their rates."""
    n, blocks = table.layout.joints, table.blocks
    for signal, unit, field in (("q", "rad", "farthest"), ("qd", "rad/s", "fastest")):
        x, limit = blocks.get(signal, np.zeros((1, n))), getattr(table.layout, field)
        row, joint = divmod(int(abs(x).argmax()), n)
        if abs(x[row, joint]) > limit:
            python, degrees = scales([x for x in ("q", "qd", "qdd") if x in blocks and signal in (x, "q")])
            cure = TOO_FAR.format(python, "Layout(transmission=...)", f"a Layout that allows it, by {field}")
            option = TOO_FAR.format(degrees, "--transmission", f"--{field}")
            claim = f"{x[row, joint]:.6g} {unit}, more than {limit:.3g}"
            fault = Finding(f"{signal}.unit", "", claim, "", cure, option, value=float(x[row, joint]))
            table.refuse(row, table.names[signal][joint], fault)
    for signal, rate in (("q", "qd"), ("qd", "qdd")):
        if {signal, rate} <= blocks.keys():
            _require_rates(table, signal, rate)


def clock_findings(table: Signals) -> list[Finding]:
    """Finding about positions that all change by one factor more, or less, than the velocities say."""
    if "qd" not in table.blocks:
        return []
    ratios, correlations = (x.diagonal() for x in _rates(table, "q", "qd"))
    ratios = ratios[correlations > FOLLOWS]
    if len(ratios) < 2 or np.ptp(ratios) > SLIP * ratios.mean() or abs(ratios - 1).min() < 2 * SLIP:
        return []
    factor = float(ratios.mean())
    found = f"positions that change {factor:.3g} times as much as velocities say"
    return [Finding("time.scale", "time", "times should be in seconds", found, *CLOCK, value=factor)]


def _rates(table: Signals, signal: str, rate: str) -> tuple[np.ndarray, np.ndarray]:
    """Change of signals per integrated rate [n, n], and their correlations; NaN of what is at rest."""
    n, x, rates = table.layout.joints, table.blocks[signal], table.blocks[rate]
    change = np.diff(table.time)[:, None] * (rates[1:] + rates[:-1]) / 2
    covariance = np.cov(x.T, np.pad(np.cumsum(change, axis=0), ((1, 0), (0, 0))).T, bias=True)
    variance, both = covariance.diagonal(), covariance[:n, n:]
    moving = np.where(variance < FOLLOWED**2, np.nan, variance)  # what is at rest follows nothing
    return both / moving[n:], both / np.sqrt(np.outer(moving[:n], moving[n:]))


def _require_rates(table: Signals, signal: str, rate: str) -> None:
    """Raise for signals that differ from their integrated rates by a factor, or follow the rate of another joint."""
    ratios, correlations = _rates(table, signal, rate)
    others = table.names[rate]
    for j, name in enumerate(table.names[signal]):
        ratio, correlation = float(ratios[j, j]), abs(correlations[j, j])
        if correlation < UNLIKE:
            for k in np.flatnonzero((correlations[j] > ALIKE) & (ratios[j] > 0.5) & (ratios[j] < 2)):
                claim = f"it changes as {others[k]} says, not as {others[j]}"
                cure = "the columns of both signals must be in the same order of joints"
                raise LogError(Finding("columns.order", f"column {name!r}", claim, "", cure), where=table.path)
        if correlation >= ALIKE and not 0.5 < ratio < 2:
            cure, option = 2 * ("the two must agree in unit, sign and joint",)
            for column, one, other, factor in ((name, signal, rate, ratio), (others[j], rate, signal, 1 / ratio)):
                if 0.5 < factor * math.pi / 180 < 2:
                    cure, option = (f"{column} seems to be in degrees; {way} reads it" for way in scales([one]))
                    if other in table.layout.scale:
                        cure, option = 2 * (f"{other} seems to be in radians; leave it out of the scales",)
            claim = f"{name} changes {ratio:.3g} times as much as {others[j]} says"
            fault = Finding("columns.rate", f"column {name!r}", claim, "", cure, option, value=ratio)
            raise LogError(fault, where=table.path)


def beyond_limits(robot: Robot, q: np.ndarray | Tensor, qd: np.ndarray | Tensor | None) -> list[Finding]:
    """Findings about joints whose positions or velocities [rows, n] are far beyond the limits of the description."""
    lower, upper, velocity, _ = (x.double().cpu() for x in robot.limits)
    q = torch.as_tensor(q).cpu()
    qd = torch.zeros_like(q) if qd is None else torch.as_tensor(qd).cpu()
    reach = upper - lower
    past = torch.maximum(lower - q, q - upper)
    turns = torch.tensor([kind.turns for kind in robot.joint_types]) & (reach > 1.99 * math.pi)
    far = ((past > torch.where(turns, MOST_TURNS, reach)).double().mean(0) > OFTEN) & (reach > 0)
    fast = ((qd.abs() > FASTER * velocity).double().mean(0) > OFTEN) & (velocity > 0)
    found = []
    for j in (far | fast).nonzero()[:, 0].tolist():
        unit, _, other, _, _ = UNITS[robot.joint_types[j].turns]
        if far[j]:
            code, x, expected = "position.limits", q[:, j], f"its limits are {lower[j]:.3g} and {upper[j]:.3g} {unit}"
            moves = f"positions from {x.min():.3g} to {x.max():.3g}"
        else:
            code, x, expected = "velocity.limits", qd[:, j], f"its limit is {velocity[j]:.3g} {unit}/s"
            moves = f"speeds up to {x.abs().max():.3g}"
        ways = scales(["q"] if far[j] else ["qd"], robot.joint_types[j].turns)
        cure, option = (f"are these {other} ({way} reads them), or of other joints?" for way in ways)
        found.append(Finding(code, robot.joint_names[j], expected, moves, cure, option, value=float(x.abs().max())))
    return found
