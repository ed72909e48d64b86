"""Backends: the compiled programs against the same programs run by torch, operation by operation.

Values, batches and threads; that no row of a batch touches another; and that the kernels write nowhere but into their
results. What the compiler makes of them with the flags of the package is the claim of test_as_shipped.py.
"""

import itertools
import platform

import pytest
import torch
from helpers import eager, random, thinned, threads  # noqa: F401
from host_gpu import host_backends  # noqa: F401
from oracles import EPS, states
from programs import FUNCTIONS, KINDS, PANDA, TREE, TWO, agree, condition, on, same
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.utils.flop_counter import FlopCounterMode

import torchdq
from torchdq.backends import c_library as build
from torchdq.backends import threads as pool
from torchdq.backends.c import COMPILED, CompiledKernel
from torchdq.program.program import Argument, record

F32, F64 = torch.float32, torch.float64
BACKEND = "auto"

pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")

RPH = TREE.bake()


# kernels of the GPU backend are compiled for the host, also with the threads of a block backwards
every_kernel = pytest.mark.parametrize("backend", ["c", "host"])


# --- values ----------------------------------------------------------------------------------------------------------


# backend, function, robot, precision
EVERY = list(itertools.product(("c", "host"), FUNCTIONS, (TWO, TREE), (F64, F32)))
OF_AN_ARM = [("c", "inverse_dynamics", PANDA, F64), ("c", "mass_matrix", PANDA, F64)]
FEW = [(backend, name, TREE, dtype) for backend, dtype in (("c", F64), ("host", F32)) for name in KINDS]
FEW += [
    (backend, name, TREE, dtype) for backend, dtype in (("c", F32), ("host", F64)) for name in ("forward_dynamics",)
]


@pytest.mark.parametrize(
    "backend, name, robot, dtype",
    thinned([*EVERY, *OF_AN_ARM], [*FEW, OF_AN_ARM[0]]),
    ids=lambda x: getattr(x, "name", str(x)),
)
def test_compiled_functions_equal_torch_operations(backend, name, robot, dtype):
    s = states(robot, 150, dtype=dtype)
    found, expected = (on(one, FUNCTIONS[name], robot, s) for one in (backend, "eager"))
    agree(found, expected, 256.0 * condition(name, robot, s))
    if backend == "host":
        same(on("backwards", FUNCTIONS[name], robot, s), found)


FIELDS = (("mass",), ("gravity", "home"), ("com", "inertia", "armature"), ("X_PB_home", "screw"))


@pytest.mark.parametrize(
    "fields, batch",
    thinned([(x, batch) for x in FIELDS for batch in ((), (19,))], [(FIELDS[0], ()), *((x, (19,)) for x in FIELDS)]),
)
def test_robots_that_vary_equal_torch_operations(fields, batch):
    scale = 1 + 0.1 * random(*batch, 1).squeeze(-1)
    values = {name: getattr(TREE, name) for name in fields}
    changes = {name: x * scale.reshape(batch + (1,) * x.ndim) for name, x in values.items()}
    robot, s = TREE.replace(**changes, on_unphysical="ignore"), states(TREE, 19)
    agree(on("c", FUNCTIONS["inverse_dynamics"], robot, s), on("eager", FUNCTIONS["inverse_dynamics"], robot, s))


@pytest.mark.case("P1")
@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
@every_kernel
def test_a_row_of_a_batch_is_bitwise_the_row_alone(backend, dtype):
    wrong = []
    for batch in (0, 1, 2, 7, 8, 9, 15, 16, 17, 31, 32, 33, 63, 64, 65, 127, 128, 129, 1000):
        s = states(TREE, batch, dtype=dtype)
        tau = torchdq.inverse_dynamics(TREE, *s, backend=backend)
        assert tau.shape == (batch, TREE.n)
        for k in {*range(min(batch, 40)), *range(max(batch - 9, 0), batch)}:
            alone = torchdq.inverse_dynamics(TREE, *(x[k : k + 1] for x in s), backend=backend)
            wrong += [] if torch.equal(tau[k], alone[0]) else [(batch, k)]
    assert wrong == []


@pytest.mark.case("P9")
@pytest.mark.parametrize("dtype", thinned([F64, F32], [F32]), ids=str)
@every_kernel
def test_a_bad_row_leaves_every_other_bitwise_as_it_was(backend, dtype):
    def run_(s):
        x = [v.clone().requires_grad_() for v in s[:3]]
        tau = torchdq.inverse_dynamics(TREE, *x, backend=backend)
        return tau.detach(), *torch.autograd.grad(tau.sum(), x)

    rows = 35
    s = states(TREE, rows, dtype=dtype)
    before = run_(s)
    for k, bad in itertools.product((0, 9, 34), (float("nan"), float("inf"), -float("inf"), 1e30, 1e-320)):
        spoiled = [x.clone() for x in s]
        for x in spoiled:
            x[k] = bad
        others = torch.arange(rows) != k
        for y, z in zip(run_(spoiled), before, strict=True):
            assert torch.equal(y[others], z[others]), (k, bad)


# --- rows in and out of vectors --------------------------------------------------------------------------------------

GUARD = -777.25


def kernel(program, dtype=F64):
    """The compiled program."""
    return COMPILED.kernel(program, dtype, torch.device("cpu"))


WIDTHS = (1, 2, 3, 4, 5, 7, 8, 9, 12, 15, 16, 17, 20)


def reversed_and_summed(c, *rows):
    """Of every row its numbers backwards, the first and a constant, and twice the sum over all samples."""
    found = {}
    for x in rows:
        found |= {f"y{len(x)}": x[::-1], f"z{len(x)}": [x[0] + c[0]], f"w{len(x)}": [v * 2.0 for v in x]}
    return found


@pytest.mark.parametrize("dtype", [F64, F32], ids=str)
def test_rows_of_any_width_are_read_and_nothing_but_results_is_written(dtype):
    """That nothing else is read is the claim of test_kernel_bounds.py."""
    arguments = [Argument("c", 1, True), *(Argument(f"x{width}", width) for width in WIDTHS)]
    run = kernel(record("widths", arguments, reversed_and_summed, [f"w{k}" for k in WIDTHS]), dtype).compiled.run
    for samples in (0, 1, 2, 3, 5, 8, 9, 15, 16, 17, 23, 33, 40):
        rows, c = [random(samples, width, dtype=dtype) for width in WIDTHS], torch.tensor([3.0], dtype=dtype)
        sizes = [size for width in WIDTHS for size in (samples * width, samples, width)]
        room = [torch.full((64 + size + 64,), GUARD, dtype=dtype) for size in sizes]
        inside = [y[64:-64] for y in room]
        run(samples, None, *(x.data_ptr() for x in (c, *rows)), *(y.data_ptr() + 64 * y.element_size() for y in room))
        assert all((y[:64] == GUARD).all() and (y[-64:] == GUARD).all() for y in room)
        for k, x in enumerate(rows):
            y, z, w = inside[3 * k : 3 * k + 3]
            assert torch.equal(y.view(x.shape), x.flip(-1)) and torch.equal(z, x[:, 0] + 3.0)
            assert torch.allclose(w, 2 * x.sum(0), rtol=0, atol=64 * EPS[dtype] * max(samples, 1))


def test_a_program_longer_than_a_function_may_be_is_right():
    def algorithm(x):
        values = list(x)
        for i in range(2600):
            values.append(values[-1] * values[-3] - values[i % 4] if i % 50 else (values[-1] + values[-2]).sin())
        return {"y": values[-3:], "z": [values[7].cos(), values[7].sin()]}

    program = record("long", [Argument("x", 4)], algorithm)
    x = 0.1 * random(21, 4)
    agree(kernel(program)([x], 21), eager(program, [x]), 1e4)


# --- threads ---------------------------------------------------------------------------------------------------------


@pytest.mark.case("P13")
def test_the_number_of_threads_changes_no_bit_of_a_result(threads):  # noqa: F811
    s = states(TREE, 9001)
    torchdq.clear_caches()
    results = []
    for number in (1, 2, 3):
        threads(number)
        results.append(torchdq.inverse_dynamics(TREE, *s, backend="c"))
    assert pool.running(), "the batch was to be large enough for threads"
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])
    torchdq.clear_caches()
    assert not pool.running()


@pytest.mark.case("P13")
def test_the_number_of_threads_changes_summed_gradients_by_rounding_only(threads):  # noqa: F811
    s = states(TREE, 9001)
    gradients = []
    for number in (1, 2):
        threads(number)
        mass = TREE.mass.clone().requires_grad_()
        tau = torchdq.inverse_dynamics(TREE.replace(mass=mass), s.q, s.qd, s.qdd, backend="c")
        gradients.append(torch.autograd.grad((tau**2).sum(), mass))
    agree(*gradients)


# --- what torch hands over -------------------------------------------------------------------------------------------


@pytest.mark.case("P2")
@every_kernel
def test_how_an_input_lies_in_memory_does_not_matter(backend):
    x, qd = random(9, 3), random(9, 3, seed=1)
    for name, q in {
        "transposed": x.mT.contiguous().mT,
        "strided": torch.stack([x, x], -1)[..., 0],
        "expanded": x[:1].expand_as(x),
        "flipped": x.flip(0),
        "misaligned": torch.cat([x.new_zeros(1), x.flatten()])[1:].view(x.shape),
    }.items():
        plain = q.clone(memory_format=torch.contiguous_format)
        found, expected = (torchdq.inverse_dynamics(RPH, at, qd, backend=backend) for at in (q, plain))
        assert torch.equal(found, expected), name


# --- other processors ------------------------------------------------------------------------------------------------


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the flags are those of x86")
@pytest.mark.parametrize(
    ("flags", "dtype"),
    thinned(
        [(flags, dtype) for flags in ("-mno-avx512f", "-mno-avx512f -mno-avx") for dtype in (F32, F64)],
        [("-mno-avx512f", F32), ("-mno-avx512f -mno-avx", F64)],
    ),
)
def test_vectors_of_32_and_16_bytes_compute_the_same(monkeypatch, flags, dtype):
    recorded = torchdq.compile(TWO, "forward_dynamics").program
    x = [random(37, TWO.n, seed=k, dtype=dtype) for k in range(3)]
    monkeypatch.setattr(build, "FLAGS", (*build.FLAGS, *flags.split()))
    found, _ = CompiledKernel(recorded, dtype)(x, 37)
    (expected,) = eager(recorded, x)
    # without fused multiplication and addition some roundings differ
    assert (found - expected).abs().max() <= 256 * torch.finfo(dtype).eps * expected.abs().max()


# --- tensors whose memory is not what they are -----------------------------------------------------------------------


def test_views_with_a_sign_of_their_own_are_read_with_it():
    q = random(5, 3)
    negated = torch._neg_view(-q)
    turned = torch.complex(torch.zeros(3, dtype=F64), -q[0]).conj().imag
    assert negated.is_neg() and turned.is_neg()
    for function in (torchdq.inverse_dynamics, torchdq.mass_matrix, torchdq.forward_kinematics):
        expected = function(RPH, q, backend="c")
        assert torch.equal(function(RPH, negated, backend="c"), expected)
        assert torch.equal(function(RPH, turned, backend="c"), function(RPH, q[0], backend="c"))
    x = q.clone().requires_grad_()
    found, expected = (
        torch.autograd.grad(torchdq.inverse_dynamics(RPH, x, backend="c"), x, d)[0] for d in (negated, q)
    )
    assert torch.equal(found, expected)


def test_zeros_without_memory_are_zeros():
    zeros = torch._efficientzerotensor((4, 3), dtype=F64), torch.zeros(4, 3, dtype=F64)
    assert torch.equal(*(torchdq.inverse_dynamics(RPH, q, backend="c") for q in zeros))


def test_tensors_without_values_give_tensors_without_values():
    with FakeTensorMode():
        q = torch.randn(3, 3, dtype=F64)
        for function in (torchdq.inverse_dynamics, torchdq.mass_matrix, torchdq.forward_kinematics):
            found = function(RPH, q)
            assert isinstance(found, FakeTensor) and found.shape[0] == 3


def test_a_counter_of_operations_does_not_change_the_numbers():
    q = random(5, 3)
    expected = torchdq.inverse_dynamics(RPH, q)
    with FlopCounterMode(display=False):
        assert torch.equal(torchdq.inverse_dynamics(RPH, q), expected)
