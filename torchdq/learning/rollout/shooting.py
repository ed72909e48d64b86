"""Multiple shooting: motions of a scene through measured positions, the state before every step a node of its own.

The nodes of a segment need not follow from each other while they are sought. A step of Gauss-Newton moves them, the
starts of the segments and the parameters at once, to where the linearised steps of the scene follow from each other
and come closest to the measurements:

    minimise |W (y - H x)|^2   over parameters p and starts, with x' = A x + B p + gap.

All steps are rows of one batch, for the program of a step and for that of its Jacobian matrix. A segment is blocks of
nodes side by side. The measurements of a block are condensed to the state at which it starts and the parameters, then
those of a segment to its start, which is eliminated (H. G. Bock, K. J. Plitt, "A multiple shooting algorithm for direct
solution of optimal control problems", IFAC 1984).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.learning.rollout.recordings import CheckedRecording
from torchdq.optional import imported

if TYPE_CHECKING:
    from torchdq.envs.sensitivity import StepMap

SMOOTHED = 0.02  # time to both sides of a node over which its first velocity is that of a cubic [s]
HELD = 1e-7  # weight of a start where it is, relative to what the measurements say of it: for what they do not see


class Segments(NamedTuple):
    """Pieces of all logs as rows of a batch, with as many nodes each; those beyond an end stay without measurements."""

    dt: float  # [s]
    n: int  # number of joints
    block: int  # nodes of a block
    log: np.ndarray  # [K] logs that the pieces are of
    time: np.ndarray  # [K, T] times of the nodes [s]
    row: np.ndarray  # [K, T] rows of the log that were measured at the nodes; -1: none
    follows: Tensor  # [K, T, 1] 1 where the next node belongs to the same piece, else 0
    used: Tensor  # [K, T, 1] 1 where there is a measurement, else 0
    y: Tensor  # [K, T, c] measured positions, then velocities if there are any
    late: Tensor | None  # [K, T, 1] time from a node to its measurement [s]; None: there is none


class Motions(NamedTuple):
    """Nodes at some parameters, and what they lack."""

    nodes: Tensor  # [K, T, s]
    gaps: Tensor  # [K, T, s] from the next node to the state that follows
    residual: Tensor  # [K, T, c] measured less predicted, zero where nothing was measured


class Linear(NamedTuple):
    """Linearised motions: changes, of columns s + p + 1, by those of a start, of the parameters, and by the gaps."""

    inner: Tensor  # [size, K blocks, s, s + p + 1] of the nodes of blocks, by the states at which the blocks start
    starts: Tensor  # [blocks, K, s + p + 1, s + p + 1] of those, by the states at which the segments start
    factor: Tensor  # [K, s + p + 1, s + p + 1] triangular: weighted measurements by starts, parameters, and their rest


# --- segments --------------------------------------------------------------------------------------------------------


def segments(logs: Sequence[CheckedRecording], dt: float, seconds: float | None) -> Segments:
    """Pieces of logs, as long as `seconds` if possible; None: every log is one."""
    pieces = []
    for k, log in enumerate(logs):
        node = np.rint((log.time - log.time[0]) / dt).astype(int)
        if (same := np.flatnonzero(np.diff(node) == 0)).size:
            raise ArgumentError(
                f"dt of the scene must not be longer than the time between two rows of a log, found {dt:g} s, and less "
                f"between rows {same[0]} and {same[0] + 1} of {log.name}; take a smaller dt, or fewer rows"
            )
        last = max(1, int(node[-1]))
        count = 1 if seconds is None else max(1, round(last * dt / seconds))
        ends = np.rint(np.linspace(0, last, count + 1)).astype(int)
        ends[-1] += 1
        rows = np.full(last + 1, -1)
        rows[node] = np.arange(len(node))
        pieces += [(k, a, rows[a:b]) for a, b in itertools.pairwise(ends)]
    most = max(len(rows) for *_, rows in pieces)
    block = max(1, math.isqrt(most))
    T = -(-most // block) * block
    time = np.stack([logs[k].time[0] + (a + np.arange(T)) * dt for k, a, _ in pieces])
    row = np.stack([np.concatenate([rows, np.full(T - len(rows), -1)]) for *_, rows in pieces])
    which = np.array([k for k, *_ in pieces])
    signals = [np.concatenate([x for x in (log.q, log.qd) if x is not None], axis=1) for log in logs]
    used = row[..., None] >= 0
    y = np.stack([signals[k][rows] for k, rows in zip(which, row, strict=True)]) * used
    late = np.stack([logs[k].time[rows] for k, rows in zip(which, row, strict=True)]) - time
    late = np.where(used[..., 0] & (abs(late) > 1e-6 * dt), late, 0.0)[..., None]
    lengths = np.array([len(rows) for *_, rows in pieces])
    follows = np.arange(T) < lengths[:, None] - 1
    return Segments(
        dt,
        logs[0].q.shape[1],
        block,
        which,
        time,
        row,
        torch.from_numpy(follows[..., None].astype(float)),
        torch.from_numpy(used.astype(float)),
        torch.from_numpy(y),
        torch.from_numpy(late) if late.any() else None,
    )


def first_guess(pieces: Segments, logs: Sequence[CheckedRecording]) -> tuple[Tensor, Tensor]:
    """Positions and velocities [K, T, n] of the nodes: those measured, or slopes of cubics through measured ones."""
    signal = imported("scipy.signal", "scipy", "fit_rollout")
    found = np.zeros((2, *pieces.time.shape, pieces.n))
    for k, log in enumerate(logs):
        grid = np.arange(log.time[0], log.time[-1] + 0.5 * pieces.dt, pieces.dt)
        q = _interpolated(grid, log.time, log.q)
        if log.qd is None:
            rows = max(SMOOTHED, 2.5 * float(np.diff(log.time).max())) / pieces.dt
            window = min(2 * math.ceil(rows) + 1, (len(grid) - 1) // 2 * 2 + 1)
            qd = signal.savgol_filter(q, window, min(3, window - 1), deriv=1, delta=pieces.dt, axis=0)
        else:
            qd = _interpolated(grid, log.time, log.qd)
        own = pieces.log == k
        at = np.clip(np.rint((pieces.time[own] - log.time[0]) / pieces.dt).astype(int), 0, len(grid) - 1)
        found[0, own], found[1, own] = q[at], qd[at]
    q, qd = torch.from_numpy(found)
    return q, qd


def _interpolated(at: np.ndarray, time: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.stack([np.interp(at, time, column) for column in x.T], axis=-1)


def commands(
    pieces: Segments, logs: Sequence[CheckedRecording], delay: float, slope: bool = False
) -> dict[str, Tensor]:
    """Commands [K, T, width] of all steps, or their derivatives by the delay [s]."""
    found = {}
    for name, first in logs[0].inputs.items():
        rows = np.zeros((*pieces.time.shape, first.values.shape[1]))
        for k, log in enumerate(logs):
            own, given = pieces.log == k, log.inputs[name]
            at = pieces.time[own] - delay
            rows[own] = -given.slope(at, pieces.dt) if slope else given.mean(at, pieces.dt)
        found[name] = torch.from_numpy(rows)
    return found


# --- motions ---------------------------------------------------------------------------------------------------------


def motions(
    step: StepMap, pieces: Segments, nodes: Tensor, inputs: Mapping[str, Tensor], parameters: Mapping[str, Tensor]
) -> Motions:
    """Nodes [K, T, s] and what they lack at some parameters."""
    after = step.after(nodes, inputs, parameters)
    gaps = torch.zeros_like(nodes)
    torch.sub(after[:, :-1], nodes[:, 1:], out=gaps[:, :-1])
    gaps.mul_(pieces.follows)
    return Motions(nodes, gaps.masked_fill_(pieces.follows == 0, 0.0), pieces.y - seen(pieces, nodes))


def seen(pieces: Segments, nodes: Tensor) -> Tensor:
    """Rows [K, T, c] of what is measured at nodes [K, T, s]; zero where there is no measurement."""
    n, c = pieces.n, pieces.y.shape[-1]
    x = nodes[..., :c]
    if pieces.late is not None:
        x = torch.cat([x[..., :n] + pieces.late * nodes[..., n : 2 * n], x[..., n:]], -1)
    return x * pieces.used


def linearised(pieces: Segments, moved: Motions, A: Tensor, B: Tensor, weight: Tensor) -> Linear:
    """Linearised motions.

    Args:
        pieces: the segments.
        moved: steps of the nodes.
        A: derivatives [K, T, s, s] of the steps in the states.
        B: derivatives [K, T, s, p] of the steps in the parameters.
        weight: [c] of a measurement: one over its standard deviation.
    """
    (K, T, s, _), size, n, c = A.shape, pieces.block, pieces.n, pieces.y.shape[-1]
    width, blocks = s + B.shape[-1] + 1, T // pieces.block
    added = A.new_zeros(K * blocks, size, s, width)
    added[..., s:-1], added[..., -1] = B.reshape(*added.shape[:3], -1), moved.gaps.reshape(added.shape[:3])
    through = A.reshape(K * blocks, size, s, s)
    inner = A.new_empty(size + 1, K * blocks, s, width)
    inner[0] = torch.eye(s, width, dtype=A.dtype)
    states = inner.unbind(0)
    for j, (b, a) in enumerate(zip(added.unbind(1), through.unbind(1), strict=True)):
        torch.baddbmm(b, a, states[j], out=states[j + 1])
    starts = _chained(inner[size].reshape(K, blocks, s, width))

    scale = (pieces.used * weight).reshape(K * blocks, size, c)
    rows = A.new_empty(K * blocks, size, c, width)
    torch.mul(inner[:size, :, :c].transpose(0, 1), scale[..., None], out=rows)
    if pieces.late is not None:
        late = scale[..., :n] * pieces.late.reshape(K * blocks, size, 1)
        rows[:, :, :n] += inner[:size, :, n : 2 * n].transpose(0, 1) * late[..., None]
    rows[..., -1] = scale * moved.residual.reshape(scale.shape) - rows[..., -1]
    factors = _triangular(rows.flatten(1, 2)).reshape(K, blocks, width, width)
    # the column of the rest has the other sign: what is measured less what is predicted
    sign = A.new_ones(width)
    sign[-1] = -1.0
    rows = (factors @ (sign[:, None] * starts.transpose(0, 1) * sign)).flatten(1, 2)
    held = HELD * rows[..., :s].square().sum(1).amax(-1).sqrt()
    more = held[:, None, None] * torch.eye(s, width, dtype=A.dtype)
    return Linear(inner[:size], starts, _triangular(torch.cat([rows, more], 1)))


def _chained(last: Tensor) -> Tensor:
    """Starts of all blocks, of the states [K, blocks, s, w] at which the next ones start; parameters stay."""
    K, blocks, s, width = last.shape
    through = last.new_zeros(blocks, K, width, width)
    through[:, :, :s], through[:, :, s:, s:] = last.transpose(0, 1), torch.eye(width - s, dtype=last.dtype)
    starts = torch.eye(width, dtype=last.dtype).repeat(blocks, K, 1, 1)
    states = starts.unbind(0)
    for i, a in enumerate(through.unbind(0)[:-1]):
        torch.bmm(a, states[i], out=states[i + 1])
    return starts


def _triangular(rows: Tensor) -> Tensor:
    """Triangular factors [K, w, w] of rows [K, r, w], which may be fewer than columns."""
    K, r, w = rows.shape
    whole = rows if r >= w else torch.cat([rows, rows.new_zeros(K, w - r, w)], 1)
    return torch.linalg.qr(whole, mode="r").R


def changes(linear: Linear, step: Tensor) -> Tensor:
    """Changes of the nodes [K, T, s] for a step [p] of the parameters, with the best starts for it."""
    R, s, K = linear.factor, linear.inner.shape[2], len(linear.factor)
    right = R[:, :s, -1] - R[:, :s, s:-1] @ step
    start = torch.linalg.solve_triangular(R[:, :s, :s], right[..., None], upper=True)[..., 0]
    by = torch.cat([start, torch.cat([step, step.new_ones(1)]).expand(K, -1)], 1)
    at = (linear.starts @ by[..., None])[..., 0].transpose(0, 1).flatten(0, 1)  # [K blocks, s + p + 1]
    found = torch.linalg.vecdot(linear.inner, at[:, None])  # [size, K blocks, s]
    return found.transpose(0, 1).reshape(K, -1, s)
