"""Second derivatives of the dynamics against differences of first ones, and against two backward passes of torch."""

import pytest
import torch
from closed_loops import four_bar
from helpers import all_in_one, random, thinned
from messages import refused
from oracles import random_tree
from robots import F64, on_free_base, panda, two

import torchdq
from torchdq import ArgumentError
from torchdq.errors import TorchdqError

OF = ("inverse", "forward")
FUNCTIONS = {"inverse": torchdq.inverse_dynamics, "forward": torchdq.forward_dynamics}
ROBOTS = {"two_link": two, "panda": panda, "a tree": lambda: random_tree(4, 0).robot}


def slopes(robot, z, of):
    """First derivatives [..., n, 3n] of torques, or of accelerations by those of the torques at them."""
    q, qd, last = z.split(robot.n, -1)
    if of == "inverse":
        return torch.cat(torchdq.dynamics_jacobian(robot, q, qd, last), -1)
    dq, dqd, M = torchdq.dynamics_jacobian(robot, q, qd, torchdq.forward_dynamics(robot, q, qd, last))
    return M.inverse() @ torch.cat((-dq, -dqd, torch.eye(robot.n, dtype=F64).expand_as(M)), -1)


def close(found, expected, tolerance):
    assert found.shape == expected.shape
    assert (found - expected).abs().max() <= tolerance * expected.abs().max()


CASES = thinned([(name, of) for name in ROBOTS for of in OF], [("a tree", of) for of in OF])


@pytest.mark.parametrize(("name", "of"), CASES)
def test_second_derivatives_are_the_limits_of_differences(name, of):
    robot, h = ROBOTS[name](), 1e-5
    z = random(2, 3 * robot.n)
    H, J = torchdq.dynamics_hessian(robot, *z.split(robot.n, -1), of=of)
    close(J, slopes(robot, z, of), 1e-10)
    steps = h * torch.eye(3 * robot.n, dtype=F64)
    columns = [(slopes(robot, z + step, of) - slopes(robot, z - step, of)) / (2 * h) for step in steps]
    close(H, torch.stack(columns, -1), 1e-7)
    assert torch.equal(H, H.mT)
    n = robot.n
    assert not H[..., 2 * n :, n:].any()


@pytest.mark.parametrize(("name", "of"), CASES)
def test_weighted_ones_are_those_of_two_backward_passes(name, of):
    robot = ROBOTS[name]()
    robot = robot.replace(mass=robot.mass * (1 + random(3, 1).abs()))  # a batch of robots
    n = robot.n
    z, weight = random(2, 1, 3 * n).expand(2, 3, 3 * n).clone().requires_grad_(), random(3, n, seed=1)
    f = FUNCTIONS[of](robot, *z.split(n, -1))
    (slope,) = torch.autograd.grad((weight * f).sum(), z, create_graph=True)
    expected = [torch.autograd.grad(slope[..., k].sum(), z, retain_graph=True)[0] for k in range(3 * n)]
    given = [x[:, :1].detach() for x in z.split(n, -1)]
    H, J = torchdq.dynamics_hessian(robot, *given, weight, of)
    close(H, torch.stack(expected, -1), 1e-10)
    close((weight[..., None, :] @ J)[..., 0, :], slope.detach(), 1e-11)
    close(H, torch.einsum("bi,abijk->abjk", weight, torchdq.dynamics_hessian(robot, *given, of=of).H), 1e-11)
    assert torch.equal(H, H.mT)


@all_in_one(ROBOTS)
def test_derivatives_of_the_mass_matrix(name):
    robot, h = ROBOTS[name](), 1e-5
    n, q = robot.n, random(3, robot.n)
    found = torchdq.mass_matrix_derivative(robot, q)
    steps = h * torch.eye(n, dtype=F64)
    columns = [(torchdq.mass_matrix(robot, q + s) - torchdq.mass_matrix(robot, q - s)) / (2 * h) for s in steps]
    close(found, torch.stack(columns, -1), 1e-8)
    assert torch.equal(found, found.transpose(-3, -2))
    H = torchdq.dynamics_hessian(robot, q, q, q).H
    close(H[..., 2 * n :, :n], found, 1e-12)


def test_third_derivatives():
    z = random(3, 2, 2)
    for of in OF:
        leaves = [x.requires_grad_() for x in (*z.clone(), torch.ones(2, dtype=F64))]
        assert torch.autograd.gradcheck(lambda *x, of=of: torchdq.dynamics_hessian(two(), *x, of).H, leaves)
    assert torch.autograd.gradcheck(lambda q: torchdq.mass_matrix_derivative(two(), q), z[0].clone().requires_grad_())


def test_compiled_programs_with_and_without_weights():
    robot = two()
    z, weight = random(3, 4, 2), random(2)
    for of, name, last in (("inverse", "dynamics_hessian", "qdd"), ("forward", "forward_dynamics_hessian", "tau")):
        weighted = torchdq.compile(robot, name)
        each = torchdq.compile(robot, name, arguments=("q", "qd", last))
        for program, more in ((weighted, (weight.expand(4, 2),)), (each, ())):
            expected = torchdq.dynamics_hessian(robot, *z, *more, of=of)
            assert program.axes == tuple(tuple(x.shape[1:]) for x in expected)
            for x, y in zip(program(*z, *more), expected, strict=True):
                torch.testing.assert_close(x.reshape(y.shape), y, rtol=1e-12, atol=1e-12)


def test_accelerations_that_would_lose_digits_in_single_precision_are_computed_in_double():
    robot = two()
    robot = robot.replace(mass=robot.mass * torch.tensor([1e-5, 1.0], dtype=F64), inertia=1e-5 * robot.inertia)
    z, weight = random(3, 5, 2), random(5, 2)
    z[0, :, 1] *= 0.01  # nearly straight
    given = [x.float() for x in (*z, weight)]
    assert (torchdq.error_growth(robot, z[0]) > 2**10).all()
    expected = torchdq.dynamics_hessian(robot, *[x.double() for x in given], "forward")
    for found, exact in zip(torchdq.dynamics_hessian(robot, *given, "forward"), expected, strict=True):
        close(found.double(), exact, 1e-6)


@pytest.mark.parametrize("function", [torchdq.dynamics_hessian, torchdq.mass_matrix_derivative])
def test_robots_that_are_not_served_are_refused(function):
    q = torch.zeros(2, dtype=F64)
    rows = (q, q, q) if function is torchdq.dynamics_hessian else (q,)
    with refused(ArgumentError):
        function(on_free_base(two()), *rows)
    if len(rows) > 1:
        loop = torch.zeros(3, dtype=F64)
        with refused(ArgumentError):
            function(four_bar(), loop, loop, loop)
        with refused(ArgumentError):
            function(two(), *rows, weight=torch.zeros(3, dtype=F64))
        with refused(TorchdqError):
            function(two(), *rows, of="backward")
