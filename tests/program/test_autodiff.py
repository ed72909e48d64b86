"""Derivatives of the dynamics: right, complete, and the same whichever way torch takes them.

Three kinds of evidence: finite differences (gradcheck, gradgradcheck) in every input and every physical parameter,
Pinocchio's analytic derivatives on robots of its own, and identities (d tau / d qdd = M, forward mode = reverse mode).
Finite differences compare a function with itself, so only Pinocchio and the identities would see a wrong formula.
"""

from functools import cache
from itertools import count

import numpy as np
import pinocchio as pin
import pytest
import torch
from oracles import random_tree
from torch.autograd import gradcheck, gradgradcheck
from torch.func import jacfwd, jacrev

import torchdq

F64 = torch.float64
EPS = 2.0**-52
PARAMETERS = ("mass", "com", "inertia", "gravity", "armature", "home", "X_PB_home", "screw")
# step 1e-6: truncation 1e-12, rounding eps |f| / step = 2e-10 |f|, with torques up to 50 N m
FIRST = {"eps": 1e-6, "atol": 1e-8, "rtol": 1e-6}
SECOND = {"eps": 1e-6, "atol": 1e-7, "rtol": 1e-5, "fast_mode": True}


# --- robots and states -----------------------------------------------------------------------------------------------


def random(seed):
    g = torch.Generator().manual_seed(seed)
    return lambda *shape: torch.randn(shape, dtype=F64, generator=g)


@cache
def case(n):
    """Random tree of n joints of all kinds, from four on with a branch, with rotors and tilted gravity."""
    for found in (random_tree(n, seed, armature=True) for seed in count()):
        branched = len(set(found.robot.parents)) < n
        if len(set(found.robot.kinds)) == 3 and branched == (n > 3):
            return found


def tree():
    """Four joints, of which entries of M and J are absent."""
    return case(4).robot


def chain():
    """Three joints, one of each kind, home at zero."""
    return case(3).robot.replace(home=None)


def state(robot, name, seed=0):
    """All inputs of the dynamics, in a random state or at rest in the home position."""
    draw, n = random(seed), robot.n
    inputs = {"q": draw(n), "qd": draw(n), "qdd": draw(n), "tau": draw(n), "f_tip": draw(6), "f_ext": draw(n, 6)}
    if name == "home":
        inputs["q"] = torch.zeros(n, dtype=F64) if robot.home is None else robot.home.clone()
        inputs["qd"] = torch.zeros(n, dtype=F64)
    return inputs


STATES = ("random", "home")
FUNCTIONS = {
    "inverse_dynamics": (torchdq.inverse_dynamics, "q qd qdd f_tip f_ext"),
    "forward_dynamics": (torchdq.forward_dynamics, "q qd tau f_tip f_ext"),
    "mass_matrix": (torchdq.mass_matrix, "q"),
    "closed_form": (torchdq.closed_form, "q qd"),
    "forward_kinematics": (torchdq.forward_kinematics, "q"),
    "jacobian": (lambda robot, q: torchdq.jacobian(robot, q, "tip"), "q"),
    "jacobian in world axes": (lambda robot, q: torchdq.jacobian(robot, q, "tip", "world"), "q"),
    "regressor": (torchdq.regressor, "q qd qdd"),
    "kinetic_energy": (torchdq.kinetic_energy, "q qd"),
    "potential_energy": (torchdq.potential_energy, "q"),
    "inertial_parameters": (lambda robot: robot.inertial_parameters, ""),
    "computed_torque": (
        lambda robot, q, qd, qdd, tau, f_tip: torchdq.computed_torque(robot, q, qd, tau, qd, qdd, 9.0, 6.0, f_tip),
        "q qd qdd tau f_tip",
    ),
}
CASES = [(key, name) for key, (_, names) in FUNCTIONS.items() for name in [*names.split(), *PARAMETERS]]


def outputs(robot, key, inputs):
    """Results of a function as a tuple."""
    f, names = FUNCTIONS[key]
    result = f(robot, *(inputs[name] for name in names.split()))
    return (result,) if isinstance(result, torch.Tensor) else tuple(result)


def in_one(robot, key, name, inputs):
    """A function of one of its inputs or of one of the robot's parameters, and where it is taken."""
    if name in inputs:
        return lambda x: outputs(robot, key, inputs | {name: x}), inputs[name]
    return lambda x: outputs(robot.replace(**{name: x}, on_unphysical="ignore"), key, inputs), getattr(robot, name)


def flat(tensors):
    return torch.cat([x.flatten() for x in tensors])


def relative(a, b):
    return float((a - b).abs().max() / b.abs().max())


# --- finite differences ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("where", STATES)
@pytest.mark.parametrize(("key", "name"), CASES)
def test_first_derivatives_are_those_of_finite_differences(key, name, where):
    robot = tree()
    f, x = in_one(robot, key, name, state(robot, where))
    x = x.clone().requires_grad_()
    reached = [i for i, y in enumerate(f(x)) if y.requires_grad]
    if reached:
        # fast mode compares the Jacobian between two random vectors, so that no entry can be wrong unnoticed
        assert gradcheck(lambda x: flat(f(x)[i] for i in reached), x, fast_mode=True, **FIRST)
    # a result that autograd does not connect to x must not depend on it
    moved = f(x.detach() + 0.1)
    assert all(torch.equal(a, b) for i, (a, b) in enumerate(zip(f(x), moved, strict=True)) if i not in reached)


def test_the_dynamics_jacobian_is_differentiable():
    robot, inputs = chain(), state(chain(), "random")
    at = [inputs["q"], inputs["qd"], inputs["qdd"], robot.mass]

    def f(q, qd, qdd, mass):
        return flat(torchdq.dynamics_jacobian(robot.replace(mass=mass), q, qd, qdd))

    assert gradcheck(f, [x.clone().requires_grad_() for x in at], fast_mode=True, **FIRST)


@pytest.mark.case("D11")
@pytest.mark.parametrize("where", STATES)
@pytest.mark.parametrize("names", ["q qd qdd f_tip f_ext", "q mass com inertia"])
def test_second_derivatives_of_inverse_dynamics(names, where):
    check_second("inverse_dynamics", names.split(), where)


@pytest.mark.case("D12")
@pytest.mark.parametrize("where", STATES)
@pytest.mark.parametrize("names", ["q qd tau f_tip f_ext", "q mass com inertia"])
def test_second_derivatives_of_forward_dynamics(names, where):
    check_second("forward_dynamics", names.split(), where)


def check_second(key, names, where):
    robot = chain()
    inputs = state(robot, where)

    def f(*tensors):
        given = dict(zip(names, tensors, strict=True))
        changed = {name: x for name, x in given.items() if name in PARAMETERS}
        return outputs(robot.replace(**changed), key, inputs | given)

    at = [inputs[name] if name in inputs else getattr(robot, name) for name in names]
    # a fixed weight, because torch would draw a random one
    weight = random(9)(robot.n).requires_grad_()
    assert gradgradcheck(f, [x.clone().requires_grad_() for x in at], [weight], **SECOND)


# --- Pinocchio -------------------------------------------------------------------------------------------------------


def in_both(n):
    """A robot, its inputs, the same for Pinocchio: model, data, q, qd and others by name, wrenches; and its order."""
    twin, x = case(n), state(case(n).robot, "random")
    moved = {name: twin.velocity(x[name].numpy()) for name in ("qd", "qdd", "tau")}
    wrenches = pin.StdVec_Force()
    wrenches.extend(twin.wrenches(x["f_ext"].numpy()))
    at = (twin.model, twin.model.createData(), twin.configuration(x["q"].numpy()), moved["qd"])
    return twin.robot, x, at, moved, wrenches, np.ix_(twin.order, twin.order)


def worst(found, expected):
    return max(relative(a, torch.tensor(np.array(b))) for a, b in zip(found, expected, strict=True))


@pytest.mark.case("D11")
@pytest.mark.parametrize("n", [6, 7])
def test_derivatives_of_inverse_dynamics_are_those_of_pinocchio(n, margin):
    robot, x, at, moved, wrenches, order = in_both(n)
    expected = [d[order] for d in pin.computeRNEADerivatives(*at, moved["qdd"], wrenches)]
    found = jacrev(lambda q, qd, qdd: torchdq.inverse_dynamics(robot, q, qd, qdd, f_ext=x["f_ext"]), argnums=(0, 1, 2))(
        x["q"], x["qd"], x["qdd"]
    )
    margin(worst(found, expected), 64 * robot.n * EPS)


@pytest.mark.case("D12")
@pytest.mark.parametrize("n", [6, 7])
def test_derivatives_of_forward_dynamics_are_those_of_pinocchio(n, margin):
    robot, x, at, moved, wrenches, order = in_both(n)
    expected = [d[order] for d in pin.computeABADerivatives(*at, moved["tau"], wrenches)]
    found = jacrev(lambda q, qd, tau: torchdq.forward_dynamics(robot, q, qd, tau, f_ext=x["f_ext"]), argnums=(0, 1, 2))(
        x["q"], x["qd"], x["tau"]
    )
    condition = float(torch.linalg.cond(torchdq.mass_matrix(robot, x["q"])))
    margin(worst(found, expected), min(64 * robot.n * EPS * condition, 1e-9))


# --- identities ------------------------------------------------------------------------------------------------------


@pytest.mark.case("D11")
@pytest.mark.parametrize("where", STATES)
@pytest.mark.parametrize("name", ["panda", "tree"])
def test_the_derivative_of_torque_in_acceleration_is_the_mass_matrix(name, where):
    robot = torchdq.robots.load("panda") if name == "panda" else tree()
    x = state(robot, where)
    found = jacrev(lambda qdd: torchdq.inverse_dynamics(robot, x["q"], x["qd"], qdd))(x["qdd"])
    assert relative(found, torchdq.mass_matrix(robot, x["q"])) < 16 * robot.n * EPS


@pytest.mark.parametrize("name", ["panda", "tree"])
def test_the_derivative_of_potential_energy_is_the_gravity_torque(name):
    robot = torchdq.robots.load("panda") if name == "panda" else tree()
    x = state(robot, "random")
    found = jacrev(lambda q: torchdq.potential_energy(robot, q))(x["q"])
    assert relative(found, torchdq.inverse_dynamics(robot, x["q"])) < 16 * robot.n * EPS


def test_the_derivative_of_torque_in_a_tip_wrench_is_the_transposed_jacobian():
    robot, x = tree(), state(tree(), "random")
    found = jacrev(lambda f: torchdq.inverse_dynamics(robot, x["q"], x["qd"], x["qdd"], f))(x["f_tip"])
    J = torchdq.jacobian(robot, x["q"], "tip")
    # a wrench is (force, moment), a twist (angular, linear)
    assert relative(found, torch.cat([J[3:], J[:3]]).mT) < 16 * robot.n * EPS


def test_the_derivative_of_torque_in_the_parameters_is_the_regressor():
    """In the masses alone the regressor's columns combine by (1, c, -[c][c])."""
    robot, x = tree().replace(armature=None), state(tree(), "random")
    at = (x["q"], x["qd"], x["qdd"])
    found = jacrev(lambda mass: torchdq.inverse_dynamics(robot.replace(mass=mass), *at))(robot.mass)
    carried = jacrev(lambda mass: robot.replace(mass=mass).inertial_parameters)(robot.mass)
    assert relative(found, torchdq.regressor(robot, *at) @ carried) < 16 * robot.n * EPS


def test_the_dynamics_jacobian_is_the_derivative_of_inverse_dynamics():
    robot = torchdq.robots.load("panda")
    q, qd, qdd = random(2)(3, 4, 7)
    found = torchdq.dynamics_jacobian(robot, q, qd, qdd)
    rows = jacrev(lambda *x: torchdq.inverse_dynamics(robot, *x), argnums=(0, 1, 2))
    expected = [torch.stack(parts) for parts in zip(*map(rows, q, qd, qdd), strict=True)]
    assert [relative(a, b) < 1e-12 for a, b in zip(found, expected, strict=True)] == [True] * 3


@pytest.mark.case("D11")
@pytest.mark.parametrize("where", STATES)
@pytest.mark.parametrize("key", FUNCTIONS)
def test_forward_and_reverse_mode_agree(key, where, margin):
    robot = tree()
    inputs = state(robot, where)
    names = [*FUNCTIONS[key][1].split(), *PARAMETERS]

    def f(given):
        changed = {name: x for name, x in given.items() if name in PARAMETERS}
        return flat(outputs(robot.replace(**changed), key, inputs | given))

    at = {name: inputs[name] if name in inputs else getattr(robot, name) for name in names}
    forward, reverse = jacfwd(f)(at), jacrev(f)(at)
    scale = max(float(x.abs().max()) for x in reverse.values())
    margin(max(float((forward[name] - reverse[name]).abs().max()) for name in names), 1e-12 * scale)


@pytest.mark.parametrize("key", ["inverse_dynamics", "forward_dynamics"])
def test_the_third_derivative_at_home_and_at_rest_is_finite_and_symmetric(key):
    """A formula that divides by the joint angle would show here; the order of differentiation must not matter."""
    robot = chain()
    f, x = in_one(robot, key, "q", state(robot, "home"))
    third = jacfwd(jacfwd(jacrev(lambda q: f(q)[0])))(x)
    assert bool(third.isfinite().all())
    assert relative(third.permute(0, 3, 1, 2), third) < 1e-12
