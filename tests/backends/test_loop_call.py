"""Loops over a computation equal so many calls of it, bit for bit: values, gradients, rows, builds and forks.

Loops of the GPU backend are compiled for the host here; what is theirs alone is in test_cuda_loop.py.
"""

import itertools

import pytest
import torch
from helpers import all_in_one, exhaustive, random, rods, thinned, threads  # noqa: F401
from host_gpu import host_backends  # noqa: F401
from loops import equal, gradients, loop, one_by_one, parts, step, tensors
from messages import refused, warned
from programs import agree, same

import torchdq
from torchdq.backends import c, c_loop, c_source
from torchdq.backends import threads as pool
from torchdq.backends.call import evaluate
from torchdq.backends.compiler import BuildError, compiler
from torchdq.backends.loop_call import repeat
from torchdq.functions.compile import RecordedComputation
from torchdq.program.program import GROWTH, LARGEST_GROWTH, Argument, record

BACKEND = "c"
pytestmark = pytest.mark.skipif(compiler() is None, reason="there is no C compiler")

F32, F64 = torch.float32, torch.float64
SMALL, GROWING = step(), step(growth=True)
each_dtype = pytest.mark.parametrize("dtype", [F64, F32], ids=str)
every_backend = pytest.mark.parametrize("backend", ["c", "host"])


def looped(program, steps, given, total=("z",), **options):
    return repeat(RecordedComputation(program), steps, *parts(given), total=total, **options)


# --- values ----------------------------------------------------------------------------------------------------------


@every_backend
@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
def test_a_loop_is_its_steps(dtype, backend):
    """In any number of samples, of which vectors and blocks hold some, and of steps."""
    for samples, steps in itertools.product((0, 1, 3, 8, 37, 150), (0, 1, 5)):
        given = tensors(samples, steps, dtype=dtype)
        expected = one_by_one(SMALL, steps, given, backend)
        for other in (backend, "backwards") if backend == "host" else ("c",):
            assert equal(looped(SMALL, steps, given, backend=other), expected)
        same([looped(SMALL, steps, given, ends=True, backend=backend)["x"]], [expected["x"][-1]])


@pytest.mark.parametrize("width", [0, 2, 5])
def test_rows_of_any_width_are_carried(width):
    program, given = step(width), tensors(9, 3, width)
    found, expected = looped(program, 3, given), one_by_one(program, 3, given, "eager")
    agree([found[name] for name in expected], [*expected.values()])


@pytest.mark.parametrize("dtype", thinned([F64, F32], (F32,)), ids=str)
def test_long_bodies_are_functions_of_bounded_length(dtype, monkeypatch):
    monkeypatch.setattr(c_source, "LONGEST", 20)
    program = step(links=4)
    code = c_loop.source(loop(program), dtype == F32)
    assert c_source.pieces_of(code) > 2
    given = tensors(21, 4, dtype=dtype)
    assert equal(looped(program, 4, given), one_by_one(program, 4, given, "c"))


@all_in_one(["strided", "negated", "expanded samples", "expanded steps", "zero"])
def test_tensors_of_any_memory_are_read(how):
    given = tensors(11, 4)
    if how == "strided":
        views = {name: torch.stack([x, -x], -1)[..., 0] for name, x in given.items()}
    elif how == "negated":
        views = {name: torch._neg_view(-x) for name, x in given.items()}
    elif how == "expanded samples":
        views = {**given, "u": given["u"][:, :1].expand(-1, 11, -1), "p": given["p"][:1].expand(11, 1)}
    elif how == "expanded steps":
        views = {**given, "u": given["u"][:1].expand(4, -1, -1)}
    else:
        views = {**given, "u": torch._efficientzerotensor(given["u"].shape, dtype=F64)}
    plain = {name: x.new_zeros(x.shape) + x for name, x in views.items()}
    assert equal(looped(SMALL, 4, views), one_by_one(SMALL, 4, plain, "c"))


@all_in_one([(steps, *shape) for steps in (3, 4) for shape in ((), (1,), (4,), (5, 1), (5, 4))])
def test_tensors_of_every_step_broadcast_over_the_batch_as_those_of_one_do(case):
    """Also where there are as many steps as samples."""
    steps, *shape = case
    given = tensors(20, steps)
    given = {name: x.view(5, 4, x.shape[-1]) if name in ("x", "p") else x for name, x in given.items()}
    given["u"] = random(steps, *shape, 3, seed=7)
    assert equal(looped(SMALL, steps, given), one_by_one(SMALL, steps, given, "c"))


@every_backend
@pytest.mark.parametrize("grad", [False, True])
def test_tensors_that_all_samples_of_a_step_share_are_those_of_each(grad, backend):
    """Also where errors grow too much."""
    given = tensors(40, 5, dtype=F32)
    given["x"][::7, 0], shared = 1.1, given["u"][:, :1].clone().requires_grad_(grad)
    found = looped(GROWING, 5, {**given, "u": shared}, backend=backend)
    assert equal(found, looped(GROWING, 5, {**given, "u": shared.expand(5, 40, 3).clone()}, backend=backend))
    if grad:
        stepped = one_by_one(GROWING, 5, {**given, "u": shared}, backend)
        agree(*([torch.autograd.grad(y["x"].sum() + y["z"].sum(), shared)[0]] for y in (found, stepped)), 1e3)


@pytest.mark.parametrize("kind", ["values", "gradients", "shared"])
def test_threads_change_no_bit(kind, threads):  # noqa: F811
    given = tensors(3 * pool.PART // 2 + 5, 3, grad=kind == "gradients")
    given["u"] = given["u"][:, :1] if kind == "shared" else given["u"]
    found = []
    for number in (1, 2):
        threads(number)
        y = looped(SMALL, 3, given)
        found.append(gradients(y, given) if kind == "gradients" else list(y.values()))
    same(*found)
    few = {name: x if name == "m" else x[..., :70, :] for name, x in given.items()}
    if kind == "values":
        assert equal(looped(SMALL, 3, few), one_by_one(SMALL, 3, few, "c"))


# --- gradients -------------------------------------------------------------------------------------------------------


@each_dtype
@pytest.mark.parametrize(
    "backend, samples, ends",
    thinned(
        [("c", 11, False), ("c", 11, True), ("c", 3, False), ("host", 70, False)],
        [("c", 11, True), ("host", 70, False)],
    ),
)
def test_gradients_are_those_of_the_steps(backend, samples, ends, dtype):
    """Bit for bit, but for sums over steps and samples, whose order differs."""
    given = tensors(samples, 6, dtype=dtype, grad=True)
    found, expected = looped(SMALL, 6, given, ends=ends, backend=backend), one_by_one(SMALL, 6, given, backend)
    if ends:
        expected["x"] = expected["x"][-1]
    assert equal(found, expected)
    (x, u, *totals), (x_, u_, *totals_) = gradients(found, given), gradients(expected, given)
    same([x, u], [x_, u_])
    agree(totals, totals_, 256)


@every_backend
def test_derivatives_of_third_order_are_those_of_the_steps(backend):
    def third(run, backend):
        given = tensors(5, 3, grad=True)
        found = list(run(SMALL, 3, given, backend=backend).values())
        for _ in range(3):
            found = torch.autograd.grad(sum(y.square().sum() for y in found), list(given.values()), create_graph=True)
        return [y.detach() for y in found]

    agree(third(looped, backend), third(one_by_one, "eager"), 1e3)


# --- rows ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grad", [False, True])
def test_rows_over_the_limit_at_some_step_are_as_stepped_and_no_other_is_touched(grad):
    given = tensors(40, 5, dtype=F32)
    given["x"][::7, 0] = 1.1  # over the limit at the first steps
    given = {name: x.requires_grad_(grad) for name, x in given.items()}
    expected = one_by_one(GROWING, 5, given, "c")
    largest = (1000 * expected["x"][1:, :, 0] ** 2).amax(0)
    over = ~(largest <= LARGEST_GROWTH.single)
    assert 4 < over.sum() < 36
    found = looped(GROWING, 5, given)
    assert equal(found, expected)
    if grad:
        (x, u, *totals), (x_, u_, *totals_) = gradients(found, given), gradients(expected, given)
        same([x, u], [x_, u_])
        agree(totals, totals_, 1e3)


@exhaustive
def test_gradients_of_rows_over_the_limit_are_finite_where_those_of_a_float32_step_are_not():
    """Rows that divide by zero in float32 are taken step by step, with their gradient."""

    def algorithm(x, u):
        rest = (1.0 + x[0]) - 1.0
        return {"x": [0.5 * x[0] / rest + u[0]], GROWTH: [(rest + rest) / rest]}

    program = record("rest", [Argument("x", 1), Argument("u", 1)], algorithm)
    x, u = torch.tensor([[0.5], [1e-9], [0.25]]), random(3, 3, 1, dtype=F32).abs()

    def gradient(run):
        given = {"x": x.clone().requires_grad_(), "u": u.clone().requires_grad_()}
        return torch.autograd.grad(run(given).sum(), list(given.values()))

    def stepped(given):
        after = given["x"]
        for k in range(3):
            after = evaluate(RecordedComputation(program), {"x": after, "u": given["u"][k]})["x"]
        return after

    found = gradient(lambda g: repeat(RecordedComputation(program), 3, {"x": g["x"]}, {"u": g["u"]}, {})["x"][-1])
    same(found, gradient(stepped))
    assert all(y.isfinite().all() for y in found)


@every_backend
def test_a_step_over_the_limit_of_double_precision_is_nan_from_there_on(backend):
    given = tensors(70, 4)
    given["x"][7, 0], given["u"][1, 3], given["u"][2, 66] = 1e9, 1e9, float("nan")
    found = looped(GROWING, 4, given, backend=backend)
    assert equal(found, one_by_one(GROWING, 4, given, backend))
    assert found["x"][1:, 7].isnan().all() and found["x"][:2, 3].isfinite().all() and found["x"][2:, 3].isnan().all()
    assert found["x"][:, [k for k in range(70) if k not in (3, 7, 66)]].isfinite().all()


@each_dtype
@pytest.mark.parametrize("program", [SMALL, GROWING], ids=["plain", "growing"])
def test_a_row_without_values_touches_no_other(program, dtype):
    def run(given):
        found = looped(program, 4, given)
        *rows, _ = gradients(found, given)
        return [*found.values(), *rows]

    before, bad = run(tensors(21, 4, dtype=dtype, grad=True)), tensors(21, 4, dtype=dtype)
    bad["x"][3], bad["u"][2, 8], bad["p"][17] = float("nan"), float("inf"), float("nan")
    after = run({name: x.requires_grad_() for name, x in bad.items()})
    others = [k for k in range(21) if k not in (3, 8, 17)]
    for a, b in zip(after, before, strict=True):
        same([a[..., others, :]], [b[..., others, :]])
        assert not torch.equal(a, b)


# --- builds ----------------------------------------------------------------------------------------------------------


def test_loops_that_cannot_be_compiled_are_run_by_torch_or_refused(monkeypatch):
    def failing(*_):
        raise BuildError("no")

    program, given = step(4), tensors(3, 2, 4)
    monkeypatch.setattr(c.c_library, "load", failing)
    torchdq.clear_caches()  # what was warned of once
    with warned(UserWarning):
        found = looped(program, 2, given, backend="auto")
    agree(found.values(), one_by_one(program, 2, given, "eager").values())
    with refused(BuildError):
        looped(program, 2, given)
    torchdq.clear_caches()
