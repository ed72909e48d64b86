"""Results of commands, written as text for people or as one JSON object for programs."""

import json
import math
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text
from torch import Tensor

from torchdq.findings import printable


class Grid(NamedTuple):
    """Table of a text; cells that are too wide for the terminal are wrapped."""

    header: tuple[str, ...]  # empty: none
    rows: Sequence[Sequence[str]]


class Verbatim(NamedTuple):
    """Text whose lines stay as they are, however long."""

    text: str


class Outcome(NamedTuple):
    """Result of a command."""

    text: tuple[str | Grid | Verbatim, ...]  # paragraphs and tables
    data: Mapping[str, Any]
    failed: bool = False  # whether a check failed


def write(outcome: Outcome, as_json: bool, warnings: Sequence[str] = ()) -> None:
    """Write an outcome to stdout."""
    if as_json:
        write_json({**outcome.data, **({"warnings": list(warnings)} if warnings else {})})
        return
    console = Console(file=sys.stdout, highlight=False, markup=False, emoji=False)
    with console.capture() as drawn:
        before: object = ":"
        for part in outcome.text:
            if not (isinstance(before, str) and before.endswith(":")):  # a title stands close to what it is of
                console.print()
            if isinstance(part, Verbatim):
                console.print(Text(printable(part.text, kept="\n")), soft_wrap=True)
            else:
                shown = _drawn(part, console.width) if isinstance(part, Grid) else Text(printable(part, kept="\n"))
                console.print(shown)
            before = part
    sys.stdout.write("\n".join(line.rstrip() for line in drawn.get().split("\n")))


def write_json(data: Mapping[str, Any]) -> None:
    """Write one JSON object to stdout; numbers that are not finite are null."""
    text = json.dumps(plain(data), indent=2, ensure_ascii=False, allow_nan=False)
    sys.stdout.write(printable(text, kept="\n") + "\n")


def plain(x: Any) -> Any:
    """Value as JSON has it: tensors and arrays are lists, numbers that are not finite are None.

    >>> plain({"tau": np.array([1.0, math.nan]), "dtype": np.float64})
    {'tau': [1.0, None], 'dtype': "<class 'numpy.float64'>"}
    """
    if isinstance(x, Tensor):
        x = x.detach().cpu().numpy()
    if isinstance(x, np.ndarray | np.generic):
        x = x.tolist()
    if isinstance(x, float):
        return x if math.isfinite(x) else None
    if isinstance(x, Mapping):
        return {str(key): plain(value) for key, value in x.items()}
    if isinstance(x, list | tuple):
        return [plain(value) for value in x]
    return x if x is None or isinstance(x, bool | int | str) else str(x)


def _drawn(grid: Grid, width: int) -> RichTable:
    drawn = RichTable(
        box=None, padding=(0, 2 if grid.header else 1, 0, 0), pad_edge=False, show_header=bool(grid.header)
    )
    names = grid.header or ("",) * max((len(row) for row in grid.rows), default=0)
    whole = max((len(row[0]) for row in grid.rows if row), default=0) <= width // 3
    for k, name in enumerate(names):  # names in the first column stay in one piece, if they leave room for the others
        drawn.add_column(Text(name), overflow="fold", no_wrap=whole and not k)
    for row in grid.rows:
        drawn.add_row(*(Text(printable(cell)) for cell in row))
    return drawn
