"""Tables in plain text, for results that are printed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchdq.findings import printable


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Text with a line for the header and one for each row, their cells in columns.

    >>> print(table(("joint", "mass"), [("elbow", "1 kg"), ("hip", "12 kg")]))
    joint  mass
    elbow  1 kg
    hip    12 kg
    """
    lines = [[printable(cell) for cell in line] for line in (header, *rows)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(header))]
    padded = ("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)
    return "\n".join(line.rstrip() for line in padded)


def summary(title: str, signals: Mapping[str, tuple[Any, str]]) -> str:
    """Summary table of signals: shape, least, mean and greatest.

    Args:
        title: head of the first column.
        signals: tensors or arrays by name, with their unit.
    """
    rows = []
    for name, (x, unit) in signals.items():
        filled = 0 not in x.shape
        numbers = [f"{float(f()):.4g}" if filled else "-" for f in (x.min, x.mean, x.max)]
        rows.append((name, str(list(x.shape)), *numbers, unit))
    return table((title, "shape", "least", "mean", "greatest", "unit"), rows)
