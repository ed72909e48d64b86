"""Signs and turns: negation is recorded as plain arithmetic has it, and rotations by many turns keep their digits."""

import mpmath
import numpy as np
import pytest
import torch

from torchdq import dq
from torchdq.program.program import Argument, record, replay, results

EPS = 2.0**-52


EXPRESSIONS = {
    "minus one times": lambda x, y: -1.0 * x,
    "times minus one": lambda x, y: (x + y) * -1.0,
    "a negative divided": lambda x, y: (-x) / y,
    "divided by a negative": lambda x, y: x / (-y),
    "a negative divided by a negative": lambda x, y: (-x) / (-y),
    "a constant divided by a negative": lambda x, y: 3.0 / (-x),
    "sine of a negative": lambda x, y: (-x).sin(),
    "cosine of a negative": lambda x, y: (-x).cos(),
    "sine of a difference the other way round": lambda x, y: (y - x).sin(),
}


@pytest.mark.parametrize("expression", EXPRESSIONS.values(), ids=EXPRESSIONS)
def test_signs_are_those_of_plain_arithmetic(expression):
    """Negation and multiplication by minus one are exact, so that recorded and plain arithmetic agree bitwise."""
    x, y = torch.from_numpy(np.random.default_rng(1).uniform(-2.0, 2.0, (2, 100)))
    program = record("signs", [Argument("x", 1), Argument("y", 1)], lambda x, y: {"z": [expression(x[0], y[0])]})
    assert torch.equal(results(program, replay(program, [[x], [y]]))["z"][0], expression(x, y))


@pytest.mark.parametrize("angle", [1e2, 1e3, 1e4, 1e5])
def test_a_rotation_by_many_turns_loses_nothing_to_the_rounding_of_its_angle(angle):
    """The length of the screw, rounded, would be off by up to 7e-12 rad at 1e5; the reference is mpmath's."""
    rng = np.random.default_rng(2)
    axes = rng.normal(size=(50, 3))
    a = angle * rng.uniform(0.5, 1.0, (50, 1)) * axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    found = dq.exp(torch.from_numpy(np.concatenate([a, np.zeros((50, 3))], -1)))[:, :4].numpy()
    with mpmath.workdps(40):
        for row, (w, *v) in zip(a, found, strict=True):
            row = [mpmath.mpf(float(x)) for x in row]
            length = mpmath.norm(row)
            exact = [mpmath.cos(length), *(mpmath.sin(length) / length * x for x in row)]
            assert max(abs(mpmath.mpf(float(x)) - e) for x, e in zip((w, *v), exact, strict=True)) <= 4 * EPS
