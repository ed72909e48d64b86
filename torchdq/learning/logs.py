"""Logs of robot arms in CSV files and NPZ archives: read, and checked for gaps, missing numbers and degrees.

A CSV file holds a header line and columns time [s], q1 ... qn [rad], qd1 ... [rad/s], tau1 ... measured at the joints
[N m] and, if they are known, qdd1 ... [rad/s^2]. A `Layout` names other columns, turns motor currents into torques, or
does without a header. Columns under a header are found by name; others may stand among them and stay unread. A file may
be packed with gzip, or be an NPZ archive of arrays time [rows], q, qd, tau and, if they are known, qdd, `[rows, n]`.
A packed file is unpacked up to 100 times its size, so that a small file cannot fill the memory.
"""

import codecs
import gzip
import io
import math
import warnings
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import replace
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import IO, Any, NamedTuple, NoReturn

import numpy as np

from torchdq import sources
from torchdq.errors import ArgumentError
from torchdq.learning.data import UNITS
from torchdq.learning.layouts import SIGNALS, Layout, LogError, MissingLogError, find_columns, is_number, listed
from torchdq.learning.plausibility import LogWarning
from torchdq.tables import summary

MOST_BYTES = 1_000_000_000  # largest file that is read
GAP = 0.1  # [s] longest time between two rows; beyond it the motion in between is unknown
UNLIKE, ALIKE = 0.5, 0.95  # correlations of signals that have nothing to do with each other, and that follow each other
JUMP = 0.05  # [rad or m] change of a position between two rows that may stay unexplained by the velocities
FAR = 10.0  # times the usual unexplained change from which one is a jump
FOLLOWED = 0.01  # [rad or rad/s] least standard deviation of a signal that is compared with its rate
PACKED, ALWAYS = 100, 2**24  # most times that a file may grow when it is unpacked, and bytes that are always unpacked
LONGEST = 100_000  # most characters of the first line, enough for ten thousand columns
MARKS = {  # that a text in another encoding than UTF-8 starts with; the longer ones first
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}
OTHERS = {  # first bytes of files that are neither tables nor archives
    b"\x93NUMPY": "a single NumPy array, save all by np.savez(time=..., q=..., qd=..., tau=...)",
    b"PAR1": "a Parquet file",
    b"\x89HDF": "an HDF5 file",
    b"MATLAB 5.0": "a file of MATLAB",
    b"#ROSBAG": "a ROS bag",
    b"SQLite format 3": "an SQLite file, as ROS 2 writes its bags",
    b"\x80": "a pickle",
    b"BZh": "packed with bzip2",
    b"\xfd7zXZ": "packed with xz",
    b"{": "JSON",
    b"[": "JSON",
}
ELSEWHERE = "read the rows before it or after it, by rows=(first, last)"

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

    def __repr__(self) -> str:
        size = f"{self.q.shape[1]} joints, {len(self.time)} rows, {self.repeats} repeated time stamps left out"
        signals = {name: (x, UNITS[name]) for name, x in self._asdict().items() if name in UNITS and x is not None}
        return f"{self.path}: {size}\n\n{summary('Log', signals)}"


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
    Warns:
        LogWarning: a position jumps farther than its velocities explain, or the last number seems to be cut.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "log.csv"
    >>> _ = path.write_text("time,q1,qd1,tau1\\n0.00,0.1,0.5,2.0\\n0.01,0.105,0.5,2.1\\n")
    >>> read(path).tau
    array([[2. ],
           [2.1]])
    """
    if not isinstance(layout, Layout):
        cure = "columns are named by Layout(columns={'q': 'position_{0}'})"
        raise ArgumentError(f"layout must be a Layout, found {type(layout).__name__}; {cure}")
    whole = rows is None or (isinstance(rows, tuple | list) and all(map(_is_index, rows)) and len(rows) == 2)
    if not whole or (rows is not None and not 0 <= rows[0] < rows[1]):
        raise ArgumentError(f"rows must be a first row and a greater one after the last, whole numbers, found {rows!r}")
    name, content = sources.content("log", path, MOST_BYTES, LogError, MissingLogError)
    path = Path(name)
    _require_table(path, content)
    table = (_archive if content.startswith(b"PK") else _text)(path, content, layout, rows)
    if layout.gain and len(layout.gain) != table.layout.joints:
        raise ArgumentError(f"gain must have {table.layout.joints} numbers, one per joint, found {len(layout.gain)}")
    for row, column in np.argwhere(~np.isfinite(table.values))[:1]:
        _refuse(table, row, column, f"{table.cell(row, column)} is not a finite number; {_cure(table, row, column)}")
    _require_times(table)
    _require_radians(table)
    for doubt in (table.doubt, _jump(table)):
        if doubt:
            warnings.warn(f"{path}, {doubt}", LogWarning, stacklevel=2)
    time = table.values[:, 0]
    new = np.concatenate([[True], np.diff(time) > 0])
    q, qd, effort, *qdd = (block[new] for block in table.blocks)
    return Log(path, table.layout, time[new], q, qd, effort * (layout.gain or 1.0), int((~new).sum()), *qdd)


def _is_index(x: Any) -> bool:
    return isinstance(x, Integral) and not isinstance(x, bool)


# --- the table in a file ---------------------------------------------------------------------------------------------


class _Table(NamedTuple):
    """Columns of a file that are read: time, q, qd, effort and perhaps qdd."""

    path: Path
    layout: Layout  # with the number of joints found
    names: list[str]
    values: np.ndarray  # [rows, columns]
    first: int  # number of the first row, for messages
    cell: Callable[[int, int], object]  # a value as the file writes it, for messages
    doubt: str = ""  # words for what a file may lack

    @property
    def blocks(self) -> list[np.ndarray]:
        """Arrays q, qd, effort and perhaps qdd, [rows, n]."""
        n = self.layout.joints
        return np.split(self.values[:, 1:], range(n, self.values.shape[1] - 1, n), axis=1)


def _text(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> _Table:
    """Table in a CSV file; its rows are numbered as an editor does."""
    text = _decoded(path, _unpacked(path, content) if content.startswith(b"\x1f\x8b") else content)
    ended, text = text.endswith(("\n", "\r")), text.rstrip()
    if not text:
        raise LogError(f"{path} is empty")
    head = (text[: LONGEST + 1].splitlines() or [""])[0]
    if len(head) > LONGEST:
        raise LogError(f"{path}: the first line is longer than {LONGEST} characters; it must be the names of columns")
    lines = text.splitlines()
    heads = [cell.strip() for cell in head.split(",")] if layout.header else layout.order
    layout, names = find_columns(f"{path}, row 1", layout, heads)
    start = layout.header + (rows[0] if rows else 0)
    body = lines[start : None if rows is None else start + rows[1] - rows[0]]
    for number, line in enumerate(body, start + 1):
        if (found := line.count(",") + 1) != len(heads):
            expected = f"{len(heads)} columns {heads[0]} ... {heads[-1]}"
            cure = "; decimal commas must be points" if found > len(heads) else ""
            if not line.strip():
                cure = "; remove empty lines"
            raise LogError(f"{path}, row {number}: {found} columns, expected {expected}{cure}")
    _require_rows(path, len(body))
    used = [heads.index(name) for name in names]
    values: np.ndarray
    try:
        values = np.loadtxt(body, delimiter=",", usecols=used, comments=None, ndmin=2)
    except ValueError:  # some cell is no number; NaN marks it
        values = np.array([[_number(cells[i]) for i in used] for cells in (line.split(",") for line in body)])
    whole = ended or start + len(body) < len(lines) or len(heads) - 1 not in used
    doubt = "" if whole else _cut(body, start, layout)
    return _Table(path, layout, names, values, start + 1, lambda i, k: repr(body[i].split(",")[used[k]]), doubt)


def _cut(lines: list[str], start: int, layout: Layout) -> str:
    """Words for a last line, which no line break ends, whose last number is shorter than all before; "" if not."""
    *before, last = [len(line) - line.rfind(",") - 1 for line in lines]
    if last >= min(before):
        return ""
    first = start - layout.header
    return (
        f"row {start + len(lines)}: the last number has fewer digits than all before it, and no line break after it; "
        f"if the file was cut there, leave the row out by rows=({first}, {first + len(before)})"
    )


def _archive(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> _Table:
    """Table in an NPZ archive; its rows are numbered from 0."""
    called = {signal: layout.columns.get(signal, signal) for signal in SIGNALS}
    if any(not isinstance(name, str) for name in called.values()):
        raise ArgumentError(f"columns of an archive must be names of its arrays, found {layout.columns}")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as members:
            _require_bounded(path, len(content), sum(member.file_size for member in members.infolist()))
            inside = members.namelist()
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            found = {signal: archive[name] for signal, name in called.items() if name in archive}
    except LogError:
        raise
    except Exception as fault:  # numpy and zipfile raise errors of many kinds on damaged bytes
        raise LogError(f"{path} is damaged or not an archive of numbers ({fault})") from fault
    if inside and not any(name.endswith(".npy") for name in inside):
        raise LogError(f"{path} is a zip archive of {listed(inside)}; unpack it")
    for signal in SIGNALS[:4]:
        if signal not in found:
            needed = "time [rows], q, qd and tau [rows, n]"
            arrays = listed([name.removesuffix(".npy") for name in inside])
            cure = f"other names are given by Layout(columns=...), e.g. {{'q': 'positions'}}; found {arrays}"
            raise LogError(f"{path}: there is no array {called[signal]!r}; needed are {needed}; {cure}")
    shape = found["q"].shape
    for signal, x in found.items():
        if x.shape != (shape[:1] if signal == "time" else shape) or len(shape) != 2 or x.dtype.kind not in "fiu":
            raise LogError(
                f"{path}, array {called[signal]!r}: {x.dtype} {list(x.shape)}, expected real numbers, "
                "time [rows] and q, qd, tau [rows, n]"
            )
    if layout.joints not in (0, shape[1]) or not shape[1]:
        raise LogError(f"{path}: {shape[1]} joints, expected {layout.joints or 'at least one'}")
    names = ["time", *(f"{signal}{joint}" for signal in list(found)[1:] for joint in range(1, shape[1] + 1))]
    start, end = rows or (0, None)
    values = np.column_stack([x.astype(float) for x in found.values()])[start:end]
    _require_rows(path, len(values))
    layout = layout if layout.joints else replace(layout, joints=shape[1])
    return _Table(path, layout, names, values, start, lambda i, k: values[i, k])


def _unpacked(path: Path, content: bytes) -> bytes:
    """Content of a file packed with gzip."""
    most = max(ALWAYS, PACKED * len(content))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
            unpacked = file.read(most + 1)
    except (OSError, EOFError, zlib.error) as fault:
        raise LogError(f"{path} is damaged or not a text ({fault})") from fault
    _require_bounded(path, len(content), len(unpacked))
    return unpacked


def _decoded(path: Path, content: bytes) -> str:
    """Text in UTF-8, or in the encoding that its first bytes name."""
    encoding = next((name for mark, name in MARKS.items() if content.startswith(mark)), "utf-8-sig")
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as fault:
        raise LogError(f"{path} is damaged or not a text ({fault}); save it as UTF-8 text") from fault


def _number(cell: str) -> float:
    return float(cell) if is_number(cell) else math.nan


# --- checks ----------------------------------------------------------------------------------------------------------


def _refuse(table: _Table, row: int, column: int, fault: str) -> NoReturn:
    raise LogError(f"{table.path}, row {table.first + row}, column {table.names[column]!r}: {fault}")


def _cure(table: _Table, row: int, column: int) -> str:
    """Advice about a cell that is not a finite number."""
    if '"' in str(table.cell(row, column)):
        return "quotation marks must be removed"
    if row == 0 and np.isnan(table.values[0]).all() and len(table.values) > 1:
        start = table.first - table.layout.header
        return f"a row of words or units must be removed, or left out by rows=({start}, last)"
    return ELSEWHERE


def _require_table(path: Path, content: bytes) -> None:
    """Refuse files of other kinds, by their first bytes."""
    for start, kind in OTHERS.items():
        if content.startswith(start):
            raise LogError(f"{path} is {kind}, not a table; needed are columns separated by commas, or an NPZ archive")


def _require_bounded(path: Path, size: int, unpacked: int) -> None:
    """Refuse a file that grows too much when it is unpacked."""
    if unpacked > (most := max(ALWAYS, PACKED * size)):
        times = f"{PACKED} times its own size"
        raise LogError(f"{path} unpacks to more than {most} bytes, {times}; unpack it by hand if you trust it")


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
        cure = ELSEWHERE if seconds else "times must be in seconds; divide milliseconds by 1000, nanoseconds by 1e9"
        _refuse(table, i + 1, 0, f"{step[i]:.4g} s after the row above, more than {GAP} s; {cure}")
    if not step.any():
        _refuse(table, 1, 0, "the same time in all rows")


def _jump(table: _Table) -> str:
    """Words for the first jump of a position that its velocities do not explain; "" for none."""
    time, (q, qd, *_) = table.values[:, 0], table.blocks
    step = np.diff(time)
    # stamps may be rounded, or late by a row
    fastest = np.maximum(abs(qd[1:]), abs(qd[:-1])) * (step + np.median(step))[:, None]
    unexplained = np.maximum(abs(np.diff(q, axis=0)) - fastest, 0.0)
    jumps = unexplained > np.maximum(JUMP, FAR * np.quantile(unexplained, 0.9, axis=0))
    if not jumps.any():
        return ""
    i, joint = np.argwhere(jumps)[0]
    rows, change = int(jumps.any(1).sum()), abs(q[i + 1, joint] - q[i, joint])
    others = f", the first of {rows} such jumps" if rows > 1 else ""
    return (
        f"row {table.first + i + 1}, column {table.names[1 + joint]!r}: it changes by {change:.3g} within "
        f"{step[i]:.3g} s, of which its velocity explains {fastest[i, joint]:.2g} at most{others}; is a number "
        f"wrong, or does an angle turn over at pi? {ELSEWHERE}"
    )


def _require_radians(table: _Table) -> None:
    """Refuse columns in degrees, by their size, and signals that do not change as their rates say."""
    n, layout, blocks, time = table.layout.joints, table.layout, table.blocks, table.values[:, 0]
    for k, limit, unit in ((0, layout.farthest, "rad"), (1, layout.fastest, "rad/s")):
        row, joint = divmod(int(abs(blocks[k]).argmax()), n)
        if abs(blocks[k][row, joint]) > limit:
            others = "are these degrees (multiply by pi/180), or millimetres of a joint that slides (by 0.001)?"
            cure = f"if the joint does go there, pass a Layout that allows it, by {('farthest', 'fastest')[k]}"
            found = f"{blocks[k][row, joint]:.6g} {unit}, more than {limit:.3g}"
            _refuse(table, row, 1 + k * n + joint, f"{found}; {others} {cure}")
    for k, rate in ((0, 1), (1, 3)):
        for joint in range(n) if rate < len(blocks) else ():
            ratio, correlation = _followed(time, blocks[k][:, joint], blocks[rate][:, joint])
            name, other = table.names[1 + k * n + joint], table.names[1 + rate * n + joint]
            if abs(correlation) < UNLIKE:
                _require_no_other_rate(table, k, rate, joint)
            if not abs(correlation) >= ALIKE or 0.5 < ratio < 2:
                continue
            cure = "the two must agree in unit, sign and joint"
            for column, factor in ((name, ratio), (other, 1 / ratio)):
                if 0.5 < factor * math.pi / 180 < 2:
                    cure = f"{column} seems to be in degrees; multiply the column by pi/180"
            found = f"{name} changes {ratio:.3g} times as much as {other} says"
            raise LogError(f"{table.path}, column {name!r}: {found}; {cure}")


def _require_no_other_rate(table: _Table, k: int, rate: int, joint: int) -> None:
    """Raise if a signal, which does not follow its own rate, follows that of another joint."""
    n, blocks, time = table.layout.joints, table.blocks, table.values[:, 0]
    for other in range(n):
        ratio, correlation = _followed(time, blocks[k][:, joint], blocks[rate][:, other])
        if other != joint and correlation > ALIKE and 0.5 < ratio < 2:
            names = [table.names[1 + i] for i in (k * n + joint, rate * n + other, rate * n + joint)]
            raise LogError(
                f"{table.path}, column {names[0]!r}: it changes as {names[1]} says, not as {names[2]}; the columns of "
                "both signals must be in the same order of joints"
            )


def _followed(time: np.ndarray, x: np.ndarray, rate: np.ndarray) -> tuple[float, float]:
    """Changes of a signal over the integral of a rate, and the correlation of both; NaN where one is at rest."""
    integral = np.concatenate([[0.0], np.cumsum(np.diff(time) * (rate[1:] + rate[:-1]) / 2)])
    x, integral = x - x.mean(), integral - integral.mean()
    if x.std() < FOLLOWED or integral.std() < FOLLOWED:
        return math.nan, math.nan
    product = float(x @ integral)
    return product / float(integral @ integral), product / math.sqrt((x @ x) * (integral @ integral))
