"""Programs compiled with the flags of the package: values, rows, and sine and cosine against those of mpmath."""

from itertools import product

import mpmath
import numpy as np
import pytest
import torch
from helpers import thinned
from oracles import states
from programs import FUNCTIONS, TREE, agree, condition, on

from torchdq.backends import c_library as build
from torchdq.backends.c import COMPILED
from torchdq.program.program import Argument, record

F32, F64 = torch.float32, torch.float64
BACKEND, AS_SHIPPED = "auto", True  # see conftest.py

pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")


@pytest.mark.parametrize(
    ("name", "dtype"),
    thinned(list(product(FUNCTIONS, (F64, F32))), [("inverse_dynamics", F64), ("forward_dynamics", F32)]),
    ids=str,
)
def test_functions_equal_torch_operations_and_rows_of_a_batch_are_bitwise_the_rows_alone(name, dtype):
    s = states(TREE, 35, dtype=dtype)
    found = on("c", FUNCTIONS[name], TREE, s)
    agree(found, on("eager", FUNCTIONS[name], TREE, s), 256.0 * condition(name, TREE, s))
    for k in range(35):
        alone = on("c", FUNCTIONS[name], TREE, type(s)(*(x[k : k + 1] for x in s)))
        assert all(torch.equal(a[0], b[k]) for a, b in zip(alone, found, strict=True)), k


# --- sine and cosine -------------------------------------------------------------------------------------------------


TRIG = record("trig", [Argument("x", 1)], lambda x: {"y": [x[0].sin(), x[0].cos()]})


def angles(largest: float, dtype) -> torch.Tensor:
    """Random angles, and angles near multiples of pi/2, where a sine or cosine is small."""
    x = np.random.default_rng(5).uniform(-largest, largest, 600)
    quarter = (x[:300] / (np.pi / 2)).round() * np.pi / 2
    x = torch.from_numpy(np.concatenate([x, quarter, np.geomspace(1e-300, 1e-3, 100)])).to(dtype)
    return x[x.abs() <= largest]


def ulps(x: torch.Tensor, floor: float) -> float:
    """Largest error in units of the last place of the result, or of `floor` where that is larger."""
    y = COMPILED.kernel(TRIG, x.dtype, x.device)([x[:, None]], len(x))[0].numpy()
    worst = 0.0
    with mpmath.workdps(60):
        for angle, row in zip(x.tolist(), y, strict=True):
            for found, f in zip(row, (mpmath.sin, mpmath.cos), strict=True):
                exact = f(mpmath.mpf(angle))
                unit = np.spacing(np.abs(found.dtype.type(max(abs(float(exact)), floor))))
                worst = max(worst, float(abs(mpmath.mpf(float(found)) - exact) / mpmath.mpf(float(unit))))
    return worst


@pytest.mark.parametrize(
    ("floor", "largest", "dtype"),
    thinned(
        [
            *((0.25, largest, F64) for largest in (1.0, 1e5, 1e6)),
            *((0.25, largest, F32) for largest in (1.0, 4e3, 1e5)),
            *((0.0, largest, F64) for largest in (10.0, 1e5, 1e6)),
        ],
        [(0.25, 1e5, F64), (0.25, 4e3, F32), (0.25, 1e5, F32), (0.0, 10.0, F64), (0.0, 1e6, F64)],
    ),
)
def test_sine_and_cosine_are_within_two_units_in_the_last_place(floor, largest, dtype):
    """A unit of 0.25 where the result is smaller, since the angle is rounded to one of its own; in double its own."""
    assert ulps(angles(largest, dtype), floor) <= (2.0 if floor else 2.5)


def test_sine_and_cosine_of_what_is_no_angle_are_not_numbers():
    x = torch.tensor([[float("nan")], [float("inf")], [-float("inf")], [1.0]], dtype=F64)
    y = COMPILED.kernel(TRIG, F64, x.device)([x], 4)[0]
    assert y[:3].isnan().all() and y[3].isfinite().all()
