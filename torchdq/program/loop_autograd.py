"""Loops as operations of torch: gradients of any order, by loops that run the other way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from torchdq.base.caches import PROGRAMS, remembered
from torchdq.program import loop as loops
from torchdq.program.autograd import in_a_graph
from torchdq.program.loop import Loop

adjoint = remembered(PROGRAMS)(loops.adjoint)
with_states = remembered(PROGRAMS)(loops.with_states)
_apart = remembered(PROGRAMS)(lambda loop: replace(loop, common=()))


def apart(loop: Loop, inputs: Sequence[Tensor], samples: int) -> tuple[Loop, Sequence[Tensor]]:
    """Loop and arguments of which samples share none of a step."""
    if not loop.common:
        return loop, inputs
    rows = [x.expand(len(x), samples, -1) if k in loop.common else x for k, x in enumerate(inputs)]
    return _apart(loop), rows


class Execute(Protocol):
    """Function that runs loops, without gradients."""

    def __call__(self, loop: Loop, inputs: Sequence[Tensor], samples: int, steps: int) -> list[Tensor]:
        """Outputs of a loop."""


def differentiable(
    execute: Execute, loop: Loop, inputs: Sequence[Tensor], samples: int, steps: int
) -> Sequence[Tensor]:
    """Outputs of a loop, recorded for gradients where torch needs it; for these, everything carried is kept."""
    if not in_a_graph(inputs):
        return execute(loop, inputs, samples, steps)
    found = _Differentiable.apply(execute, with_states(loop), samples, steps, *inputs)
    ends = [r for _, r in loop.carried if r not in loop.kept]
    # copies, since views would hold the memory of all states
    return [_end(loop, y).clone() if r in ends else y for r, y in enumerate(found)]


class _Differentiable(torch.autograd.Function):
    """Loop that keeps its states, with reverse-mode gradients."""

    @staticmethod
    def forward(ctx, execute: Execute, loop: Loop, samples: int, steps: int, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.execute, ctx.loop, ctx.samples, ctx.steps = execute, loop, samples, steps
        found = execute(loop, inputs, samples, steps)
        ctx.save_for_backward(*inputs, *(found[r] for _, r in loop.carried))
        ctx.mark_non_differentiable(*found[len(loop.body.results) :])
        return tuple(found)

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        loop, count = ctx.loop, len(ctx.loop.body.arguments)
        saved = ctx.saved_tensors  # read once, as torch's checkpoints ask for
        inputs, kept = saved[: len(loop.arguments)], saved[len(loop.arguments) :]
        needed, carried = ctx.needs_input_grad[4:], dict(loop.carried)
        added = dict(zip(loop.added, range(count, len(inputs)), strict=True))
        derivative = adjoint(loop, tuple([k for k in range(count) if needed[k] and k not in carried]))
        if any(needed[count:]):
            derivative = with_states(derivative)
        rows, given = [*inputs[:count], *cotangents[: len(loop.body.results)]], []
        for (k, r), states in zip(loop.carried, kept, strict=True):
            before = _before(loop, states)
            rows[k] = before + inputs[added[k]] if k in added else before
            rows[count + r] = states.new_zeros(states.shape[1:])
            given.append(_after(loop, cotangents[r]))
        found = differentiable(ctx.execute, derivative, [*rows, *given], ctx.samples, ctx.steps)
        taken = sorted({*(k for k in range(count) if needed[k]), *carried})
        gradients = dict(zip(taken, found, strict=False))
        for k, r in loop.carried:
            if k in added and needed[added[k]]:
                gradients[added[k]] = _after(derivative, gradients[k])
            if needed[k]:
                end = _end(derivative, gradients[k]) if any(needed[count:]) else gradients[k]
                gradients[k] = end + _start(loop, cotangents[r])
        return None, None, None, None, *[gradients[k] if wanted else None for k, wanted in enumerate(needed)]


# --- parts of states, which are one more than steps ------------------------------------------------------------------


def _before(loop: Loop, states: Tensor) -> Tensor:
    """States before the steps."""
    return states[1:] if loop.backwards else states[:-1]


def _after(loop: Loop, states: Tensor) -> Tensor:
    """States after the steps."""
    return states[:-1] if loop.backwards else states[1:]


def _start(loop: Loop, states: Tensor) -> Tensor:
    """State before the first step."""
    return states[-1 if loop.backwards else 0]


def _end(loop: Loop, states: Tensor) -> Tensor:
    """State after the last step."""
    return states[0 if loop.backwards else -1]
