"""Rows of recorded motions, and the blocks of them that are left out to validate a model.

A block is a whole motion, or a contiguous part of one where there are fewer than three: rows of one moment resemble
each other, so that rows left out at random would show nothing. A filter mixes neighbours, so the rows next to it are
left out of the fit, too. Motions that repeat themselves show the same states again and again, so regions of the states
are left out, too: slow and fast rows, and those on either side along the direction in which positions vary most.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.findings import Finding
from torchdq.functions.call import check
from torchdq.learning.logs.motions import ENDS, Motion, unknown_gains
from torchdq.learning.logs.samples import Samples
from torchdq.robot import Robot
from torchdq.robot.argument import require_motors

MOST = 10  # most blocks; further motions share one
PARTS = 6  # blocks, at least, that fewer than three motions are cut into
LEAST = 20  # fewest rows of a block
REGIONS = 4  # of the states, which are left out, too
MARGIN = 0.02  # part of a motion without times that is left out on either side of a block
FITTED = 0.25  # least part of the rows that a fit without a block has
SIGNALS = ("q", "qd", "qdd", "tau", "direction")


class MotionRows(NamedTuple):
    """Rows of motions, one after the other, as float64."""

    q: Tensor  # [rows, n] [rad or m]
    qd: Tensor  # [rows, n] [rad/s or m/s]
    qdd: Tensor  # [rows, n] [rad/s^2 or m/s^2]
    lengths: tuple[int, ...]  # rows of each motion
    tau: Tensor | None = None  # [rows, n] [N m or N]
    direction: Tensor | None = None  # [rows, n] sign of the velocity, filtered as the torques
    time: Tensor | None = None  # [rows] [s]
    known_gains: bool | tuple[bool, ...] = True  # whether tau is in these units, of all joints or of each
    names: tuple[str, ...] = ()  # logs of the motions; empty: unknown

    @property
    def measured(self) -> Tensor:
        """Torques [rows, n]; raises if there are none."""
        if self.tau is None:
            raise ArgumentError("motions must have torques to identify a robot, found motions without")
        return self.tau

    @property
    def torques(self) -> Tensor:
        """Torques [rows, n]; raises if there are none, or efforts of unknown gains."""
        if not np.all(self.known_gains):
            raise ArgumentError(unknown_gains())
        return self.measured

    def signals(self) -> dict[str, Tensor]:
        """Rows of the signals that there are, by name."""
        return {name: x for name in SIGNALS if (x := getattr(self, name)) is not None}

    def some(self, rows: Tensor) -> "MotionRows":
        """Rows with these numbers, as one motion, without times."""
        tau = None if self.tau is None else self.tau[rows]
        return MotionRows(self.q[rows], self.qd[rows], self.qdd[rows], (len(rows),), tau)


class Block(NamedTuple):
    """Rows that are left out together."""

    rows: slice
    margins: tuple[slice, ...]  # rows on either side that neither validate nor are fitted meanwhile
    motion: slice  # rows of the motions that it belongs to


def of_motions(robot: Robot, motions: Motion | Samples | Sequence[Motion | Samples]) -> MotionRows:
    """Rows of motions from `smooth`, or of samples [..., rows, n], whose leading axes are those of motions."""
    one = not isinstance(motions, Sequence) or hasattr(motions, "_fields")  # a Motion or a Log is a tuple, too
    several: list[Any] = [motions] if one else [*motions]
    if not several:
        raise ArgumentError("motions must be at least one, found none")
    parts = [_rows_of(robot, motion) for motion in several]
    if len(parts) == 1:
        return parts[0]
    lengths, names = (tuple(x for part in parts for x in getattr(part, name)) for name in ("lengths", "names"))
    known = tuple(np.all([np.broadcast_to(part.known_gains, robot.n) for part in parts], axis=0).tolist())
    signals: dict[str, Any] = {name: [getattr(part, name) for part in parts] for name in (*SIGNALS, "time")}
    joined = {name: torch.cat(x) for name, x in signals.items() if not any(part is None for part in x)}
    return MotionRows(**joined, lengths=lengths, known_gains=known, names=names if len(names) == len(parts) else ())


def _rows_of(robot: Robot, motion: Any) -> MotionRows:
    """Rows of one motion, or of samples."""
    if isinstance(motion, Samples):
        return of_tensors(robot, **motion._asdict())
    if not isinstance(motion, Motion):
        cure = "smooth(log) makes one, and Samples(q, qd, qdd, tau) holds tensors"
        raise ArgumentError(f"motions must be Motion objects or Samples, found {type(motion).__name__}; {cure}")
    if motion.q.shape[1:] != (robot.n,):
        found = f"found one with {motion.q.shape[1]}"
        raise ArgumentError(f"motions must be of {robot.name!r}, which has {robot.n} joints, {found}")
    require_motors(robot, motion.coupling)
    given = {name: x for name in (*SIGNALS, "time") if (x := getattr(motion, name)) is not None}
    rows = {name: torch.as_tensor(x, dtype=torch.float64, device=robot.mass.device) for name, x in given.items()}
    return MotionRows(**rows, lengths=(len(motion.q),), known_gains=motion.known_gains, names=(motion.name,))


def of_tensors(robot: Robot, **signals: Tensor) -> MotionRows:
    """Rows of signals q, qd, qdd and perhaps tau [..., rows, n]; leading axes are those of motions."""
    batch = check(robot, (), **signals)
    shape, lengths = (math.prod(batch), robot.n), (batch[-1],) * math.prod(batch[:-1]) if batch else (1,)
    rows: dict[str, Any] = {name: x.detach().double().expand(*batch, -1).reshape(shape) for name, x in signals.items()}
    return MotionRows(**rows, lengths=lengths)


def blocks(recording: MotionRows) -> list[Block]:
    """Blocks of the rows, none if there are too few rows: every row is in exactly one."""
    ends = np.cumsum(recording.lengths).tolist()
    motions = [slice(end - rows, end) for end, rows in zip(ends, recording.lengths, strict=True)]
    if len(motions) >= 3:
        groups = np.array_split(np.arange(len(motions)), min(MOST, len(motions)))
        found = [slice(motions[group[0]].start, motions[group[-1]].stop) for group in groups]
        whole = [Block(rows, (), rows) for rows in found]
    else:
        whole = [block for motion in motions for block in _parts(recording, motion, -(-PARTS // len(motions)))]
    fitted = min(len(recording.q) - sum(map(_length, (block.rows, *block.margins))) for block in whole)
    enough = min(_length(block.rows) for block in whole) >= LEAST and fitted >= FITTED * len(recording.q)
    return whole if enough else []


def too_few(recording: MotionRows) -> Finding:
    """Finding about rows that are too few to leave blocks out, with the number of rows that would do."""
    motions, time = len(recording.lengths), recording.time
    parts = 1 if motions >= 3 else -(-PARTS // motions)
    rows, step = LEAST * parts, None if time is None or len(time) < 2 else float(time.diff().median())
    if step and motions == 1:  # a block in the middle, and the rows on either side of it, are left out
        rows = max(rows, math.ceil(2 * ENDS / step / (1 - FITTED - 1 / parts)))

    def amount(rows: int) -> str:
        return f"{rows} rows" + (f" ({rows * step:.2g} s)" if step else "")

    needed = f"{amount(rows)} of motion are needed to choose a model by blocks left out"
    claim = needed + (", for each motion" if motions > 1 else "")
    return Finding("rows.few", "", claim, amount(min(recording.lengths)), "record longer motions", value=rows)


def regions(recording: MotionRows) -> list[tuple[Tensor, Tensor]]:
    """Pairs of regions of the states, each the rows of one and of the other."""
    speed = (recording.qd / recording.qd.std(0).clamp_min(1e-300)).norm(dim=1)
    middle = recording.q - recording.q.mean(0)
    spread = torch.linalg.eigh(middle.T @ middle).eigenvectors[:, -1]
    half = len(speed) // 2
    return [(order[:half], order[half:]) for order in (speed.argsort(), (middle @ spread).argsort())]


def _parts(recording: MotionRows, motion: slice, count: int) -> list[Block]:
    """Contiguous parts of a motion, with the rows next to them."""
    cuts = np.linspace(motion.start, motion.stop, count + 1).round().astype(int).tolist()
    time = recording.time
    found = []
    for first, last in pairwise(cuts):
        if time is None or last == first:
            before = after = round(MARGIN * _length(motion))
        else:
            before = int((time[motion.start : first] > time[first] - ENDS).sum())
            after = int((time[last : motion.stop] < time[last - 1] + ENDS).sum())
        margins = (slice(max(motion.start, first - before), first), slice(last, min(motion.stop, last + after)))
        found.append(Block(slice(first, last), margins, motion))
    return found


def _length(rows: slice) -> int:
    return rows.stop - rows.start
