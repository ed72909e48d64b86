"""Recorded motions of robot arms: read, validate, put on an even time base, filter and differentiate.

    log = read("panda.csv")    # what the file holds, checked, torques in N m, on its own uneven time stamps
    motion = smooth(log)       # even steps, filtered without delay, with accelerations

Two layouts of a file are known; another one is another entry in `LAYOUTS`:

* `panda`: a header line, then time [s], q [rad], qd [rad/s] and measured joint torques [N m], seven of each.
* `ur10e`: no header; time [s], six each of q [rad], qd [rad/s], motor current [A], and twelve numbers of the controller
  that are wishes, not measurements, and stay unread.
"""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

GAP = 0.1  # [s] longest time between two rows; beyond it, the motion in between is anyone's guess
ENDS = 0.5  # [s] left out at either end, where a filter of a few Hz has neighbours on one side only
AT_REST = 0.02  # [rad/s] below it in every joint the arm stands still, and static friction may be anything


class LogError(ValueError):
    """A log that cannot be used; the message names the file, and the row and column where there is one."""


@dataclass(frozen=True)
class Layout:
    """How one kind of log is written, and how its signals want to be treated."""

    robot: str
    """Name of the shipped robot it was recorded on."""
    joints: int
    """Number of joints."""
    blocks: tuple[str, ...]
    """What follows the time, one column per joint each; the first three are read."""
    header: bool
    """Whether the first line holds the names of the columns."""
    gain: tuple[float, ...]
    """Torque per unit of the third block [N m]."""
    cutoff_qd: float
    """Low-pass frequency of the velocities [Hz]."""
    cutoff_tau: float
    """Low-pass frequency of the torques [Hz]."""
    slow: float
    """Speed over which Coulomb friction changes sign [rad/s]: about the noise of the filtered velocity."""
    rotors: bool
    """Whether torques are taken at the motors, before the rotors' inertia."""

    @property
    def columns(self) -> list[str]:
        """Names of all columns."""
        return ["time", *(f"{block}{joint}" for block in self.blocks for joint in range(1, self.joints + 1))]


LAYOUTS = {
    "panda": Layout(
        robot="panda",
        joints=7,
        blocks=("q", "qd", "tau"),
        header=True,
        gain=(1.0,) * 7,
        cutoff_qd=6.0,
        cutoff_tau=8.0,
        slow=0.05,
        rotors=False,
    ),
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


class Motion(NamedTuple):
    """A motion in even steps, `[rows, n]` each."""

    time: np.ndarray  # [rows] [s]
    q: np.ndarray  # [rad]
    qd: np.ndarray  # [rad/s]
    qdd: np.ndarray  # [rad/s^2]
    tau: np.ndarray  # [N m]


def read(path: str | Path, layout: str = "auto", rows: tuple[int, int] | None = None) -> Log:
    """The log in a file.

    Args:
        path: the file, numbers separated by commas.
        layout: a name in `LAYOUTS`, or "auto" to tell it from the first line.
        rows: first row and the one after the last to use, counted from 0; None: all.
    Raises:
        LogError: a number is missing or not finite, time runs backwards, or there is a gap.
    """
    path = Path(path)
    with path.open(newline="") as file:
        lines = list(csv.reader(file))
    while lines and not lines[-1]:
        lines.pop()
    if not lines:
        raise LogError(f"{path} is empty")
    kind = LAYOUTS[_recognised(path, lines[0]) if layout == "auto" else layout]
    columns = kind.columns
    if kind.header and lines[0] != columns:
        raise LogError(f"{path}, row 1: {_difference(lines[0], columns)}")

    first_line = 2 if kind.header else 1  # rows are named as an editor numbers them
    body = lines[first_line - 1 :]
    if rows is not None:
        body, first_line = body[slice(*rows)], first_line + rows[0]
    table = np.array([_numbers(path, i, cells, columns) for i, cells in enumerate(body, first_line)])
    if len(table) < 2:
        raise LogError(f"{path}: {len(table)} rows of numbers, at least two are needed")

    step = np.diff(table[:, 0])
    for fault, what in ((step < 0, "before the row above"), (step > GAP, f"after the row above, more than {GAP} s")):
        if fault.any():
            i = int(fault.argmax())
            raise LogError(f"{path}, row {first_line + i + 1}, column 'time': {abs(step[i]):.4g} s {what}")
    new = np.concatenate([[True], step > 0])
    time, q, qd, effort = np.split(table[new, : 1 + 3 * kind.joints], [1, 1 + kind.joints, 1 + 2 * kind.joints], axis=1)
    return Log(path, kind, time[:, 0], q, qd, effort * kind.gain, repeats=int((~new).sum()))


def smooth(log: Log) -> Motion:
    """The motion of a log in even steps of its median step, without its ends and the rows at rest.

    Velocities and torques pass a Butterworth filter of fourth order forwards and backwards, so that neither lags behind
    the other; accelerations are central differences of the filtered velocities.
    """
    step = float(np.median(np.diff(log.time)))
    time = np.arange(log.time[0], log.time[-1], step)
    if time[-1] - time[0] <= 3 * ENDS:
        raise LogError(f"{log.path}: {log.time[-1] - log.time[0]:.3g} s of motion, more than {3 * ENDS} s are needed")

    def even(signal: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(time, log.time, column) for column in signal.T], axis=-1)

    def low_pass(signal: np.ndarray, cutoff: float) -> np.ndarray:
        return sosfiltfilt(butter(4, cutoff, fs=1 / step, output="sos"), signal, axis=0)

    qd = low_pass(even(log.qd), log.layout.cutoff_qd)
    tau = low_pass(even(log.tau), log.layout.cutoff_tau)
    used = (abs(qd) > AT_REST).any(axis=-1) & (time - time[0] >= ENDS) & (time[-1] - time >= ENDS)
    if not used.any():
        raise LogError(f"{log.path}: no joint ever moves faster than {AT_REST} rad/s")
    return Motion(*(x[used] for x in (time, even(log.q), qd, np.gradient(qd, step, axis=0), tau)))


# --- what went wrong, in words ---------------------------------------------------------------------------------------


def _recognised(path: Path, line: Sequence[str]) -> str:
    named = line[0].strip() == "time"
    for name, kind in LAYOUTS.items():
        if kind.header == named and (named or len(line) == len(kind.columns)):
            return name
    known = "; ".join(f"{name}: {_described(kind.columns)}" for name, kind in LAYOUTS.items())
    raise LogError(f"{path}, row 1: {len(line)} columns, from {line[0]!r} on, fit no known layout ({known})")


def _described(columns: Sequence[str]) -> str:
    return f"{len(columns)} columns {columns[0]}, {columns[1]} ... {columns[-1]}"


def _difference(found: Sequence[str], columns: Sequence[str]) -> str:
    for i, (name, expected) in enumerate(zip(found, columns, strict=False), 1):
        if name != expected:
            return f"column {i} is {name!r}, expected {expected!r}"
    return f"{len(found)} columns, expected {_described(columns)}"


def _numbers(path: Path, row: int, cells: Sequence[str], columns: Sequence[str]) -> list[float]:
    if len(cells) != len(columns):
        raise LogError(f"{path}, row {row}: {len(cells)} columns, expected {_described(columns)}")
    try:
        values = [float(cell) for cell in cells]
        if np.isfinite(values).all():
            return values
    except ValueError:
        pass
    column, cell = next((c, x) for c, x in zip(columns, cells, strict=True) if not _finite(x))
    raise LogError(f"{path}, row {row}, column {column!r}: {cell!r} is not a finite number")


def _finite(cell: str) -> bool:
    try:
        return bool(np.isfinite(float(cell)))
    except ValueError:
        return False
