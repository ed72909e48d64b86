"""Derivatives of compiled programs, and transforms of torch.func, against differences and torch operations."""

import pytest
import torch
from helpers import random, thinned
from host_gpu import host_backends  # noqa: F401
from oracles import states
from programs import PANDA, TWO, agree, on, same, tree
from torch.autograd import gradcheck, gradgradcheck

import torchdq
from torchdq.backends import c_library as build
from torchdq.backends import precision as running
from torchdq.backends.c import COMPILED
from torchdq.backends.fast_call import FAST

F64 = torch.float64
BACKEND = "auto"
pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")

RPH = tree(3).bake()


ID, FD = torchdq.inverse_dynamics, torchdq.forward_dynamics


@pytest.mark.parametrize(
    "backend, function, robot",  # the kernels of the GPU backend are compiled for the host here
    thinned(
        [(backend, f, robot) for backend in ("c", "host") for f in (ID, FD) for robot in (TWO, RPH)],
        [("c", ID, RPH), ("host", FD, TWO)],
    ),
    ids=lambda x: getattr(x, "__name__", getattr(x, "name", x)),
)
def test_derivatives_are_finite_differences(backend, function, robot):
    x = tuple(0.5 * random(3, robot.n, seed=k).requires_grad_() for k in range(3))

    def f(*x):
        return function(robot, *x, backend=backend)

    assert gradcheck(f, x, eps=1e-6, atol=1e-7, rtol=1e-6, check_forward_ad=True, check_batched_grad=True)
    assert gradgradcheck(f, x, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)


LEARNED = ("com", "inertia", "gravity", "armature", "home", "X_PB_home", "screw")


@pytest.mark.parametrize("learn", thinned([("mass",), LEARNED], [LEARNED]), ids=str)
def test_gradients_of_what_is_learned_equal_torch_operations(learn):
    s, layer = states(RPH, 70), torchdq.DQRNEA(RPH.replace(armature=torch.ones(3, dtype=F64)), learn=learn)
    gradients = {}
    for backend in ("c", "host", "backwards", "eager"):
        x = [v.clone().requires_grad_() for v in s[:3]]
        with torchdq.backend(backend):
            total = (layer(*x, s.f_tip) ** 2).sum()
            gradients[backend] = torch.autograd.grad(total, (*x, *layer.parameters()))
    for backend in ("c", "host"):
        agree(gradients[backend], gradients["eager"], 1024)
    same(gradients["backwards"], gradients["host"])


def tau(q, qd, qdd):
    return torchdq.inverse_dynamics(TWO, q, qd, qdd)


def beside_a_constant(q, qd, qdd):
    """Gradient of a Jacobian of a product, with a factor that is a constant for both."""
    mass = TWO.mass.clone().requires_grad_()

    def product(q):
        with torch.no_grad():
            factor = torchdq.inverse_dynamics(TWO.replace(mass=mass), q, qd, qdd)
        return (factor * torchdq.inverse_dynamics(TWO.replace(mass=mass), q, qd, qdd)).sum()

    return torch.autograd.grad(torch.func.jacrev(product)(q).sum(), mass)


def after_its_transform(q, qd, qdd):
    """Products with a Jacobian of Jacobians, when the transforms have ended and torch records nothing."""
    _, pull = torch.func.vjp(torch.func.vmap(torch.func.jacrev(tau)), q, qd, qdd)
    with torch.no_grad():
        return pull(torch.ones(6, 2, 2, dtype=F64))


TRANSFORMS = {
    "vmap": lambda q, qd, qdd: torch.func.vmap(tau, in_dims=(0, None, 1))(q, qd[0], qdd.mT),
    "vmap of vmap": lambda *x: torch.func.vmap(torch.func.vmap(tau))(*(v.unflatten(0, (2, 3)) for v in x)),
    "jacrev of jacfwd": lambda *x: torch.func.jacrev(torch.func.jacfwd(tau))(*(v[0] for v in x)),
    "jvp": lambda *x: torch.func.jvp(tau, x, (x[1], x[2], x[0])),
    "gradient of jvp": lambda *x: torch.func.vjp(
        lambda q, v: torch.func.jvp(lambda q: tau(q, x[1], x[2]), (q,), (v,))[1], x[0], x[1]
    )[1](x[2]),
    "hessian": lambda *x: torch.func.vmap(torch.func.hessian(tau))(*x),
    "jacrev of jacrev": lambda *x: torch.func.vmap(torch.func.jacrev(torch.func.jacrev(tau)))(*x),
    "vmap in a gradient in vmap": lambda q, qd, qdd: torch.func.vmap(
        torch.func.grad(lambda v: torch.func.vmap(tau, in_dims=(0, None, 0))(q, v, qdd).square().sum())
    )(qd),
    "second derivatives in masses": lambda q, qd, qdd: torch.func.vmap(
        torch.func.hessian(lambda m, q: torchdq.inverse_dynamics(TWO.replace(mass=m), q, qd, qdd).square().sum()),
        in_dims=(None, 0),
    )(TWO.mass, q),
    "a constant in gradients": beside_a_constant,
    "vjp after its transform": after_its_transform,
    "functionalize in vmap": lambda *x: torch.func.functionalize(torch.func.vmap(tau))(*x),
    "third derivative": lambda *x: torch.func.jacrev(torch.func.jacfwd(torch.func.jacrev(tau)))(*(v[0] for v in x)),
}


NESTED = ("hessian", "a constant in gradients", "vmap in a gradient in vmap", "vjp after its transform")
NESTED += ("second derivatives in masses", "functionalize in vmap")


@pytest.mark.case("P3")
@pytest.mark.parametrize(
    "name", thinned(TRANSFORMS, ("vmap", "vmap of vmap", "gradient of jvp", "third derivative", *NESTED))
)
def test_transforms_equal_torch_operations(name):
    x = [random(6, 2, seed=k) for k in range(3)]
    agree(on("c", TRANSFORMS[name], *x), on("eager", TRANSFORMS[name], *x), 1024)


@pytest.mark.parametrize("name", ["hessian", "jacrev of jacrev", "second derivatives in masses"])
def test_second_derivatives_under_transforms_run_compiled_programs(name, monkeypatch):
    monkeypatch.setattr(running.Guarded, "by_torch", property(lambda self: pytest.fail("run as torch operations")))
    batches = []
    FAST.clear()  # whose calls ask for no kernel, and to learn one asks for it once more
    monkeypatch.setattr(running, "learn", lambda *call, **how: None)
    kernel = type(COMPILED).kernel
    monkeypatch.setattr(type(COMPILED), "kernel", lambda *of: batches.append(of[1].name) or kernel(*of))
    on("c", TRANSFORMS[name], *[random(6, 2, seed=k) for k in range(3)])
    assert batches and len(batches) <= 5  # of a program and its derivatives, each at once


def test_gradients_in_a_batch_are_those_one_by_one_to_any_order(monkeypatch):
    monkeypatch.setattr(running.Guarded, "by_torch", property(lambda self: pytest.fail("run as torch operations")))
    mass, *x = [v.requires_grad_() for v in (TWO.mass.clone(), *[random(6, 2, seed=k) for k in range(3)])]
    leaves = (mass, *x)

    def slopes(y, directions):
        batch = torch.autograd.grad(y, leaves, directions, is_grads_batched=True, create_graph=True)
        rows = [torch.autograd.grad(y, leaves, d, create_graph=True) for d in directions]
        agree(batch, [torch.stack(of) for of in zip(*rows, strict=True)], 1024)
        return batch

    y = torchdq.inverse_dynamics(TWO.replace(mass=mass), *x, backend="c")
    first = slopes(y, random(3, 6, 2))
    second = slopes(first[1], random(4, 3, 6, 2))
    slopes(second[2], random(2, 4, 6, 2))


@pytest.mark.case("P3")
def test_vmap_over_robots_equals_their_batch():
    mass, q = RPH.mass * (1 + random(5, 1).abs()), random(5, 3)
    mapped = torch.func.vmap(lambda m, q: torchdq.inverse_dynamics(RPH.replace(mass=m), q, backend="c"))(mass, q)
    agree([mapped], [torchdq.inverse_dynamics(RPH.replace(mass=mass), q, backend="eager")], 256)


def test_nothing_but_the_inputs_is_kept_for_backward():
    x = [random(50, 7, seed=k).requires_grad_() for k in range(3)]
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t) or t, lambda t: t):
        torchdq.inverse_dynamics(PANDA, *x, backend="c")
    assert sum(t.numel() for t in kept) == sum(v.numel() for v in x)
    assert {t.data_ptr() for t in kept} == {v.data_ptr() for v in x}


def test_forward_derivatives_in_one_batch_of_directions():
    q = random(2)
    function = lambda q: torchdq.inverse_dynamics(TWO, q, backend="c")  # noqa: E731
    jacobian = torch.autograd.functional.jacobian
    found = jacobian(function, q, vectorize=True, strategy="forward-mode")
    torch.testing.assert_close(found, jacobian(function, q), rtol=1e-12, atol=1e-12)
