"""Logs of robot arms in CSV files and NPZ archives: read, and checked for gaps, missing numbers and degrees.

A CSV file holds a header line and columns time [s], q1 ... qn [rad], qd1 ... [rad/s], tau1 ... measured at the joints
[N m] and, if they are known, qdd1 ... [rad/s^2]. A `Layout` names other columns, turns motor currents into torques, or
does without a header. Columns under a header are found by name; others may stand among them and stay unread. A file may
be packed with gzip, or be an NPZ archive of arrays time [rows], q, qd, tau and, if they are known, qdd, `[rows, n]`.
"""

import gzip
import io
import math
import re
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import IO, Any, NamedTuple, NoReturn

import numpy as np

from torchdq import sources
from torchdq.errors import ArgumentError, TorchdqError

MOST_BYTES = 1_000_000_000  # largest file that is read
GAP = 0.1  # [s] longest time between two rows; beyond it the motion in between is unknown
FOLLOWED = 0.01  # [rad or rad/s] least standard deviation of a signal that is compared with its rate
ELSEWHERE = "read the rows before it or after it, by rows=(first, last)"


class LogError(TorchdqError, ValueError):
    """Unusable log; the message names the file, and the row and column where there is one."""


class MissingLogError(LogError, FileNotFoundError):
    """Log in a file that does not exist."""


@dataclass(frozen=True)
class Layout:
    """Columns and units of a log, and the filters its signals need."""

    joints: int = 0  # number of joints; 0: as many as the header names
    # names of the columns but for the number of the joint; the first three hold q, qd and the effort, and are read
    blocks: tuple[str, ...] = ("q", "qd", "tau")
    header: bool = True  # whether the first line holds the names; else the columns are time and `blocks`, in order
    gain: tuple[float, ...] = ()  # torque per unit of effort [N m], per joint; empty: the effort is the torque
    cutoff_qd: float = 8.0  # low-pass frequency of the velocities [Hz]
    cutoff_tau: float = 8.0  # low-pass frequency of the torques [Hz]
    farthest: float = 8 * math.pi  # position beyond which numbers are taken for degrees [rad]
    fastest: float = 50.0  # speed beyond which numbers are taken for degrees [rad/s]

    @property
    def columns(self) -> list[str]:
        """Names of the time and of all columns of the blocks."""
        return ["time", *(f"{block}{joint}" for block in self.blocks for joint in range(1, self.joints + 1))]


STANDARD = Layout()


class Log(NamedTuple):
    """Content of a file, row by row."""

    path: Path
    layout: Layout
    time: np.ndarray  # [rows], strictly increasing [s]
    q: np.ndarray  # [rows, n] [rad]
    qd: np.ndarray  # [rows, n] [rad/s]
    tau: np.ndarray  # [rows, n] [N m]
    repeats: int  # rows left out because they repeat a time stamp
    qdd: np.ndarray | None = None  # [rows, n] [rad/s^2], if the file holds them


def read(
    path: str | PathLike[str] | bytes | IO[Any], layout: Layout = STANDARD, rows: tuple[int, int] | None = None
) -> Log:
    """Log in a file.

    Args:
        path: path of the file, a file:// or package:// address, an open file, or its bytes: numbers separated by
            commas, packed with gzip or not, or an NPZ archive.
        layout: names and units of the columns; by default time, q1 ..., qd1 ..., tau1 ... in SI units.
        rows: first row and the one after the last to use, counted from 0; None: all.
    Raises:
        LogError: the file cannot be opened, a column is missing, a number is missing or not finite, time runs
            backwards, there is a gap, or a column is in degrees.
        MissingLogError: there is no such file; it is a FileNotFoundError too.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "log.csv"
    >>> _ = path.write_text("time,q1,qd1,tau1\\n0.00,0.1,0.5,2.0\\n0.01,0.105,0.5,2.1\\n")
    >>> read(path).tau
    array([[2. ],
           [2.1]])
    """
    if rows is not None and not 0 <= rows[0] < rows[1]:
        raise ArgumentError(f"rows must be a first row and a greater one after the last, found {rows}")
    name, content = sources.content("log", path, MOST_BYTES, LogError, MissingLogError)
    path = Path(name)
    table = (_archive if content.startswith(b"PK") else _text)(path, content, layout, rows)
    for row, column in np.argwhere(~np.isfinite(table.values))[:1]:
        _refuse(table, row, column, f"{table.cell(row, column)} is not a finite number; {ELSEWHERE}")
    _require_times(table)
    _require_radians(table)
    time = table.values[:, 0]
    new = np.concatenate([[True], np.diff(time) > 0])
    q, qd, effort, *qdd = (block[new] for block in table.blocks)
    return Log(path, table.layout, time[new], q, qd, effort * (layout.gain or 1.0), int((~new).sum()), *qdd)


# --- the table in a file ---------------------------------------------------------------------------------------------


class _Table(NamedTuple):
    """Columns of a file that are read: time, q, qd, effort and perhaps qdd."""

    path: Path
    layout: Layout  # with the number of joints found
    names: list[str]
    values: np.ndarray  # [rows, columns]
    first: int  # number of the first row, for messages
    cell: Callable[[int, int], object]  # a value as the file writes it, for messages

    @property
    def blocks(self) -> list[np.ndarray]:
        """Arrays q, qd, effort and perhaps qdd, [rows, n]."""
        n = self.layout.joints
        return np.split(self.values[:, 1:], range(n, self.values.shape[1] - 1, n), axis=1)


def _text(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> _Table:
    """Table in a CSV file; its rows are numbered as an editor does."""
    try:
        text = (gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content).decode("utf-8-sig")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as fault:
        raise LogError(f"{path} is damaged or not a text ({fault})") from fault
    lines = text.rstrip().splitlines()
    if not lines:
        raise LogError(f"{path} is empty")
    heads = [cell.strip() for cell in lines[0].split(",")] if layout.header else layout.columns
    layout, names = _read_columns(f"{path}, row 1", layout, heads)
    start = layout.header + (rows[0] if rows else 0)
    body = lines[start : None if rows is None else start + rows[1] - rows[0]]
    for number, line in enumerate(body, start + 1):
        if (found := line.count(",") + 1) != len(heads):
            expected = f"{len(heads)} columns {heads[0]} ... {heads[-1]}"
            raise LogError(f"{path}, row {number}: {found} columns, expected {expected}")
    _require_rows(path, len(body))
    used = [heads.index(name) for name in names]
    values: np.ndarray
    try:
        values = np.loadtxt(body, delimiter=",", usecols=used, comments=None, ndmin=2)
    except ValueError:  # some cell is no number; NaN marks it
        values = np.array([[_number(cells[i]) for i in used] for cells in (line.split(",") for line in body)])
    return _Table(path, layout, names, values, start + 1, lambda i, k: repr(body[i].split(",")[used[k]]))


def _archive(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> _Table:
    """Table in an NPZ archive; its rows are numbered from 0."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            found = {name: archive[name] for name in ("time", "q", "qd", "tau", "qdd") if name in archive}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as fault:
        raise LogError(f"{path} is damaged or not an archive of numbers ({fault})") from fault
    for name in ("time", "q", "qd", "tau"):
        if name not in found:
            raise LogError(f"{path}: there is no array {name!r}; needed are time [rows], q, qd and tau [rows, n]")
    shape = found["q"].shape
    for name, x in found.items():
        if x.shape != (shape[:1] if name == "time" else shape) or len(shape) != 2 or x.dtype.kind not in "fiu":
            raise LogError(
                f"{path}, array {name!r}: {x.dtype} {list(x.shape)}, expected real numbers, "
                "time [rows] and q, qd, tau [rows, n]"
            )
    heads = ["time", *(f"{name}{joint}" for name in list(found)[1:] for joint in range(1, shape[1] + 1))]
    layout, names = _read_columns(str(path), layout, heads)
    start, end = rows or (0, None)
    values = np.column_stack([x.astype(float) for x in found.values()])[start:end]
    _require_rows(path, len(values))
    return _Table(path, layout, names, values, start, lambda i, k: values[i, k])


def _read_columns(where: str, layout: Layout, heads: list[str]) -> tuple[Layout, list[str]]:
    """Layout with its number of joints, and names of the columns to read."""
    joints = sum(re.fullmatch(rf"{re.escape(layout.blocks[0])}\d+", head) is not None for head in heads)
    layout = layout if layout.joints else replace(layout, joints=max(joints, 1))
    wanted = ", ".join(f"{block}1 ... {block}{layout.joints}" for block in layout.blocks[:3])
    known = any(re.fullmatch(r"qdd\d+", head) for head in heads)
    names = replace(layout, blocks=(*layout.blocks[:3], *(("qdd",) if known else ()))).columns
    for name in names:
        if heads.count(name) != 1:
            found = "there is no column" if name not in heads else "there are several columns"
            raise LogError(f"{where}: {found} {name!r}; needed are columns time, {wanted}")
    if joints != layout.joints:
        raise LogError(f"{where}: {joints} joints, expected {layout.joints}")
    return layout, names


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


# --- checks ----------------------------------------------------------------------------------------------------------


def _refuse(table: _Table, row: int, column: int, fault: str) -> NoReturn:
    raise LogError(f"{table.path}, row {table.first + row}, column {table.names[column]!r}: {fault}")


def _require_rows(path: Path, rows: int) -> None:
    if rows < 2:
        raise LogError(f"{path}: {rows} rows of numbers, at least two are needed")


def _require_times(table: _Table) -> None:
    """Refuse times that run backwards, leave gaps, or are not in seconds."""
    step = np.diff(table.values[:, 0])
    if (step < 0).any():
        i = int((step < 0).argmax())
        _refuse(table, i + 1, 0, f"{-step[i]:.4g} s before the row above; {ELSEWHERE}")
    if (step > GAP).any():
        i = int((step > GAP).argmax())
        seconds = np.median(step) <= GAP
        cure = ELSEWHERE if seconds else "times must be in seconds; divide milliseconds by 1000"
        _refuse(table, i + 1, 0, f"{step[i]:.4g} s after the row above, more than {GAP} s; {cure}")
    if not step.any():
        _refuse(table, 1, 0, "the same time in all rows")


def _require_radians(table: _Table) -> None:
    """Refuse columns that are in degrees: by their size, and because positions change as their velocities say."""
    n, layout, blocks, time = table.layout.joints, table.layout, table.blocks, table.values[:, 0]
    for k, limit, unit in ((0, layout.farthest, "rad"), (1, layout.fastest, "rad/s")):
        row, joint = divmod(int(abs(blocks[k]).argmax()), n)
        if abs(blocks[k][row, joint]) > limit:
            cure = "multiply the column by pi/180, and if the joint does go there, pass a Layout that allows it"
            found = f"{blocks[k][row, joint]:.6g} {unit}, more than {limit:.3g}"
            _refuse(table, row, 1 + k * n + joint, f"{found}; if these are degrees, {cure}")
    for k, rate in ((0, 1), (1, 3)):
        for joint in range(n) if rate < len(blocks) else ():
            ratio = _ratio(time, blocks[k][:, joint], blocks[rate][:, joint])
            if ratio is None or 0.5 < ratio < 2:
                continue
            name, other = table.names[1 + k * n + joint], table.names[1 + rate * n + joint]
            cure = "the two must agree in unit, sign and joint"
            for column, factor in ((name, ratio), (other, 1 / ratio)):
                if 0.5 < factor * math.pi / 180 < 2:
                    cure = f"{column} seems to be in degrees; multiply the column by pi/180"
            found = f"{name} changes {ratio:.3g} times as much as {other} says"
            raise LogError(f"{table.path}, column {name!r}: {found}; {cure}")


def _ratio(time: np.ndarray, x: np.ndarray, rate: np.ndarray) -> float | None:
    """Changes of a signal over the integral of its rate; None where noise, drift or rest hide it."""
    integral = np.concatenate([[0.0], np.cumsum(np.diff(time) * (rate[1:] + rate[:-1]) / 2)])
    x, integral = x - x.mean(), integral - integral.mean()
    if x.std() < FOLLOWED or integral.std() < FOLLOWED:
        return None
    if abs(x @ integral) < 0.95 * math.sqrt((x @ x) * (integral @ integral)):
        return None
    return float(x @ integral / (integral @ integral))
