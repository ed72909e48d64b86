"""Reading of logs: tables of sources of any kind, checked, joined by time, taken to the joints' side, at a rate."""

import warnings
from collections.abc import Mapping, Sequence
from numbers import Integral
from os import PathLike
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from torchdq.base import sources
from torchdq.base.checks import require_number, require_object
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.learning.logs.bags import MAGIC, bag_tables
from torchdq.learning.logs.checks import (
    beyond_limits,
    clock_findings,
    jumps,
    require_numbers,
    require_radians,
    require_times,
)
from torchdq.learning.logs.errors import LogError, LogWarning, MissingLogError
from torchdq.learning.logs.filters import at_times, fewer_times
from torchdq.learning.logs.headers import find_columns
from torchdq.learning.logs.layouts import SPARE, Layout
from torchdq.learning.logs.outliers import clipped_findings, frozen_findings, outlier_findings
from torchdq.learning.logs.poses import StaticPoses, poses_at_rest
from torchdq.learning.logs.samples import signal_table
from torchdq.learning.logs.signals import Signals, joined, read_signals
from torchdq.learning.logs.tables import Rows, Table, arrays_table, file_arrays, text_table
from torchdq.robot import Robot

File = str | PathLike[str] | bytes | IO[Any]
Source = File | Mapping[str, Any] | Sequence[File]

STANDARD = Layout()
MOST_BYTES = 1_000_000_000  # largest file that is read
FEWEST = 30  # rows that a log of a lower rate must keep: the filter before it takes as many
ARRAYS = (b"PK", b"\x93NUMPY", b"MATLAB 5.0")  # first bytes of files of arrays
OTHERS = {  # and of files that are none of all these
    b"PAR1": "a Parquet file",
    b"\x89HDF": "an HDF5 file",
    b"MATLAB 7.3": "a file of MATLAB 7.3, which is HDF5: save(file, '-v7') writes one that is read",
    b"#ROSBAG": "a bag of ROS 1",
    b"SQLite format 3": "a bag in SQLite; `ros2 bag convert` makes one in MCAP, which is read",
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
    joined: str = ""  # what was done to join several files by time

    def static_poses(self, seconds: float = 1.0, near: float = 0.01) -> StaticPoses:
        """Poses that the arm rests at, approached by every joint from below and from above, as `StaticPoses`.

        Dry friction opposes the motion that ended: after an approach from below it adds to the torque what it takes
        from it after one from above, and the mean is without it. Poses follow each other in any order, each visited
        with all joints coming from one side, and from the other.

        Args:
            seconds: least time at rest [s].
            near: distance of positions up to which poses are the same [rad or m].
        Raises:
            LogError: there are no torques, or no pose is approached from both sides by all joints.

        >>> import numpy as np
        >>> from torchdq.learning import read_log
        >>> time = np.arange(0, 20, 0.01)
        >>> # from below, from above
        >>> q = np.interp(time, [0, 3, 5, 8, 10, 20], [0.2, 0.5, 0.5, 1, 0.5, 0.5])[:, None]
        >>> side = np.where(time < 5, 1.0, -1.0)[:, None]
        >>> poses = read_log(
        ...     {"time": time, "q": q, "qd": None, "tau": 9.81 * np.cos(q) + 2.0 * side}
        ... ).static_poses()
        >>> print(f"{float(poses.tau / poses.q.cos()):.4f}, {float(poses.friction):.4f}")
        9.8100, 2.0000
        """
        return poses_at_rest(self.path, self.time, self.q, self.qd, self.tau, seconds, near)

    def __repr__(self) -> str:
        size = f"{self.q.shape[1]} joints, {len(self.time)} rows, {self.repeats} repeated time stamps left out"
        done = f"\n{self.joined}" if self.joined else ""
        return f"{self.path}: {size}{done}\n\n{signal_table('Log', self._asdict(), self.layout.known_gains)}"


def read_log(
    path: Source,
    layout: Layout = STANDARD,
    rows: Rows = None,
    rate: float | None = None,
    robot: Robot | None = None,
) -> Log:
    """Log in files, or made of arrays.

    Columns are found by name: time [s], q1 ... qn [rad], qd1 ... [rad/s], tau1 ... measured at the joints [N m] and, if
    they are known, qdd1 ... [rad/s^2]; of joints that slide, in m, m/s, N and m/s^2. Others stay unread.

    Args:
        path: path of the file, a file:// or package:// address, an open file, or its bytes: a text of numbers, packed
            with gzip or not, an NPZ or NPY file, a file of MATLAB, or a ROS 2 bag in MCAP. Or arrays by name; None
            instead of one says that it was not recorded. Or a list of files, which are joined by time.
        layout: names and units of the columns; by default time, q1 ..., qd1 ..., tau1 ... in SI units: s, rad, rad/s
            and N m, and of joints that slide (prismatic ones) m, m/s and N.
        rows: first row and the one after the last to use, counted from 0; None: all.
        rate: rows per second, on even time stamps, without what is too fast for them [Hz], e.g. for a log of a drive
            at 8 kHz; needs scipy. None: the rows as they are.
        robot: the robot that was recorded, whose number of joints and limits the log is checked against, and in whose
            order joints of bags are read; None: unknown.
    Raises:
        LogError: the file cannot be opened, a column is missing, a number is missing or not finite, time runs
            backwards, there is a gap, or a column is in degrees; or the robot has another number of joints.
        MissingLogError: there is no such file; it is a FileNotFoundError too.
        MissingLibraryError: scipy is not installed, and a rate or files of different times are given; or the extra
            "ros", for a bag.
    Warns:
        LogWarning: a position jumps farther than its velocities explain, an effort leaps in a few rows, or motions are
            far beyond the robot's limits; the same are in `Log.findings`.

    >>> import tempfile
    >>> from pathlib import Path
    >>> path = Path(tempfile.mkdtemp()) / "log.csv"
    >>> _ = path.write_text("time,q1,qd1,tau1\\n0.00,0.1,0.5,2.0\\n0.01,0.105,0.5,2.1\\n")
    >>> read_log(path).tau
    array([[2. ],
           [2.1]])
    >>> read_log(
    ...     {"time": [0.0, 0.01], "q": [[0.1], [0.105]], "qd": None, "tau": [[2.0], [2.1]]}
    ... ).tau.shape
    (2, 1)
    """
    require_object("layout", layout, Layout, "torchdq.learning", "Layout(columns={'q': 'position_{0}'})")
    if rows is not None:
        pair = rows if isinstance(rows, tuple | list) and len(rows) == 2 else (None, None)
        whole = all(isinstance(x, Integral) and not isinstance(x, bool) for x in pair)
        if not whole or not 0 <= rows[0] < rows[1]:
            expected = "a first row and a greater one after the last, whole numbers"
            raise ArgumentError(f"rows must be {expected}, found {rows!r}")
    if rate is not None:
        require_number("rate", rate, positive=True)
    with Progress(f"reading {path}" if isinstance(path, str | PathLike) else "reading a log"):
        joints = () if robot is None else robot.joint_names
        signals = _signals(path, layout.of_joints(joints), rows, joints)
        require_radians(signals)
    findings = [*signals.findings, *clock_findings(signals), *jumps(signals)]
    if "tau" in signals.names:
        names = [f"column {x!r}" for x in signals.names["tau"]]
        tau = signals.blocks["tau"]
        findings += [*outlier_findings(names, tau, signals.first), *clipped_findings(names, tau)]
        findings += frozen_findings(names, tau, signals.blocks["q"], signals.time, signals.first)
    new = signals.distinct()
    repeats = len(signals.time) - len(new.time)
    if rate is not None:
        new = _at_rate(new, rate)
    blocks: dict[str, Any] = {"qd": None, "tau": None} | new.blocks
    if robot is not None:
        if (n := blocks["q"].shape[1]) != robot.n:
            claim = f"{robot.n} joints are needed, those of {robot.name!r}"
            cure, option = (
                "lock joints of the robot, or choose columns by Layout",
                "--joints keeps some joints of the robot",
            )
            raise LogError(Finding("log.joints", "", claim, str(n), cure, option, value=n), where=new.path)
        findings += beyond_limits(robot, blocks["q"], blocks["qd"])
    if findings:
        warnings.warn(LogWarning(*findings, where=new.path), stacklevel=2)
    return Log(new.path, new.layout, new.time, repeats=repeats, findings=tuple(findings), joined=new.joined, **blocks)


def _signals(source: Any, layout: Layout, rows: Rows, joints: Sequence[str]) -> Signals:
    """Signals of the joints in a source of any kind; of several tables, rows are those that they have in common."""
    files = list(source) if isinstance(source, list | tuple) else [source]
    if not files:
        raise ArgumentError("no file given")
    if isinstance(source, Mapping):
        names = {x: given for x in SPARE if isinstance(given := layout.columns.get(x, x), str)}
        layout = layout.with_columns({x: None for x, name in names.items() if source.get(name, x) is None})
        tables = [arrays_table(Path("the arrays"), source, layout.names("time", 1)[0], rows)]
    else:
        tables = [table for file in files for table in _tables(file, layout, rows if len(files) == 1 else None, joints)]
    where = " + ".join(dict.fromkeys(str(table.path) for table in tables))
    if len(tables) == 1 and tables[0].first > tables[0].before:
        where += f", row {max(1, tables[0].first - tables[0].before - 1)}"
    found, columns, places = find_columns(where, layout, tables)
    parts = read_signals(found, columns, tables, places)
    for part in parts:
        require_numbers(part)
        require_times(part)
    whole = joined([_scaled(part) for part in parts])
    if rows and len(files) > 1:
        whole = whole.rows(slice(*rows))
        require_numbers(whole)  # there may be none
    return whole


def _tables(path: Any, layout: Layout, rows: Rows, joints: Sequence[str]) -> list[Table]:
    """Tables of a file, or of the bag in a folder."""
    inside = sorted(Path(path).glob("*.mcap")) if isinstance(path, str | PathLike) else []
    contents = [sources.content("log", file, MOST_BYTES, LogError, MissingLogError) for file in inside or [path]]
    name, content = Path(path if inside else contents[0].name), contents[0].data
    for start, kind in OTHERS.items():
        if content.startswith(start):
            needed = "needed are columns of text, an NPZ archive, a file of MATLAB before 7.3, or a bag in MCAP"
            cure = f"{needed}; or arrays: read_log({{'time': ..., 'q': ..., ...}})"
            raise LogError(Finding("log.kind", "", f"this is {kind}", "", cure, needed), where=name)
    if content.startswith(MAGIC):
        return bag_tables(name, [one.data for one in contents], joints, rows)
    if content.startswith(ARRAYS):
        return [arrays_table(name, file_arrays(name, content), layout.names("time", 1)[0], rows)]
    return [text_table(name, content, rows)]


def _scaled(table: Signals) -> Signals:
    """Signals of the joints, or of motors that are coupled; efforts are multiplied by their gains, if known."""
    layout = table.layout
    of_joints = {name: getattr(layout, name) for name in ("gain", "transmission", "zero")}
    of_joints |= {f"scale of {signal}": x for signal, x in layout.scale.items() if np.ndim(x)}
    for name, given in of_joints.items():
        if given and len(given) != layout.joints:
            rows = "rows" if isinstance(given[0], tuple) else "numbers"
            raise ArgumentError(f"{name} must have {layout.joints} {rows}, one per joint, found {len(given)}")
    return table._replace(blocks={signal: _at_motor(layout, signal, x) for signal, x in table.blocks.items()})


def _at_motor(layout: Layout, signal: str, x: np.ndarray) -> np.ndarray:
    """Signal of the motors at the scale of their joints, which are the joints unless they are coupled [rows, n]."""
    x = x * layout.scale.get(signal, 1.0)
    if signal == "tau" and layout.gain:
        x = x * [1.0 if gain is None else gain for gain in layout.gain]
    if signal == "command" or (not layout.transmission and not layout.zero):
        return x
    # positions of joints are q = C z + q0, with the motors z at the scale of their joints, and no power is lost
    ratios, C = layout.ratios if layout.transmission else 1.0, np.array(layout.coupling or np.eye(layout.joints))
    if signal == "tau":
        return x / ratios if signal in layout.at_motors else x @ C
    if signal not in layout.at_motors:
        return x @ np.linalg.inv(C).T
    return x * ratios + (np.linalg.solve(C, layout.zero) if signal == "q" and layout.zero else 0.0)


def _at_rate(signals: Signals, rate: float) -> Signals:
    """Signals at a rate."""
    time, path = signals.time, signals.path
    seconds, most = time[-1] - time[0], 1 / float(np.median(np.diff(time)))
    if seconds * most < FEWEST:
        claim = f"more than {FEWEST} rows are needed to read it at a rate"
        fault = Finding("log.rows", "", claim, str(len(time)), "rate=None reads all", "", value=len(time))
        raise LogError(fault, where=path)
    if rate > 1.01 * most or seconds * rate < FEWEST:
        expected = f"at most {most:.4g} Hz, that of the rows, and at least {FEWEST / seconds:.3g} Hz"
        raise ArgumentError(f"rate must be {expected}, of which {FEWEST} rows of {path} are left, found {rate!r}")
    new = fewer_times(time, rate)
    blocks = {signal: at_times(new, time, x, "read_log") for signal, x in signals.blocks.items()}
    return signals._replace(time=new, blocks=blocks)
