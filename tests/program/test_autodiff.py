"""Derivatives of the dynamics: right, complete, and the same whichever way torch takes them.

Two kinds of evidence: finite differences (gradcheck, gradgradcheck) in every input and every physical parameter, and
identities (d tau / d qdd = M, forward mode = reverse mode). Pinocchio's analytic derivatives are in the hard cases.
"""

from functools import cache
from itertools import count

import pytest
import torch
from helpers import EVERYTHING, all_in_one, thinned
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
INVERSE, FORWARD = pytest.mark.case("D11"), pytest.mark.case("D12")


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


DYNAMICS = ("inverse_dynamics", "forward_dynamics")
THOROUGH = ("inverse_dynamics", "inertial_parameters")  # with every parameter, in the default run


@all_in_one(
    [
        (key, name, where)
        for key, (_, names) in FUNCTIONS.items()
        for name in [
            *names.split()[: None if EVERYTHING or key in DYNAMICS else 1],
            *thinned(PARAMETERS, PARAMETERS if key in THOROUGH else ("X_PB_home",)),
        ]
        for where in thinned(STATES, STATES if name == "q" and key in DYNAMICS else ("random",))
    ]
)
def test_first_derivatives_are_those_of_finite_differences(of_what):
    (key, name, where), robot = of_what, tree()
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


@pytest.mark.parametrize(
    ("key", "names", "where"),
    [
        pytest.param(key, names, where, marks=mark)
        for key, given, mark in (("inverse_dynamics", "q qd qdd", INVERSE), ("forward_dynamics", "q qd tau", FORWARD))
        for names in (f"{given} f_tip f_ext", "q mass com inertia")
        for where in thinned(STATES, ("random",))
    ],
)
def test_second_derivatives_are_those_of_finite_differences(key, names, where):
    robot, names = chain(), names.split()
    inputs = state(robot, where)

    def f(*tensors):
        given = dict(zip(names, tensors, strict=True))
        changed = {name: x for name, x in given.items() if name in PARAMETERS}
        return outputs(robot.replace(**changed), key, inputs | given)

    at = [inputs[name] if name in inputs else getattr(robot, name) for name in names]
    # a fixed weight, because torch would draw a random one
    weight = random(9)(robot.n).requires_grad_()
    assert gradgradcheck(f, [x.clone().requires_grad_() for x in at], [weight], **SECOND)


# --- identities ------------------------------------------------------------------------------------------------------


@pytest.mark.case("D11")
@pytest.mark.parametrize("where", STATES)
def test_derivatives_of_torque_are_the_mass_matrix_the_transposed_jacobian_and_the_regressor(where):
    """Derivatives by the masses combine the regressor's columns by (1, c, -[c][c])."""
    robot, bare, x = tree(), tree().replace(armature=None), state(tree(), where)
    at, bound = (x["q"], x["qd"], x["qdd"]), 16 * robot.n * EPS
    found = jacrev(lambda qdd: torchdq.inverse_dynamics(robot, *at[:2], qdd))(x["qdd"])
    assert relative(found, torchdq.mass_matrix(robot, x["q"])) < bound
    found, J = (
        jacrev(lambda f: torchdq.inverse_dynamics(robot, *at, f))(x["f_tip"]),
        torchdq.jacobian(robot, x["q"], "tip"),
    )
    assert (
        relative(found, torch.cat([J[3:], J[:3]]).mT) < bound
    )  # a wrench is (force, moment), a twist (angular, linear)
    found = jacrev(lambda mass: torchdq.inverse_dynamics(bare.replace(mass=mass), *at))(robot.mass)
    carried = jacrev(lambda mass: bare.replace(mass=mass).inertial_parameters)(robot.mass)
    assert relative(found, torchdq.regressor(bare, *at) @ carried) < bound


@pytest.mark.case("D11")
@pytest.mark.parametrize(
    "key, where",
    [
        (key, where)
        for key in thinned(FUNCTIONS, ("inverse_dynamics", "forward_dynamics", "jacobian in world axes", "regressor"))
        for where in thinned(STATES, ("random",))
    ],
)
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


@pytest.mark.parametrize("key", thinned(["inverse_dynamics", "forward_dynamics"], ("forward_dynamics",)))
def test_the_third_derivative_at_home_and_at_rest_is_finite_and_symmetric(key):
    """A formula that divides by the joint angle would show here; the order of differentiation must not matter."""
    robot = chain()
    f, x = in_one(robot, key, "q", state(robot, "home"))
    third = jacfwd(jacfwd(jacrev(lambda q: f(q)[0])))(x)
    assert bool(third.isfinite().all())
    assert relative(third.permute(0, 3, 1, 2), third) < 1e-12
