"""Motions of robot arms from their logs: on an even time base, filtered, differentiated, split into training and test.

log = read("arm.csv")             # `torchdq.learning.logs`: checked, torques in N m, on its own uneven time stamps
motion = smooth(log)              # even steps, filtered without delay, with accelerations
before, after = cut(motion, 0.6)  # to fit and to test; with several motions: hold_out
train = samples(before)           # tensors, for `torchdq.learning.fit`
signs = directions(before)        # signs of the velocities, filtered as the torques, for `torchdq.learning.identify`
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from torchdq.checks import is_number, require_count, require_number
from torchdq.errors import ArgumentError
from torchdq.learning.data import UNITS, Samples
from torchdq.learning.layouts import LogError
from torchdq.learning.logs import Log
from torchdq.optional import imported
from torchdq.tables import summary

ENDS = 0.5  # [s] least time left out at either end, where a filter of a few Hz has neighbours on one side only
SIGN_WIDTH = 1e-3  # velocity below which its sign is rounded, small beside what the filter rounds [rad/s or m/s]
AT_REST = 0.02  # [rad/s] speed of every joint below which a row is left out: static friction may be anything there


class Motion(NamedTuple):
    """Motion in even steps, `[rows, n]` each, as float64."""

    time: np.ndarray  # [rows] [s]
    q: np.ndarray  # [rad]
    qd: np.ndarray  # [rad/s]
    qdd: np.ndarray  # [rad/s^2]
    tau: np.ndarray  # [N m]
    direction: np.ndarray | None = None  # sign of the velocity, filtered as the torques; None: unknown

    def __repr__(self) -> str:
        return summary("Motion", {name: (x, UNITS[name]) for name, x in self._asdict().items() if name in UNITS})


def smooth(
    log: Log,
    cutoff_qd: float | None = None,
    cutoff_tau: float | None = None,
    rate: float | None = None,
    width: float = SIGN_WIDTH,
) -> Motion:
    """Motion of a log in even steps of its median step, without its ends and the rows at rest.

    Velocities and torques pass a Butterworth filter of fourth order forwards and backwards, so that neither lags behind
    the other; accelerations are central differences of the filtered velocities, or those of the log, filtered alike.

    The filter rounds the step that dry friction makes in the torque where a velocity changes its sign. `direction` is
    that sign, rounded alike: with it `identify` finds the friction without bias, if its shape is right (`directions`).

    Args:
        log: from `read`.
        cutoff_qd: low-pass frequency of velocities and accelerations [Hz]; None: the layout's.
        cutoff_tau: low-pass frequency of torques [Hz]; None: the layout's.
        rate: rows per second that are kept [Hz], rounded to every so many of the log; None: all. Twice the cutoff are
            independent, as `identify` takes them to be for its standard errors.
        width: velocity below which dry friction is viscous [rad/s or m/s], as in `torchdq.effects.Coulomb`, whose
            default is 0.01: the default here is a sharp step, for logs of real arms. Only `direction` depends on it.
    Raises:
        LogError: the log is too short, or nothing moves in it.
        ArgumentError: a frequency is not between zero and half the rate of the rows, or no rows are left.
        MissingLibraryError: scipy is not installed.
    """
    if not isinstance(log, Log):
        raise ArgumentError(f"log must be a Log, found {type(log).__name__}; read(path) reads one")
    signal = imported("scipy.signal", "scipy", "smooth")
    cutoff_qd = log.layout.cutoff_qd if cutoff_qd is None else cutoff_qd
    cutoff_tau = log.layout.cutoff_tau if cutoff_tau is None else cutoff_tau
    step = float(np.median(np.diff(log.time)))
    for name, cutoff in (("cutoff_qd", cutoff_qd), ("cutoff_tau", cutoff_tau)):
        if not is_number(cutoff) or not 0 < cutoff < 0.5 / step:
            raise ArgumentError(f"{name} must be between 0 and {0.5 / step:.4g} Hz, half the rate, found {cutoff!r}")
    if rate is not None:
        require_number("rate", rate, positive=True)
    every = 1.0 if rate is None else max(1.0, np.rint(1 / rate / step))
    require_number("width", width, positive=True)
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
    direction = low_pass(qd / np.hypot(qd, width), cutoff_tau)
    used = (abs(qd) > AT_REST).any(axis=-1) & (time - time[0] >= ends) & (time[-1] - time >= ends)
    if not used.any():
        raise LogError(f"{log.path}: no joint ever moves faster than {AT_REST} rad/s")
    used &= np.arange(len(time)) % every == 0
    if not used.any():
        raise ArgumentError(
            f"rate must leave rows of the {time[-1] - time[0]:.3g} s of motion, found {rate:g} Hz, which leaves none"
        )
    return Motion(*(x[used] for x in (time, even(log.q), qd, qdd, tau, direction)))


def cut(motion: Motion, share: float) -> tuple[Motion, Motion]:
    """First part of a motion, with a share of the rows, and the rest.

    The `ENDS` seconds after the first part belong to neither: the filter has mixed them with it.

    Args:
        motion: from `smooth`.
        share: fraction of the rows that the first part gets, between 0 and 1.
    Raises:
        ArgumentError: a part would be empty.
    """
    rows = len(motion.time)
    require_number("share", share)
    first = np.arange(rows) < share * rows
    second = motion.time > (motion.time[first].max(initial=-np.inf) + ENDS)
    if not (0 < share < 1 and first.any() and second.any()):
        raise ArgumentError(f"share must leave rows on both sides of the cut of {rows} rows, found {share}")
    return _rows(motion, first), _rows(motion, second)


def _rows(motion: Motion, rows: np.ndarray) -> Motion:
    return Motion._make(None if x is None else x[rows] for x in motion)


def hold_out(motions: Sequence[Motion], share: float, seed: int = 0) -> tuple[list[Motion], list[Motion]]:
    """Motions to fit and motions to test, chosen at random: whole ones, because rows of one motion resemble each other.

    Args:
        motions: at least two.
        share: fraction of the motions that is held out for the test, rounded; at least one is, and not all.
        seed: seed of the choice.
    Raises:
        ArgumentError: there are fewer than two motions, or the share is not between 0 and 1.
    """
    if len(motions) < 2:
        raise ArgumentError(f"motions must be at least two to hold one out, found {len(motions)}; cut a single one")
    if not is_number(share) or not 0 < share < 1:
        raise ArgumentError(f"share must be between 0 and 1, found {share!r}")
    require_count("seed", seed, least=0)
    count = min(max(round(share * len(motions)), 1), len(motions) - 1)
    held = set(np.random.default_rng(seed).permutation(len(motions))[:count].tolist())
    parts: tuple[list[Motion], list[Motion]] = ([], [])
    for i, motion in enumerate(motions):
        parts[i in held].append(motion)
    return parts


def samples(motions: Motion | Sequence[Motion], dtype: torch.dtype = torch.float64) -> Samples:
    """Rows of one or several motions as tensors `[N, n]`, in their order.

    Args:
        motions: one motion, or several of the same arm.
        dtype: dtype of the tensors.
    Raises:
        ArgumentError: there is no motion, or they have different numbers of joints.
    """
    several = _several(motions)
    parts = ([getattr(motion, name) for motion in several] for name in Samples._fields)
    return Samples(*(torch.as_tensor(np.concatenate(part), dtype=dtype) for part in parts))


def directions(motions: Motion | Sequence[Motion], dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Signs of the velocities, filtered as the torques are, [N, n], of the rows of `samples`; for `identify`.

    Args:
        motions: one motion from `smooth`, or several of the same arm.
        dtype: dtype of the tensor.
    Raises:
        ArgumentError: as `samples`, or a motion has no directions.
    """
    parts = [motion.direction for motion in _several(motions)]
    known = [x for x in parts if x is not None]
    if len(known) < len(parts):
        raise ArgumentError("motions must have the field direction; smooth(log) makes it")
    return torch.as_tensor(np.concatenate(known), dtype=dtype)


def _several(motions: Motion | Sequence[Motion]) -> Sequence[Motion]:
    """Motions of one arm."""
    several = [motions] if isinstance(motions, Motion) else motions
    if not isinstance(several, Sequence) or not all(isinstance(motion, Motion) for motion in several):
        raise ArgumentError(f"motions must be Motion objects, found {type(motions).__name__}; smooth(log) makes one")
    joints = sorted({motion.q.shape[1] for motion in several})
    if len(joints) != 1:
        raise ArgumentError(f"motions must be of one arm, found motions of {joints or 'no'} joints")
    return several
