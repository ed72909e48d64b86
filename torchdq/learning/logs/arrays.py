"""Tables of arrays: those in NPZ archives, and those a caller holds; rows are numbered from 0."""

import io
import zipfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.learning.logs.headers import still_possible
from torchdq.learning.logs.layouts import NEEDED, SIGNALS, Layout, LogError, listed
from torchdq.learning.logs.tables import Table, require_bounded, require_rows


def archive_table(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table in the bytes of an NPZ archive."""
    called = _called(layout)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as members:
            require_bounded(path, len(content), sum(member.file_size for member in members.infolist()))
            inside = members.namelist()
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            found = {signal: archive[name] for signal, name in called.items() if name in archive}
    except LogError:
        raise
    except Exception as fault:  # numpy and zipfile raise errors of many kinds on damaged bytes
        raise LogError(f"{path} is damaged or not an archive of numbers ({fault})") from fault
    if inside and not any(name.endswith(".npy") for name in inside):
        raise LogError(f"{path} is a zip archive of {listed(inside)}; unpack it")
    return _table(path, found, called, [name.removesuffix(".npy") for name in inside], layout, rows)


def arrays_table(arrays: Mapping[str, Any], layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table of arrays by name; None in place of one: it was not recorded."""
    path, found = Path("the arrays"), {}
    called = {signal: name for signal, name in _called(layout).items() if arrays.get(name, "") is not None}
    for name in ("time", "q"):
        called.setdefault(name, name)  # no log is without
    for signal, name in called.items():
        if (x := arrays.get(name)) is not None:
            try:
                found[signal] = np.asarray(x.detach().cpu() if isinstance(x, Tensor) else x)
            except Exception as fault:  # numpy takes any object, whose conversion may fail in any way
                raise LogError(f"{path}, array {name!r}: not an array of numbers ({fault})") from fault
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
            cure = f"other names are given by Layout(columns=...), e.g. {{'q': 'positions'}}; found {listed(inside)}"
            if way := still_possible(called.keys() - found.keys(), inside):
                cure += f"; {way}"
            raise LogError(f"{path}: there is no array {name!r}; needed are {needed}; {cure}")
    shape = found["q"].shape
    for signal, x in {"q": found["q"], **found}.items():  # positions first, whose shape the others must have
        if x.shape != (shape[:1] if signal == "time" else shape) or len(shape) != 2 or x.dtype.kind not in "fiu":
            raise LogError(
                f"{path}, array {called[signal]!r}: {x.dtype} {list(x.shape)}, expected real numbers, "
                f"time [rows] and q, qd, tau [rows, n]{_cure(found, signal, x)}"
            )
    if layout.joints not in (0, shape[1]) or not shape[1]:
        raise LogError(f"{path}: {shape[1]} joints, expected {layout.joints or 'at least one'}")
    joints = range(1, shape[1] + 1)
    names = {signal: ["time"] if signal == "time" else [f"{signal}{joint}" for joint in joints] for signal in found}
    start, end = rows or (0, None)
    values = np.column_stack([x.astype(float) for x in found.values()])[start:end]
    require_rows(path, len(values))
    layout = layout if layout.joints else replace(layout, joints=shape[1])
    return Table(path, layout, names, values, start, lambda i, k: values[i, k], before=start)


def _cure(found: Mapping[str, np.ndarray], signal: str, x: np.ndarray) -> str:
    """Words on what to do about the shape of an array."""
    rows = found["time"].shape[:1]
    if x.dtype.kind not in "fiu":
        return "; convert it by .astype(float)"
    if found["q"].ndim == 1:
        return "; one joint is written [rows, 1], as q[:, None]"
    if rows and found["q"].shape[1:] == rows and found["q"].shape[:1] != rows:
        return f"; the joints are in the first axis and the {rows[0]} rows in the second: transpose, as q.T"
    if x.shape[:1] != found["q"].shape[:1]:
        return f"; it has {len(x) if x.ndim else 0} rows and q has {len(found['q'])}: they must be recorded together"
    return ""
