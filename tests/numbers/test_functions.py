"""Roots, exponentials, logarithms and comparisons: on floats, recorded, differentiated and compiled.

The references are mpmath, plain Python comparisons, and torch's own autograd of the program run operation by operation.
"""

import math
import operator
from fractions import Fraction

import mpmath
import numpy as np
import pytest
import torch
from helpers import EVERYTHING, all_in_one, compiled, eager, random
from hypothesis import given, settings
from hypothesis import strategies as st
from messages import refused
from oracles import EPS
from precisions import every_backend, every_dtype, single_compiled

import torchdq
from torchdq.backends import c_library as build
from torchdq.backends import c_source
from torchdq.numbers.functions import absolute, at_least, clip, exp, floor, log, maximum, minimum, select, sqrt, tanh
from torchdq.numbers.ops import OPS, apply
from torchdq.program import autodiff as derive
from torchdq.program.program import Argument, Program, record, replay, results

F32, F64 = torch.float32, torch.float64
INF, NAN = math.inf, math.nan
RUN = {"c": compiled, "eager": eager}
compiles = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")


def program(function, width: int, uniform: bool = False) -> Program:
    """Program of a function of `width` numbers that returns a list of numbers."""
    return record("f", [Argument("x", width, uniform)], lambda x: {"y": function(*x)})


ONE = {f.__name__: program(lambda x, f=f: [f(x)], 1) for f in (sqrt, exp, log, tanh, floor)}


def column(p: Program, values, dtype=F64, backend="c") -> list[float]:
    """Result of a program of one number and one result for many numbers."""
    return RUN[backend](p, [torch.tensor(values, dtype=dtype)[:, None]])[0][:, 0].tolist()


def same(found, expected) -> bool:
    """Whether floats are equal, NaN being equal to itself."""
    return all(f == e or (f != f and e != e) for f, e in zip(found, expected, strict=True))


# --- what is recorded ------------------------------------------------------------------------------------------------


RECORDED = [
    (lambda x, y: [maximum(x, y), maximum(x, y)], ["max"]),
    (lambda x, y: [maximum(-x, -y), -minimum(x, y)], ["min"]),
    (lambda x, y: [minimum(-x, -y), -maximum(x, y)], ["max"]),
    (lambda x, y: [maximum(x, x), minimum(-x, -x)], []),
    (lambda x, y: [at_least(x, y), at_least(-y, -x)], ["ge"]),
    (lambda x, y: [maximum(-x, 2.0)], ["const", "min"]),
    (lambda x, y: [at_least(0.5, x)], ["const", "ge"]),
    (lambda x, y: [maximum(x, -y)], ["const", "sub", "max"]),
    (lambda x, y: [exp(-x), exp(-x), exp(x)], ["exp", "const", "sub", "exp"]),
    (lambda x, y: [log(x), sqrt(x), floor(x), log(x)], ["log", "sqrt", "floor"]),
    (lambda x, y: [clip(x, 1.0, 2.0)], ["const", "max", "const", "min"]),
    (lambda x, y: [select(x, y, 1.0), select(-x, -y, -1.0)], ["const", "select"]),
    (lambda x, y: [select(x, y, -1.0)], ["const", "select"]),
    (lambda x, y: [select(x, x, -y)], ["const", "sub", "select"]),
    (lambda x, y: [select(x, y, y), select(x, -y, -y), select(1.0, x, y), select(x, 0.5, 0.5)], ["const"]),
]


@all_in_one(range(len(RECORDED)))
def test_equal_operations_are_recorded_once_and_signs_are_worked_in(k):
    function, codes = RECORDED[k]
    assert sorted(op.code for op in program(function, 2).ops if op.code != "in") == sorted(codes)


def test_functions_of_constants_are_not_recorded():
    p = program(
        lambda x: [sqrt(4.0), exp(0), log(1.0), floor(-1.5), maximum(1, 2.0), at_least(2, 1), clip(5.0, 0, 1)], 1
    )
    assert p.ops == () and p.results[0].values == (2.0, 1.0, 0.0, -2.0, 2.0, 1.0, 1.0)


def test_a_program_counts_and_prints_them():
    p = program(lambda x, y: [sqrt(x) + exp(x) + log(y), floor(x) * maximum(x, y), minimum(x, y), at_least(x, y)], 2)
    assert p.count() == (1, 2, 0, 0, 1, 2, 4) and p.count().total == 10
    assert "= sqrt x0\n" in str(p) and "= max x0 x1\n" in str(p)


# --- on floats and other kinds ---------------------------------------------------------------------------------------


def test_floats_that_python_refuses_give_what_programs_give():
    assert same(map(sqrt, [-1.0, -0.0, INF, NAN]), [NAN, 0.0, INF, NAN])
    assert same(map(exp, [1000.0, -1000.0, INF, -INF, NAN]), [INF, 0.0, INF, 0.0, NAN])
    assert same(map(log, [0.0, -0.0, -1.0, INF, NAN]), [-INF, -INF, NAN, INF, NAN])
    assert same(map(floor, [-0.5, 2.0**60, INF, -INF, NAN]), [-1.0, 2.0**60, INF, -INF, NAN])
    assert same(map(absolute, [-3.0, 3.0, -INF, NAN]), [3.0, 3.0, INF, NAN])


@pytest.mark.parametrize("kind", [mpmath.mpf, Fraction])
def test_other_kinds_are_compared_exactly_and_have_the_functions_that_they_offer(kind):
    third, more = kind(1) / 3, kind(1) / 3 + kind(2) ** -50
    assert maximum(third, more) == more and minimum(third, more) == third and absolute(-more) == more
    assert at_least(more, third) == 1.0 and at_least(third, more) == 0.0 and clip(kind(5), third, more) == more
    for function in (exp, log, floor):
        with pytest.raises(TypeError, match=kind.__name__):
            function(third)
    if kind is mpmath.mpf:
        assert sqrt(third) == mpmath.sqrt(third)


QUARTERS = st.integers(-8, 8).map(lambda k: k / 4)
LEAVES = st.one_of(st.sampled_from([("x", 0), ("x", 1), ("x", 2)]), st.tuples(st.just("known"), QUARTERS))
UNARY = {
    **{f.__name__: f for f in (operator.neg, tanh, floor, absolute)},
    "sqrt": lambda a: sqrt(absolute(a)),
    "exp": lambda a: exp(minimum(a, 3.0)),
    "log": lambda a: log(1.0 + a * a),
    "clip": lambda a: clip(a, -1.0, 0.5),
}
BINARY = {f.__name__: f for f in (operator.add, operator.sub, operator.mul, maximum, minimum, at_least)}
BINARY["select"] = lambda a, b: select(a - b, a * b, b)


def larger(inner):
    """Expressions of one or two others."""
    of_one = st.tuples(st.sampled_from(sorted(UNARY)), inner)
    return st.one_of(of_one, st.tuples(st.sampled_from(sorted(BINARY)), inner, inner))


EXPRESSIONS = st.recursive(LEAVES, larger, max_leaves=12)


def value(expression, x):
    """Value of a random expression on numbers of any kind."""
    code, *rest = expression
    if code == "known":
        return rest[0]
    if code == "x":
        return x[rest[0]]
    inner = [value(e, x) for e in rest]
    return UNARY[code](*inner) if code in UNARY else BINARY[code](*inner)


@settings(deadline=None, max_examples=400 if EVERYTHING else 60, derandomize=True)
@given(EXPRESSIONS, st.tuples(QUARTERS, QUARTERS, QUARTERS))
def test_a_recorded_expression_is_the_expression_bitwise(expression, x):
    """Signs, value numbering and constants; quarters are equal often enough for ties."""
    p = program(lambda *numbers: [value(expression, numbers)], 3)
    again = program(lambda *numbers: results(p, replay(p, [numbers]))["y"], 3)
    for q in (p, again):
        assert same(results(q, replay(q, [x]))["y"], [value(expression, x)])


# --- values of programs ----------------------------------------------------------------------------------------------


def spread(name: str, dtype) -> torch.Tensor:
    """Random arguments over the whole range, denser where a function is hard."""
    rng, double = np.random.default_rng(11), dtype is F64
    low, high = (-1022, 1024) if double else (-126, 128)
    everywhere = 2.0 ** rng.uniform(low, high - 1e-6, 1000)
    if name == "exp":
        ends = (-745.1, 709.78) if double else (-103.9, 88.72)
        gradual = (-745.1, -708.0) if double else (-103.9, -87.0)
        near = rng.normal(size=300) * 2.0 ** rng.uniform(-60, 0, 300)
        x = np.concatenate([rng.uniform(*ends, 1000), rng.uniform(*gradual, 300), rng.uniform(-1, 1, 700), near])
    elif name == "tanh":
        near = rng.normal(size=500) * 2.0 ** rng.uniform(-60, 0, 500)
        x = np.concatenate([rng.uniform(-1, 1, 1000), rng.uniform(-20, 20, 500), near, everywhere[:200]])
    elif name == "log":
        near = 1 + rng.normal(size=500) * 2.0 ** rng.uniform(-50, -2, 500)
        x = np.concatenate([everywhere, rng.uniform(0.5, 2, 1000), near, 2.0 ** rng.uniform(low - 20, low, 300)])
    else:
        x = np.concatenate([everywhere, rng.uniform(0, 4, 500)])
    x = torch.from_numpy(x).to(dtype)
    return x[x.isfinite() & ((x > 0) | (name in ("exp", "tanh")))][:: 1 if EVERYTHING else 3]


@compiles
@every_dtype
@pytest.mark.parametrize(("name", "bound"), [("exp", 1.0), ("log", 1.0), ("tanh", 2.0), ("sqrt", 0.5001)])
def test_functions_are_within_a_unit_in_the_last_place(name, bound, dtype):
    x = spread(name, dtype)
    found = np.array(column(ONE[name], x.tolist(), dtype), dtype=np.float64 if dtype is F64 else np.float32)
    worst = 0.0
    with mpmath.workdps(50):
        for argument, y in zip(x.tolist(), found, strict=True):
            exact = getattr(mpmath, name)(mpmath.mpf(argument))
            unit = np.spacing(np.abs(found.dtype.type(float(exact))))
            worst = max(worst, float(abs(mpmath.mpf(float(y)) - exact) / mpmath.mpf(float(unit))))
    assert worst <= bound


@every_backend
@every_dtype
def test_special_values(dtype, backend):
    tiny, large = torch.finfo(dtype).tiny / 8, torch.finfo(dtype).max
    for name, x, expected in [
        ("exp", [NAN, INF, -INF, 0.0, 1e4, -1e4, large, -large], [NAN, INF, 0.0, 1.0, INF, 0.0, INF, 0.0]),
        ("log", [NAN, INF, -INF, 0.0, -0.0, 1.0, -1.0, -tiny], [NAN, INF, NAN, -INF, -INF, 0.0, NAN, NAN]),
        ("sqrt", [NAN, INF, -INF, 0.0, 1.0, -1.0, 4.0], [NAN, INF, NAN, 0.0, 1.0, NAN, 2.0]),
        ("tanh", [NAN, INF, -INF, 0.0, -0.0, large, -large, tiny], [NAN, 1.0, -1.0, 0.0, -0.0, 1.0, -1.0, tiny]),
        ("floor", [NAN, INF, -INF, 0.0, large, -large, -0.5, -tiny], [NAN, INF, -INF, 0.0, large, -large, -1.0, -1.0]),
    ]:
        assert same(column(ONE[name], x, dtype, backend), expected), name
    found = column(ONE["log"], [tiny], dtype, backend)[0]
    assert abs(found - math.log(tiny)) <= EPS[dtype] * abs(found)


@compiles
@every_dtype
def test_the_whole_part_is_exact_for_numbers_of_any_size(dtype):
    bits = 53 if dtype is F64 else 24
    rng = np.random.default_rng(2)
    x = rng.uniform(-1, 1, 2000) * 2.0 ** rng.integers(-3, bits + 6, 2000)
    whole = [k + d for k in (0, 1, 2 ** (bits - 3), 2 ** (bits - 2) - 1, 2 ** (bits - 1) - 1) for d in (0.0, 0.25, 0.5)]
    x = torch.from_numpy(np.concatenate([x, whole, np.negative(whole)])).to(dtype).tolist()
    assert column(ONE["floor"], x, dtype) == [float(math.floor(v)) for v in x]


AWKWARD = [NAN, INF, -INF, 0.0, 1.0, -1.0, 1.0 + 2.0**-20, 3.0]
PAIRS = [(a, b) for a in AWKWARD for b in AWKWARD]


SIGNS = [(1, 1), (-1, 1), (1, -1), (-1, -1)]


@single_compiled
def test_comparisons_of_awkward_numbers(dtype, backend):
    """The references are Python's own comparisons; a program carries NaN on."""
    compared = (maximum, minimum, at_least)
    p = program(lambda a, b: [f(s * a, t * b) for s, t in SIGNS for f in compared], 2)
    for (x, y), row in zip(PAIRS, RUN[backend](p, [torch.tensor(PAIRS, dtype=dtype)])[0].tolist(), strict=True):
        for k, (a, b) in enumerate((s * x, t * y) for s, t in SIGNS):
            expected = [NAN, NAN, 0.0] if a != a or b != b else [max(a, b), min(a, b), float(a >= b)]
            assert same(row[3 * k : 3 * k + 3], expected) and same([f(a, b) for f in compared], expected)


@single_compiled
def test_clipped_numbers_are_the_bounds_exactly(dtype, backend):
    lower, upper = -0.1, 1 / 3
    p = program(lambda x: [clip(x, lower, upper), -clip(-x, -upper, -lower)], 1)
    x = torch.tensor([-INF, -1e30, -0.2, -0.1, 0.25, 1 / 3, 7.0, INF, NAN], dtype=dtype)
    low, high = torch.tensor([lower, upper], dtype=dtype)
    expected = torch.stack([low, low, low, low, x[4], high, high, high, x[8]])
    for y in RUN[backend](p, [x[:, None]])[0].unbind(-1):
        assert same(y.tolist(), expected.tolist())


@single_compiled
def test_what_is_not_selected_touches_neither_value_nor_gradient(dtype, backend):
    """A product with a mask would be NaN where the other is not finite; a mask that is NaN is not 0."""
    p = program(lambda m, x, y: [select(m, x, 2.0 * y), select(m, 3.0, -y)], 3)
    rows = [(1.0, 2.0, INF), (0.0, NAN, 4.0), (-2.0, INF, NAN), (NAN, 5.0, NAN), (-0.0, -INF, 0.5)]
    x = torch.tensor(rows, dtype=dtype, requires_grad=True)
    (found,) = RUN[backend](p, [x])
    assert found.tolist() == [[2.0, 3.0], [8.0, -4.0], [INF, 3.0], [5.0, 3.0], [1.0, -0.5]]
    (gradient,) = torch.autograd.grad(found.sum(), x)
    taken, other = [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]
    assert gradient.tolist() == [taken, other, taken, taken, other]


def everything(x, y, z):
    """All functions, of positive numbers."""
    a = sqrt(x) + exp(-y) * log(z)
    b = maximum(a, y) - minimum(-z, a) * clip(x, 0.5, 1.5)
    c = exp(minimum(b, 0.25)) / log(select(y, 1.0 + z, x))
    return [a, b, sqrt(absolute(b)), floor(3.0 * a) + at_least(x, y), c]


def positive(rows, low=0.1, high=3.1, seed=4):
    """Random numbers [rows, 3] between two bounds."""
    return low + (high - low) * torch.rand(rows, 3, dtype=F64, generator=torch.Generator().manual_seed(seed))


@compiles
@pytest.mark.parametrize("dtype, longest", [(F32, 4), (F64, c_source.LONGEST)], ids=["many functions of C", "one"])
def test_compiled_functions_equal_torch_operations(dtype, longest, monkeypatch):
    monkeypatch.setattr(c_source, "LONGEST", longest)
    x, p = positive(100).to(dtype), program(everything, 3)
    found, expected = compiled(p, [x])[0], eager(p, [x])[0]
    assert (found - expected).abs().max() <= 64 * EPS[dtype] * expected.abs().max()
    shared = compiled(program(everything, 3, uniform=True), [x[0]])[0]
    assert (shared - found[0]).abs().max() <= 16 * EPS[dtype] * found[0].abs().max()


@compiles
@every_dtype
def test_a_row_is_bitwise_the_row_alone_whatever_the_others_hold(dtype):
    p, rows = program(everything, 3), 37
    gradient = derive.vjp(p, (0,))
    x = positive(rows).to(dtype)
    seeds = torch.ones(rows, 5, dtype=dtype)
    bad = dict(zip(range(0, rows, 5), [NAN, INF, -INF, 1e30, -1e30, 0.0, 1e-320, -1.0], strict=True))
    for k, v in bad.items():
        x[k] = v
    for q, inputs in ((p, [x]), (gradient, [x, seeds])):
        together = compiled(q, inputs)[0]
        for k in set(range(rows)) - set(bad):
            alone = compiled(q, [v[k : k + 1] for v in inputs])[0]
            assert alone.isfinite().all() and torch.equal(together[k], alone[0])


@single_compiled
def test_numbers_of_a_sample_are_compared_with_those_that_all_share(dtype, backend):
    def algorithm(x, u):
        (x,), (u,) = x, u
        two = x.tape.constant(2.0)  # recorded, and not folded
        y = [maximum(u, x), minimum(x, u), at_least(x, u), maximum(u, 1.0), at_least(1.0, u)]
        return {"y": y, "z": [sqrt(two) * x, maximum(two, -two) * x, floor(-two) * x]}

    p = record("f", [Argument("x", 1), Argument("u", 1, True)], algorithm)
    x = torch.tensor([[-1.0], [0.5], [2.0]], dtype=dtype)
    y, z = RUN[backend](p, [x, torch.tensor([0.5], dtype=dtype)])
    assert y.tolist() == [[0.5, -1.0, 0.0, 1.0, 1.0], [0.5, 0.5, 1.0, 1.0, 1.0], [2.0, 0.5, 1.0, 1.0, 1.0]]
    expected = x * torch.tensor([math.sqrt(2.0), 2.0, -2.0], dtype=dtype)
    assert (z - expected).abs().max() <= 2 * EPS[dtype] * 4


# --- derivatives -----------------------------------------------------------------------------------------------------


def smooth(x, y, z):
    """All functions that have derivatives, nowhere near a tie."""
    a = sqrt(x * x + y * y) * exp(-0.3 * z) + log(x)
    return [a, maximum(a, 9.0 + y) * minimum(x, 8.0 - z), log(1.0 + exp(a)) / sqrt(z), clip(y, -5.0, 5.0) * exp(x)]


@all_in_one(OPS)
def test_derivatives_of_every_operation_are_those_of_finite_differences(code):
    row, h = OPS[code], EPS[F64] ** (1 / 3)
    for point in [(0.7, 0.4, 1.3), (0.4, 0.7, -1.3), (0.0, 0.7, 1.3)][: 2 + (len(row.partials) > 1)]:
        x = point[: len(row.partials)]
        y = row.value(*x)
        for k, partial in enumerate(row.partials):
            above, below = (row.value(*x[:k], x[k] + step, *x[k + 1 :]) for step in (h, -h))
            found = 0.0 if partial is None else partial(1.0, y, *x)
            found /= 1.0 if row.divisor is None else row.divisor(y, *x)
            assert abs(found - (above - below) / (2 * h)) <= 64 * h * h, k


@pytest.mark.parametrize("wrong", [{"partials": (None, None)}, {"cost": "tangents"}], ids=["partials", "cost"])
def test_an_operation_whose_row_is_wrong_is_named(wrong, monkeypatch):
    monkeypatch.setitem(OPS, "tan", OPS["tanh"]._replace(**wrong))
    with refused(torchdq.ArgumentError):
        program(lambda x: [apply("tan", x)], 1)


@compiles
@pytest.mark.parametrize("derivative", [derive.vjp, derive.jvp])
def test_compiled_derivatives_equal_autograd(derivative):
    p, x = program(smooth, 3), positive(19, 0.5, 1.5)
    seeds = random(19, 4 if derivative is derive.vjp else 3)
    if derivative is derive.vjp:
        (expected,) = torch.func.vjp(lambda v: eager(p, [v])[0], x)[1](seeds)
    else:
        _, expected = torch.func.jvp(lambda v: eager(p, [v])[0], (x,), (seeds,))
    found = compiled(derivative(p, (0,)), [x, seeds])[0]
    assert (found - expected).abs().max() <= 64 * EPS[F64] * expected.abs().max()


def kinks(x, y):
    """Functions with ties, steps and bounds; the last is smooth, so that torch can differentiate every one."""
    compared = [maximum(x, y), minimum(x, y), maximum(-x, -y), maximum(x, -y), minimum(-y, x)]
    bounded = [clip(x, -1.0, 1.0), maximum(-x, 1.0), maximum(1.0, x), absolute(x)]
    return [*compared, *bounded, floor(x) + at_least(x, y) + at_least(0.5, -x) + 2.0 * x]


TIES = torch.tensor([(a, b) for a in (-1.0, 0.0, 0.5, 1.0) for b in (-1.0, 0.0, 0.5, 1.0)], dtype=F64)


@compiles
def test_derivatives_where_two_numbers_are_equal_are_those_of_the_first_and_of_torch():
    p = program(kinks, 2)
    jacobian = compiled(derive.jacobian(p, (0,)), [TIES])[0].view(-1, 10, 2)
    expected = torch.func.vmap(torch.func.jacrev(lambda v: eager(p, [v[None]])[0][0]))(TIES)
    assert torch.equal(jacobian, expected)
    x = TIES.clone().requires_grad_()
    assert torch.equal(torch.autograd.grad(compiled(p, [x])[0].sum(), x)[0], expected.sum(1))
    at_one = jacobian[(TIES == 1.0).all(-1).nonzero().item()]
    assert at_one[:3].tolist() == [[1.0, 0.0], [1.0, 0.0], [-1.0, 0.0]]
    # at its bound a number still moves, and where it has no whole part of its own it moves alone
    assert at_one[5].tolist() == [1.0, 0.0] and at_one[9].tolist() == [2.0, 0.0]


@compiles
@pytest.mark.filterwarnings("error")
def test_gradients_may_be_batched():
    p, x = program(smooth, 3), positive(5, 0.5, 1.5).requires_grad_()
    seeds = torch.eye(4, dtype=F64)[:, None].expand(4, 5, 4)
    y = compiled(p, [x])[0]
    found = torch.autograd.grad(y, x, seeds, is_grads_batched=True, retain_graph=True)[0]
    for k in range(4):
        expected = torch.autograd.grad(y, x, seeds[k], retain_graph=True)[0]
        assert (found[k] - expected).abs().max() <= 64 * EPS[F64] * (1 + expected.abs().max())


# --- what a program cannot record ------------------------------------------------------------------------------------

REFUSED = {
    "truth": ["1.0 if x else 0.0", "not x", "x and y"],
    "comparison": ["x == y", "x != 0", "x < 0.1", "0.1 >= x", "x in (y, 1.0)", "max(x, y)", "sorted((x, y))"],
    "arithmetic": ["abs(x)", "x**2", "2**x", "x % 1.0", "x // 1.0", "1.0 // x", "divmod(x, 2.0)"],
    "number": ["[1, 2][x]", "{x: 1.0}", "float(x)", "int(x)", "round(x)", "math.exp(x)", "math.floor(x)"],
    "array": ["np.where(x, 1.0, 2.0)", "np.array(x, dtype=float)", "np.sin(x)"],
    "tensor": ["torch.exp(x)", "torch.where(torch.ones(1) > 0, x, y)"],
    "sum with a tensor": [
        "torch.ones(2) * x",
        "torch.ones(2).double() - x",
        "x + torch.ones(())",
        "x / torch.ones(())",
    ],
    "sum with something else": ["np.ones(2) * x", "x * '2'", "x - None"],
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_a_program_cannot_record_is_refused_with_a_way_out(kind):
    """A comparison that gave an answer would make the value of no sample a constant of the program."""
    for code in REFUSED[kind]:
        with refused(torchdq.NumberError):
            program(lambda x, y, code=code: eval(code, globals(), {"x": x, "y": y}), 2)


def test_numbers_of_numpy_are_constants():
    for three in (np.float64(3.0), np.float32(3.0), np.int64(3)):
        assert program(lambda x, k=three: [k * x + (k - x) / k, k / x], 1).count().total == 5
