"""Reading of logs: a table from a source of any kind, checked, taken to the joints' side, at a rate."""

from collections.abc import Mapping
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from torchdq.base import sources
from torchdq.base.checks import require_number
from torchdq.base.progress import Progress
from torchdq.base.tables import summary
from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.learning.logs.checks import jumps, require_numbers, require_radians, require_times
from torchdq.learning.logs.errors import LogError, MissingLogError
from torchdq.learning.logs.filters import decimated, fewer_times
from torchdq.learning.logs.layouts import Layout
from torchdq.learning.logs.outliers import outlier_findings
from torchdq.learning.logs.samples import UNITS
from torchdq.learning.logs.tables import Table, archive_table, arrays_table, text_table

Source = str | PathLike[str] | bytes | IO[Any] | Mapping[str, Any]

MOST_BYTES = 1_000_000_000  # largest file that is read
FEWEST = 30  # rows that a log of a lower rate must keep: the filter before it takes as many
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


class Log(NamedTuple):
    """Content of a file, row by row."""

    path: Path
    layout: Layout
    time: np.ndarray  # [rows], strictly increasing [s]
    q: np.ndarray  # [rows, n] [rad or m]
    qd: np.ndarray | None  # [rows, n] [rad/s or m/s]; None: not recorded
    tau: np.ndarray | None  # [rows, n] [N m or N]; efforts where `layout.gain` is None; None: not recorded
    repeats: int  # rows left out because they repeat a time stamp
    qdd: np.ndarray | None = None  # [rows, n] [rad/s^2 or m/s^2], if the file holds them
    command: np.ndarray | None = None  # [rows, n], what the drives were asked for, if the file holds it
    findings: tuple[Finding, ...] = ()  # what is probably wrong in it

    def __repr__(self) -> str:
        size = f"{self.q.shape[1]} joints, {len(self.time)} rows, {self.repeats} repeated time stamps left out"
        units = UNITS | {"command": "as in the file"}
        if not np.all(self.layout.known_gains):
            units |= {"tau": "unknown gains"}
        signals = {name: (x, units[name]) for name, x in self._asdict().items() if name in units and x is not None}
        return f"{self.path}: {size}\n\n{summary('Log', signals)}"


def read(path: Source, layout: Layout, rows: tuple[int, int] | None, rate: float | None) -> Log:
    """Log in a file, or made of arrays, with findings instead of warnings; arguments and errors are `read_log`'s."""
    if not isinstance(layout, Layout):
        cure = "columns are named by Layout(columns={'q': 'position_{0}'})"
        raise ArgumentError(f"layout must be a Layout, found {type(layout).__name__}; {cure}")
    if rows is not None:
        pair = rows if isinstance(rows, tuple | list) and len(rows) == 2 else (None, None)
        whole = all(isinstance(x, Integral) and not isinstance(x, bool) for x in pair)
        if not whole or not 0 <= rows[0] < rows[1]:
            expected = "a first row and a greater one after the last, whole numbers"
            raise ArgumentError(f"rows must be {expected}, found {rows!r}")
    if rate is not None:
        require_number("rate", rate, positive=True)
    with Progress(f"reading {path}" if isinstance(path, str | PathLike) else "reading a log"):
        table = _table(path, layout, rows)
        require_numbers(table)
        table = _joint_side(table)
        require_times(table)
        require_radians(table)
    findings = [*table.notes, *jumps(table)]
    if "tau" in table.names:
        findings += outlier_findings([f"column {x!r}" for x in table.names["tau"]], table.blocks["tau"], table.first)
    new = np.concatenate([[True], np.diff(table.time) > 0])
    time, blocks = table.time[new], {signal: x[new] for signal, x in table.blocks.items()}
    if rate is not None:
        time, blocks = _at_rate(table.path, time, blocks, rate)
    signals: dict[str, Any] = {"qd": None, "tau": None} | blocks
    return Log(table.path, table.layout, time, repeats=int((~new).sum()), findings=tuple(findings), **signals)


def _table(path: Any, layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table of a source of any kind."""
    if isinstance(path, Mapping):
        return arrays_table(path, layout, rows)
    name, content = sources.content("log", path, MOST_BYTES, LogError, MissingLogError)
    for start, kind in OTHERS.items():
        if content.startswith(start):
            needed = "not a table; needed are columns separated by commas"
            cure = ", an NPZ archive, or arrays: read_log({'time': ..., 'q': ..., ...})"
            python, option = (f"{needed}{rest}" for rest in (cure, " or an NPZ archive"))
            raise LogError(Finding("log.kind", "", f"this is {kind}", "", python, option), where=Path(name))
    return (archive_table if content.startswith(b"PK") else text_table)(Path(name), content, layout, rows)


def _joint_side(table: Table) -> Table:
    """Table of the joints, from that of the motors that drive them; efforts are multiplied by their gains, if known.

    Joints' positions are linear in the motors', q = S m + q0, so that velocities and accelerations follow by S, and,
    the transmission being lossless, torques at the joints are S^-T times those at the motors.
    """
    layout = table.layout
    for name, given in (("gain", layout.gain), ("transmission", layout.transmission), ("zero", layout.zero)):
        if given and len(given) != layout.joints:
            rows = "rows" if name == "transmission" and np.ndim(layout.transmission) == 2 else "numbers"
            raise ArgumentError(f"{name} must have {layout.joints} {rows}, one per joint, found {len(given)}")
    blocks = {signal: _at_joint(layout, signal, x) for signal, x in table.blocks.items()}
    return table._replace(values=np.column_stack([table.time, *blocks.values()]))


def _at_joint(layout: Layout, signal: str, x: np.ndarray) -> np.ndarray:
    """Signal of the joints [rows, n]."""
    if signal == "tau" and layout.gain:
        x = x * [1.0 if gain is None else gain for gain in layout.gain]
    if not layout.transmission or signal not in layout.at_motors:
        return x
    given = np.array(layout.transmission)
    S = np.diag(given) if given.ndim == 1 else given
    if signal == "tau":
        return x @ np.linalg.inv(S)
    return x @ S.T + (np.array(layout.zero or 0.0) if signal == "q" else 0.0)


def _at_rate(
    path: Path, time: np.ndarray, blocks: dict[str, np.ndarray], rate: float
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times and signals at a rate."""
    seconds, most = time[-1] - time[0], 1 / float(np.median(np.diff(time)))
    if seconds * most < FEWEST:
        claim = f"more than {FEWEST} rows are needed to read it at a rate"
        fault = Finding("log.rows", "", claim, str(len(time)), "rate=None reads all", "", value=len(time))
        raise LogError(fault, where=path)
    if rate > 1.01 * most or seconds * rate < FEWEST:
        expected = f"at most {most:.4g} Hz, that of the rows, and at least {FEWEST / seconds:.3g} Hz"
        raise ArgumentError(f"rate must be {expected}, of which {FEWEST} rows of {path} are left, found {rate!r}")
    return fewer_times(time, rate), {signal: decimated(time, x, rate, "read_log") for signal, x in blocks.items()}
