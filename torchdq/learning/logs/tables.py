"""Tables of named columns: what texts, NPZ archives, files of MATLAB and arrays hold, before anything is made of it.

Rows are numbered as an editor does, those of arrays from 0.
"""

import codecs
import csv
import gzip
import io
import math
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch import Tensor

from torchdq.base.optional import imported
from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.layouts import bare, is_numeric, listed

MARKS = {  # that a text in another encoding than UTF-8 starts with; the longer ones first
    "utf-32": (codecs.BOM_UTF32_LE, codecs.BOM_UTF32_BE),
    "utf-16": (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE),
}
SEPARATORS = ";\t,|"  # of the columns of a text, the first that its rows hold; without any: blanks
COMMENTS, DEEPEST = ("#", "%"), 1000  # what they begin with; lines among which the first numbers are
DECIMAL_COMMAS = ";\t"  # separators besides which a comma is that of a number

Rows = tuple[int, int] | None  # first row and the one after the last; None: all


class Table(NamedTuple):
    """Columns of a source by name, none of which is read yet."""

    path: Path
    heads: list[str]  # names of the columns
    read: Callable[[list[int]], np.ndarray]  # numbers in some columns [rows, columns]; NaN where there are none
    cell: Callable[[int, int], object]  # what the source writes in a row and a column, for messages
    first: int = 0  # number of the first row, for messages
    before: int = 0  # rows of numbers before the first, which are left out
    arrays: Mapping[str, list[str]] = {}  # names of the columns of each array

    @property
    def name(self) -> str:
        """Name before a colon by which its columns differ from those of other files."""
        return self.path.name.partition(".")[0]


def rows_option(first: object, last: object) -> tuple[str, str]:
    """Part of a log, as an argument of `read_log` and as an option of the command line."""
    return f"rows=({first}, {last})", f"--rows {str(first).upper()} {str(last).upper()}"


# --- texts ---


def text_table(path: Path, content: bytes, rows: Rows) -> Table:
    """Table in a text: numbers between commas, semicolons, tabs, bars or blanks, below a line of names or not.

    Lines above the names are left out, and lines of words, such as units, between the names and the numbers.
    """
    lines = _decoded(path, content).rstrip().splitlines()
    if not lines:
        raise LogError(Finding("log.empty", "", "it is empty"), where=path)
    top, numbers = _head(lines)
    head = lines[top]
    row = next((line for line in lines[max(numbers, top + 1) :] if line.strip()), head)
    seen = (row, "" if " " in row else head)
    separator = next((x for text in seen for x in SEPARATORS if x in text), None)
    words = next(csv.reader([head], delimiter=separator)) if separator else head.strip("#% ").split()
    width, said = len(row.split(separator)), head.startswith(("#", "%"))
    named = not all(map(is_numeric, words)) or words == [str(k) for k in range(len(words))]
    header = named and (not said or len(words) == width)  # other comments are none
    heads = [bare(word) for word in words] if header else [str(k + 1) for k in range(width)]
    before, end = rows or (0, None)
    top += header or said
    while top < numbers and not any(map(is_numeric, _cells(lines[top]))):
        top += 1
    body, first = lines[top:][before:end], top + before + 1
    if separator and separator in DECIMAL_COMMAS:
        body = [line.replace(",", ".") for line in body]

    def read(used: list[int]) -> np.ndarray:
        for number, line in enumerate(body, first):
            if (found := len(line.split(separator))) != len(heads):
                cure = "" if found <= len(heads) else "decimal commas must be points"
                expected = f"{len(heads)} columns {heads[0]} ... {heads[-1]} are needed"
                fault = Finding("row.columns", "", expected, str(found), cure if line.strip() else "remove empty lines")
                raise LogError(fault, where=f"{path}, row {number}")
        if len(body) < 2:
            return np.empty((len(body), len(used)))
        try:
            return np.loadtxt(body, delimiter=separator, usecols=used, comments=None, ndmin=2, quotechar='"')
        except ValueError:  # some cell is not numeric; NaN marks it
            split = ([cell.strip(' "') for cell in line.split(separator)] for line in body)
            return np.array([[float(row[i]) if is_numeric(row[i]) else math.nan for i in used] for row in split])

    return Table(path, heads, read, lambda i, k: repr(body[i].split(separator)[k]), first, before)


def _head(lines: list[str]) -> tuple[int, int]:
    """Lines of the names, which is the first one of numbers where there are none, and of the first numbers."""
    cells = [_cells(line) for line in lines[:DEEPEST]]
    numeric = [2 * sum(map(is_numeric, row)) > len(row) for row in cells]
    alike = (len(row) == len(after) for row, after in pairwise(cells))
    numbers = next((i for i, (yes, also) in enumerate(zip(numeric[:-1], alike, strict=True)) if yes and also), 0)
    top = numbers
    while top and len(cells[top - 1]) == len(cells[numbers]) and not lines[top].startswith(COMMENTS):
        top -= 1
    return (top - 1 if 0 < top == numbers and not lines[top - 1].startswith(COMMENTS) else top), numbers


def _cells(line: str) -> list[str]:
    """Cells of a line, whose numbers have decimal points."""
    separator = next((x for x in SEPARATORS if x in line), None)
    line = line.replace(",", ".") if separator and separator in DECIMAL_COMMAS else line
    return [cell.strip(' "') for cell in line.strip("#% ").split(separator)]


def _decoded(path: Path, content: bytes) -> str:
    """Text in UTF-8, in the encoding that its first bytes name, or in that of Windows; unpacked if gzip packed it."""
    try:
        content = gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content
        marked = next((name for name, marks in MARKS.items() if content.startswith(marks)), None)
        try:
            return content.decode(marked or "utf-8-sig")
        except UnicodeDecodeError:
            if marked or b"\0" in content:
                raise
            return content.decode("cp1252")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as fault:
        claim = f"damaged or not a text ({fault})"
        raise LogError(Finding("log.damaged", "", claim, "", "save it as UTF-8 text"), where=path) from fault


# --- arrays ---


def file_arrays(path: Path, content: bytes) -> dict[str, Any]:
    """Arrays in an NPZ archive, an NPY file, whose columns have no names, or a file of MATLAB."""
    matlab = imported("scipy.io", "scipy", "reading a file of MATLAB") if content.startswith(b"MATLAB") else None
    try:
        if matlab:
            known = matlab.loadmat(io.BytesIO(content), simplify_cells=True)
            return {name: x for name, x in known.items() if not name.startswith("__")}
        archive = np.load(io.BytesIO(content), allow_pickle=False)
        if isinstance(archive, np.ndarray):
            return {"": archive}
        inside = archive.zip.namelist()
        if not inside or any(name.endswith(".npy") for name in inside):
            return dict(archive)
    except Exception as fault:  # numpy, scipy and zipfile raise errors of many kinds on damaged bytes
        claim = f"damaged or not an archive of numbers ({fault})"
        raise LogError(Finding("log.damaged", "", claim), where=path) from fault
    raise LogError(Finding("log.zip", "", f"a zip archive of {listed(inside)}", "", "unpack it"), where=path)


def arrays_table(path: Path, given: Mapping[str, Any], time: str, rows: Rows) -> Table:
    """Table of arrays: x [rows, n] has the columns x1 ... xn, and is known by its own name, too.

    Rows are as many as times, or as most arrays have; an array with the joints in its first axis is transposed.
    """
    known = {bare(name): x for name, x in _flat(path, given)}
    lengths = Counter(k for x in known.values() for k in x.shape if k > 1)
    length = known[time].size if time in known else max(lengths, key=lambda k: (lengths[k], k), default=0)
    arrays, columns = {}, list[tuple[str, int]]()  # names of columns by array; array and place in it by column
    for name, x in known.items():
        x = x.T if x.ndim == 2 and x.shape[0] != length == x.shape[1] else x
        known[name] = x = x[:, None] if x.ndim == 1 else x
        n = x.shape[1] if x.ndim == 2 else 1
        arrays[name] = [f"{name}{k + 1}" for k in range(n)] if n > 1 else [name]
        columns += [(name, k) for k in range(n)]
    first, end = rows or (0, None)

    def column(k: int) -> np.ndarray:
        name, place = columns[k]
        return known[name][first:end, place]

    def read(used: list[int]) -> np.ndarray:
        for name in dict.fromkeys(columns[k][0] for k in used):
            x = known[name]
            if x.ndim != 2 or len(x) != length or x.dtype.kind not in "fiu":
                expected = f"must hold real numbers, [{length}] or [{length}, n]"
                found = f"{x.dtype} {list(x.shape)}"
                cure = "convert it by .astype(float)" if x.dtype.kind not in "fiu" else "all must have the same rows"
                raise LogError(Finding("array.shape", f"array {name!r}", expected, found, cure), where=path)
        return np.column_stack([column(k).astype(float) for k in used])

    heads = [head for names in arrays.values() for head in names]
    return Table(path, heads, read, lambda i, k: column(k)[i], first, first, arrays)


def _flat(path: Path, given: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Arrays in structures, structure.field by name."""
    for name, x in given.items():
        if isinstance(x, Mapping):
            yield from _flat(path, x, f"{prefix}{name}.")
        elif x is not None:
            try:
                yield f"{prefix}{name}", np.asarray(x.detach().cpu() if isinstance(x, Tensor) else x)
            except Exception as fault:  # numpy takes any object, whose conversion may fail in any way
                claim = f"must be an array of numbers ({fault})"
                raise LogError(Finding("array.kind", f"array {prefix + name!r}", claim), where=path) from fault
