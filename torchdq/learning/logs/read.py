"""Logs of robot arms in CSV files, NPZ archives and arrays: read, and checked for gaps, missing numbers and degrees.

A CSV file holds a header line and columns time [s], q1 ... qn [rad], qd1 ... [rad/s], tau1 ... measured at the joints
[N m] and, if they are known, qdd1 ... [rad/s^2]; of joints that slide, in m, m/s, N and m/s^2. A `Layout` names other
columns, says what was not recorded, turns motor currents into torques and motors' positions into joints', or does
without a header. Columns under a header are found by name; others may stand among them and stay unread. A file may be
packed with gzip, or be an NPZ archive of arrays time [rows], q, qd, tau and, if they are known, qdd, `[rows, n]`;
arrays in memory are given in the same way. A packed file is unpacked up to 100 times its size, so that a small file
cannot fill the memory.
"""

import warnings
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
from torchdq.learning.evaluation.diagnostics import LogWarning
from torchdq.learning.logs.arrays import archive_table, arrays_table
from torchdq.learning.logs.checks import jump, require_numbers, require_radians, require_times
from torchdq.learning.logs.filters import decimated, fewer_times
from torchdq.learning.logs.layouts import Layout, LogError, MissingLogError
from torchdq.learning.logs.outliers import spikes_told
from torchdq.learning.logs.samples import UNITS
from torchdq.learning.logs.tables import Table
from torchdq.learning.logs.texts import text_table
from torchdq.learning.logs.transmissions import joint_side

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
STANDARD = Layout()


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

    def __repr__(self) -> str:
        size = f"{self.q.shape[1]} joints, {len(self.time)} rows, {self.repeats} repeated time stamps left out"
        units = UNITS | {"command": "as in the file"}
        if not np.all(self.layout.known_gains):
            units |= {"tau": "unknown gains"}
        signals = {name: (x, units[name]) for name, x in self._asdict().items() if name in units and x is not None}
        return f"{self.path}: {size}\n\n{summary('Log', signals)}"


def read(
    path: str | PathLike[str] | bytes | IO[Any] | Mapping[str, Any],
    layout: Layout = STANDARD,
    rows: tuple[int, int] | None = None,
    rate: float | None = None,
) -> Log:
    """Log in a file, or made of arrays.

    Args:
        path: path of the file, a file:// or package:// address, an open file, or its bytes: numbers separated by
            commas, packed with gzip or not, or an NPZ archive. Or arrays by name, as in such an archive; None in place
            of one says that it was not recorded.
        layout: names and units of the columns; by default time, q1 ..., qd1 ..., tau1 ... in SI units: s, rad, rad/s
            and N m, and of joints that slide (prismatic ones) m, m/s and N.
        rows: first row and the one after the last to use, counted from 0; None: all.
        rate: rows per second, on even time stamps, without what is too fast for them [Hz], e.g. for a log of a drive
            at 8 kHz; needs scipy. None: the rows as they are.
    Raises:
        LogError: the file cannot be opened, a column is missing, a number is missing or not finite, time runs
            backwards, there is a gap, or a column is in degrees.
        MissingLogError: there is no such file; it is a FileNotFoundError too.
        MissingLibraryError: scipy is not installed, and a rate is given.
    Warns:
        LogWarning: a position jumps farther than its velocities explain, an effort leaps in a few rows, or the last
            number seems to be cut.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "log.csv"
    >>> _ = path.write_text("time,q1,qd1,tau1\\n0.00,0.1,0.5,2.0\\n0.01,0.105,0.5,2.1\\n")
    >>> read(path).tau
    array([[2. ],
           [2.1]])
    >>> read({"time": [0.0, 0.01], "q": [[0.1], [0.105]], "qd": None, "tau": [[2.0], [2.1]]}).tau.shape
    (2, 1)
    """
    if not isinstance(layout, Layout):
        cure = "columns are named by Layout(columns={'q': 'position_{0}'})"
        raise ArgumentError(f"layout must be a Layout, found {type(layout).__name__}; {cure}")
    whole = rows is None or (isinstance(rows, tuple | list) and all(map(_is_index, rows)) and len(rows) == 2)
    if not whole or (rows is not None and not 0 <= rows[0] < rows[1]):
        raise ArgumentError(f"rows must be a first row and a greater one after the last, whole numbers, found {rows!r}")
    if rate is not None:
        require_number("rate", rate, positive=True)
    with Progress(f"reading {path}" if isinstance(path, str | PathLike) else "reading a log"):
        table = _table(path, layout, rows)
        require_numbers(table)
        table = joint_side(table)
        require_times(table)
        require_radians(table)
    for doubt in (table.doubt, jump(table), *_leaps(table)):
        if doubt:
            warnings.warn(f"{table.path}, {doubt}", LogWarning, stacklevel=2)
    new = np.concatenate([[True], np.diff(table.time) > 0])
    time, blocks = table.time[new], {signal: x[new] for signal, x in table.blocks.items()}
    if rate is not None:
        time, blocks = _at_rate(table.path, time, blocks, rate)
    qd, tau, qdd, command = (blocks.get(signal) for signal in ("qd", "tau", "qdd", "command"))
    return Log(table.path, table.layout, time, blocks["q"], qd, tau, int((~new).sum()), qdd, command)


def _leaps(table: Table) -> list[str]:
    """Words for rows in which efforts leap away and back."""
    names = [f"column {name!r}" for name in table.names.get("tau", ())]
    return spikes_told(names, table.blocks["tau"], table.first) if names else []


def _is_index(x: Any) -> bool:
    return isinstance(x, Integral) and not isinstance(x, bool)


def _table(path: Any, layout: Layout, rows: tuple[int, int] | None) -> Table:
    """Table of a source of any kind."""
    if isinstance(path, Mapping):
        return arrays_table(path, layout, rows)
    name, content = sources.content("log", path, MOST_BYTES, LogError, MissingLogError)
    for start, kind in OTHERS.items():
        if content.startswith(start):
            expected = "columns separated by commas, an NPZ archive, or arrays: read({'time': ..., 'q': ..., ...})"
            raise LogError(f"{Path(name)} is {kind}, not a table; needed are {expected}")
    return (archive_table if content.startswith(b"PK") else text_table)(Path(name), content, layout, rows)


def _at_rate(
    path: Path, time: np.ndarray, blocks: dict[str, np.ndarray], rate: float
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Times and signals at a rate."""
    seconds, most = time[-1] - time[0], 1 / float(np.median(np.diff(time)))
    if seconds * most < FEWEST:
        raise LogError(
            f"{path}: {len(time)} rows, more than {FEWEST} are needed to read it at a rate; rate=None reads all"
        )
    if rate > 1.01 * most or seconds * rate < FEWEST:
        expected = f"at most {most:.4g} Hz, that of the rows, and at least {FEWEST / seconds:.3g} Hz"
        raise ArgumentError(f"rate must be {expected}, of which {FEWEST} rows of {path} are left, found {rate!r}")
    return fewer_times(time, rate), {signal: decimated(time, x, rate, "read") for signal, x in blocks.items()}
