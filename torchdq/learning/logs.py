"""Recorded motions of robot arms: read, check, put on an even time base, filter, differentiate, split.

    log = read("panda.csv")           # what the file holds, checked, torques in N m, on its own uneven time stamps
    motion = smooth(log)              # even steps, filtered without delay, with accelerations
    before, after = cut(motion, 0.6)  # to fit and to test; with several motions: hold_out
    train = samples(before)           # tensors, for `torchdq.learning.fit`

The layouts known are `LAYOUTS`; another one is another entry:

* `panda`: a header line, and columns time [s], q1 ... q7 [rad], qd1 ... [rad/s], tau1 ... measured at the joints [N m].
* `ur10e`: no header; time [s], six each of q [rad], qd [rad/s], motor current [A], and twelve numbers of the controller
  that are wishes, not measurements, and stay unread.
* `double_pendulum`: a header line, and columns time [s], pos_meas1, pos_meas2 [rad], vel_meas1 ... [rad/s],
  tau_meas1 ... from the motor currents [N m].
* `csv`: as `panda`, for any number of joints, and qdd1 ... [rad/s^2] if they are known.

Columns under a header are found by their names; others may stand among them and stay unread. A file may be packed with
gzip, or be an NPZ archive of arrays time [rows], q, qd, tau and, if they are known, qdd, `[rows, n]` each.
"""

import gzip
import io
import math
import re
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
import torch

from torchdq.errors import ArgumentError, TorchdqError, UnknownNameError
from torchdq.learning.training import Samples
from torchdq.optional import imported

GAP = 0.1  # [s] longest time between two rows; beyond it, the motion in between is anyone's guess
ENDS = 0.5  # [s] least time left out at either end, where a filter of a few Hz has neighbours on one side only
AT_REST = 0.02  # [rad/s] below it in every joint the arm stands still, and static friction may be anything
FOLLOWED = 0.01  # [rad or rad/s] standard deviation from which a signal is held against its rate
ELSEWHERE = "read the rows before it or after it, by rows=(first, last)"


class LogError(TorchdqError, ValueError):
    """A log that cannot be used; the message names the file, and the row and column where there is one."""


@dataclass(frozen=True)
class Layout:
    """How one kind of log is written, and how its signals want to be treated."""

    robot: str | None = None
    """Name of the shipped robot it was recorded on, if it is one."""
    joints: int = 0
    """Number of joints; 0: as many as the header names."""
    blocks: tuple[str, ...] = ("q", "qd", "tau")
    """Names of the columns but for the number of the joint; the first three hold q, qd and the effort, and are read."""
    header: bool = True
    """Whether the first line holds the names of the columns; else they are the time and `blocks`, in order."""
    gain: tuple[float, ...] = ()
    """Torque per unit of effort [N m]; empty: the effort is the torque."""
    cutoff_qd: float = 8.0
    """Low-pass frequency of the velocities [Hz]."""
    cutoff_tau: float = 8.0
    """Low-pass frequency of the torques [Hz]."""
    slow: float = 0.02
    """Speed over which Coulomb friction changes sign [rad/s]: about the noise of the filtered velocity."""
    rotors: bool = False
    """Whether torques are taken at the motors, before the rotors' inertia."""
    farthest: float = 8 * math.pi
    """Position beyond which numbers are taken for degrees [rad]."""
    fastest: float = 50.0
    """Speed beyond which numbers are taken for degrees [rad/s]."""

    @property
    def columns(self) -> list[str]:
        """Names of the time and of all columns of the blocks."""
        return ["time", *(f"{block}{joint}" for block in self.blocks for joint in range(1, self.joints + 1))]


LAYOUTS = {
    "panda": Layout(robot="panda", joints=7, cutoff_qd=6.0, slow=0.05),
    "ur10e": Layout(
        robot="ur10e",
        joints=6,
        blocks=("q", "qd", "current", "current_des", "tau_des"),
        header=False,
        gain=(10.0, 10.6956, 8.4566, 9.0029, 9.48, 10.1232),  # drive gains identified with a known payload [N m/A]
        cutoff_qd=7.0,
        cutoff_tau=10.0,
        slow=0.01,
        rotors=True,
    ),
    "double_pendulum": Layout(
        joints=2,
        blocks=("pos_meas", "vel_meas", "tau_meas"),
        cutoff_qd=8.0,  # above 8 Hz, the shoulder's torques are those of the shaking mount
        rotors=True,
    ),
    "csv": Layout(),
}


class Log(NamedTuple):
    """What a file holds, row by row."""

    path: Path
    layout: Layout
    time: np.ndarray  # [rows], strictly increasing [s]
    q: np.ndarray  # [rows, n] [rad]
    qd: np.ndarray  # [rows, n] [rad/s]
    tau: np.ndarray  # [rows, n] [N m]
    repeats: int  # rows left out because they repeat a time stamp
    qdd: np.ndarray | None = None  # [rows, n] [rad/s^2], if the file holds them


class Motion(NamedTuple):
    """A motion in even steps, `[rows, n]` each, as float64."""

    time: np.ndarray  # [rows] [s]
    q: np.ndarray  # [rad]
    qd: np.ndarray  # [rad/s]
    qdd: np.ndarray  # [rad/s^2]
    tau: np.ndarray  # [N m]


def read(path: str | Path, layout: str = "auto", rows: tuple[int, int] | None = None) -> Log:
    """The log in a file.

    Args:
        path: the file: numbers separated by commas, packed with gzip or not, or an NPZ archive.
        layout: a name in `LAYOUTS`; "auto" tells it from the first line, and takes any seven joints for a Panda's.
        rows: first row and the one after the last to use, counted from 0; None: all.
    Raises:
        LogError: a column is missing, a number is missing or not finite, time runs backwards, there is a gap, or a
            column is in degrees.
        UnknownNameError: there is no such layout.
        OSError: the file cannot be opened.

    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "log.csv"
    >>> _ = path.write_text("time,q1,qd1,tau1\\n0.00,0.1,0.5,2.0\\n0.01,0.105,0.5,2.1\\n")
    >>> read(path).tau
    array([[2. ],
           [2.1]])
    """
    path = Path(path)
    if layout != "auto" and layout not in LAYOUTS:
        raise UnknownNameError("layout", layout, ["auto", *LAYOUTS])
    if rows is not None and not 0 <= rows[0] < rows[1]:
        raise ArgumentError(f"rows must be a first row and a greater one after the last, found {rows}")
    content = path.read_bytes()
    kind, table = (_arrays if content.startswith(b"PK") else _lines)(path, content, layout, rows)

    _require_times(path, table)
    new = np.concatenate([[True], np.diff(table.values[:, 0]) > 0])
    q, qd, effort, *qdd = table.blocks(kind.joints)
    _require_radians(path, kind, table)
    repeats = int((~new).sum())
    return Log(
        path,
        kind,
        table.values[new, 0],
        q[new],
        qd[new],
        effort[new] * (kind.gain or 1.0),
        repeats,
        *(x[new] for x in qdd),
    )


def smooth(log: Log, cutoff_qd: float | None = None, cutoff_tau: float | None = None) -> Motion:
    """The motion of a log in even steps of its median step, without its ends and the rows at rest.

    Velocities and torques pass a Butterworth filter of fourth order forwards and backwards, so that neither lags behind
    the other; accelerations are central differences of the filtered velocities, or those of the log, filtered alike.

    Args:
        log: what `read` returned.
        cutoff_qd: low-pass frequency of velocities and accelerations [Hz]; None: the layout's.
        cutoff_tau: low-pass frequency of torques [Hz]; None: the layout's.
    Raises:
        LogError: the log is too short, or nothing moves in it.
        ArgumentError: a frequency is not between zero and half the rate of the rows.
        MissingLibraryError: scipy is not installed.
    """
    signal = imported("scipy.signal", "scipy", "smooth")
    cutoff_qd = log.layout.cutoff_qd if cutoff_qd is None else cutoff_qd
    cutoff_tau = log.layout.cutoff_tau if cutoff_tau is None else cutoff_tau
    step = float(np.median(np.diff(log.time)))
    for name, cutoff in (("cutoff_qd", cutoff_qd), ("cutoff_tau", cutoff_tau)):
        if not 0 < cutoff < 0.5 / step:
            raise ArgumentError(f"{name} must be between 0 and {0.5 / step:.4g} Hz, half the rate, found {cutoff}")
    time = np.arange(log.time[0], log.time[-1], step)
    ends = max(ENDS, 3 / min(cutoff_qd, cutoff_tau))
    if time[-1] - time[0] <= 3 * ends:
        raise LogError(
            f"{log.path}: {log.time[-1] - log.time[0]:.3g} s of motion, more than {3 * ends:.3g} s are needed"
        )

    def even(x: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(time, log.time, column) for column in x.T], axis=-1)

    def low_pass(x: np.ndarray, cutoff: float) -> np.ndarray:
        return signal.sosfiltfilt(signal.butter(4, cutoff, fs=1 / step, output="sos"), x, axis=0)

    qd = low_pass(even(log.qd), cutoff_qd)
    qdd = np.gradient(qd, step, axis=0) if log.qdd is None else low_pass(even(log.qdd), cutoff_qd)
    tau = low_pass(even(log.tau), cutoff_tau)
    used = (abs(qd) > AT_REST).any(axis=-1) & (time - time[0] >= ends) & (time[-1] - time >= ends)
    if not used.any():
        raise LogError(f"{log.path}: no joint ever moves faster than {AT_REST} rad/s")
    return Motion(*(x[used] for x in (time, even(log.q), qd, qdd, tau)))


def cut(motion: Motion, share: float) -> tuple[Motion, Motion]:
    """The first part of a motion, with a share of the rows, and what follows it.

    The `ENDS` seconds after the first part belong to neither: the filter has mixed them with it.

    Args:
        motion: what `smooth` returned.
        share: of the rows, between 0 and 1.
    Raises:
        ArgumentError: a part would be empty.
    """
    rows = len(motion.time)
    first = np.arange(rows) < share * rows
    second = motion.time > (motion.time[first].max(initial=-np.inf) + ENDS)
    if not (0 < share < 1 and first.any() and second.any()):
        raise ArgumentError(f"share must leave rows on both sides of the cut of {rows} rows, found {share}")
    return Motion(*(x[first] for x in motion)), Motion(*(x[second] for x in motion))


def hold_out(motions: Sequence[Motion], share: float, seed: int = 0) -> tuple[list[Motion], list[Motion]]:
    """Motions to fit and motions to test, chosen by lot: whole ones, because rows of one motion resemble each other.

    Args:
        motions: at least two.
        share: of the motions that are held out for the test, rounded; at least one is, and not all.
        seed: of the lot.
    Raises:
        ArgumentError: there are fewer than two motions, or the share is not between 0 and 1.
    """
    if len(motions) < 2:
        raise ArgumentError(f"motions must be at least two to hold one out, found {len(motions)}; cut a single one")
    if not 0 < share < 1:
        raise ArgumentError(f"share must be between 0 and 1, found {share}")
    count = min(max(round(share * len(motions)), 1), len(motions) - 1)
    held = set(np.random.default_rng(seed).permutation(len(motions))[:count].tolist())
    parts: tuple[list[Motion], list[Motion]] = ([], [])
    for i, motion in enumerate(motions):
        parts[i in held].append(motion)
    return parts


def samples(motions: Motion | Sequence[Motion], dtype: torch.dtype = torch.float64) -> Samples:
    """The rows of one or several motions as tensors `[N, n]`, in their order.

    Args:
        motions: of one arm.
        dtype: of the tensors.
    Raises:
        ArgumentError: there is no motion, or they have different numbers of joints.
    """
    several = [motions] if isinstance(motions, Motion) else list(motions)
    joints = sorted({motion.q.shape[1] for motion in several})
    if len(joints) != 1:
        raise ArgumentError(f"motions must be of one arm, found motions of {joints or 'no'} joints")
    return Samples(
        *(torch.as_tensor(np.concatenate(parts), dtype=dtype) for parts in list(zip(*several, strict=True))[1:])
    )


# --- the table in a file ---------------------------------------------------------------------------------------------


class _Table(NamedTuple):
    """Numbers that are read: time, q, qd, effort and perhaps qdd."""

    values: np.ndarray  # [rows, columns]
    names: list[str]
    first: int  # number of the first row, for messages

    def blocks(self, joints: int) -> list[np.ndarray]:
        """q, qd, effort and perhaps qdd, [rows, n]."""
        return np.split(self.values[:, 1:], range(joints, self.values.shape[1] - 1, joints), axis=1)


def _lines(path: Path, content: bytes, layout: str, rows: tuple[int, int] | None) -> tuple[Layout, _Table]:
    """The table in a text; its rows are named as an editor numbers them."""
    try:
        text = (gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content).decode("utf-8-sig")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError) as fault:
        raise LogError(f"{path} is damaged or not a text ({fault})") from fault
    lines = text.rstrip().splitlines()
    if not lines:
        raise LogError(f"{path} is empty")
    heads = [cell.strip() for cell in lines[0].split(",")]
    kind = LAYOUTS[_recognised(path, heads) if layout == "auto" else layout]
    kind, names = _named(f"{path}, row 1", kind, heads if kind.header else kind.columns)
    if not kind.header:
        heads = kind.columns
    start = (1 if kind.header else 0) + (rows[0] if rows else 0)
    body = lines[start : None if rows is None else start + rows[1] - rows[0]]
    for number, line in enumerate(body, start + 1):
        if line.count(",") + 1 != len(heads):
            found = line.count(",") + 1
            raise LogError(
                f"{path}, row {number}: {found} columns, expected {len(heads)} columns {heads[0]} ... {heads[-1]}"
            )
    if len(body) < 2:
        raise LogError(f"{path}: {len(body)} rows of numbers, at least two are needed")
    used = [heads.index(name) for name in names]
    values: np.ndarray
    try:
        values = np.loadtxt(body, delimiter=",", usecols=used, comments=None, ndmin=2)
    except ValueError:  # some cell is no number; which one is found below
        values = np.array([[_number(cells[i]) for i in used] for cells in (line.split(",") for line in body)])
    for row, column in np.argwhere(~np.isfinite(values))[:1]:
        cell = body[row].split(",")[used[column]]
        _refuse(path, start + 1 + row, names[column], f"{cell!r} is not a finite number; {ELSEWHERE}")
    return kind, _Table(values, names, start + 1)


def _arrays(path: Path, content: bytes, layout: str, rows: tuple[int, int] | None) -> tuple[Layout, _Table]:
    """The table in an NPZ archive; its rows are numbered from 0."""
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            found = {name: archive[name] for name in ("time", "q", "qd", "tau", "qdd") if name in archive}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as fault:
        raise LogError(f"{path} is damaged or not an archive of numbers ({fault})") from fault
    missing = [name for name in ("time", "q", "qd", "tau") if name not in found]
    if missing:
        raise LogError(f"{path}: there is no array {missing[0]!r}; needed are time [rows], q, qd and tau [rows, n]")
    shape = found["q"].shape
    for name, x in found.items():
        expected = shape[:1] if name == "time" else shape
        if x.shape != expected or len(shape) != 2 or x.dtype.kind not in "fiu":
            raise LogError(
                f"{path}, array {name!r}: {x.dtype} {list(x.shape)}, expected real numbers, "
                "time [rows] and q, qd, tau [rows, n]"
            )
    joints = range(1, shape[1] + 1)
    heads = ["time", *(f"{name}{joint}" for name in list(found)[1:] for joint in joints)]
    start, end = rows or (0, None)
    values = np.column_stack([x.astype(float) for x in found.values()])[start:end]
    kind = LAYOUTS["csv" if layout == "auto" else layout]
    kind, names = _named(str(path), kind, heads)
    if len(values) < 2:
        raise LogError(f"{path}: {len(values)} rows of numbers, at least two are needed")
    for row, column in np.argwhere(~np.isfinite(values))[:1]:
        _refuse(path, start + row, heads[column], f"{values[row, column]} is not a finite number; {ELSEWHERE}")
    return kind, _Table(values, names, start)


def _recognised(path: Path, heads: Sequence[str]) -> str:
    """Name of the layout that a first line is of."""
    for name, kind in LAYOUTS.items():
        if kind.header and "time" in heads and _joints(kind, heads) in {kind.joints or _joints(kind, heads)} - {0}:
            return name
        if not kind.header and "time" not in heads and len(heads) == len(kind.columns):
            return name
    known = "; ".join(f"{name}: {_wanted(kind)}" for name, kind in LAYOUTS.items())
    raise LogError(f"{path}, row 1: {len(heads)} columns, from {heads[0]!r} on, fit no known layout ({known})")


def _joints(kind: Layout, heads: Sequence[str]) -> int:
    """Number of joints that a header names."""
    return sum(re.fullmatch(rf"{re.escape(kind.blocks[0])}\d+", head) is not None for head in heads)


def _named(where: str, kind: Layout, heads: Sequence[str]) -> tuple[Layout, list[str]]:
    """The layout with its number of joints, and the names of the columns to read."""
    if not kind.joints:
        kind = replace(kind, joints=max(_joints(kind, heads), 1))
    blocks = [*kind.blocks[:3], *(["qdd"] if any(re.fullmatch(r"qdd\d+", head) for head in heads) else [])]
    names = replace(kind, blocks=tuple(blocks)).columns
    for name in names:
        if heads.count(name) != 1:
            found = "there is no column" if name not in heads else "there are several columns"
            raise LogError(f"{where}: {found} {name!r}; needed are {_wanted(kind)}")
    if _joints(kind, heads) != kind.joints:
        raise LogError(f"{where}: {_joints(kind, heads)} joints, expected {kind.joints}")
    return kind, names


def _wanted(kind: Layout) -> str:
    """Columns of a layout, in words."""
    if not kind.header:
        return f"{len(kind.columns)} columns without a header"
    last = kind.joints or "n"
    return "columns time, " + ", ".join(f"{block}1 ... {block}{last}" for block in kind.blocks)


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _refuse(path: Path, row: int, column: str, what: str) -> NoReturn:
    raise LogError(f"{path}, row {row}, column {column!r}: {what}")


# --- what the numbers mean -------------------------------------------------------------------------------------------


def _require_times(path: Path, table: _Table) -> None:
    """Refuse times that run backwards, leave gaps, or are not in seconds."""
    step = np.diff(table.values[:, 0])
    if (step < 0).any():
        i = int((step < 0).argmax())
        _refuse(path, table.first + i + 1, "time", f"{-step[i]:.4g} s before the row above; {ELSEWHERE}")
    if (step > GAP).any():
        i = int((step > GAP).argmax())
        cure = ELSEWHERE
        if np.median(step) > GAP:
            cure = "times must be in seconds; divide milliseconds by 1000"
        _refuse(path, table.first + i + 1, "time", f"{step[i]:.4g} s after the row above, more than {GAP} s; {cure}")
    if not step.any():
        _refuse(path, table.first + 1, "time", "the same time in all rows")


def _require_radians(path: Path, kind: Layout, table: _Table) -> None:
    """Refuse columns that are in degrees: by their size, and because positions change as their velocities say."""
    n = kind.joints
    time, blocks = table.values[:, 0], table.blocks(n)
    names = [table.names[1 + i * n : 1 + (i + 1) * n] for i in range(len(blocks))]
    for k, limit, unit in ((0, kind.farthest, "rad"), (1, kind.fastest, "rad/s")):
        row, joint = divmod(int(abs(blocks[k]).argmax()), n)
        if abs(blocks[k][row, joint]) > limit:
            _refuse(
                path,
                table.first + row,
                names[k][joint],
                f"{blocks[k][row, joint]:.6g} {unit}, more than {limit:.3g}; if these are degrees, multiply the column "
                "by pi/180, and if the joint does go there, read with a Layout in LAYOUTS that allows it",
            )
    for k, rate in ((0, 1), (1, 3)):
        for joint in range(n) if rate < len(blocks) else ():
            ratio = _ratio(time, blocks[k][:, joint], blocks[rate][:, joint])
            if ratio is None or 0.5 < ratio < 2:
                continue
            name, other = names[k][joint], names[rate][joint]
            what = f"{name} changes {ratio:.3g} times as much as {other} says"
            cure = "the two must agree in unit, sign and joint"
            for column, factor in ((name, ratio), (other, 1 / ratio)):
                if 0.5 < factor * math.pi / 180 < 2:
                    cure = f"{column} seems to be in degrees; multiply the column by pi/180"
            raise LogError(f"{path}, column {name!r}: {what}; {cure}")


def _ratio(time: np.ndarray, x: np.ndarray, rate: np.ndarray) -> float | None:
    """Changes of a signal over the integral of its rate; None where noise, drift or rest hide it."""
    integral = np.concatenate([[0.0], np.cumsum(np.diff(time) * (rate[1:] + rate[:-1]) / 2)])
    x, integral = x - x.mean(), integral - integral.mean()
    if x.std() < FOLLOWED or integral.std() < FOLLOWED:
        return None
    if abs(x @ integral) < 0.95 * math.sqrt((x @ x) * (integral @ integral)):
        return None
    return float(x @ integral / (integral @ integral))
