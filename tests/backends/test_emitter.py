"""The emitter of programs: operations, constants and results have the values of torch in every dialect.

A dialect is run as what it is for: vectors of C, single numbers of C that all samples share, kernels of a GPU on the
host, and exported C99 of one sample and in blocks.
"""

import ctypes
import itertools
import math
import shutil

import pytest
import torch
from exporting import loaded
from helpers import thinned
from host_gpu import BACKWARDS, HOST
from oracles import EPS
from programs import same

from torchdq.backends.c import COMPILED
from torchdq.backends.compiler import compiler
from torchdq.backends.precision import run
from torchdq.backends.torch import EAGER
from torchdq.functions.compile import CompiledProgram
from torchdq.numbers.ops import OPS, apply
from torchdq.program.program import Argument, record

pytestmark = pytest.mark.skipif(compiler() is None or not shutil.which("gcc"), reason="there is no C compiler")

F32, F64 = torch.float32, torch.float64


def exported(batch):
    """Results of an exported function, of one sample after the other or of all."""

    def results(algorithm, x, folder):
        program = record("all", [Argument("x", x.shape[1])], algorithm)
        axes = tuple((len(r.values),) for r in program.results)
        made = CompiledProgram(program, x.dtype, axes).export(folder, "exported", batch=True)
        found, library = [x.new_empty(len(x), *row) for row in axes], loaded(made)
        if batch:
            library.exported_batch(ctypes.c_size_t(len(x)), *(ctypes.c_void_p(y.data_ptr()) for y in (x, *found)))
        else:
            for k in range(len(x)):
                library.exported(*(ctypes.c_void_p(y[k].data_ptr()) for y in (x, *found)))
        return found

    return results


def shared(algorithm, x, folder):
    """Results of numbers that all samples share."""
    program = record("all", [Argument("x", x.shape[1], uniform=True)], algorithm)
    rows = [run(program, [row], COMPILED) for row in x]
    return [torch.cat([y.reshape(1, -1) for y in same_result]) for same_result in zip(*rows, strict=True)]


def of(backend):
    return lambda algorithm, x, folder: run(record("all", [Argument("x", x.shape[1])], algorithm), [x], backend)


DIALECTS = {
    "vectors of C": of(COMPILED),
    "single numbers of C": shared,
    "CUDA": of(HOST),
    "CUDA, backwards": of(BACKWARDS),
    "C99": exported(batch=False),
    "C99 in blocks": exported(batch=True),
}
IN_SINGLE = ("vectors of C", "CUDA", "C99")  # the others write numbers by the same table as one of these


def each_of(dialects):
    """Dialects, in both precisions."""
    every = list(itertools.product(dialects, (F64, F32)))
    kept = thinned(every, [(name, dtype) for name, dtype in every if dtype == F64 or name in IN_SINGLE])
    return pytest.mark.parametrize(("dialect", "dtype"), kept, ids=str)


SPECIAL = (0.0, -0.0, 1.0, -2.5, 1e-30, math.inf, -math.inf, math.nan, 700.0, -700.0)
CONSTANTS = (math.inf, -math.inf, math.nan, 1 / 3, 1e-310, -0.0, -2.0)


@each_of(DIALECTS)
def test_every_operation_and_its_negative_have_the_values_of_torch(dialect, dtype, tmp_path):
    widths = {code: len(row.partials) for code, row in OPS.items()}

    def every(x):
        return {code: [apply(code, *x[:k]), -apply(code, *x[:k])] for code, k in widths.items()}

    x = torch.cartesian_prod(*[torch.tensor(SPECIAL, dtype=dtype)] * max(widths.values()))
    expected = of(EAGER)(every, x, tmp_path)
    for code, found, value in zip(OPS, DIALECTS[dialect](every, x, tmp_path), expected, strict=True):
        torch.testing.assert_close(
            found, value, rtol=4 * EPS[dtype], atol=0, equal_nan=True, msg=lambda text, code=code: f"{code}: {text}"
        )


@each_of(DIALECTS)
def test_constants_are_exact_in_results_and_operands(dialect, dtype, tmp_path):
    def algorithm(x):
        return {
            "result": [x[0] * 0 + c for c in CONSTANTS],
            "operand": [f for c in CONSTANTS for f in (x[0] * c, c - x[0])],
        }

    x = torch.tensor([[1.0], [-0.5], [3.0]], dtype=dtype)
    same(DIALECTS[dialect](algorithm, x, tmp_path), of(EAGER)(algorithm, x, tmp_path))


@each_of([name for name in DIALECTS if name != "single numbers of C"])
def test_sine_and_cosine_of_any_angle_are_exact_to_the_last_digit(dialect, dtype, tmp_path):
    """Functions of blocks give NaN for angles beyond their range."""

    def turn(x):
        return {
            "both": [apply("sin", x[0]), apply("cos", x[0])],
            "alone": [apply("sin", -2.0 * x[0]), apply("cos", 3.0 * x[0])],
        }

    near = torch.cat([torch.linspace(-1e3, 1e3, 20001), -(10 ** torch.linspace(-30, 3, 99))])
    far = 10 ** torch.linspace(5.5, 30, 301)
    x = torch.cat([near, far]).to(dtype).unsqueeze(-1)
    found, expected = (results(turn, x, tmp_path) for results in (DIALECTS[dialect], of(EAGER)))
    if dialect == "C99 in blocks":
        assert all(y[len(near) :].isnan().all() for y in found)
        found, expected = ([y[: len(near)] for y in side] for side in (found, expected))
    for y, e in zip(found, expected, strict=True):
        assert (y - e).abs().max() <= 1.5 * EPS[dtype]
