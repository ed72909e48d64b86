"""Recordings of motions with commands: what a simulated scene is compared with, checked row by row."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from torchdq.errors import ArgumentError
from torchdq.learning.logs.errors import LogError


class Recording(NamedTuple):
    """Measured positions of a robot and the commands that it was given, row by row.

    Every command holds from its row to the next one.

    >>> Recording(time=[0.0, 0.01], q=[[0.0], [0.1]], inputs={"torque": [[1.0], [1.0]]}).q
    [[0.0], [0.1]]
    """

    time: ArrayLike  # [rows], strictly increasing [s]
    q: ArrayLike  # [rows, n] measured positions [rad or m]
    inputs: Mapping[str, ArrayLike]  # by name, [rows, width]: inputs of the scene, such as torque, target, reference
    qd: ArrayLike | None = None  # [rows, n] measured velocities [rad/s or m/s]; None: they were not measured
    name: str = ""  # by which errors call it; "": its number


class Commands(NamedTuple):
    """Commands that hold from their times on, the first one before them and the last one after."""

    time: np.ndarray  # [rows] [s]
    values: np.ndarray  # [rows, width]

    def mean(self, start: np.ndarray, span: float) -> np.ndarray:
        """Mean commands [..., width] over intervals of a length from `start` [...] on."""
        first, last = self._row(start), self._row(start + span)
        u, steps = self.values, np.diff(self.time)[:, None] * self.values[:-1]
        sums = np.concatenate([np.zeros_like(steps[:1]), np.cumsum(steps, axis=0)])  # integrals up to each time
        early = (self.time[np.minimum(first + 1, len(u) - 1)] - start)[..., None] * u[first]
        late = (start + span - self.time[last])[..., None] * u[last]
        between = sums[last] - sums[np.minimum(first + 1, last)]
        return np.where((last > first)[..., None], (early + between + late) / span, u[first])

    def slope(self, start: np.ndarray, span: float) -> np.ndarray:
        """Derivatives [..., width] of the means by a shift to later times.

        Where a command changes just at the ends of an interval, the mean of the derivatives to both sides.
        """
        near = 1e-6 * span
        first, last = (
            0.5 * (self.values[self._row(t - near)] + self.values[self._row(t + near)]) for t in (start, start + span)
        )
        return (last - first) / span

    def _row(self, t: np.ndarray) -> np.ndarray:
        """Rows whose commands hold at some times; a time that misses a row by rounding has reached it."""
        found = np.searchsorted(self.time, t + 1e-9 * (self.time[-1] - self.time[0]) / len(self.time), side="right") - 1
        return np.clip(found, 0, len(self.time) - 1)


class CheckedRecording(NamedTuple):
    """Recording as arrays of finite numbers."""

    name: str
    time: np.ndarray
    q: np.ndarray
    qd: np.ndarray | None
    inputs: dict[str, Commands]


def checked(logs: Recording | Sequence[Recording], joints: int, widths: Mapping[str, int]) -> list[CheckedRecording]:
    """Recordings as arrays; raises, naming log and row, unless they fit each other and a scene with such inputs."""
    several = [logs] if isinstance(logs, Recording) else logs
    if not isinstance(several, Sequence) or not several or not all(isinstance(log, Recording) for log in several):
        raise ArgumentError(f"logs must be a Recording or several, found {type(logs).__name__}")
    found = [_checked(log, f"log {log.name or k}", joints, widths) for k, log in enumerate(several)]
    for k, log in enumerate(found):
        if log.inputs.keys() != found[0].inputs.keys() or (log.qd is None) != (found[0].qd is None):
            raise ArgumentError(f"logs must have the same signals, found others in log 0 than in log {k}")
    return found


def _checked(log: Recording, name: str, joints: int, widths: Mapping[str, int]) -> CheckedRecording:
    if not isinstance(log.inputs, Mapping):
        raise ArgumentError(f"inputs of {name} must be arrays by name, found {type(log.inputs).__name__}")
    for key in log.inputs:
        if key not in widths:
            raise ArgumentError(f"inputs of {name} must be among those of the scene, {', '.join(widths)}, found {key}")
    time = _array(f"time of {name}", log.time)
    if len(time) < 3:
        raise ArgumentError(f"{name} must have at least three rows, found {len(time)}")
    if (np.diff(time) <= 0).any():
        row = int(np.argmax(np.diff(time) <= 0)) + 1
        raise LogError(f"{name}, row {row}: time must increase, found {time[row]:g} s after {time[row - 1]:g} s")
    q = _array(f"q of {name}", log.q, (len(time), joints))
    qd = None if log.qd is None else _array(f"qd of {name}", log.qd, (len(time), joints))
    inputs = {key: _array(f"{key} of {name}", log.inputs[key], (len(time), widths[key])) for key in sorted(log.inputs)}
    return CheckedRecording(name, time, q, qd, {key: Commands(time, x) for key, x in inputs.items()})


def _array(name: str, x: Any, shape: tuple[int, int] | None = None) -> np.ndarray:
    """Array of finite numbers; raises unless it has that shape, or one axis."""
    try:
        found = np.asarray(x, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name} must be an array of numbers, found {type(x).__name__}") from error
    if found.shape != (shape or (found.size,)):
        expected = list(shape) if shape else "[rows]"
        raise ArgumentError(f"{name} must have the shape {expected}, found {list(found.shape)}")
    bad = np.argwhere(~np.isfinite(found))
    if len(bad):
        row, *column = bad[0].tolist()
        place = f", column {column[0]}" if column else ""
        raise LogError(f"{name}, row {row}{place}: {found[tuple(bad[0])]} is not a finite number; leave the row out")
    return found
