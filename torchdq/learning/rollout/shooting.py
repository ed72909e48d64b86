"""Multiple shooting: motions of a scene through measured positions, the state before every step a node of its own.

The nodes of a segment need not follow from each other until the end: what they lack are defects. A step of Gauss-Newton
moves them, the starts of the segments and the parameters at once, to where the linearised steps of the scene follow
from each other and come closest to the measurements:

    minimise |W (y - H x)|^2   over parameters p and starts, with x' = A x + B p + defect.

All steps are rows of one batch, for the program of a step and for that of its Jacobian matrix. What follows is done on
arrays of numpy, whose products of small matrices take a third of the time of torch's. A segment is blocks of nodes side
by side. The measurements of a block are condensed to the state at which it starts and the parameters, then
those of a segment to its start, which is eliminated (H. G. Bock, K. J. Plitt, "A multiple shooting algorithm for direct
solution of optimal control problems", IFAC 1984).
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from torchdq.errors import ArgumentError
from torchdq.learning.rollout.recordings import CheckedRecording

SMOOTHED = 0.02  # time to both sides of a node over which its first velocity is that of a cubic [s]
HELD = 1e-7  # weight of a start where it is, relative to the information of the measurements: for what they do not see


class Segments(NamedTuple):
    """Segments of all logs, padded to the same number of nodes."""

    dt: float  # [s]
    n: int  # number of joints
    block: int  # nodes of a block
    log: np.ndarray  # [K] log of each segment
    time: np.ndarray  # [K, T] times of the nodes [s]
    row: np.ndarray  # [K, T] rows of the log measured at the nodes; -1: none
    follows: np.ndarray  # [K, T, 1] True where the next node belongs to the same segment
    used: np.ndarray  # [K, T, 1] 1 where there is a measurement, else 0
    y: np.ndarray  # [K, T, c] measured positions, then velocities if there are any
    late: np.ndarray | None  # [K, T, 1] time from a node to its measurement [s]; None: there is none


class Motions(NamedTuple):
    """Nodes at some parameters, with their defects and residuals."""

    nodes: np.ndarray  # [K, T, s]
    defects: np.ndarray  # [K, T, s] from the next node to the state that follows
    residual: np.ndarray  # [K, T, c] measured less predicted, zero where nothing was measured


class Linear(NamedTuple):
    """Linearised motions: changes by the s numbers of a start, the p parameters and the defects, one column each."""

    inner: np.ndarray  # [size, K blocks, s, s + p + 1] of the nodes of blocks, by the states at which the blocks start
    starts: np.ndarray  # [blocks, K, s + p + 1, s + p + 1] of those, by the states at which the segments start
    factor: np.ndarray  # [K, s + p + 1, s + p + 1] triangular: weighted measurements by starts, parameters, their rest


# --- segments --------------------------------------------------------------------------------------------------------


def segments(logs: Sequence[CheckedRecording], dt: float, seconds: float | None) -> Segments:
    """Segments of logs, about `seconds` long; None: every log is one."""
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
    signals = [np.column_stack([x for x in (log.time, log.q, log.qd) if x is not None]) for log in logs]
    measured, used = np.stack([signals[k][rows] for k, rows in zip(which, row, strict=True)]), row[..., None] >= 0
    late = measured[..., :1] - time[..., None]
    late = np.where(used & (abs(late) > 1e-6 * dt), late, 0.0)
    follows = np.arange(T)[:, None] < np.array([len(rows) - 1 for *_, rows in pieces])[:, None, None]
    n, y, some = logs[0].q.shape[1], measured[..., 1:] * used, late if late.any() else None
    return Segments(dt, n, block, which, time, row, follows, used.astype(float), y, some)


def first_guess(pieces: Segments, logs: Sequence[CheckedRecording]) -> np.ndarray:
    """Positions and velocities [K, T, 2 n] of the nodes, as measured; unmeasured velocities by smoothing cubics."""
    found = []
    for k, log in enumerate(logs):
        grid = np.arange(log.time[0], log.time[-1] + 0.5 * pieces.dt, pieces.dt)
        measured = log.q if log.qd is None else np.concatenate([log.q, log.qd], -1)
        nodes = np.stack([np.interp(grid, log.time, x) for x in measured.T], -1)
        if log.qd is None:
            rows = max(SMOOTHED, 2.5 * float(np.diff(log.time).max())) / pieces.dt
            window = min(2 * math.ceil(rows) + 1, (len(grid) - 1) // 2 * 2 + 1)
            nodes = np.concatenate([nodes, slopes(nodes, window) / pieces.dt], -1)
        at = np.rint((pieces.time[pieces.log == k] - log.time[0]) / pieces.dt).astype(int)
        found.append(nodes[np.clip(at, 0, len(grid) - 1)])
    return np.concatenate(found)


def slopes(x: np.ndarray, window: int) -> np.ndarray:
    """Slopes [rows, n] per row of cubics, each the best through an odd number of rows around its own.

    A. Savitzky, M. J. E. Golay, "Smoothing and differentiation of data by simplified least squares procedures",
    Analytical Chemistry 36 (1964).
    """
    # scipy.signal.savgol_filter does the same, but importing it takes longer than most fits, which need no scipy
    middle, degrees = window // 2, np.arange(min(4, window))
    u = np.arange(-middle, middle + 1)[:, None] / max(middle, 1)
    # slopes at every row of a window, from its rows
    rows = (degrees * u ** np.maximum(degrees - 1, 0)) @ np.linalg.pinv(u**degrees) / max(middle, 1)
    inner = np.lib.stride_tricks.sliding_window_view(x, window, axis=0) @ rows[middle]
    return np.concatenate([rows[:middle] @ x[:window], inner, rows[middle + 1 :] @ x[-window:]])


def commands(
    pieces: Segments, logs: Sequence[CheckedRecording], delay: float, slope: bool = False
) -> dict[str, np.ndarray]:
    """Commands [K, T, width] of all steps, or their derivatives by the delay [s]."""
    found: dict[str, list[np.ndarray]] = {name: [] for name in logs[0].inputs}
    for k, log in enumerate(logs):
        at = pieces.time[pieces.log == k] - delay
        for name, given in log.inputs.items():
            found[name].append(-given.slope(at, pieces.dt) if slope else given.mean(at, pieces.dt))
    return {name: np.concatenate(rows) for name, rows in found.items()}


# --- motions ---------------------------------------------------------------------------------------------------------


def motions(pieces: Segments, nodes: np.ndarray, after: np.ndarray) -> Motions:
    """Nodes [K, T, s] with defects and residuals, from the states after the step of each."""
    defects = np.where(pieces.follows, after - np.roll(nodes, -1, axis=1), 0.0)
    return Motions(nodes, defects, pieces.y - seen(pieces, nodes))


def seen(pieces: Segments, nodes: np.ndarray) -> np.ndarray:
    """Rows [K, T, c] of what is measured at nodes [K, T, s]; zero where there is no measurement."""
    n, c = pieces.n, pieces.y.shape[-1]
    x = nodes[..., :c]
    if pieces.late is not None:
        x = np.concatenate([x[..., :n] + pieces.late * nodes[..., n : 2 * n], x[..., n:]], -1)
    return x * pieces.used


def linearised(
    pieces: Segments,
    moved: Motions,
    A: np.ndarray,  # [K, T, s, s] derivatives of the steps of the nodes in the states
    B: np.ndarray,  # [K, T, s, p] derivatives in the parameters
    weight: np.ndarray,  # [c] one over the standard deviation of a measurement
) -> Linear:
    """Linearised motions."""
    (K, T, s, _), size, n, c = A.shape, pieces.block, pieces.n, pieces.y.shape[-1]
    width, blocks = s + B.shape[-1] + 1, T // pieces.block

    def by_block(x: np.ndarray) -> np.ndarray:
        """Array [size, K blocks, ...] of one over the nodes [K, T, ...]."""
        return x.reshape(K * blocks, size, *x.shape[2:]).swapaxes(0, 1)

    inner = np.empty((size + 1, K * blocks, s, width))
    inner[0], inner[1:, ..., :s] = np.eye(s, width), 0.0
    inner[1:, ..., s:-1], inner[1:, ..., -1] = by_block(B), by_block(moved.defects)
    for j, through in enumerate(by_block(A)):
        inner[j + 1] += through @ inner[j]
    last = inner[size].reshape(K, blocks, s, width)
    starts = np.empty((blocks, K, width, width))
    starts[:] = np.eye(width)
    for i in range(blocks - 1):
        np.matmul(last[:, i], starts[i], out=starts[i + 1, :, :s])

    scale = by_block(pieces.used * weight)
    rows = np.empty((K * blocks, size, c, width))
    by_node = rows.swapaxes(0, 1)
    np.multiply(inner[:size, :, :c], scale[..., None], out=by_node)
    if pieces.late is not None:
        by_node[:, :, :n] += inner[:size, :, n : 2 * n] * (scale[..., :n] * by_block(pieces.late))[..., None]
    by_node[..., -1] = scale * by_block(moved.residual) - by_node[..., -1]
    factors = triangular(rows.reshape(K * blocks, size * c, width)).reshape(K, blocks, width, width)
    # the column of the rest has the other sign: what is measured less what is predicted
    sign = np.ones(width)
    sign[-1] = -1.0
    rows = (factors @ (sign[:, None] * starts.swapaxes(0, 1) * sign)).reshape(K, blocks * width, width)
    held = HELD * np.sqrt(np.square(rows[..., :s]).sum(1).max(-1))
    return Linear(inner[:size], starts, triangular(np.concatenate([rows, held[:, None, None] * np.eye(s, width)], 1)))


def triangular(rows: np.ndarray) -> np.ndarray:
    """Triangular factors [..., w, w] of rows [..., r, w], which may be fewer than columns."""
    *batch, r, w = rows.shape
    whole = rows if r >= w else np.concatenate([rows, np.zeros((*batch, w - r, w))], -2)
    return np.asarray(np.linalg.qr(whole, mode="r"))


def changes(linear: Linear, step: np.ndarray) -> np.ndarray:
    """Changes of the nodes [K, T, s] for a step [p] of the parameters, with the best starts for it."""
    R, s, K = linear.factor, linear.inner.shape[2], len(linear.factor)
    by = np.ones((K, R.shape[-1]))
    by[:, s:-1] = step
    by[:, :s] = solved(R[:, :s, :s], R[:, :s, -1] - R[:, :s, s:-1] @ step)
    at = (linear.starts @ by[..., None]).swapaxes(0, 1).reshape(-1, by.shape[1], 1)  # [K blocks, s + p + 1, 1]
    return (linear.inner @ at).swapaxes(0, 1).reshape(K, -1, s)


def solved(R: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions [..., w] of triangular systems, R x = right; not finite where R is singular."""
    factor, sides = torch.from_numpy(R), torch.from_numpy(right[..., None])
    return torch.linalg.solve_triangular(factor, sides, upper=True).numpy()[..., 0]
