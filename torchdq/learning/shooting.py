"""Multiple shooting: motions of a scene through measured positions, every state between two steps a node of its own.

The nodes of a segment need not follow from each other while they are sought. A step of Gauss-Newton moves them, the
starts of the segments and the parameters at once, to where the linearised steps of the scene follow from each other
and come closest to the measurements:

    minimise |W (y - H s)|^2   over parameters and starts, with s' = A ds + B dp + F(s) linear in both.

All steps are rows of one batch, for the program of a step and for that of its Jacobian matrix. The chain of a segment
is condensed to its start and the parameters, and the start is eliminated segment by segment (H. G. Bock, K. J. Plitt,
"A multiple shooting algorithm for direct solution of optimal control problems", IFAC 1984).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq.learning.recordings import Checked
from torchdq.optional import imported

if TYPE_CHECKING:
    from torchdq.envs.sensitivity import StepMap

SMOOTHED = 0.02  # time to both sides of a node over which the velocities at the start are those of a cubic [s]
HELD = 1e-7  # weight of a start where it is, relative to what the measurements say of it: for what they do not see


class Evidence(NamedTuple):
    """Measurements of the segments, row by row; segments with fewer rows than others are filled."""

    log: Tensor  # [K, R] log of the row
    row: Tensor  # [K, R] its number there
    node: Tensor  # [K, R] nearest node of the segment
    late: Tensor  # [K, R] time from the node to the row [s]
    used: Tensor  # [K, R] 1, or 0 where there is none
    y: Tensor  # [K, R, c] measured positions, then velocities if there are any


class Segments(NamedTuple):
    """Pieces of all logs as rows of a batch, each with the same number of nodes; those beyond its end are not used."""

    dt: float  # [s]
    n: int  # number of joints
    time: np.ndarray  # [K, T] times of the nodes [s]
    log: np.ndarray  # [K] logs that the pieces are of
    steps: Tensor  # [K, T - 1] whether a step is between nodes of a piece
    evidence: Evidence
    every: bool  # whether the rows are the nodes, in their order
    late: bool  # whether there are rows between nodes


class Chain(NamedTuple):
    """States that follow from each other by x' = A x + B p + gap, as changes [s, s + p + 1] of a start, p and gaps.

    Blocks of about sqrt(T) steps side by side, and the states at which the blocks start.
    """

    inner: Tensor  # [size, K blocks, s, s + p + 1] states of the blocks, from those at which they start
    starts: Tensor  # [blocks, K, s, s + p + 1] from those at which the segments start
    nodes: int  # T, not all states of the last block are


class Linear(NamedTuple):
    """Linearised motions, and the triangular factors of their weighted measurements."""

    chain: Chain
    factor: Tensor  # [K, s + p + 1, s + p + 1] triangular: starts, parameters, residuals


def segments(logs: Sequence[Checked], dt: float, seconds: float | None) -> Segments:
    """Pieces of logs, as long as `seconds` if possible; None: every log is one."""
    pieces = []
    for k, log in enumerate(logs):
        last = max(1, round((log.time[-1] - log.time[0]) / dt))
        count = 1 if seconds is None else max(1, round(last * dt / seconds))
        ends = np.rint(np.linspace(0, last, count + 1)).astype(int)
        node = np.rint((log.time - log.time[0]) / dt).astype(int)
        for a, b in zip(ends[:-1], ends[1:], strict=True):
            end = b + 1 if b == last else b
            rows = np.flatnonzero((node >= a) & (node < end))
            pieces.append((k, a, end - a, rows, node[rows] - a))
    T, R = max(piece[2] for piece in pieces), max(len(piece[3]) for piece in pieces)
    time = np.stack([logs[k].time[0] + (a + np.arange(T)) * dt for k, a, *_ in pieces])
    y = [np.concatenate([x for x in (log.q, log.qd) if x is not None], axis=1) for log in logs]
    index = np.zeros((len(pieces), R, 4), dtype=np.int64)
    late, values = np.zeros((len(pieces), R)), np.zeros((len(pieces), R, y[0].shape[1]))
    for i, (k, _, _, rows, nodes) in enumerate(pieces):
        r = len(rows)
        index[i, :r] = np.stack([np.full(r, k), rows, nodes, np.ones(r, dtype=int)], axis=1)
        late[i, :r], values[i, :r] = logs[k].time[rows] - time[i, nodes], y[k][rows]
    late[abs(late) < 1e-6 * dt] = 0.0
    of, row, node, used = torch.from_numpy(index).unbind(-1)
    evidence = Evidence(of, row, node, torch.from_numpy(late), used.double(), torch.from_numpy(values))
    length = torch.tensor([piece[2] for piece in pieces])
    steps = torch.arange(T - 1) < (length - 1)[:, None]
    every = R == T and all(np.array_equal(piece[4], np.arange(len(piece[4]))) for piece in pieces)
    which = np.array([piece[0] for piece in pieces])
    return Segments(dt, logs[0].q.shape[1], time, which, steps, evidence, every, bool(late.any()))


def first_guess(pieces: Segments, logs: Sequence[Checked]) -> tuple[Tensor, Tensor]:
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


def commands(pieces: Segments, logs: Sequence[Checked], delay: float, slope: bool = False) -> dict[str, Tensor]:
    """Commands [K, T - 1, width] of all steps, or their derivatives by the delay [s]."""
    found = {}
    for name, first in logs[0].inputs.items():
        rows = np.zeros((*pieces.time[:, 1:].shape, first.values.shape[1]))
        for k, log in enumerate(logs):
            own, given = pieces.log == k, log.inputs[name]
            at = pieces.time[own, :-1] - delay
            rows[own] = -given.slope(at, pieces.dt) if slope else given.mean(at, pieces.dt)
        found[name] = torch.from_numpy(rows)
    return found


class Motions(NamedTuple):
    """Steps of the nodes at some parameters, and how far they are from the measurements."""

    nodes: Tensor  # [K, T, s]
    gaps: Tensor  # [K, T - 1, s] from the next node to the state that follows from one
    residual: Tensor  # [K, R, c] measured less predicted


def motions(
    step: StepMap, pieces: Segments, nodes: Tensor, inputs: Mapping[str, Tensor], parameters: Mapping[str, Tensor]
) -> Motions:
    """Steps of nodes [K, T, s]."""
    rows = {name: x.flatten(0, 1) for name, x in inputs.items()}
    after = step.after(nodes[:, :-1].flatten(0, 1), rows, parameters).reshape(nodes[:, 1:].shape)
    gaps = torch.where(pieces.steps[..., None], after - nodes[:, 1:], 0.0)
    evidence = pieces.evidence
    return Motions(nodes, gaps, evidence.y * evidence.used[..., None] - seen(pieces, nodes))


def seen(pieces: Segments, nodes: Tensor) -> Tensor:
    """Rows [K, R, c] of what is measured, of nodes [K, T, s]; zero where there is no measurement."""
    return _measured(pieces, nodes[:, :, : 2 * pieces.n, None]).squeeze(-1) * pieces.evidence.used[..., None]


def _measured(pieces: Segments, x: Tensor) -> Tensor:
    """Rows [K, R, c, w] of what is measured, of those [K, T, 2 n, w] of the nodes; velocities carry to late rows."""
    e, n = pieces.evidence, pieces.n
    if not pieces.every:
        x = x[torch.arange(len(x))[:, None], e.node]
    if not pieces.late:
        return x[:, :, : e.y.shape[-1]]
    q = x[:, :, :n] + e.late[..., None, None] * x[:, :, n:]
    return torch.cat([q, x[:, :, n : e.y.shape[-1]]], 2)


# --- linearised motions ----------------------------------------------------------------------------------------------


def condensed(A: Tensor, B: Tensor) -> Chain:
    """Chain of steps A [K, T - 1, s, s] and B [K, T - 1, s, p + 1], the last column of which are the gaps."""
    K, steps, s, _ = A.shape
    size = max(1, math.isqrt(steps))
    blocks = -(-(steps + 1) // size)
    width = s + B.shape[-1]
    a = torch.eye(s, dtype=A.dtype).repeat(K, blocks * size, 1, 1)
    b = A.new_zeros(K, blocks * size, s, width)
    a[:, :steps], b[:, :steps, :, s:] = A, B
    a, b = a.reshape(K * blocks, size, s, s), b.reshape(K * blocks, size, s, width)
    inner = A.new_zeros(size + 1, K * blocks, s, width)
    inner[0, ..., :s] = torch.eye(s, dtype=A.dtype)
    for j in range(size):
        torch.baddbmm(b[:, j], a[:, j], inner[j], out=inner[j + 1])
    last = inner[size].reshape(K, blocks, s, width)
    through = last[..., :s]
    added = torch.cat([torch.zeros_like(through), last[..., s:]], -1)
    starts = A.new_zeros(blocks, K, s, width)
    starts[0] = inner[0, :K]
    for i in range(1, blocks):
        torch.baddbmm(added[:, i - 1], through[:, i - 1], starts[i - 1], out=starts[i])
    return Chain(inner[:size], starts, steps + 1)


def _rows(chain: Chain, first: int) -> Tensor:
    """Changes [K, T, first, s + p + 1] of the first numbers of all states."""
    blocks, K, s, width = chain.starts.shape
    size = len(chain.inner)
    inner = chain.inner[:, :, :first].reshape(size, K, blocks, first, width).permute(1, 2, 0, 3, 4)
    found = inner[..., :s].reshape(K, blocks, size * first, s) @ chain.starts.transpose(0, 1)
    found = found.reshape(K, blocks, size, first, width)
    found[..., s:] += inner[..., s:]
    return found.reshape(K, blocks * size, first, width)[:, : chain.nodes]


def linearised(pieces: Segments, moved: Motions, A: Tensor, B: Tensor, weight: Tensor) -> Linear:
    """Linearised motions.

    Args:
        pieces: the segments.
        moved: steps of the nodes.
        A: derivatives [K, T - 1, s, s] of the steps in the states.
        B: derivatives [K, T - 1, s, p] of the steps in the parameters.
        weight: [c] of a measurement: one over its standard deviation.
    """
    s, e = A.shape[-1], pieces.evidence
    chain = condensed(A, torch.cat([B, moved.gaps[..., None]], -1))
    both = pieces.late or e.y.shape[-1] > pieces.n
    rows = _measured(pieces, _rows(chain, 2 * pieces.n if both else pieces.n))
    scale = weight * e.used[..., None]
    rows = rows * scale[..., None]
    rows[..., -1] = scale * moved.residual - rows[..., -1]
    rows = rows.flatten(1, 2)
    held = HELD * rows[..., :s].square().sum(1).amax(-1).sqrt()
    count = max(s, rows.shape[2] - rows.shape[1])  # at least as many rows as columns
    more = rows.new_zeros(len(rows), count, rows.shape[2])
    more[:, :s, :s] = held[:, None, None] * torch.eye(s, dtype=rows.dtype)
    return Linear(chain, torch.linalg.qr(torch.cat([rows, more], 1), mode="r").R)


def changes(linear: Linear, step: Tensor) -> Tensor:
    """Changes of the nodes [K, T, s] for a step [p] of the parameters, with the best starts for it."""
    R, (inner, starts, nodes) = linear.factor, linear.chain
    size, (blocks, K, s, _) = len(inner), starts.shape
    right = R[:, :s, -1] - R[:, :s, s:-1] @ step
    start = torch.linalg.solve_triangular(R[:, :s, :s], right[..., None], upper=True)[..., 0]
    rest = torch.cat([step, step.new_ones(1)]).expand(K, -1)
    first = starts @ torch.cat([start, rest], 1)[..., None]
    at = torch.cat([first[..., 0].transpose(0, 1), rest[:, None].expand(K, blocks, -1)], -1).flatten(0, 1)
    found = (inner * at[:, None]).sum(-1).reshape(size, K, blocks, s)
    return found.permute(1, 2, 0, 3).reshape(K, blocks * size, s)[:, :nodes]
