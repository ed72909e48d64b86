"""Gradients of loops, of first to third order, against torch's own through every step, and finite differences."""

import pytest
import torch
from helpers import random
from loops import interpreted, loop, step, tensors
from programs import agree

from torchdq.program.loop_autograd import differentiable

SAMPLES = 3
NAMES = ("x", "u", "p", "m")
every_loop = pytest.mark.parametrize("over", [loop(step(2)), loop(step(2), ()), loop(step(2), (0, 1, 2), True)])


def derivatives(call, wrt, steps: int, order: int) -> list[torch.Tensor]:
    """Gradients of squares of gradients of squares of the results, in the arguments of some names."""
    given = tensors(SAMPLES, steps, 2)
    found = call([x.requires_grad_(name in wrt) for name, x in given.items()], steps)
    wanted = [given[name] for name in wrt]
    for _ in range(order):
        rows = [*found, *wanted]  # on which a loop of no steps does not depend
        total = sum((y.square() * (1 + random(*y.shape, seed=k).square())).sum() for k, y in enumerate(rows))
        found = torch.autograd.grad(total, wanted, create_graph=True, materialize_grads=True)
    return [y.detach() for y in found]


@every_loop
@pytest.mark.parametrize(("steps", "order"), [(0, 2), (1, 2), (4, 1), (4, 2), (3, 3)])
def test_derivatives_of_any_order_are_those_of_torch(over, steps, order):
    def recorded(given, steps):
        return differentiable(interpreted, over, given, SAMPLES, steps)

    for wrt in (NAMES, ("x",), ("u",), ("p", "m")):
        expected = derivatives(lambda given, steps: interpreted(over, given, SAMPLES, steps), wrt, steps, order)
        agree(derivatives(recorded, wrt, steps, order), expected, 1e3)


@every_loop
def test_derivatives_are_finite_differences(over):
    given = [x.requires_grad_() for x in tensors(SAMPLES, 3, 2).values()]

    def call(*rows):
        return tuple(differentiable(interpreted, over, rows, SAMPLES, 3))

    assert torch.autograd.gradcheck(call, given, fast_mode=True)
    assert torch.autograd.gradgradcheck(call, given, fast_mode=True)


def test_nothing_is_recorded_and_no_states_are_kept_without_gradients():
    seen = []

    def watched(over, inputs, samples, steps):
        seen.append(over)
        return interpreted(over, inputs, samples, steps)

    over, given = loop(step(2), ()), tensors(SAMPLES, 3, 2)
    differentiable(watched, over, list(given.values()), SAMPLES, 3)
    given["u"].requires_grad_()
    with torch.no_grad():
        differentiable(watched, over, list(given.values()), SAMPLES, 3)
    assert seen == [over, over]
    found = differentiable(watched, over, list(given.values()), SAMPLES, 3)
    assert seen[-1].kept == (0,) and found[0].shape == (SAMPLES, 2) and found[0].requires_grad
