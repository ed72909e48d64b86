"""Tables in CSV files, packed with gzip or not; rows are numbered as an editor does."""

import codecs
import gzip
import io
import math
import zlib
from pathlib import Path

import numpy as np

from torchdq.learning.logs.headers import find_columns
from torchdq.learning.logs.layouts import Layout, LogError, is_number
from torchdq.learning.logs.tables import ALWAYS, PACKED, Table, require_bounded, require_rows

LONGEST = 100_000  # most characters of the first line, enough for ten thousand columns
MARKS = {  # that a text in another encoding than UTF-8 starts with; the longer ones first
    codecs.BOM_UTF32_LE: "utf-32",
    codecs.BOM_UTF32_BE: "utf-32",
    codecs.BOM_UTF16_LE: "utf-16",
    codecs.BOM_UTF16_BE: "utf-16",
}


def text_table(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table in the bytes of a CSV file."""
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
    require_rows(path, len(body))
    used = [heads.index(name) for block in names.values() for name in block]
    values: np.ndarray
    try:
        values = np.loadtxt(body, delimiter=",", usecols=used, comments=None, ndmin=2)
    except ValueError:  # some cell is no number; NaN marks it
        values = np.array([[_number(cells[i]) for i in used] for cells in (line.split(",") for line in body)])
    whole = ended or start + len(body) < len(lines) or len(heads) - 1 not in used
    doubt = "" if whole else _cut(body, start, layout)
    before = start - layout.header
    return Table(path, layout, names, values, start + 1, lambda i, k: repr(body[i].split(",")[used[k]]), doubt, before)


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


def _unpacked(path: Path, content: bytes) -> bytes:
    """Content of a file packed with gzip."""
    most = max(ALWAYS, PACKED * len(content))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(content)) as file:
            unpacked = file.read(most + 1)
    except (OSError, EOFError, zlib.error) as fault:
        raise LogError(f"{path} is damaged or not a text ({fault})") from fault
    require_bounded(path, len(content), len(unpacked))
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
