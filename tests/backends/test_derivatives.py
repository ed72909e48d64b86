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
@pytest.mark.parametrize("name", thinned(TRANSFORMS, ("vmap", "vmap of vmap", "gradient of jvp", "third derivative")))
def test_transforms_equal_torch_operations(name):
    x = [random(6, 2, seed=k) for k in range(3)]
    agree(on("c", TRANSFORMS[name], *x), on("eager", TRANSFORMS[name], *x), 1024)


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
