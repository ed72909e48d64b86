"""Loops as values: what they return of each step, in both directions, and their adjoints, by formulas and torch."""

import weakref

import pytest
import torch
from helpers import random
from loops import interpreted, loop, step, tensors
from programs import agree

from torchdq.program.loop import Loop, adjoint, by_steps, shapes, with_states
from torchdq.program.program import Argument, record

GAIN = 0.5


def recurrence(width: int = 2):
    """Program of x' = x / 2 + u, with its input returned twice: once to be kept, once for the total."""
    arguments = [Argument("x", width), Argument("u", width)]
    return record(
        "recurrence",
        arguments,
        lambda x, u: {"x": [GAIN * a + b for a, b in zip(x, u, strict=True)], "kept": u, "sum": u},
    )


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("kept", [(1,), (0, 1)])
@pytest.mark.parametrize("steps", [0, 1, 6])
def test_a_loop_returns_what_it_carries_what_it_keeps_and_totals(steps, kept, backwards):
    """A linear recurrence in closed form: x_n = x / 2^n + sum_k u_k / 2^(n-1-k)."""
    over = Loop(recurrence(), ((0, 0),), (1,), kept, backwards)
    x, u = random(4, 2), random(steps, 4, 2, seed=1)
    found = interpreted(over, [x, u], 4, steps)
    assert [y.shape for y in found] == shapes(over, 4, steps)
    given = u.flip(0) if backwards else u
    states = [GAIN**n * x + sum((GAIN ** (n - 1 - k) * given[k] for k in range(n)), 0.0 * x) for n in range(steps + 1)]
    expected = torch.stack(states[::-1] if backwards else states) if 0 in kept else states[-1]
    agree(found, [expected, u, u.sum(0)])


def test_what_is_added_comes_before_every_step():
    """Program that is linear in its carried argument, which more is added to."""
    over = Loop(recurrence(), ((0, 0),), (1,), added=(0,))
    assert [a.name for a in over.arguments] == ["x", "u", "x+"] and over.given == (1, 2)
    x, u, more = random(4, 2), random(3, 4, 2, seed=1), random(3, 4, 2, seed=2)
    plain = Loop(recurrence(), ((0, 0),), (1,))
    found, expected = interpreted(over, [x, u, more], 4, 3), interpreted(plain, [x, u + GAIN * more], 4, 3)
    agree(found[:1], expected[:1])


@pytest.mark.parametrize("backwards", [False, True])
def test_an_adjoint_has_the_gradients_of_torch_and_runs_the_other_way(backwards):
    whole, samples, steps = with_states(loop(step(), (1,), backwards)), 5, 4
    assert whole.kept == (0, 1)
    given = tensors(samples, steps, grad=True)
    x, y, z = interpreted(whole, list(given.values()), samples, steps)
    over_y, over_z = random(*y.shape, seed=5), random(*z.shape, seed=6)
    end = x[0] if backwards else x[-1]
    expected = torch.autograd.grad((end.sum() + (y * over_y).sum() + (z * over_z).sum()), list(given.values()))
    back = adjoint(whole, (1, 2, 3))
    assert back.backwards is not backwards
    before = x[1:] if backwards else x[:-1]
    more = torch.zeros_like(before)  # cotangents of all states but the first; of the last it is one
    more[0 if backwards else -1] = 1.0
    rows = [before, *list(given.values())[1:], torch.zeros_like(end), over_y, over_z, more]
    found = interpreted(back, [r.detach() for r in rows], samples, steps)
    agree(found, expected)


def test_of_what_is_wanted_of_the_last_step_no_other_step_is_kept():
    """Steps that count: what there is at a time is the start, and what the steps before and after have returned."""
    alive = weakref.WeakSet()

    def step(k, rows):
        alive.add(x := rows["x"] + 1)
        assert len(alive) <= 2
        return {"x": x, "k": torch.tensor(k)}

    found = by_steps(step, {"x": torch.zeros(())}, range(9), torch.stack, last=("x",))
    assert found["x"] == 9 and found["k"].tolist() == [*range(9)]
