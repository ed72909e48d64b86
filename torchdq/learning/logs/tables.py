"""Numbers of a log as its source holds them, before anything is made of them: the table that every source becomes."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np

from torchdq.learning.logs.layouts import Layout, LogError

PACKED, ALWAYS = 100, 2**24  # most times that a file may grow when it is unpacked, and bytes that are always unpacked


class Table(NamedTuple):
    """Columns of a log that are read: the time, and a block of columns, one per joint, for every signal."""

    path: Path
    layout: Layout  # with the number of joints found
    names: dict[str, list[str]]  # names of the columns by signal, in their order
    values: np.ndarray  # [rows, columns]
    first: int  # number of the first row, for messages
    cell: Callable[[int, int], object]  # a value as the source writes it, for messages
    doubt: str = ""  # words for what a file may lack
    before: int = 0  # rows of numbers before the first, which are left out

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

    def refuse(self, row: int, name: str, fault: str) -> NoReturn:
        """Raise for a row and a column of this name."""
        raise LogError(f"{self.path}, row {self.first + row}, column {name!r}: {fault}")


def require_bounded(path: Path, size: int, unpacked: int) -> None:
    """Refuse a file that grows too much when it is unpacked."""
    if unpacked > (most := max(ALWAYS, PACKED * size)):
        times = f"{PACKED} times its own size"
        raise LogError(f"{path} unpacks to more than {most} bytes, {times}; unpack it by hand if you trust it")


def require_rows(path: Path, rows: int) -> None:
    """Refuse a log of fewer than two rows."""
    if rows < 2:
        raise LogError(f"{path}: {rows} rows of numbers, at least two are needed")
