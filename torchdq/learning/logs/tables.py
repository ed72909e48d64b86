"""Numbers of a log as its source holds them, before anything is made of them: the table that every source becomes."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.layouts import Layout


class Table(NamedTuple):
    """Columns of a log that are read: the time, and a block of columns, one per joint, for every signal."""

    path: Path
    layout: Layout  # with the number of joints found
    names: dict[str, list[str]]  # names of the columns by signal, in their order
    values: np.ndarray  # [rows, columns]
    first: int  # number of the first row, for messages
    cell: Callable[[int, int], object]  # a value as the source writes it, for messages
    before: int = 0  # rows of numbers before the first, which are left out
    notes: tuple[Finding, ...] = ()  # what the source may lack

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


def require_rows(path: Path, rows: int) -> None:
    """Refuse a log of fewer than two rows."""
    if rows < 2:
        raise LogError(Finding("log.rows", "", "at least two rows of numbers are needed", str(rows)), where=str(path))


def rows_option(first: object, last: object) -> tuple[str, str]:
    """Part of a log, as an argument of `read_log` and as an option of the command line."""
    return f"rows=({first}, {last})", f"--rows {str(first).upper()} {str(last).upper()}"
