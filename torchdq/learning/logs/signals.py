"""Signals of a log, read from the tables that hold their columns, and joined by time where those are several."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.filters import NEARLY, PASSED, at_times
from torchdq.learning.logs.headers import Columns, Places
from torchdq.learning.logs.layouts import Layout
from torchdq.learning.logs.tables import Table


class Signals(NamedTuple):
    """Numbers of a log: the time, and a block of columns, one per joint, for every signal."""

    path: Path
    layout: Layout  # with the number of joints found
    names: dict[str, list[str]]  # names of the columns by signal, in their order, the time first
    time: np.ndarray  # [rows] [s]
    blocks: dict[str, np.ndarray]  # signals that the log has, [rows, n] each
    first: int  # number of the first row, for messages
    cell: Callable[[int, int], object]  # a value as the source writes it, by row and column, for messages
    before: int = 0  # rows of numbers before the first, which are left out
    joined: str = ""  # what was done to signals of other times
    findings: tuple[Finding, ...] = ()  # signals that hold no number

    def refuse(self, row: int, name: str, fault: Finding) -> NoReturn:
        """Raise for a row and a column of this name."""
        raise LogError(fault._replace(subject=f"column {name!r}"), where=f"{self.path}, row {self.first + row}")

    def rows(self, used: Any) -> "Signals":
        """Signals in some rows."""
        return self._replace(time=self.time[used], blocks={signal: x[used] for signal, x in self.blocks.items()})

    def distinct(self) -> "Signals":
        """Signals without rows that repeat a time stamp."""
        return self.rows(np.diff(self.time, prepend=-np.inf) > 0)


def read_signals(layout: Layout, columns: Columns, tables: Sequence[Table], places: Places) -> list[Signals]:
    """Signals of every table that has some, at its own times."""
    clock = columns.get("time", ["time"])[:1]
    found: dict[int, dict[str, list[str]]] = {}
    for signal, names in columns.items():
        if signal != "time":
            inside = {places[name][0][0] for name in names}
            if len(inside) > 1:
                files = ", ".join(str(tables[i].path) for i in sorted(inside))
                raise LogError(Finding("column.split", "", f"columns of {signal} must be in one file", files))
            found.setdefault(inside.pop(), {"time": clock})[signal] = names
    return [_of_table(layout, names, i, tables, places) for i, names in found.items()]


def _of_table(layout: Layout, names: dict[str, list[str]], i: int, tables: Sequence[Table], places: Places) -> Signals:
    """Signals of a table, at its times, at even ones, or at those of another table, row by row."""
    table, clock, signals = tables[i], names["time"][0], list(names)[1:]
    stamps = {} if layout.rate else dict(places[clock])  # tables that have times, and their place there
    own = [stamps[i]] if i in stamps else []
    used = {name: places[name][0][1] for signal in signals for name in names[signal]}
    if {*own} & {*used.values()}:
        claim = f"{clock!r} would be read for several signals or joints"
        raise LogError(Finding("column.shared", "", claim, "", "see columns", "see --columns"), where=table.path)
    values = table.read([*own, *used.values()])
    empty = [name for name, x in zip(used, values.T[len(own) :], strict=True) if len(x) > 1 and np.isnan(x).all()]
    if empty and (findings := _without(names, empty, table)):
        left = {signal: x for signal, x in names.items() if signal not in {one.subject for one in findings}}
        return _of_table(layout, left, i, tables, places)._replace(findings=tuple(findings))
    if own:
        time = values[:, 0] * layout.scale.get("time", 1.0)
    elif layout.rate:
        time = (table.before + np.arange(len(values))) / layout.rate
    else:
        other, k = stamps.popitem()
        time = tables[other].read([k])[:, 0] * layout.scale.get("time", 1.0)
        if len(time) != len(values):
            claim = f"there is no column {clock!r}, and {len(time)} times elsewhere for {len(values)} rows"
            cure, option = (f"rows at an even rate need none, but {x}" for x in ("Layout(rate=...)", "--rate"))
            raise LogError(Finding("time.missing", "", claim, "", cure, option), where=table.path)

    def cell(row: int, column: int) -> object:
        return table.cell(row, [*own, *used.values()][column - 1 + len(own)]) if own or column else time[row]

    blocks = dict(zip(signals, np.split(values[:, len(own) :], max(1, len(signals)), axis=1), strict=False))
    return Signals(table.path, layout, names, time, blocks, table.first, cell, table.before)


def _without(names: dict[str, list[str]], empty: list[str], table: Table) -> list[Finding]:
    """Findings about signals that a log can do without, and that are NaN throughout; raises for those that it needs."""
    cures = {"qd": "; smooth differentiates the positions", "qdd": "; smooth differentiates the velocities"}
    found = []
    for signal in names:
        if not {*names[signal]} & {*empty} or signal == "time":
            continue
        if signal == "q" or (signal not in cures and not {*names[signal]} <= {*empty}):
            column = next(name for name in names[signal] if name in empty)
            cure = "lock this joint of the robot, and leave its columns out, by Layout(columns=...)"
            option = "leave this joint out, by --joints and --columns"
            fault = Finding("column.empty", f"column {column!r}", "it holds no number in any row", "", cure, option)
            raise LogError(fault, where=table.path)
        columns = ", ".join(name for name in names[signal] if name in empty)
        claim = f"it was left out: there is no number in {columns}{cures.get(signal, '')}"
        found.append(Finding("column.empty", signal, claim, severity="note"))
    return found


def joined(parts: Sequence[Signals]) -> Signals:
    """Signals of several tables at the times of the slowest of them, while all of them run.

    Positions, velocities, accelerations and efforts are interpolated, those of more rows without what is too fast for
    the others; commands keep their last value.
    """
    findings = tuple(one for part in parts for one in part.findings)
    parts = [part.distinct() for part in parts if part.blocks] if len(parts) > 1 else parts
    if len(parts) == 1:
        return parts[0]._replace(findings=findings)
    steps = [float(np.median(np.diff(part.time))) for part in parts]
    longest, slowest = max(zip(steps, parts, strict=True), key=lambda pair: pair[0])
    first, last = max(part.time[0] for part in parts), min(part.time[-1] for part in parts)
    common = (slowest.time >= first) & (slowest.time <= last)
    time = slowest.time[common]
    if len(time) < 2:
        ranges = " and ".join(f"{part.time[0]:.6g} to {part.time[-1]:.6g} s in {part.path}" for part in parts)
        cure = "times of all files must count from the same instant"
        raise LogError(Finding("time.apart", "", "the files must have times in common", ranges, cure))
    names, blocks, said = dict[str, list[str]](), dict[str, np.ndarray](), list[str]()
    for part, step in zip(parts, steps, strict=True):
        names |= part.names
        if np.array_equal(part.time, slowest.time):
            blocks |= part.rows(common).blocks
            continue
        for signal, x in part.blocks.items():
            if signal == "command":
                blocks[signal] = x[np.searchsorted(part.time, time, "right") - 1]
            else:
                blocks[signal] = at_times(time, part.time, x, "joining files by time")
        filtered = f", low-passed at {PASSED / longest:.4g} Hz" if step * NEARLY <= longest else ""
        said.append(f"{', '.join(part.blocks)} of {part.path} ({1 / step:.4g} Hz{filtered})")
    held = " (commands are held)" if "command" in names else ""
    done = f"interpolated{held} at the times of {slowest.path} ({1 / longest:.4g} Hz): {'; '.join(said)}"
    path, done = Path(" + ".join(str(part.path) for part in parts)), done if said else "joined row by row"
    return Signals(path, slowest.layout, names, time, blocks, 0, slowest.cell, joined=done, findings=findings)
