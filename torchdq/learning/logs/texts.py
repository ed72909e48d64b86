"""Tables in CSV files, packed with gzip or not; rows are numbered as an editor does."""

import codecs
import gzip
import math
import zlib
from pathlib import Path

import numpy as np

from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.headers import find_columns
from torchdq.learning.logs.layouts import Layout, is_number
from torchdq.learning.logs.tables import Table, require_rows, rows_option

MARKS = {  # that a text in another encoding than UTF-8 starts with; the longer ones first
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}


def text_table(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table in the bytes of a CSV file."""
    text = _decoded(path, content)
    ended, lines = text.endswith(("\n", "\r")), text.rstrip().splitlines()
    if not lines:
        raise LogError(Finding("log.empty", "", "it is empty"), where=str(path))
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
        raise LogError(Finding("log.damaged", "", claim, "", "save it as UTF-8 text"), where=str(path)) from fault
