"""Backward pass over knots that are too large for one program: compiled derivatives, and products of torch.

The formulas are those of `knot`. Derivatives of steps and costs of all knots are samples of two programs. Then, step by
step, the quadratic form M of a knot's costs and those of the steps that follow, with its gradient g, is pulled back,

    Q = T^T (M T + [0 0 g]),   T = [A B gap; 0 1 0]

where the gap, of states that no torques lead to, is left out on the left. The minimum over the torques is a program
again. Rows of problems are the batch of all products.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.backends.call import evaluate
from torchdq.backends.choice import BackendName
from torchdq.optimal.knot import NEXT, Knot, costs, smallest
from torchdq.scene.linearize import derivatives
from torchdq.scene.policies import apart
from torchdq.scene.recording import Stage
from torchdq.scene.spec import ORDER

COLUMNS = 600_000  # operations of a step times columns, up to which a program of all columns compiles within a minute


class Derivatives(NamedTuple):
    """Derivatives of all knots [steps, rows, ...], of s numbers of a displacement of the state and m of the control."""

    step: Tensor  # [s, s + m + 1] A, B and gap
    left: Tensor  # [s + m, s] columns of the state of the costs' quadratic form
    right: Tensor  # [s + m, s + m + 1] the others: zeros, columns of the control, and gradient


def derived(
    what: Knot,
    whole: bool,
    states: Mapping[str, Tensor],
    torque: Tensor,
    given: Mapping[str, Tensor],
    backend: BackendName | None,
) -> Derivatives:
    """Derivatives of the steps from states [steps + 1, rows, ...] to the next ones, and of their costs."""
    spec, control, asked = what.spec, what.objective.control, what.objective.inputs(what.spec.robot.n)
    before = {**{name: x[:-1] for name, x in states.items()}, control: torque}
    before |= {name: x for name, x in given.items() if name not in asked}
    after, A, B = derivatives(Stage(spec, "step", wrt=(control,), unguarded=True), before, whole, backend)
    names, s, m = [name for name in ORDER if name in states], A.shape[-1], B.shape[-1]
    reached = zip(names, after.split([states[name].shape[-1] for name in names], -1), strict=True)
    gap = torch.cat([apart(name, x, states[name][1:]) for name, x in reached], -1)
    judged = {**{NEXT + name: x[1:] for name, x in states.items()}, control: torque}
    judged |= {name: x for name, x in given.items() if name in asked or "." in name}
    cost = evaluate(what._replace(part=costs), judged, backend)
    M = A.new_zeros(*A.shape[:-2], s + m, s + m + 1)
    M[..., -1] = cost["g"]
    for i in range(s + m):
        row = cost[f"M{i}"]
        at = slice(i + 1 - row.shape[-1], i + 1)
        M[..., i, at] = M[..., at, i] = row
    left = M[..., :s].contiguous()
    M[..., :s] = 0.0
    return Derivatives(torch.cat([A, B, gap[..., None]], -1), left, M)


def backward(
    what: Knot,
    of: Derivatives,
    torque: Tensor,
    damping: Tensor,
    given: Mapping[str, Tensor],
    backend: BackendName | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gains [steps, rows, n, s], changes [steps, rows, n], and the two terms of the expected change of the cost."""
    (steps, rows, m), s, control = torque.shape, of.step.shape[-2], what.objective.control
    what, V, v = what._replace(part=smallest), torque.new_zeros(rows, s, s), torque.new_zeros(rows, s, 1)
    gain, change, slope = torque.new_empty(*torque.shape, s), torch.empty_like(torque), torch.empty_like(torque)
    H = torque.new_empty(*torque.shape, m)
    for k in reversed(range(steps)):
        T, left, right = of.step[k], of.left[k], of.right[k]
        left[:, :s].add_(V)
        right[:, :s, -1:].add_(v)
        moved = torch.baddbmm(right, left, T)
        Q = T[..., :-1].mT @ moved[:, :s]
        Q[:, s:].add_(moved[:, s:])
        G, H[k], slope[k] = Q[:, s:, :s], Q[:, s:, s:-1], Q[:, s:, -1]
        known = {"H": H[k], "slope": slope[k], "damping": damping, control: torque[k], **given}
        found = evaluate(what, known, backend)
        change[k] = found["change"]
        torch.bmm(found["response"], G, out=gain[k])
        V = torch.baddbmm(Q[:, :s, :s], G.mT, gain[k])
        V = 0.5 * (V + V.mT)  # rounding errors that are not symmetric would grow as the open loop does
        v = torch.baddbmm(Q[:, :s, -1:], G.mT, change[k][..., None])
    bend = (H @ change[..., None])[..., 0]
    # summed in the order of the steps, whatever the number of rows
    expected = torch.stack([(change * x).sum(-1).cumsum(0)[-1] for x in (slope, bend)], -1)
    return gain, change, expected
