"""Signals of a log, read from the tables that hold their columns, and joined by time where those are several."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.filters import PASSED, at_times
from torchdq.learning.logs.headers import Places
from torchdq.learning.logs.layouts import Layout
from torchdq.learning.logs.tables import Table


class Signals(NamedTuple):
    """Numbers of a log: the time, and a block of columns, one per joint, for every signal."""

    path: Path
    layout: Layout  # with the number of joints found
    names: dict[str, list[str]]  # names of the columns by signal, in their order
    values: np.ndarray  # [rows, columns]
    first: int  # number of the first row, for messages
    cell: Callable[[int, int], object]  # a value as the source writes it, for messages
    before: int = 0  # rows of numbers before the first, which are left out
    joined: str = ""  # what was done to signals of other times

    @property
    def time(self) -> np.ndarray:
        """Time stamps [rows] [s]."""
        return self.values[:, 0]

    @property
    def blocks(self) -> dict[str, np.ndarray]:
        """Arrays of the signals that the log has, without the time, [rows, n] each."""
        n, signals = self.layout.joints, list(self.names)[1:]
        return {signal: self.values[:, 1 + i * n : 1 + (i + 1) * n] for i, signal in enumerate(signals)}

    def name(self, column: int) -> str:
        """Name of a column."""
        return [name for names in self.names.values() for name in names][column]

    def refuse(self, row: int, name: str, fault: Finding) -> NoReturn:
        """Raise for a row and a column of this name."""
        raise LogError(fault._replace(subject=f"column {name!r}"), where=f"{self.path}, row {self.first + row}")

    def distinct(self) -> "Signals":
        """Rows without those that repeat a time stamp."""
        return self._replace(values=self.values[np.concatenate([[True], np.diff(self.time) > 0])])


def read_signals(
    layout: Layout, columns: Mapping[str, Sequence[str]], tables: Sequence[Table], places: Places
) -> list[Signals]:
    """Signals of every table that has some, at its own times."""
    found: dict[int, dict[str, list[str]]] = {}
    for signal, names in columns.items():
        if signal != "time":
            inside = {places[name][0][0] for name in names}
            if len(inside) > 1:
                files = ", ".join(str(tables[i].path) for i in sorted(inside))
                raise LogError(Finding("column.split", "", f"columns of {signal} must be in one file", files))
            found.setdefault(inside.pop(), {})[signal] = list(names)
    clock = columns.get("time", ["time"])[0]
    stamps = {i: k for i, k in places.get(clock, ())}
    return [_of_table(layout, {"time": [clock], **names}, i, tables, places, stamps) for i, names in found.items()]


def _of_table(
    layout: Layout,
    names: dict[str, list[str]],
    i: int,
    tables: Sequence[Table],
    places: Places,
    stamps: Mapping[int, int],
) -> Signals:
    """Signals of a table, at its times, at even ones, or at those of another table, row by row."""
    table, used = tables[i], [places[name][0][1] for block in list(names.values())[1:] for name in block]
    if layout.rate or i not in stamps:
        values = table.read(used)
        time = (table.before + np.arange(len(values))) / layout.rate if layout.rate else np.empty(0)
        for other, k in stamps.items() if not layout.rate else ():
            time = tables[other].read([k])[:, 0]
        if len(time) != len(values):
            claim = f"there is no column {names['time'][0]!r}, and {len(time)} times elsewhere for {len(values)} rows"
            cure, option = (f"rows at an even rate need none, but {x}" for x in ("Layout(rate=...)", "--rate"))
            raise LogError(Finding("time.missing", "", claim, "", cure, option), where=table.path)
        values, used = np.column_stack([time, values]), [used[0], *used]
    elif stamps[i] in used:
        claim = f"{names['time'][0]!r} would be read for several signals or joints"
        raise LogError(Finding("column.shared", "", claim, "", "see columns", "see --columns"), where=table.path)
    else:
        used = [stamps[i], *used]
        values = table.read(used)
    if len(values) < 2:
        fault = Finding("log.rows", "", "at least two rows of numbers are needed", str(len(values)))
        raise LogError(fault, where=table.path)
    return Signals(table.path, layout, names, values, table.first, lambda r, k: table.cell(r, used[k]), table.before)


def joined(parts: Sequence[Signals]) -> Signals:
    """Signals of several tables at the times of the slowest of them, while all of them run.

    Positions, velocities, accelerations and efforts are interpolated, those of more rows without what is too fast for
    the others; commands keep their last value.
    """
    if len(parts) == 1:
        return parts[0]
    parts = [part.distinct() for part in parts]
    steps = [float(np.median(np.diff(part.time))) for part in parts]
    k = int(np.argmax(steps))
    slowest = parts[k]
    first, last = max(part.time[0] for part in parts), min(part.time[-1] for part in parts)
    time = slowest.time[(slowest.time >= first) & (slowest.time <= last)]
    if len(time) < 2:
        ranges = " and ".join(f"{part.time[0]:.6g} to {part.time[-1]:.6g} s in {part.path}" for part in parts)
        cure = "times of all files must count from the same instant"
        raise LogError(Finding("time.apart", "", "the files must have times in common", ranges, cure))
    names, blocks, said = {"time": slowest.names["time"]}, [], list[str]()
    for part, step in zip(parts, steps, strict=True):
        same = len(part.time) == len(slowest.time) and bool((part.time == slowest.time).all())
        for signal, x in part.blocks.items():
            names[signal] = part.names[signal]
            if same:
                x = x[(part.time >= first) & (part.time <= last)]
            elif signal == "command":
                x = x[np.searchsorted(part.time, time, "right") - 1]
            else:
                x = at_times(time, part.time, x, "joining files by time")
            blocks.append(x)
        if not same:
            filtered = f", low-passed at {PASSED / steps[k]:.4g} Hz" if step < steps[k] / 1.05 else ""
            what = ", ".join(list(part.names)[1:])
            said.append(f"{what} of {part.path} ({1 / step:.4g} Hz{filtered})")
    held = " (commands are held)" if "command" in names else ""
    done = f"interpolated{held} at the times of {slowest.path} ({1 / steps[k]:.4g} Hz): {'; '.join(said)}"
    path, values = Path(" + ".join(str(part.path) for part in parts)), np.column_stack([time, *blocks])
    done = done if said else "joined row by row"
    return Signals(path, slowest.layout, names, values, 0, lambda r, c: values[r, c], joined=done)
