"""Graphs that torch traces: they compute what the function does, of the robot and the values of each call."""

import pytest
import torch
from helpers import random
from host_gpu import host_backends  # noqa: F401
from messages import refused
from programs import TWO, agree
from torch.fx.experimental.proxy_tensor import make_fx

import torchdq
from torchdq.backends import c_library as build
from torchdq.errors import ArgumentError
from torchdq.program import autograd
from torchdq.program.program import LARGEST_GROWTH

F64 = torch.float64
BACKEND = "auto"
pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")


def traced(function):
    torch._dynamo.reset()
    return torch.compile(function, fullgraph=True, backend="aot_eager")


def test_a_compiled_graph_is_not_served_the_program_of_another_robot():
    f = traced(lambda robot, q: torchdq.inverse_dynamics(robot, q, backend="c"))
    q = random(9, 2)
    for robot in (TWO, TWO.replace(mass=2 * TWO.mass).bake(), TWO):
        agree([f(robot, q)], [torchdq.inverse_dynamics(robot, q, backend="eager")])


def test_compiled_graphs_of_one_robot_and_of_a_batch_of_robots_do_not_mix():
    """Their programs differ in nothing but whether an argument is uniform."""
    q, gravity = random(9, 2), TWO.gravity * (1 + random(9, 1).abs())

    def f(q, g, backend="c"):
        return torchdq.inverse_dynamics(TWO.replace(gravity=g), q, backend=backend)

    one = traced(f)
    before = one(q, gravity[0])
    many = torch.compile(f, fullgraph=True, backend="aot_eager")
    agree([many(q, gravity)], [f(q, gravity, "eager")])
    assert torch.equal(one(q, gravity[0]), before)


def test_a_graph_finds_a_derivative_that_this_process_has_not_recorded():
    """As when torch takes the graph from its cache, where another process put it."""
    f = traced(lambda q: torchdq.inverse_dynamics(TWO, q, backend="c"))
    q = random(9, 2).requires_grad_()
    (before,) = torch.autograd.grad(f(q).sum(), q)
    derived = [name for name in autograd._named if ":" in name]
    for name in derived:
        del autograd._named[name]
    assert derived and torch.equal(torch.autograd.grad(f(q).sum(), q)[0], before)


def test_a_graph_of_a_program_that_was_never_recorded_says_so():
    with refused(ArgumentError):
        autograd.operator("0" * 64, [random(1, 1)])


TRACED = {
    "a layer": lambda backend: torchdq.DQRNEA(TWO, backend=backend),
    "a layer that learns": lambda backend: torchdq.DQRNEA(TWO, learn=("mass",), backend=backend),
    "accelerations": lambda backend: lambda q: torchdq.forward_dynamics(TWO, q, q, q, backend=backend),
    "a gradient": lambda backend: torch.func.grad(lambda q: torchdq.kinetic_energy(TWO, q, q, backend=backend).sum()),
    "a batch by vmap": lambda backend: torch.func.vmap(lambda q: torchdq.mass_matrix(TWO, q, backend=backend)),
}


@pytest.mark.parametrize("name", ["a layer", "a layer that learns", "accelerations", "a function of poses"])
def test_torch_jit_trace_refuses_compiled_programs(name):
    """In transforms of torch.func, torch.jit.trace fails by itself."""
    poses = name == "a function of poses"
    x = random(9, 6 if poses else 2)
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
        *((name, None, "make_fx with symbols") for name in ("accelerations",)),
        ("a layer", "c", "make_fx"),
        ("a layer", "eager", "jit"),
    ],
)
def test_a_trace_records_what_a_function_computes_and_not_its_result(name, backend, trace):
    x, f = random(9, 2), TRACED[name](backend)
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
    f(bent)  # torch counts the names of tensors, also of those that the first call takes apart
    agree([TRACES[trace](f, bent)(stretched)], [f(stretched)], factor=1.0)
