"""Tables of logs: what CSV files, NPZ archives and arrays hold, before anything is made of it.

Rows are numbered as an editor does, those of arrays from 0.
"""

import codecs
import gzip
import io
import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.headers import OTHER_NAMES, find_columns, missing_signals
from torchdq.learning.logs.layouts import NEEDED, SIGNALS, Layout, is_number, listed

MARKS = {  # that a text in another encoding than UTF-8 starts with; the longer ones first
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}


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
        raise LogError(Finding("log.rows", "", "at least two rows of numbers are needed", str(rows)), where=path)


def rows_option(first: object, last: object) -> tuple[str, str]:
    """Part of a log, as an argument of `read_log` and as an option of the command line."""
    return f"rows=({first}, {last})", f"--rows {str(first).upper()} {str(last).upper()}"


# --- texts ---


def text_table(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table in the bytes of a CSV file."""
    text = _decoded(path, content)
    ended, lines = text.endswith(("\n", "\r")), text.rstrip().splitlines()
    if not lines:
        raise LogError(Finding("log.empty", "", "it is empty"), where=path)
    heads = [cell.strip() for cell in lines[0].split(",")] if layout.header else layout.order
    layout, names = find_columns(f"{path}, row 1", layout, heads)
    start = layout.header + (rows[0] if rows else 0)
    body = lines[start : None if rows is None else start + rows[1] - rows[0]]
    for number, line in enumerate(body, start + 1):
        if (found := line.count(",") + 1) != len(heads):
            cure = "" if found <= len(heads) else "decimal commas must be points"
            expected = f"{len(heads)} columns {heads[0]} ... {heads[-1]} are needed"
            fault = Finding("row.columns", "", expected, str(found), cure if line.strip() else "remove empty lines")
            raise LogError(fault, where=f"{path}, row {number}")
    require_rows(path, len(body))
    used = [heads.index(name) for block in names.values() for name in block]
    values: np.ndarray
    try:
        values = np.loadtxt(body, delimiter=",", usecols=used, comments=None, ndmin=2)
    except ValueError:  # some cell is not numeric; NaN marks it
        cells = (line.split(",") for line in body)
        values = np.array([[float(row[i]) if is_number(row[i]) else math.nan for i in used] for row in cells])
    whole = ended or start + len(body) < len(lines) or len(heads) - 1 not in used
    before = start - layout.header
    notes = () if whole else _cut(body, start + len(body), before)
    return Table(path, layout, names, values, start + 1, lambda i, k: repr(body[i].split(",")[used[k]]), before, notes)


def _cut(lines: list[str], number: int, first: int) -> tuple[Finding, ...]:
    """Note about a last line, which no line break ends, whose last number is shorter than all before."""
    *before, last = [len(line) - line.rfind(",") - 1 for line in lines]
    if last >= min(before):
        return ()
    found = f"row {number}: the last number has fewer digits than all before it, and no line break after it"
    cure, option = (
        f"if the file was cut there, leave the row out by {x}" for x in rows_option(first, first + len(before))
    )
    return (Finding("log.cut", "", found, "", cure, option, value=number),)


def _decoded(path: Path, content: bytes) -> str:
    """Text in UTF-8, or in the encoding that its first bytes name; unpacked if gzip has packed it."""
    try:
        content = gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content
        return content.decode(next((name for mark, name in MARKS.items() if content.startswith(mark)), "utf-8-sig"))
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as fault:
        claim = f"damaged or not a text ({fault})"
        raise LogError(Finding("log.damaged", "", claim, "", "save it as UTF-8 text"), where=path) from fault


# --- arrays ---


def archive_table(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table in the bytes of an NPZ archive."""
    called = _called(layout)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            inside = archive.zip.namelist()
            found = {signal: archive[name] for signal, name in called.items() if name in archive}
    except Exception as fault:  # numpy and zipfile raise errors of many kinds on damaged bytes
        claim = f"damaged or not an archive of numbers ({fault})"
        raise LogError(Finding("log.damaged", "", claim), where=path) from fault
    if inside and not any(name.endswith(".npy") for name in inside):
        raise LogError(Finding("log.zip", "", f"a zip archive of {listed(inside)}", "", "unpack it"), where=path)
    return _table(path, found, called, [name.removesuffix(".npy") for name in inside], layout, rows)


def arrays_table(arrays: Mapping[str, Any], layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table of arrays by name; None instead of one: it was not recorded."""
    path, found = Path("the arrays"), {}
    called = {signal: name for signal, name in _called(layout).items() if arrays.get(name, "") is not None}
    for name in ("time", "q"):
        called.setdefault(name, name)  # no log is without
    for signal, name in called.items():
        if (x := arrays.get(name)) is not None:
            try:
                found[signal] = np.asarray(x.detach().cpu() if isinstance(x, Tensor) else x)
            except Exception as fault:  # numpy takes any object, whose conversion may fail in any way
                expected = f"must be an array of numbers ({fault})"
                raise LogError(Finding("array.kind", f"array {name!r}", expected), where=path) from fault
    return _table(path, found, called, [str(name) for name in arrays], layout, rows)


def _called(layout: Layout) -> dict[str, str]:
    """Names of the arrays by signal, of those that the layout has."""
    called: dict[str, str] = {}
    for signal in filter(layout.has, SIGNALS):
        name = layout.columns.get(signal, signal)
        if not isinstance(name, str):
            raise ArgumentError(f"columns of an archive must be names of its arrays, found {layout.columns}")
        if name in called.values():
            raise ArgumentError(f"columns must name every array once, found {name!r} for several signals")
        called[signal] = name
    return called


def _table(
    path: Path,
    found: dict[str, np.ndarray],
    called: Mapping[str, str],
    inside: list[str],
    layout: Layout,
    rows: tuple[int, int] | None,
) -> Table:
    """Table of the signals found among what is inside."""
    for signal, name in called.items():
        if signal not in found and (signal in NEEDED or signal in layout.columns):
            needed = f"time [rows] and {', '.join(called[s] for s in NEEDED[1:] if s in called)} [rows, n]"
            cure, option = (f"{way}; found {listed(inside)}" for way in OTHER_NAMES)
            fault = Finding("array.missing", "", f"there is no array {name!r}; needed are {needed}", "", cure, option)
            raise LogError(missing_signals(fault, called.keys() - found.keys(), inside), where=path)
    shape = found["q"].shape
    for signal, x in {"q": found["q"], **found}.items():  # positions first, whose shape the others must have
        if x.shape != (shape[:1] if signal == "time" else shape) or len(shape) != 2 or x.dtype.kind not in "fiu":
            expected = "must hold real numbers, time [rows] and q, qd, tau [rows, n]"
            fault = Finding("array.shape", f"array {called[signal]!r}", expected, f"{x.dtype} {list(x.shape)}")
            raise LogError(fault._replace(cure=_cure(found, x)), where=path)
    if layout.joints not in (0, shape[1]) or not shape[1]:
        expected = f"{layout.joints} joints are needed" if layout.joints else "at least one joint is needed"
        raise LogError(Finding("log.joints", "", expected, str(shape[1]), value=shape[1]), where=path)
    joints = range(1, shape[1] + 1)
    names = {signal: ["time"] if signal == "time" else [f"{signal}{joint}" for joint in joints] for signal in found}
    start, end = rows or (0, None)
    values = np.column_stack([x.astype(float) for x in found.values()])[start:end]
    require_rows(path, len(values))
    layout = layout if layout.joints else replace(layout, joints=shape[1])
    return Table(path, layout, names, values, start, lambda i, k: values[i, k], before=start)


def _cure(found: Mapping[str, np.ndarray], x: np.ndarray) -> str:
    """Cure for the shape of an array."""
    rows = found["time"].shape[:1]
    if x.dtype.kind not in "fiu":
        return "convert it by .astype(float)"
    if found["q"].ndim == 1:
        return "one joint is written [rows, 1], as q[:, None]"
    if rows and found["q"].shape[1:] == rows and found["q"].shape[:1] != rows:
        return f"the joints are in the first axis and the {rows[0]} rows in the second: transpose, as q.T"
    if x.shape[:1] != found["q"].shape[:1]:
        return f"it has {len(x) if x.ndim else 0} rows and q has {len(found['q'])}: they must be recorded together"
    return ""
