"""Motions of robot arms from their logs: on an even time base, filtered, differentiated, split into training and test.

log = read("arm.csv")             # `torchdq.learning.logs.read`: checked, torques in N m, on its own uneven time stamps
motion = smooth(log)              # even steps, filtered without delay, with accelerations
before, after = cut(motion, 0.6)  # to fit and to test; with several motions: hold_out
train = samples(before)           # tensors, for `torchdq.learning.fit`
signs = directions(before)        # signs of the velocities, filtered as the torques, for `torchdq.learning.identify`
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from torchdq.base.checks import is_number, require_count, require_number
from torchdq.base.tables import summary
from torchdq.errors import ArgumentError
from torchdq.learning.logs.filters import derivative, even, low_pass
from torchdq.learning.logs.layouts import LogError
from torchdq.learning.logs.read import Log
from torchdq.learning.logs.samples import UNITS, Samples

ENDS = 0.5  # [s] least time left out at either end, where a filter of a few Hz has neighbours on one side only
SIGN_WIDTH = 1e-3  # velocity below which its sign is rounded, small beside what the filter rounds [rad/s or m/s]
CUTOFF = 8.0  # [Hz] usual for the filters: arms of a metre hardly move faster
SETTLED = 1.5  # periods of the cutoff at rest after which the filter has forgotten that the log begins or ends there
FEWEST = 15  # rows that the filter needs
AT_REST = 0.02  # [rad/s] speed of every joint below which a row is left out: static friction may be anything there


class Motion(NamedTuple):
    """Motion in even steps, `[rows, n]` each, as float64, and what was done to its signals."""

    time: np.ndarray  # [rows] [s]
    q: np.ndarray  # [rad or m]
    qd: np.ndarray  # [rad/s or m/s]
    qdd: np.ndarray  # [rad/s^2 or m/s^2]
    tau: np.ndarray | None  # [N m or N]; None: not recorded
    direction: np.ndarray | None = None  # sign of the velocity, filtered as the torques; None: unknown
    width: float = SIGN_WIDTH  # velocity below which that sign is rounded [rad/s or m/s]
    cutoff_qd: float | None = None  # filter of positions, velocities and accelerations [Hz]; None: unfiltered
    cutoff_tau: float | None = None  # filter of torques and directions [Hz]; None: unfiltered
    known_gains: bool | tuple[bool, ...] = True  # whether `tau` is in N m, of all joints or of each, or e.g. in A
    name: str = ""  # its log, for messages

    def __repr__(self) -> str:
        units = UNITS if np.all(self.known_gains) else UNITS | {"tau": "unknown gains"}
        signals = {name: (x, units[name]) for name, x in self._asdict().items() if name in units and x is not None}
        cutoffs = {"velocities": self.cutoff_qd, "torques": self.cutoff_tau}
        filters = [f"{name} at {cutoff:.4g} Hz" for name, cutoff in cutoffs.items() if cutoff is not None]
        return summary("Motion", signals) + (f"\nlow-pass filters: {', '.join(filters)}" if filters else "")


def smooth(
    log: Log,
    cutoff_qd: float | None = None,
    cutoff_tau: float | None = None,
    rate: float | None = None,
    width: float = SIGN_WIDTH,
    delay: float = 0.0,
) -> Motion:
    """Motion of a log in even steps of its median step, without the rows at rest and ends that the filter spoils.

    All signals pass a Butterworth filter of fourth order forwards and backwards, so that none lags behind another.
    Velocities that were not recorded are derivatives of the filtered positions, accelerations of the filtered
    velocities. An end at rest goes on at rest, so that nothing of the motion is lost there.

    The filter rounds the step that dry friction makes in the torque where a velocity changes its sign. `direction` is
    that sign, rounded alike: with it `identify` finds the friction without bias, if its shape is right (`directions`).

    Args:
        log: from `read`.
        cutoff_qd: low-pass frequency of positions, velocities and accelerations [Hz]; None: the layout's, or 8 Hz, or a
            quarter of the rate of the rows where that is less. The motion tells which.
        cutoff_tau: low-pass frequency of torques [Hz]; None: likewise.
        rate: rows per second that are kept [Hz], rounded to every so many of the log; None: all. Twice the cutoff are
            independent, as `identify` takes them to be for its standard errors.
        width: velocity below which dry friction is viscous [rad/s or m/s], as in `torchdq.effects.Coulomb`, whose
            default is 0.01: the default here is a sharp step, for logs of real arms. Only `direction` depends on it.
        delay: time by which the torques lag the positions in the log, which they are moved back by [s]; `identify`
            warns where it finds one.
    Raises:
        LogError: the log is too short, or nothing moves in it.
        ArgumentError: a frequency is not between zero and half the rate of the rows, or no rows are left.
        MissingLibraryError: scipy is not installed.

    >>> import numpy as np
    >>> from torchdq.learning import read
    >>> time = np.arange(0, 10, 0.01)[:, None]
    >>> log = read({"time": time[:, 0], "q": np.sin(time), "qd": np.cos(time), "tau": np.cos(time)})
    >>> smooth(log).qdd.shape
    (886, 1)
    """
    if not isinstance(log, Log):
        raise ArgumentError(f"log must be a Log, found {type(log).__name__}; read(path) reads one")
    step = float(np.median(np.diff(log.time)))
    cutoff_qd = _cutoff("cutoff_qd", cutoff_qd, log.layout.cutoff_qd, step)
    cutoff_tau = _cutoff("cutoff_tau", cutoff_tau, log.layout.cutoff_tau, step)
    if rate is not None:
        require_number("rate", rate, positive=True)
    every = 1.0 if rate is None else max(1.0, np.rint(1 / rate / step))
    require_number("width", width, positive=True)
    require_number("delay", delay)
    time = np.arange(log.time[0] - min(delay, 0.0), log.time[-1] - max(delay, 0.0), step)
    if not len(time):
        raise ArgumentError(
            f"delay must be shorter than the log, which lasts {log.time[-1] - log.time[0]:.3g} s, found {delay!r}"
        )
    lowest = cutoff_qd if log.tau is None else min(cutoff_qd, cutoff_tau)
    reach, seconds = _reach(lowest), time[-1] - time[0]
    if seconds <= reach or len(time) <= FEWEST:
        raise _too_short(log, 3 * reach)

    def filtered(x: np.ndarray, cutoff: float) -> np.ndarray:
        return low_pass(x, cutoff, step, "smooth")

    def drawn(x: np.ndarray, late: float = 0.0) -> np.ndarray:
        return even(time + late, log.time, x, "smooth")

    q = filtered(drawn(log.q), cutoff_qd)
    qd = derivative(time, q, "smooth") if log.qd is None else filtered(drawn(log.qd), cutoff_qd)
    qdd = derivative(time, qd, "smooth") if log.qdd is None else filtered(drawn(log.qdd), cutoff_qd)
    tau = None if log.tau is None else filtered(drawn(log.tau, delay), cutoff_tau)
    direction = None if log.tau is None else filtered(qd / np.hypot(qd, width), cutoff_tau)

    moves = abs(qd).max(axis=-1) > AT_REST
    since, left = time - time[0], time[-1] - time
    first, last = (reach if moves[at <= SETTLED / lowest].any() else 0.0 for at in (since, left))
    if seconds <= first + reach + last:
        raise _too_short(log, first + reach + last)
    used = moves & (since >= first) & (left >= last)
    if not used.any():
        raise LogError(f"{log.path}: no joint ever moves faster than {AT_REST} rad/s")
    used &= np.arange(len(time)) % every == 0
    if not used.any():
        raise ArgumentError(
            f"rate must leave rows of the {seconds:.3g} s of motion, found {rate:g} Hz, which leaves none"
        )
    whole = Motion(
        *(time, q, qd, qdd, tau, direction, width, cutoff_qd),
        cutoff_tau=None if tau is None else cutoff_tau,
        known_gains=log.layout.known_gains,
        name=str(log.path),
    )
    return _rows(whole, used)


def _cutoff(name: str, asked: float | None, usual: float | None, step: float) -> float:
    """Frequency of a filter: what is asked for, or usual for the log, or fits its rate."""
    cutoff = usual if asked is None else asked
    if cutoff is None:
        return min(CUTOFF, 0.25 / step)
    if not is_number(cutoff) or not 0 < cutoff < 0.5 / step:
        raise ArgumentError(f"{name} must be between 0 and {0.5 / step:.4g} Hz, half the rate, found {cutoff!r}")
    return float(cutoff)


def _reach(cutoff: float | None) -> float:
    """Time over which a filter mixes what comes before with what comes after [s]."""
    return ENDS if cutoff is None else max(ENDS, 3 / cutoff)


def _too_short(log: Log, needed: float) -> LogError:
    return LogError(f"{log.path}: {log.time[-1] - log.time[0]:.3g} s of motion, more than {needed:.3g} s are needed")


def cut(motion: Motion, share: float) -> tuple[Motion, Motion]:
    """First part of a motion, with a share of the rows, and the rest.

    What the filter has mixed with the first part belongs to neither: `ENDS` seconds, or three periods of its cutoff.

    Args:
        motion: from `smooth`.
        share: fraction of the rows that the first part gets, between 0 and 1.
    Raises:
        ArgumentError: a part would be empty.

    >>> import numpy as np
    >>> from torchdq.learning import read
    >>> time = np.arange(0, 10, 0.01)[:, None]
    >>> log = read({"time": time[:, 0], "q": np.sin(time), "qd": np.cos(time), "tau": np.cos(time)})
    >>> motion = smooth(log)
    >>> first, rest = cut(motion, 0.7)
    >>> len(first.time) > len(rest.time)
    True
    """
    if not isinstance(motion, Motion):
        raise ArgumentError(f"motion must be a Motion, found {type(motion).__name__}; smooth(log) makes one")
    rows = len(motion.time)
    require_number("share", share)
    first = np.arange(rows) < share * rows
    cutoffs = [cutoff for cutoff in (motion.cutoff_qd, motion.cutoff_tau) if cutoff is not None]
    gap = _reach(min(cutoffs, default=None))
    second = motion.time > motion.time[first].max(initial=-np.inf) + gap
    if not (0 < share < 1 and first.any() and second.any()):
        expected = f"leave rows on both sides of the cut of {rows} rows, and of {gap:.3g} s after it"
        raise ArgumentError(f"share must {expected}, found {share}")
    return _rows(motion, first), _rows(motion, second)


def _rows(motion: Motion, rows: np.ndarray) -> Motion:
    return Motion._make(x[rows] if isinstance(x, np.ndarray) else x for x in motion)


def hold_out(motions: Sequence[Motion], share: float, seed: int = 0) -> tuple[list[Motion], list[Motion]]:
    """Motions to fit and motions to test, chosen at random: whole ones, because rows of one motion resemble each other.

    Args:
        motions: at least two.
        share: fraction of the motions that is held out for the test, rounded; at least one is, and not all.
        seed: seed of the choice.
    Raises:
        ArgumentError: there are fewer than two motions, or the share is not between 0 and 1.

    >>> import numpy as np
    >>> from torchdq.learning import read
    >>> time = np.arange(0, 10, 0.01)[:, None]
    >>> log = read({"time": time[:, 0], "q": np.sin(time), "qd": np.cos(time), "tau": np.cos(time)})
    >>> motion = smooth(log)
    >>> fitted, tested = hold_out([motion, motion, motion], share=0.3)
    >>> len(fitted), len(tested)
    (2, 1)
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
        ArgumentError: there is no motion, they have different numbers of joints, or torques are missing or in units
            of unknown gains.

    >>> import numpy as np
    >>> from torchdq.learning import read
    >>> time = np.arange(0, 10, 0.01)[:, None]
    >>> log = read({"time": time[:, 0], "q": np.sin(time), "qd": np.cos(time), "tau": np.cos(time)})
    >>> motion = smooth(log)
    >>> samples([motion, motion]).tau.shape
    torch.Size([1772, 1])
    """
    several = _several(motions)
    require_torques(several)
    parts = ([getattr(motion, name) for motion in several] for name in Samples._fields)
    return Samples(*(torch.as_tensor(np.concatenate(part), dtype=dtype) for part in parts))


def require_torques(motions: Sequence[Motion]) -> None:
    """Raise unless motions hold torques, in N m.

    Raises:
        ArgumentError: a motion has none, or efforts in units of unknown gains.
    """
    for motion in motions:
        name = motion.name and f" of {motion.name}"
        if motion.tau is None:
            cure = "without torques, fit_rollout fits a simulation to positions and commands"
            raise ArgumentError(f"motions must have torques, found none in that{name}; {cure}")
        if not np.all(motion.known_gains):
            cure = "give Layout(gain=...), or identify(robot, motions, gains=True), which finds them"
            raise ArgumentError(f"motions must have torques, found efforts of unknown gains in that{name}; {cure}")


def directions(motions: Motion | Sequence[Motion], dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """Signs of the velocities, filtered as the torques are, [N, n], of the rows of `samples`; for `identify`.

    Args:
        motions: one motion from `smooth`, or several of the same arm.
        dtype: dtype of the tensor.
    Raises:
        ArgumentError: as `samples`, or a motion has no directions.

    >>> import numpy as np
    >>> from torchdq.learning import read
    >>> time = np.arange(0, 10, 0.01)[:, None]
    >>> log = read({"time": time[:, 0], "q": np.sin(time), "qd": np.cos(time), "tau": np.cos(time)})
    >>> motion = smooth(log)
    >>> directions(motion).shape
    torch.Size([886, 1])
    """
    parts = [motion.direction for motion in _several(motions)]
    known = [x for x in parts if x is not None]
    if len(known) < len(parts):
        raise ArgumentError("motions must have the field direction; smooth(log) makes it where there are torques")
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
