"""Motions of robot arms from their logs: in even steps, filtered, differentiated, split into training and test."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from torchdq.base.checks import is_number, require_number, require_object
from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.learning.logs.errors import LogError
from torchdq.learning.logs.filters import derivative, even, low_pass
from torchdq.learning.logs.poses import AT_REST  # rows below are left out: static friction may be anything there
from torchdq.learning.logs.read import Log
from torchdq.learning.logs.samples import Samples, signal_table

ENDS = 0.5  # [s] least time left out at either end, where a filter of a few Hz has neighbours on one side only
SIGN_WIDTH = 1e-3  # velocity below which its sign is rounded, small against what the filter rounds [rad/s or m/s]
CUTOFF = 8.0  # [Hz] usual for the filters: arms of a metre hardly move faster
SETTLED = 1.5  # periods of the cutoff at rest after which the filter has forgotten that the log begins or ends there
FEWEST = 15  # rows that the filter needs
TRAIN = 2 / 3  # usual share of a single motion to learn from


class Motion(NamedTuple):
    """Motion in even steps, `[rows, n]` each, as float64, and what was done to its signals."""

    time: np.ndarray  # [rows] [s]
    q: np.ndarray  # [rad or m]
    qd: np.ndarray  # [rad/s or m/s]
    qdd: np.ndarray  # [rad/s^2 or m/s^2]
    tau: np.ndarray | None  # [N m or N]; None: not recorded
    direction: np.ndarray | None = None  # sign of the velocity, filtered as the torques; None: unknown
    sign_width: float = SIGN_WIDTH  # velocity below which that sign is rounded [rad/s or m/s]
    cutoff_qd: float | None = None  # filter of positions, velocities and accelerations [Hz]; None: unfiltered
    cutoff_tau: float | None = None  # filter of torques and directions [Hz]; None: unfiltered
    known_gains: bool | tuple[bool, ...] = True  # whether `tau` is in N m, of all joints or of each, or e.g. in A
    name: str = ""  # its log, for messages
    coupling: tuple[tuple[float, ...], ...] | None = None  # C, joints = C q, where q is of motors that are coupled

    def __repr__(self) -> str:
        signals = signal_table("Motion", self._asdict(), self.known_gains)
        cutoffs = {"velocities": self.cutoff_qd, "torques": self.cutoff_tau}
        filters = [f"{name} at {cutoff:.4g} Hz" for name, cutoff in cutoffs.items() if cutoff is not None]
        return signals + (f"\nlow-pass filters: {', '.join(filters)}" if filters else "")


def smooth(
    log: Log,
    cutoff_qd: float | None = None,
    cutoff_tau: float | None = None,
    rate: float | None = None,
    sign_width: float = SIGN_WIDTH,
    delay: float = 0.0,
) -> Motion:
    """Zero-phase filtered and differentiated motion of a log, in even steps, as `Motion`.

    Signals are interpolated at the median step of the log and pass a Butterworth filter of fourth order forwards and
    backwards, so that none lags behind another. Velocities that were not recorded are derivatives of the filtered
    positions, accelerations of the filtered velocities. Rows at rest and ends that the filter spoils are left out.

    The filter rounds the step that dry friction makes in the torque where a velocity changes its sign. `direction` is
    that sign, filtered in the same way: with it `identify` finds the friction without bias, if its shape is right.

    Args:
        log: from `read_log`.
        cutoff_qd: low-pass frequency of positions, velocities and accelerations [Hz]; None: the layout's, or 8 Hz, or a
            quarter of the rate of the rows where that is less. The motion tells which.
        cutoff_tau: low-pass frequency of torques [Hz]; None: likewise.
        rate: rows per second that are kept [Hz], rounded to every so many of the log; None: all. Twice the cutoff are
            independent, as `identify` takes them to be for its standard errors.
        sign_width: velocity below which dry friction is viscous [rad/s or m/s], in `direction` alone: the default is a
            sharp step, for logs of real arms; a simulation has the width of its friction.
        delay: time by which the torques lag the positions in the log, which they are moved back by [s]; `identify`
            warns where it finds one.
    Raises:
        LogError: the log is too short, or nothing moves in it.
        ArgumentError: a frequency is not between zero and half the rate of the rows, or no rows are left.
        MissingLibraryError: scipy is not installed.

    >>> import numpy as np
    >>> from torchdq.learning import read_log
    >>> time = np.arange(0, 10, 0.01)[:, None]
    >>> log = read_log(
    ...     {"time": time[:, 0], "q": np.sin(time), "qd": np.cos(time), "tau": np.cos(time)}
    ... )
    >>> smooth(log).qdd.shape
    (886, 1)
    """
    require_object("log", log, Log, "torchdq.learning", "read_log(path)")
    step = float(np.median(np.diff(log.time)))
    cutoff_qd = _cutoff("cutoff_qd", cutoff_qd, log.layout.cutoff_qd, step)
    cutoff_tau = _cutoff("cutoff_tau", cutoff_tau, log.layout.cutoff_tau, step)
    require_number("sign_width", sign_width, positive=True)
    require_number("delay", delay)
    if rate is not None:
        require_number("rate", rate, positive=True)
    time = np.arange(log.time[0] - min(delay, 0.0), log.time[-1] - max(delay, 0.0), step)
    if not len(time):
        claim = f"delay must be shorter than the log, which lasts {np.ptp(log.time):.3g} s, found {delay!r}"
        raise ArgumentError(Finding("delay.long", "", claim, "", "", "give a shorter --delay", value=delay))
    lowest = cutoff_qd if log.tau is None else min(cutoff_qd, cutoff_tau)
    if np.ptp(time) <= _reach(lowest) or len(time) <= FEWEST:
        raise _too_short(log, 3 * _reach(lowest))

    def drawn(x: np.ndarray, cutoff: float, late: float = 0.0) -> np.ndarray:
        return low_pass(even(time + late, log.time, x, "smooth"), cutoff, step, "smooth")

    q = drawn(log.q, cutoff_qd)
    qd = derivative(time, q, "smooth") if log.qd is None else drawn(log.qd, cutoff_qd)
    qdd = derivative(time, qd, "smooth") if log.qdd is None else drawn(log.qdd, cutoff_qd)
    known, name, coupling = log.layout.known_gains, str(log.path), log.layout.coupling
    whole = Motion(time, q, qd, qdd, None, None, sign_width, cutoff_qd, None, known, name, coupling)
    if log.tau is not None:
        direction = low_pass(qd / np.hypot(qd, sign_width), cutoff_tau, step, "smooth")
        whole = whole._replace(tau=drawn(log.tau, cutoff_tau, delay), direction=direction, cutoff_tau=cutoff_tau)
    used = _used(log, whole, lowest)
    if rate is not None:
        used &= np.arange(len(time)) % max(1.0, np.rint(1 / rate / step)) == 0
        if not used.any():
            lasts = f"{np.ptp(time):.3g} s of motion"
            raise ArgumentError(f"rate must leave rows of the {lasts}, found {rate:g} Hz, which leaves none")
    return _rows(whole, used)


def _used(log: Log, whole: Motion, lowest: float) -> np.ndarray:
    """Rows that move and that the filter does not spoil [rows]."""
    time, reach = whole.time, _reach(lowest)
    moves = abs(whole.qd).max(axis=-1) > AT_REST
    since, left = time - time[0], time[-1] - time
    first, last = (reach if moves[at <= SETTLED / lowest].any() else 0.0 for at in (since, left))
    if np.ptp(time) <= first + reach + last:
        raise _too_short(log, first + reach + last)
    used: np.ndarray = moves & (since >= first) & (left >= last)
    if not used.any():
        raise LogError(Finding("log.still", "", f"no joint ever moves faster than {AT_REST} rad/s"), where=log.path)
    return used


def _cutoff(name: str, asked: float | None, usual: float | None, step: float) -> float:
    """Frequency of a filter: what is asked for, or usual for the log, or fits its rate."""
    cutoff = next(x for x in (asked, usual, min(CUTOFF, 0.25 / step)) if x is not None)
    if not is_number(cutoff) or not 0 < cutoff < 0.5 / step:
        claim = f"{name} must be between 0 and {0.5 / step:.4g} Hz, half the rate"
        raise ArgumentError(Finding("cutoff.range", "", claim, repr(cutoff), "", "give another --cutoff"))
    return float(cutoff)


def _reach(cutoff: float) -> float:
    """Time over which a filter mixes what comes before with what comes after [s]."""
    return max(ENDS, 3 / cutoff)


def _too_short(log: Log, needed: float) -> LogError:
    seconds, claim = np.ptp(log.time), f"more than {needed:.3g} s of motion are needed"
    return LogError(Finding("log.short", "", claim, f"{seconds:.3g} s", value=seconds), where=log.path)


def train_test_split(
    motions: Motion | Sequence[Motion], share: float = TRAIN, seed: int | None = None
) -> tuple[list[Motion], list[Motion]]:
    """Motions to learn from and motions to test on.

    Several motions are split as wholes, at least one on each side. A single one is cut; what the filter has mixed with
    its first part belongs to neither.

    Args:
        motions: one motion from `smooth`, or several.
        share: fraction that is learned from, between 0 and 1: of the motions, rounded, or of the rows of a single one.
        seed: seed by which several motions are drawn; None: the last ones are tested on.
    Raises:
        ArgumentError: there is no motion, the share is not between 0 and 1, or a part would be empty.

    >>> time = np.arange(0, 10, 0.01)
    >>> motion = Motion(time, *[np.sin(time)[:, None]] * 4)
    >>> (first,), (rest,) = train_test_split(motion, 0.7)
    >>> len(first.time) > len(rest.time)
    True
    >>> train, test = train_test_split([motion, motion, motion])
    >>> len(train), len(test)
    (2, 1)
    """
    whole = several(motions)
    if not is_number(share) or not 0 < share < 1:
        raise ArgumentError(f"share must be between 0 and 1, found {share!r}")
    if len(whole) == 1:
        return _cut(whole[0], share)
    count = min(max(round(share * len(whole)), 1), len(whole) - 1)
    order = range(len(whole)) if seed is None else np.random.default_rng(seed).permutation(len(whole)).tolist()
    return [whole[i] for i in sorted(order[:count])], [whole[i] for i in sorted(order[count:])]


def _cut(motion: Motion, share: float) -> tuple[list[Motion], list[Motion]]:
    """First part of a motion, with a share of the rows, and the rest."""
    rows = len(motion.time)
    first = np.arange(rows) < share * rows
    gap = _reach(min(motion.cutoff_qd or np.inf, motion.cutoff_tau or np.inf))
    second = motion.time > motion.time[first].max(initial=-np.inf) + gap
    if not (first.any() and second.any()):
        sides = f"both sides of the cut of {rows} rows, and of {gap:.3g} s after it"
        option = "give a longer log, or another one to test on by --test"
        claim = f"share must leave rows on {sides}"
        raise ArgumentError(Finding("motion.short", motion.name, claim, str(share), "", option))
    return [_rows(motion, first)], [_rows(motion, second)]


def _rows(motion: Motion, rows: np.ndarray) -> Motion:
    return Motion._make(x[rows] if isinstance(x, np.ndarray) else x for x in motion)


def stack_samples(motions: Motion | Sequence[Motion], dtype: torch.dtype = torch.float64) -> Samples:
    """Rows of one or several motions as tensors `[N, n]`, in their order.

    Args:
        motions: one motion, or several of the same arm.
        dtype: dtype of the tensors.
    Raises:
        ArgumentError: there is no motion, they have different numbers of joints, or torques are missing or in units
            of unknown gains.

    >>> time = np.arange(0, 10, 0.01)
    >>> motion = Motion(time, *[np.sin(time)[:, None]] * 4)
    >>> stack_samples([motion, motion]).tau.shape
    torch.Size([2000, 1])
    """
    whole = several(motions)
    require_torques(whole)
    parts = ([getattr(motion, name) for motion in whole] for name in Samples._fields)
    return Samples(*(torch.as_tensor(np.concatenate(part), dtype=dtype) for part in parts))


def require_torques(motions: Sequence[Motion]) -> None:
    """Raise unless motions hold torques, in N m."""
    for motion in motions:
        name = motion.name and f" of {motion.name}"
        if motion.tau is None:
            cure = "without torques, fit_rollout fits a simulation to positions and commands"
            claim = f"motions must have torques, found none in that{name}"
            raise ArgumentError(Finding("torques.missing", "", claim, "", cure))
        if not np.all(motion.known_gains):
            raise ArgumentError(unknown_gains(name))


def unknown_gains(of: str = "") -> Finding:
    """Finding about efforts in other units than torques."""
    claim = f"motions{of} must have torques, found efforts of unknown gains"
    cure = "give Layout(gain=...), or identify(robot, motions, Model(gains=True)), which finds them"
    return Finding("gains.unknown", "", claim, "", cure, "give --gains, or --estimate-gains")


def several(motions: Motion | Sequence[Motion]) -> Sequence[Motion]:
    """One motion or several as a sequence; raises unless they are of one arm."""
    found = [motions] if isinstance(motions, Motion) else motions
    if not isinstance(found, Sequence) or not all(isinstance(motion, Motion) for motion in found):
        raise ArgumentError(f"motions must be Motion objects, found {type(motions).__name__}; smooth(log) makes one")
    joints = sorted({motion.q.shape[1] for motion in found})
    if len(joints) != 1:
        raise ArgumentError(f"motions must be of one arm, found motions of {joints or 'no'} joints")
    return found
