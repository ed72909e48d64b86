"""The path from tensors to a program and back, for a computation that is none of the package's."""

from typing import NamedTuple

import pytest
import torch
from helpers import random, thinned
from messages import refused

from torchdq.backends import c_library as build
from torchdq.backends.call import Computation, evaluate
from torchdq.errors import ArgumentError, DtypeError
from torchdq.program.program import record

F32, F64 = torch.float32, torch.float64
WIDTHS = {"force": 3, "push": 3, "mass": 1, "damping": 2}

compiles = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")
every_backend = pytest.mark.parametrize("backend", ["eager", pytest.param("c", marks=compiles)])


class _Fields(NamedTuple):
    factor: float


class Point(_Fields, Computation):
    """Acceleration and power of a point whose mass may be shared."""

    def axes(self, name):
        if name not in WIDTHS:
            raise ArgumentError(f"{name} is no input of a point; it has {', '.join(WIDTHS)}")
        return (WIDTHS[name],) if name != "mass" else ()

    def shared(self, name):
        return name in ("mass", "damping")

    def subject(self):
        return " for a point"

    def check(self, tensors):
        if "force" not in tensors:
            raise ArgumentError("force must be given")

    def program(self, arguments):
        def algorithm(*rows):
            given = {a.name: row for a, row in zip(arguments, rows, strict=True)}
            push = given.get("push", (0.0,) * 3)
            a = [self.factor * (f + p) / given["mass"][0] for f, p in zip(given["force"], push, strict=True)]
            return {"a": a, "total": [sum(a, 0.0)]}

        return record("point", arguments, algorithm)


def expected(force, mass, push=0.0):
    a = 2.0 * (force + push) / mass[..., None]
    return a, a.sum(-1, keepdim=True)


def close(found, reference):
    for y, e in zip((found["a"], found["total"]), reference, strict=True):
        assert y.dtype == e.dtype and y.shape == e.shape
        torch.testing.assert_close(y, e, rtol=1e-5 if y.dtype == F32 else 1e-13, atol=0)


@every_backend
@pytest.mark.parametrize("batch", [(), (4,), (5, 1)], ids=str)
def test_results_go_by_name_and_have_the_batch_axes_of_all(batch, backend):
    force, mass = random(4, 3), 1.0 + random(*batch, 1, seed=1).abs().squeeze(-1)
    close(evaluate(Point(2.0), {"force": force, "push": None, "mass": mass}, backend), expected(force, mass))
    push = random(3, seed=2)
    close(evaluate(Point(2.0), {"force": force, "push": push, "mass": mass}, backend), expected(force, mass, push))


@every_backend
def test_a_parameter_follows_the_dtype_of_the_inputs(backend):
    force, mass = random(4, 3, dtype=F32), torch.tensor(3.0, dtype=F64)
    close(evaluate(Point(2.0), {"force": force, "mass": mass}, backend), expected(force, mass.float()))


@every_backend
def test_double_precision_inside_is_float64_rounded(backend):
    force, mass = random(64, 3, dtype=F32), torch.tensor(3.0, dtype=F32)
    single = evaluate(Point(2.0), {"force": force, "mass": mass}, backend)
    narrow = evaluate(Point(2.0), {"force": force, "mass": mass}, backend, double=True)
    wide = evaluate(Point(2.0), {"force": force.double(), "mass": mass.double()}, backend)
    assert all(torch.equal(narrow[name], wide[name].float()) for name in wide)
    assert not torch.equal(single["total"], narrow["total"])


@every_backend
def test_gradients_transforms_and_traced_graphs_go_through(backend):
    force, mass = random(4, 3), torch.tensor(3.0, dtype=F64)

    def acceleration(force, mass):
        return evaluate(Point(2.0), {"force": force, "mass": mass}, backend)["a"]

    assert torch.autograd.gradcheck(acceleration, (force.requires_grad_(), mass.requires_grad_()))
    force, mass = force.detach(), mass.detach()
    assert torch.equal(torch.func.vmap(acceleration, in_dims=(0, None))(force, mass), acceleration(force, mass))
    for dynamic in thinned((False, True), (True,)):
        torch._dynamo.reset()
        graph = torch.compile(acceleration, fullgraph=True, backend="aot_eager", dynamic=dynamic)
        assert torch.equal(graph(force, mass), acceleration(force, mass))


@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"force": [1.0]}, ArgumentError),
        ({"force": random(4, 2)}, ArgumentError),
        ({"push": random(3, dtype=F32)}, DtypeError),
        ({"push": random(5, 3)}, ArgumentError),
        ({"pull": random(3)}, ArgumentError),
        ({"force": None}, ArgumentError),
    ],
)
def test_what_does_not_fit_is_named(wrong, error):
    with refused(error):
        evaluate(Point(2.0), {"force": random(4, 3), "mass": torch.tensor(1.0), **wrong})


def test_computations_with_other_fields_do_not_share_a_program():
    given = {"force": random(4, 3), "mass": torch.tensor(1.0)}
    assert torch.equal(2.0 * evaluate(Point(2.0), given)["a"], evaluate(Point(4.0), given)["a"])
