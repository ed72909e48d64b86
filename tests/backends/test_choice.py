"""Which backend runs, programs that calls share, and functions compiled ahead."""

import warnings
from functools import partial

import pytest
import torch
from helpers import all_in_one, random
from host_gpu import host_backends  # noqa: F401
from kinds_of_programs import free
from messages import refused
from programs import PANDA, TWO, agree

import torchdq
from torchdq.backends import c_library as build
from torchdq.backends import call
from torchdq.backends import precision as running
from torchdq.backends.fast_call import FAST
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.catalogue import FLOATING, RECIPES
from torchdq.robot.robot import arguments

F64 = torch.float64
BACKEND = "auto"
pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")


# --- choosing a backend, and recording no more than needed -----------------------------------------------------------


@pytest.fixture
def ran(monkeypatch):
    """Names of the backends that ran, in order; no call is known, which would run by itself."""
    log: list[str] = []
    FAST.clear()
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
    FAST.clear()  # the call in the block of "c" is known by now
    torchdq.inverse_dynamics(TWO, q)
    assert ran == ["eager", "c", "c", "eager", "c"]
    torchdq.DQRNEA(TWO, backend="eager")(q)  # a module keeps its own
    with torchdq.backend("eager"):
        torchdq.DQRNEA(TWO, backend="c")(q)
    assert ran[5:] == ["eager", "c"]


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
    assert "void run(word samples" in compiled.source("c")


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


@all_in_one(MISUSE)
def test_what_means_nothing_is_refused_by_name(name):
    with refused((ArgumentError, UnknownNameError)):
        MISUSE[name]()


def test_the_name_of_one_argument_need_not_be_in_a_sequence():
    assert [a.name for a in torchdq.compile(TWO, "inverse_dynamics", arguments="q").program.arguments] == ["q"]


@all_in_one(RECIPES)
def test_a_compiled_program_needs_its_arguments(function):
    options = ["tip"] if function in ("jacobian", "floating.jacobian") else ()
    if function.startswith(("operational", "cartesian", "manipulability", "inverse_kin", "differential")):
        options = ["tip", "body", "x y"]
    others = [field.name for field in RECIPES[function].arguments if not field.optional][:-1]
    robot = free(TWO) if function.startswith(FLOATING) else TWO
    with refused(ArgumentError):
        torchdq.compile(robot, function, arguments=others, options=options)
