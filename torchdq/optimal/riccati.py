"""Backward pass over knots that are too large for one program: compiled derivatives, and products of torch.

The formulas are those of `knot`. Derivatives of steps and costs of all knots are samples of two programs. Then, step by
step, with the quadratic form of a knot's costs and of the steps that follow as a matrix of rows (ds', du) and columns
(ds', 1, du), whose one in the middle is the gradient,

    Q = [A B; 0 1]^T M [A gap B; 0 1 0; 0 0 1]

and the minimum over du, a box QP, is a program again. Rows of problems are the batch of all products.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.call import evaluate
from torchdq.optimal.knot import NEXT, Knot
from torchdq.scene.linearize import derivatives
from torchdq.scene.policies import apart
from torchdq.scene.recording import Stage
from torchdq.scene.spec import ORDER

COLUMNS = 600_000  # operations of a step times columns, up to which a program of all columns compiles within a minute


class Derivatives(NamedTuple):
    """Derivatives of all knots."""

    step: Tensor  # [steps, rows, s, s + 1 + m] as A, gap, B
    cost: Tensor  # [steps, rows, s + m, s + 1 + m] as M_s, g, M_u


def derived(
    what: Knot, whole: bool, states: Mapping[str, Tensor], torque: Tensor, given: Mapping[str, Tensor], backend: Any
) -> Derivatives:
    """Derivatives of steps that lead from states to the next ones, [steps + 1, rows, ...], and of their costs."""
    spec, control, asked = what.spec, what.objective.control, what.objective.inputs(what.spec.robot.n)
    before = {name: x[:-1] for name, x in states.items()} | {control: torque}
    others = {name: x for name, x in given.items() if name not in asked}
    step = Stage(spec, "step", wrt=(control,), unguarded=True)
    A, B = derivatives(step, {**before, **others}, whole, backend)
    after = evaluate(step._replace(wrt=None), {**before, **others}, backend)
    gap = torch.cat([apart(name, after[name], states[name][1:]) for name in ORDER if name in states], -1)
    judged = {NEXT + name: x[1:] for name, x in states.items()} | {control: torque}
    judged |= {name: x for name, x in given.items() if name in asked or "." in name}
    cost = evaluate(what._replace(part="costs"), judged, backend)
    M, g, s = cost["M"], cost["g"][..., None], A.shape[-1]
    return Derivatives(torch.cat([A, gap[..., None], B], -1), torch.cat([M[..., :s], g, M[..., s:]], -1))


def backward(
    what: Knot, of: Derivatives, torque: Tensor, damping: Tensor, given: Mapping[str, Tensor], backend: Any
) -> tuple[Tensor, Tensor, Tensor]:
    """Gains [steps, rows, n, s], changes [steps, rows, n], and the two terms of the expected change of the cost."""
    steps, rows, s, _ = of.step.shape
    what, control = what._replace(part="minimum"), what.objective.control
    V = of.cost.new_zeros(rows, s, s + 1)
    gain, change, expected = of.step.new_empty(*torque.shape, s), torch.empty_like(torque), of.step.new_zeros(rows, 2)
    for k in reversed(range(steps)):
        N, M = of.step[k], of.cost[k]
        M[:, :s, : s + 1] += V
        T = torch.cat([N[..., :s], N[..., s + 1 :]], -1)
        # M = (M_s, g, M_u): of its products those with the identity are sums
        rest = torch.cat([torch.zeros_like(M[..., :s]), M[..., s:]], -1)
        Y = torch.baddbmm(rest, M[..., :s], N)
        Q = T.mT @ Y[:, :s]
        Q[:, s:] += Y[:, s:]
        G, slope, H = Q[:, s:, :s], Q[:, s:, s].contiguous(), Q[:, s:, s + 1 :].contiguous()
        known = {"H": H, "slope": slope, "damping": damping, control: torque[k], **given}
        found = evaluate(what, known, backend)
        u, K = found["change"], -(found["inverse"] @ G)
        moved = torch.cat([K, u[..., None]], -1)
        V = torch.baddbmm(Q[:, :s, : s + 1], G.mT, moved)
        gain[k], change[k] = K, u
        expected += torch.stack([(u * slope).sum(-1), ((H @ u[..., None])[..., 0] * u).sum(-1)], -1)
    return gain, change, expected
