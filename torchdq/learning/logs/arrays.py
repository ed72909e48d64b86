"""Tables of arrays: those in NPZ archives, and those a caller holds; rows are numbered from 0."""

import io
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.headers import OTHER_NAMES, missing_signals
from torchdq.learning.logs.layouts import NEEDED, SIGNALS, Layout, listed
from torchdq.learning.logs.tables import Table, require_rows


def archive_table(path: Path, content: bytes, layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table in the bytes of an NPZ archive."""
    called = _called(layout)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            inside = archive.zip.namelist()
            found = {signal: archive[name] for signal, name in called.items() if name in archive}
    except Exception as fault:  # numpy and zipfile raise errors of many kinds on damaged bytes
        claim = f"damaged or not an archive of numbers ({fault})"
        raise LogError(Finding("log.damaged", "", claim), where=str(path)) from fault
    if inside and not any(name.endswith(".npy") for name in inside):
        raise LogError(Finding("log.zip", "", f"a zip archive of {listed(inside)}", "", "unpack it"), where=str(path))
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
                raise LogError(Finding("array.kind", f"array {name!r}", expected), where=str(path)) from fault
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
            raise LogError(missing_signals(fault, called.keys() - found.keys(), inside), where=str(path))
    shape = found["q"].shape
    for signal, x in {"q": found["q"], **found}.items():  # positions first, whose shape the others must have
        if x.shape != (shape[:1] if signal == "time" else shape) or len(shape) != 2 or x.dtype.kind not in "fiu":
            expected = "must hold real numbers, time [rows] and q, qd, tau [rows, n]"
            fault = Finding("array.shape", f"array {called[signal]!r}", expected, f"{x.dtype} {list(x.shape)}")
            raise LogError(fault._replace(cure=_cure(found, x)), where=str(path))
    if layout.joints not in (0, shape[1]) or not shape[1]:
        expected = f"{layout.joints} joints are needed" if layout.joints else "at least one joint is needed"
        raise LogError(Finding("log.joints", "", expected, str(shape[1]), value=shape[1]), where=str(path))
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
