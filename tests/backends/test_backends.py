"""Backends: the compiled programs against the same programs run by torch, operation by operation.

Values, gradients, batches, transforms, traced graphs and threads; that no row of a batch touches another; that the
kernels write nowhere but into their results; and that their sine and cosine are as good as mpmath says.
"""

import platform
import warnings
from functools import partial

import helpers
import mpmath
import numpy as np
import programs
import pytest
import torch
from helpers import EVERYTHING, eager, random
from host_gpu import host_backends  # noqa: F401
from kinds_of_programs import free
from messages import refused
from oracles import EPS, states
from programs import FUNCTIONS, PANDA, TREE, TWO, on, tree
from torch._subclasses.fake_tensor import FakeTensor, FakeTensorMode
from torch.autograd import gradcheck, gradgradcheck
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils.flop_counter import FlopCounterMode

import torchdq
from torchdq.backends import c_library as build
from torchdq.backends import call
from torchdq.backends import precision as running
from torchdq.backends import threads as pool
from torchdq.backends.c import COMPILED, CompiledKernel
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.catalogue import FLOATING, RECIPES
from torchdq.program import autograd
from torchdq.program.program import LARGEST_GROWTH, Argument, record
from torchdq.robot.robot import arguments

F32, F64 = torch.float32, torch.float64
BACKEND, AS_SHIPPED = "auto", True  # see conftest.py

pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")


RPH = tree(3).bake()


def agree(found, expected, factor: float = 256.0) -> None:
    """Both are the same sums, rounded differently."""
    programs.agree(found, expected, factor)


# the kernels of the GPU backend are compiled for the host here
every_kernel = pytest.mark.parametrize("backend", ["c", "host"])


# --- values ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [F64, F32], ids=str)
@pytest.mark.parametrize("robot", [TWO, TREE] if EVERYTHING else [TREE], ids=lambda r: r.name)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_compiled_functions_equal_torch_operations(name, robot, dtype):
    s = states(robot, 19, dtype=dtype)
    allowed = 256.0 * programs.condition(name, robot, s)
    agree(on("c", FUNCTIONS[name], robot, s), on("eager", FUNCTIONS[name], robot, s), allowed)


@pytest.mark.parametrize("name", ["inverse_dynamics", "mass_matrix"])
def test_compiled_functions_of_an_arm_equal_torch_operations(name):
    s = states(PANDA, 19)
    agree(on("c", FUNCTIONS[name], PANDA, s), on("eager", FUNCTIONS[name], PANDA, s))


@pytest.mark.parametrize("batch", [(), (19,)], ids=["uniform", "per sample"])
@pytest.mark.parametrize(
    "fields", [("mass",), ("gravity", "home"), ("com", "inertia", "armature"), ("X_PB_home", "screw")]
)
def test_robots_that_vary_equal_torch_operations(fields, batch):
    scale = 1 + 0.1 * random(*batch, 1).squeeze(-1)
    changes = {}
    for name in fields:
        x = getattr(TREE, name)
        changes[name] = x * scale.reshape(batch + (1,) * x.ndim)
    robot, s = TREE.replace(**changes, on_unphysical="ignore"), states(TREE, 19)
    agree(on("c", FUNCTIONS["inverse_dynamics"], robot, s), on("eager", FUNCTIONS["inverse_dynamics"], robot, s))


@pytest.mark.case("P1")
@pytest.mark.parametrize("dtype", [F64, F32], ids=str)
@pytest.mark.parametrize("batch", [0, 1, 2, 7, 8, 9, 15, 16, 17, 31, 32, 33, 63, 64, 65, 127, 128, 129, 1000])
@every_kernel
def test_a_row_of_a_batch_is_bitwise_the_row_alone(backend, batch, dtype):
    s = states(TREE, batch, dtype=dtype)
    tau = torchdq.inverse_dynamics(TREE, *s, backend=backend)
    assert tau.shape == (batch, TREE.n)
    for k in {*range(min(batch, 40)), *range(max(batch - 9, 0), batch)}:
        alone = torchdq.inverse_dynamics(TREE, *(x[k : k + 1] for x in s), backend=backend)
        assert torch.equal(tau[k], alone[0])


@pytest.mark.case("P9")
@pytest.mark.parametrize("dtype", [F64, F32], ids=str)
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e30, 1e-320])
@every_kernel
def test_a_bad_row_leaves_every_other_bitwise_as_it_was(backend, bad, dtype):
    def run_(s):
        x = [v.clone().requires_grad_() for v in s[:3]]
        tau = torchdq.inverse_dynamics(TREE, *x, backend=backend)
        return tau.detach(), *torch.autograd.grad(tau.sum(), x)

    rows = 35
    s = states(TREE, rows, dtype=dtype)
    before = run_(s)
    for k in (0, 9, 34):
        spoiled = [x.clone() for x in s]
        for x in spoiled:
            x[k] = bad
        others = torch.arange(rows) != k
        for y, z in zip(run_(spoiled), before, strict=True):
            assert torch.equal(y[others], z[others])


# --- sine and cosine -------------------------------------------------------------------------------------------------


def kernel(program, dtype=F64):
    """The compiled program."""
    return COMPILED.kernel(program, dtype, torch.device("cpu"))


TRIG = record("trig", [Argument("x", 1)], lambda x: {"y": [x[0].sin(), x[0].cos()]})


def angles(largest: float, dtype) -> torch.Tensor:
    """Random angles, and angles near multiples of pi/2, where a sine or cosine is small."""
    x = np.random.default_rng(5).uniform(-largest, largest, 1500)
    quarter = (x[:500] / (np.pi / 2)).round() * np.pi / 2
    x = torch.from_numpy(np.concatenate([x, quarter, np.geomspace(1e-300, 1e-3, 100)])).to(dtype)
    return x[x.abs() <= largest]


def ulps(x: torch.Tensor, floor: float) -> float:
    """Largest error in units of the last place of the result, or of `floor` where that is larger."""
    y = kernel(TRIG, x.dtype)([x[:, None]], len(x))[0].numpy()
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
    [
        *((0.25, largest, F64) for largest in (1.0, 1e5, 1e6)),
        *((0.25, largest, F32) for largest in (1.0, 4e3, 1e5)),
        *((0.0, largest, F64) for largest in (10.0, 1e5, 1e6)),
    ],
)
def test_sine_and_cosine_are_within_two_units_in_the_last_place(floor, largest, dtype):
    """A unit of 0.25 where the result is smaller, since the angle is rounded to one of its own; in double its own."""
    assert ulps(angles(largest, dtype), floor) <= (2.0 if floor else 2.5)


def test_sine_and_cosine_of_what_is_no_angle_are_not_numbers():
    x = torch.tensor([[float("nan")], [float("inf")], [-float("inf")], [1.0]], dtype=F64)
    y = kernel(TRIG)([x], 4)[0]
    assert y[:3].isnan().all() and y[3].isfinite().all()


# --- rows in and out of vectors --------------------------------------------------------------------------------------

GUARD = -777.25


@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
@pytest.mark.parametrize("width", [1, 2, 3, 4, 5, 7, 8, 9, 12, 15, 16, 17, 20])
def test_rows_of_any_width_are_read_and_nothing_but_results_is_written(width, single):
    """That nothing else is read is the claim of test_kernel_bounds.py."""
    program = record(
        "widths",
        [Argument("x", width), Argument("c", 1, True)],
        lambda x, c: {"y": [*reversed(x)], "z": [x[0] + c[0]], "w": [v * 2.0 for v in x]},
        summed=["w"],
    )
    dtype = F32 if single else F64
    run = kernel(program, dtype).function
    for samples in (0, 1, 2, 3, 5, 8, 9, 15, 16, 17, 23, 33, 40):
        x, c = random(samples, width, dtype=dtype), torch.tensor([3.0], dtype=dtype)
        out = [torch.full((64 + size + 64,), GUARD, dtype=dtype) for size in (samples * width, samples, width)]
        step = x.element_size()
        run(samples, x.data_ptr(), c.data_ptr(), *(y.data_ptr() + 64 * step for y in out))
        y, z, w = (y[64:-64] for y in out)
        assert all((y[:64] == GUARD).all() and (y[-64:] == GUARD).all() for y in out)
        assert torch.equal(y.view(samples, width), x.flip(-1))
        assert torch.equal(z, x[:, 0] + 3.0)
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


threads = helpers.threads


@pytest.mark.case("P13")
def test_the_number_of_threads_changes_no_bit_of_a_result(threads):
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
def test_the_number_of_threads_changes_summed_gradients_by_rounding_only(threads):
    s = states(TREE, 9001)
    gradients = []
    for number in (1, 2):
        threads(number)
        mass = TREE.mass.clone().requires_grad_()
        tau = torchdq.inverse_dynamics(TREE.replace(mass=mass), s.q, s.qd, s.qdd, backend="c")
        gradients.append(torch.autograd.grad((tau**2).sum(), mass))
    agree(*gradients)


# --- derivatives -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", [TWO, RPH], ids=["two_link", "R-P-H"])
@pytest.mark.parametrize("function", [torchdq.inverse_dynamics, torchdq.forward_dynamics], ids=lambda f: f.__name__)
@every_kernel
def test_derivatives_are_finite_differences(backend, function, robot):
    x = tuple(0.5 * random(3, robot.n, seed=k).requires_grad_() for k in range(3))

    def f(*x):
        return function(robot, *x, backend=backend)

    assert gradcheck(f, x, eps=1e-6, atol=1e-7, rtol=1e-6, check_forward_ad=True, check_batched_grad=True)
    assert gradgradcheck(f, x, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)


@pytest.mark.parametrize(
    "learn", [("mass",), ("com", "inertia", "gravity"), ("armature", "home"), ("X_PB_home", "screw")], ids=str
)
def test_gradients_of_what_is_learned_equal_torch_operations(learn):
    s, layer = states(RPH, 21), torchdq.DQRNEA(RPH.replace(armature=torch.ones(3, dtype=F64)), learn=learn)
    gradients = []
    for backend in ("c", "eager"):
        with torchdq.backend(backend):
            gradients.append(torch.autograd.grad((layer(s.q, s.qd, s.qdd, s.f_tip) ** 2).sum(), layer.parameters()))
    agree(*gradients, 1024)


def tau(q, qd, qdd):
    return torchdq.inverse_dynamics(RPH, q, qd, qdd)


TRANSFORMS = {
    "vmap": lambda q, qd, qdd: torch.func.vmap(tau, in_dims=(0, None, 1))(q, qd[0], qdd.mT),
    "vmap of vmap": lambda *x: torch.func.vmap(torch.func.vmap(tau))(*(v.unflatten(0, (2, 3)) for v in x)),
    "jacrev of jacfwd": lambda *x: torch.func.jacrev(torch.func.jacfwd(tau))(*(v[0] for v in x)),
    "jvp": lambda *x: torch.func.jvp(tau, x, (x[1], x[2], x[0])),
    "gradient of jvp": lambda *x: torch.func.vjp(
        lambda q, v: torch.func.jvp(lambda q: tau(q, x[1], x[2]), (q,), (v,))[1], x[0], x[1]
    )[1](x[2]),
    "third derivative": lambda *x: torch.func.jacrev(torch.func.jacfwd(torch.func.jacrev(tau)))(*(v[0] for v in x)),
}


@pytest.mark.case("P3")
@pytest.mark.parametrize("name", TRANSFORMS)
def test_transforms_equal_torch_operations(name):
    x = [random(6, 3, seed=k) for k in range(3)]
    agree(on("c", TRANSFORMS[name], *x), on("eager", TRANSFORMS[name], *x), 1024)


@pytest.mark.case("P3")
def test_vmap_over_robots_equals_their_batch():
    mass, q = RPH.mass * (1 + random(5, 1).abs()), random(5, 3)
    mapped = torch.func.vmap(lambda m, q: torchdq.inverse_dynamics(RPH.replace(mass=m), q, backend="c"))(mass, q)
    agree([mapped], [torchdq.inverse_dynamics(RPH.replace(mass=mass), q, backend="eager")])


def test_nothing_but_the_inputs_is_kept_for_backward():
    x = [random(50, 7, seed=k).requires_grad_() for k in range(3)]
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t) or t, lambda t: t):
        torchdq.inverse_dynamics(PANDA, *x, backend="c")
    assert sum(t.numel() for t in kept) == sum(v.numel() for v in x)
    assert {t.data_ptr() for t in kept} == {v.data_ptr() for v in x}


# --- what torch hands over -------------------------------------------------------------------------------------------


@pytest.mark.case("P2")
@pytest.mark.parametrize(
    "change",
    [
        lambda x: x.mT.contiguous().mT,
        lambda x: torch.stack([x, x], -1)[..., 0],
        lambda x: x[:1].expand_as(x),
        lambda x: x.flip(0),
        lambda x: torch.cat([x.new_zeros(1), x.flatten()])[1:].view(x.shape),
    ],
    ids=["transposed", "strided", "expanded", "flipped", "misaligned"],
)
@every_kernel
def test_how_an_input_lies_in_memory_does_not_matter(backend, change):
    q, qd = change(random(9, 3)), random(9, 3, seed=1)
    found, expected = (
        torchdq.inverse_dynamics(RPH, x, qd, backend=backend)
        for x in (q, q.clone(memory_format=torch.contiguous_format))
    )
    assert torch.equal(found, expected)


# --- traced graphs ---------------------------------------------------------------------------------------------------


def traced(function):
    torch._dynamo.reset()
    return torch.compile(function, fullgraph=True, backend="aot_eager")


def test_a_compiled_graph_is_not_served_the_program_of_another_robot():
    f = traced(lambda robot, q: torchdq.inverse_dynamics(robot, q, backend="c"))
    q = random(9, 3)
    for robot in (RPH, RPH.replace(mass=2 * RPH.mass).bake(), RPH.replace(gravity=None), RPH):
        agree([f(robot, q)], [torchdq.inverse_dynamics(robot, q, backend="eager")])


def test_compiled_graphs_of_one_robot_and_of_a_batch_of_robots_do_not_mix():
    """Their programs differ in nothing but whether an argument is uniform."""
    q, gravity = random(9, 3), RPH.gravity * (1 + random(9, 1).abs())

    def f(q, g, backend="c"):
        return torchdq.inverse_dynamics(RPH.replace(gravity=g), q, backend=backend)

    one = traced(f)
    before = one(q, gravity[0])
    many = torch.compile(f, fullgraph=True, backend="aot_eager")
    agree([many(q, gravity)], [f(q, gravity, "eager")])
    assert torch.equal(one(q, gravity[0]), before)


def test_a_graph_finds_a_derivative_that_this_process_has_not_recorded():
    """As when torch takes the graph from its cache, where another process put it."""
    f = traced(lambda q: torchdq.inverse_dynamics(RPH, q, backend="c"))
    q = random(9, 3).requires_grad_()
    (before,) = torch.autograd.grad(f(q).sum(), q)
    derived = [name for name in autograd._named if ":" in name]
    for name in derived:
        del autograd._named[name]
    assert derived and torch.equal(torch.autograd.grad(f(q).sum(), q)[0], before)


def test_a_graph_of_a_program_that_was_never_recorded_says_so():
    with refused(ArgumentError):
        autograd.operator("0" * 64, [random(1, 1)])


TRACED = {
    "a layer": lambda backend: torchdq.DQRNEA(RPH, backend=backend),
    "a layer that learns": lambda backend: torchdq.DQRNEA(RPH, learn=("mass",), backend=backend),
    "accelerations": lambda backend: lambda q: torchdq.forward_dynamics(RPH, q, q, q, backend=backend),
    "a gradient": lambda backend: torch.func.grad(lambda q: torchdq.kinetic_energy(RPH, q, q, backend=backend).sum()),
    "a batch by vmap": lambda backend: torch.func.vmap(lambda q: torchdq.mass_matrix(RPH, q, backend=backend)),
}


@pytest.mark.parametrize("name", ["a layer", "a layer that learns", "accelerations", "a function of poses"])
def test_torch_jit_trace_refuses_compiled_programs(name):
    """In transforms of torch.func, torch.jit.trace fails by itself."""
    poses = name == "a function of poses"
    x = random(9, 6 if poses else 3)
    for backend in (None, "c"):
        f = torchdq.dq.exp if poses else TRACED[name](backend)
        f(x)  # a call that is known already is refused as well
        with refused(ArgumentError):
            torch.jit.trace(f, (x,), check_trace=False)


TRACES = {
    "jit": lambda f, x: torch.jit.trace(f, (x,)),
    "make_fx": lambda f, x: make_fx(f)(x),
    "make_fx with symbols": lambda f, x: make_fx(f, tracing_mode="symbolic")(x),
}


@pytest.mark.parametrize(
    ("name", "backend", "trace"),
    [
        *((name, None, "make_fx") for name in TRACED),
        *((name, None, "make_fx with symbols") for name in ("a layer", "accelerations")),
        ("a layer", "c", "make_fx"),
        ("a layer", "eager", "jit"),
    ],
)
def test_a_trace_records_what_a_function_computes_and_not_its_result(name, backend, trace):
    x, f = random(9, 3), TRACED[name](backend)
    f(x)
    agree([TRACES[trace](f, x)(2 * x)], [f(2 * x)])


@pytest.mark.parametrize("trace", ["make_fx", "jit"])
def test_a_trace_recomputes_the_rows_of_other_values_in_float64(trace):
    """The arm of the example is bent and needs float32 only, that of the call is stretched and needs float64."""
    light = TWO.replace(mass=torch.tensor([1e-3, 1.0], dtype=F64), inertia=1e-4 * TWO.inertia).bake()
    light = light.replace(com=torch.tensor([[1.0, 0.0, 0.0]] * 2, dtype=F64)).bake()
    bent, stretched = torch.tensor([[0.0, 1.5]]), torch.tensor([[0.3, 0.0]])
    growth = torchdq.error_growth(light, torch.cat([bent, stretched]))
    assert growth[0] < LARGEST_GROWTH.single < growth[1]
    f = lambda q: torchdq.forward_dynamics(light, q, q + 1, q, backend="eager")  # noqa: E731
    agree([TRACES[trace](f, bent)(stretched)], [f(stretched)], factor=1.0)


# --- choosing a backend, and recording no more than needed -----------------------------------------------------------


@pytest.fixture
def ran(monkeypatch):
    """Names of the backends that ran, in order."""
    log: list[str] = []
    for module, name in ((running, "_outputs"), (call, "unguarded")):
        original = getattr(module, name)
        noted = lambda b, *a, original=original: log.append(b.name) or original(b, *a)  # noqa: E731
        monkeypatch.setattr(module, name, noted)
    return log


def test_a_block_chooses_the_backend_and_an_argument_overrides_it(ran):
    q = random(2)
    with torchdq.backend("eager"):
        torchdq.inverse_dynamics(TWO, q)
        torchdq.inverse_dynamics(TWO, q, backend="c")
        with torchdq.backend("c"):
            torchdq.inverse_dynamics(TWO, q)
        torchdq.inverse_dynamics(TWO, q)
    torchdq.inverse_dynamics(TWO, q)
    assert ran == ["eager", "c", "c", "eager", "c"]


def test_a_module_keeps_its_backend(ran):
    q = random(2)
    torchdq.DQRNEA(TWO, backend="eager")(q)
    with torchdq.backend("eager"):
        torchdq.DQRNEA(TWO, backend="c")(q)
    assert ran == ["eager", "c"]


@pytest.fixture
def built(monkeypatch):
    """Names of the programs that were recorded into kernels, of a process that remembers none."""
    torchdq.clear_caches()
    log: list[str] = []
    original = build.load
    monkeypatch.setattr(build, "load", lambda source, name, *a: log.append(name) or original(source, name, *a))
    return log


SHARING = {  # robots and positions whose calls need one kernel
    "new values of a tensor": [(TWO.bake().replace(mass=k * TWO.mass), random(5, 2)) for k in (1.0, 2.0, 3.0)],
    "batches of other sizes": [(TWO.bake(), random(*shape)) for shape in ((2,), (1, 2), (5, 2), (70, 2))],
    "equal robots": [
        (robot, random(5, 7))
        for robot in (*(torchdq.robots.load("panda") for _ in range(2)), PANDA.replace(mass=PANDA.mass).bake())
    ],
}


@pytest.mark.parametrize("name", SHARING)
def test_calls_share_a_kernel_where_nothing_of_the_program_differs(name, built):
    for robot, q in SHARING[name]:
        agree(*([torchdq.inverse_dynamics(robot, q, backend=backend)] for backend in ("c", "eager")))
    assert len(built) == 1


def test_a_robot_that_was_changed_in_place_spoils_no_other():
    changed = TWO.replace(mass=TWO.mass.clone(), inertia=TWO.inertia.clone()).bake()
    q = random(5, 2)
    for x in (changed.mass, changed.inertia):
        x.mul_(2)
    before = torchdq.inverse_dynamics(TWO, q)
    torchdq.clear_caches()
    with refused(torchdq.ArgumentError):
        torchdq.inverse_dynamics(changed, q)
    assert torch.equal(torchdq.inverse_dynamics(TWO, q), before)


def test_what_is_forgotten_is_recorded_again(built):
    q = random(5, 2)
    before = torchdq.inverse_dynamics(TWO, q, backend="c")
    torchdq.inverse_dynamics(TWO, q, backend="c")
    torchdq.clear_caches()
    assert torch.equal(torchdq.inverse_dynamics(TWO, q, backend="c"), before)
    assert built == ["inverse_dynamics_two_link"] * 2


def test_baking_makes_constants(built):
    heavy = TWO.replace(mass=2 * TWO.mass).bake()
    q = random(5, 2)
    assert arguments(heavy) == ()
    agree([torchdq.inverse_dynamics(heavy, q, backend="c")], [2 * torchdq.inverse_dynamics(TWO, q, backend="c")])
    assert "inverse_dynamics_two_link" in built


def test_the_compiler_is_found_without_a_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        torchdq.inverse_dynamics(TWO.bake(), random(2))


# --- ahead of time ---------------------------------------------------------------------------------------------------


def test_a_program_compiled_ahead_is_the_function():
    q, qd, qdd = (random(4, TWO.n, seed=k) for k in range(3))
    compiled = torchdq.compile(TWO, "inverse_dynamics")
    assert torch.equal(compiled(q, qd, qdd), torchdq.inverse_dynamics(TWO, q, qd, qdd))
    x = [t.clone().requires_grad_() for t in (q, qd, qdd)]
    cotangent = torch.ones_like(q)
    expected = torch.autograd.grad(torchdq.inverse_dynamics(TWO, *x), x, cotangent)
    assert all(map(torch.equal, compiled.vjp()(q, qd, qdd, cotangent), expected))
    assert "void run(long samples" in compiled.source("c")


def test_compiled_functions_have_the_options_of_the_public_ones():
    panda, q = torchdq.robots.load("panda"), random(4, 7)
    whole = torchdq.compile(panda, "forward_kinematics")(q)
    assert torch.equal(whole, torchdq.forward_kinematics(panda, q).flatten(-2))
    J = torchdq.compile(panda, "jacobian", options="tip")(q)
    assert torch.equal(J, torchdq.jacobian(panda, q, "tip").flatten(-2))
    assert len(torchdq.compile(panda, "closed_form")(q, q)) == len(torchdq.closed_form(panda, q, q))


OPTIONS = (
    ("jacobian", ()),
    ("jacobian", ("tip", "local")),
    ("jacobian", ("hand",)),
    ("jacobian", ("tip", "body", "world")),
    ("forward_kinematics", ("hand",)),
    ("closed_form", ("hand",)),
    ("closed_form", ("tip", "")),
    ("computed_torque", ("ki",)),
    ("inverse_dynamics", ("tip",)),
    ("inverse_dynamics", 3),
)
MISUSE = {
    "backend of a call": lambda: torchdq.inverse_dynamics(TWO, random(2), backend="fast"),
    "backend of a block": lambda: torchdq.backend("fast").__enter__(),
    "function": lambda: torchdq.compile(TWO, "inverse_dynamic"),
    "name of an argument": lambda: torchdq.compile(TWO, "inverse_dynamics", arguments=("q", "f_tips")),
    "arguments without names": lambda: torchdq.compile(TWO, "inverse_dynamics", arguments=[1, 2]),
    "width": lambda: torchdq.compile(TWO, "inverse_dynamics")(random(4, 2), random(4, 3), random(4, 2)),
    "no tensors": lambda: torchdq.compile(TWO, "inverse_dynamics")([1.0], 2, 3),
    **{f"{name} {given}": partial(torchdq.compile, PANDA, name, options=given) for name, given in OPTIONS},
}


@pytest.mark.parametrize("name", MISUSE)
def test_what_means_nothing_is_refused_by_name(name):
    with refused((ArgumentError, UnknownNameError)):
        MISUSE[name]()


def test_the_name_of_one_argument_need_not_be_in_a_sequence():
    assert [a.name for a in torchdq.compile(TWO, "inverse_dynamics", arguments="q").program.arguments] == ["q"]


@pytest.mark.parametrize("function", RECIPES)
def test_a_compiled_program_needs_its_arguments(function):
    options = ["tip"] if function in ("jacobian", "floating.jacobian") else ()
    if function.startswith(("operational", "cartesian", "manipulability", "inverse_kin", "differential")):
        options = ["tip", "body", "x y"]
    others = [name for name, _, optional in RECIPES[function].arguments if not optional][:-1]
    robot = free(TWO) if function.startswith(FLOATING) else TWO
    with refused(ArgumentError):
        torchdq.compile(robot, function, arguments=others, options=options)


# --- other processors ------------------------------------------------------------------------------------------------


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the flags are those of x86")
@pytest.mark.parametrize("flags", [("-mno-avx512f",), ("-mno-avx512f", "-mno-avx")], ids=["32 bytes", "16 bytes"])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_narrower_vectors_compute_the_same(monkeypatch, flags, dtype):
    recorded = torchdq.compile(TWO, "forward_dynamics").program
    x = [random(37, TWO.n, seed=k, dtype=dtype) for k in range(3)]
    monkeypatch.setattr(build, "FLAGS", (*build.FLAGS, *flags))
    found, _ = CompiledKernel(recorded, dtype)(x, 37)
    (expected,) = eager(recorded, x)
    # without fused multiplication and addition some roundings differ
    assert (found - expected).abs().max() <= 256 * torch.finfo(dtype).eps * expected.abs().max()


# --- tensors whose memory is not what they are -----------------------------------------------------------------------


def test_views_with_a_sign_of_their_own_are_read_with_it():
    q = random(5, 7)
    negated = torch._neg_view(-q)
    turned = torch.complex(torch.zeros(7, dtype=F64), -q[0]).conj().imag
    assert negated.is_neg() and turned.is_neg()
    for function in (torchdq.inverse_dynamics, torchdq.mass_matrix, torchdq.forward_kinematics):
        expected = function(PANDA, q, backend="c")
        assert torch.equal(function(PANDA, negated, backend="c"), expected)
        assert torch.equal(function(PANDA, turned, backend="c"), function(PANDA, q[0], backend="c"))
    x = q.clone().requires_grad_()
    found, expected = (
        torch.autograd.grad(torchdq.inverse_dynamics(PANDA, x, backend="c"), x, d)[0] for d in (negated, q)
    )
    assert torch.equal(found, expected)


def test_zeros_without_memory_are_zeros():
    found = torchdq.inverse_dynamics(PANDA, torch._efficientzerotensor((4, 7), dtype=F64), backend="c")
    assert torch.equal(found, torchdq.inverse_dynamics(PANDA, torch.zeros(4, 7, dtype=F64), backend="c"))


def test_tensors_without_values_give_tensors_without_values():
    with FakeTensorMode():
        q = torch.randn(3, 7, dtype=F64)
        for function in (torchdq.inverse_dynamics, torchdq.mass_matrix, torchdq.forward_kinematics):
            found = function(PANDA, q)
            assert isinstance(found, FakeTensor) and found.shape[0] == 3


def test_a_counter_of_operations_does_not_change_the_numbers():
    q = random(5, 7)
    expected = torchdq.inverse_dynamics(PANDA, q)
    with FlopCounterMode(display=False):
        assert torch.equal(torchdq.inverse_dynamics(PANDA, q), expected)


def test_forward_derivatives_in_one_batch_of_directions():
    q = random(2)
    function = lambda q: torchdq.inverse_dynamics(TWO, q, backend="c")  # noqa: E731
    jacobian = torch.autograd.functional.jacobian
    found = jacobian(function, q, vectorize=True, strategy="forward-mode")
    torch.testing.assert_close(found, jacobian(function, q), rtol=1e-12, atol=1e-12)
