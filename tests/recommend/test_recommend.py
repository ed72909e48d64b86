"""What is recommended keeps the error that was asked for, and nothing that costs less does."""

import math
import re
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one, exhaustive, rods, thinned
from messages import refused, warned
from oracles import pinocchio_model, random_tree
from scipy.integrate import solve_ivp

import torchdq
from torchdq import Scene, effects
from torchdq.backends import c_library as build
from torchdq.base import progress
from torchdq.recommend.recommend import recommend_settings
from torchdq.recommend.recommendation import EXACT, MIXED, SINGLE
from torchdq.recommend.trajectories import SAFETY, SAMPLES, random_states
from torchdq.scene import State, controllers, integrators

BACKEND, F64 = "auto", torch.float64
pytestmark = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")

ROBOTS = {name: torchdq.robots.load(name) for name in ("two_link", "ur10e", "puma560", "panda")}
ROBOTS |= {"a tree of four": random_tree(4, seed=11).robot}
HORIZON = 0.3


def others(robot, samples=5):
    """States that were not tried: the last of more random ones than are."""
    q, qd = random_states(robot, SAMPLES + samples)
    return q[-samples:], qd[-samples:]


def truth(robot, q, qd, horizon):
    """Positions under gravity by scipy's DOP853 on pinocchio's accelerations."""
    model = pinocchio_model(robot)
    data, n = model.createData(), robot.n

    def rate(_, y):
        return np.concatenate([y[n:], pin.aba(model, data, y[:n], y[n:], np.zeros(n))])

    ends = [
        solve_ivp(rate, (0, horizon), np.concatenate(start), method="DOP853", rtol=1e-12, atol=1e-12).y[:n, -1]
        for start in zip(q.numpy(), qd.numpy(), strict=True)
    ]
    return torch.tensor(np.array(ends))


def end(scene, state, horizon, dtype, **inputs):
    """Positions at the end of trajectories."""
    steps = round(horizon / scene.dt)
    given = {name: x.to(dtype).expand(steps, *x.shape) for name, x in inputs.items()}
    return scene.rollout(state.to(dtype), steps=steps, nonfinite="ignore", **given).q[-1].double()


@cache
def recommended(name, error, horizon=HORIZON):
    return recommend_settings(ROBOTS[name], error, horizon)


def falling(name, *more, dt=HORIZON / 8):
    """Scene of a robot under gravity and further effects."""
    return Scene(ROBOTS[name], (effects.Gravity(), *more), dt=dt)


ASKED = [(name, error, HORIZON) for name in ("two_link", "ur10e", "a tree of four") for error in (1e-2, 1e-8)]
MORE = [(name, 1e-4, HORIZON) for name in ROBOTS] + [("panda", 1e-3, 1.0)]
KEPT = [("two_link", 1e-8, HORIZON)]


@pytest.mark.parametrize(("name", "error", "horizon"), thinned([*ASKED, *MORE], KEPT))
def test_what_is_recommended_keeps_the_error_on_other_states(name, error, horizon):
    robot, found = ROBOTS[name], recommended(name, error, horizon)
    assert found.horizon == horizon and not found.limit
    assert name != "panda" or found.step > 2e-4
    q, qd = others(robot)
    made = (end(found.scene, State(q, qd), horizon, found.dtype) - truth(robot, q, qd, horizon)).abs().max()
    assert made <= error
    assert found.error <= error


@pytest.mark.parametrize(
    ("name", "error"),
    thinned([(name, error) for name in ("two_link", "ur10e") for error in (1e-2, 1e-8)], [("two_link", 1e-8)]),
)
def test_nothing_that_costs_less_keeps_the_error(name, error):
    """Of every integrator and precision, with the steps that two thirds of the operations pay for."""
    robot, scene = ROBOTS[name], falling(name)
    state = scene.start(*random_states(robot))
    expected = truth(robot, state.q, state.qd, HORIZON)
    budget, tried = recommended(name, error).others[0].operations / 1.5 * scene.dt, 0
    for integrator in (integrators.SemiImplicitEuler(), integrators.RungeKutta4(), integrators.StoermerVerlet()):
        one = scene.replace(integrator=integrator)
        for arithmetic in (SINGLE, MIXED, EXACT):
            if times := math.floor(budget / (arithmetic.weight * one.count().total)):
                tried += 1
                cheaper = one.replace(dt=scene.dt / times, precision=arithmetic.precision)
                off = end(cheaper, state, HORIZON, arithmetic.dtype) - expected
                assert off.abs().nan_to_num(9.0).max() > SAFETY * error
    assert tried


def test_float32_is_recommended_until_it_no_longer_keeps_the_error():
    dtypes = [recommended("two_link", error).dtype for error in (1e-2, 1e-4, 1e-8)]
    assert dtypes == [torch.float32, torch.float32, torch.float64]


def test_stiff_joints_are_given_to_the_implicit_integrator():
    stiff = falling("two_link", effects.Viscous(1e4), dt=0.05)
    assert isinstance(recommend_settings(stiff, 0.05, 0.2).integrator, integrators.LinearlyImplicit)


def test_a_scene_with_a_controller_keeps_its_interval():
    robot = ROBOTS["two_link"]
    scene = Scene(robot, (effects.Gravity(),), controllers.ComputedTorque(400.0, 40.0), dt=0.02)
    q, qd = others(robot)
    wanted = torch.cat([q + 0.3, 0 * q, 0 * q], -1)
    found = recommend_settings(scene, 1e-6, 0.2, State(q, qd), reference=wanted)
    assert found.scene.dt == scene.dt and found.repeats == 1
    assert found.step == pytest.approx(scene.dt / found.scene.substeps)
    fine = scene.replace(integrator=integrators.RungeKutta4(), substeps=64, unroll=False)
    ends = [end(s, State(q, qd), 0.2, d, reference=wanted) for s, d in ((found.scene, found.dtype), (fine, F64))]
    assert (ends[0] - ends[1]).abs().max() <= 1e-6


def test_a_scene_without_anything_sampled_is_divided():
    found = recommend_settings(falling("two_link", dt=0.1), 1e-6, 0.4)
    assert found.scene.dt * found.repeats == pytest.approx(0.1)


ACCELERATED = [(name, error) for name in ROBOTS if name != "panda" for error in (1e-2, 3e-6, 1e-11)]


@pytest.mark.parametrize(
    ("name", "error"), thinned(ACCELERATED, [("two_link", 1e-2), ("ur10e", 3e-6), ("a tree of four", 1e-11)])
)
def test_accelerations_keep_the_error_on_other_states(name, error):
    robot, found = ROBOTS[name], recommended(name, error, None)
    q, qd = others(robot, 50)
    tau = torchdq.inverse_dynamics(robot, q, qd, torch.rand_like(q))
    q, qd, tau = (x.float().double() for x in (q, qd, tau))
    model = pinocchio_model(robot)
    data = model.createData()
    rows = zip(q.numpy(), qd.numpy(), tau.numpy(), strict=True)
    expected = torch.tensor(np.array([pin.aba(model, data, *x) for x in rows]))
    x = torchdq.forward_dynamics(robot, *[y.to(found.dtype) for y in (q, qd, tau)], precision=found.precision)
    assert ((x.double() - expected).abs().amax(-1) / expected.abs().amax(-1)).max() <= error


def test_a_long_chain_is_recommended_articulated_bodies_in_double_precision_at_once():
    """Float32 cannot bear it."""
    assert recommended("two_link", 1e-2, None).method == "mass matrix"
    found = recommend_settings(rods(24, planar=True), 1e-3, None)
    assert found.method == "articulated bodies"
    assert (found.dtype, found.precision) in ((torch.float64, "auto"), (torch.float32, "double"))


def test_starts_are_within_the_limits_that_are_simulated():
    scene = falling("two_link", effects.Viscous(0.5), effects.JointLimits(-1.0, 1.0), dt=0.05)
    starts = [random_states(scene.robot, SAMPLES + 5, limits) for limits in (None, scene.effects[2])]
    assert [bool(q.abs().max() <= 1) for q, _ in starts] == [False, True]
    found = recommend_settings(scene, 1e-3, 0.2)
    fine = scene.replace(integrator=integrators.RungeKutta4(), substeps=512, unroll=False)
    state = State(*(x[-5:] for x in starts[1]))
    ends = [end(s, state, 0.2, d) for s, d in ((found.scene, found.dtype), (fine, F64))]
    assert (ends[0] - ends[1]).abs().max() <= 1e-3


@exhaustive
def test_a_falling_arm_is_held_no_longer_than_it_can_be():
    with warned(UserWarning):
        found = recommend_settings(ROBOTS["ur10e"], 0.1, 1000.0)
    assert 1.5 <= found.horizon <= 2.2 and 1e5 < found.growth <= 1e6
    assert found.step > 2e-4
    assert f"{found.horizon:.3g} s only: trajectories of 'ur10e' cannot be held" in str(found)
    assert found.repeats * found.step == pytest.approx(found.horizon / 8)


def test_the_growth_of_errors_is_that_of_a_small_change():
    found = recommended("two_link", 1e-2)
    q, qd = (x[:SAMPLES] for x in others(ROBOTS["two_link"], SAMPLES))
    ends = [end(found.scene, State(x, qd), HORIZON, F64) for x in (q, q + 1e-7)]
    grown = float((ends[0] - ends[1]).abs().max()) / 1e-7
    assert found.growth / 10 <= grown <= 10 * found.growth


def test_damping_lets_a_trajectory_be_held():
    found = recommend_settings(falling("two_link", effects.Viscous(2.0), dt=2.5), 0.1, 10.0)
    assert found.horizon == 10.0 and not found.limit and found.growth < 100


def test_a_scene_is_held_for_some_of_its_steps():
    with warned(UserWarning):
        found = recommend_settings(falling("ur10e", dt=0.2), 0.1, 3.2)
    assert found.scene.dt * found.repeats == pytest.approx(0.2)
    assert 1.4 <= found.horizon <= 2.0 and found.growth > 1e4
    assert f"{found.horizon:.3g} s only: trajectories of 'ur10e' cannot be held" in str(found)


def test_it_says_what_it_recommends():
    text = str(recommend_settings(ROBOTS["two_link"], 1e-3, HORIZON))
    for word in ("float32", "RungeKutta4", "steps of", "backend", "error", "ns per robot", "alternatives"):
        assert word in text


ARM, SERVED = ROBOTS["two_link"], Scene(ROBOTS["two_link"], (effects.Servo(10.0, 1.0),))
MANY = ARM.replace(mass=torch.ones(3, 2, dtype=F64))
BODY = {"base_mass": 2.0, "base_com": [0.0] * 3, "base_inertia": [0.1, 0.0, 0.1, 0.0, 0.0, 0.1]}
FREE = ARM.replace(**{name: torch.tensor(x, dtype=F64) for name, x in BODY.items()})
MISUSE = {
    "no error": lambda: recommend_settings(ARM, 0.0),
    "truth value": lambda: recommend_settings(ARM, True),
    "negative horizon": lambda: recommend_settings(ARM, 1e-3, -1.0),
    "no steps": lambda: recommend_settings(ARM, 1e-3, most_steps=0),
    "too few steps": lambda: recommend_settings(ARM, 1e-12, 0.2, most_steps=64),
    "scene without horizon": lambda: recommend_settings(Scene(ARM), 1e-3, None),
    "name": lambda: recommend_settings("panda"),
    "several robots": lambda: recommend_settings(MANY),
    "accelerations of several robots": lambda: recommend_settings(MANY, 1e-2, None),
    "floating base": lambda: recommend_settings(FREE, 1e-3, 0.1),
    "contact": lambda: recommend_settings(Scene(ARM, (effects.Contact(height=0.1),), dt=0.001), 1e-3, 0.1),
    "positions as a state": lambda: recommend_settings(ARM, 1e-3, 0.1, torch.zeros(3, 2)),
    "list": lambda: recommend_settings(ARM, 1e-3, 0.1, torque=[1.0, 2.0]),
    "nan": lambda: recommend_settings(ARM, 1e-3, 0.1, torque=torch.tensor([1.0, math.nan])),
    "torque of accelerations": lambda: recommend_settings(ARM, 1e-3, None, torque=torch.zeros(2)),
    "unknown input": lambda: recommend_settings(Scene(ARM), 1e-3, 0.1, foo=torch.zeros(2)),
    "missing input": lambda: recommend_settings(SERVED, 1e-3, 0.1),
    "too short steps": lambda: recommend_settings(Scene(ARM, dt=1e-6), 1e-3, 0.1),
    "trajectories beyond rounding": lambda: recommend_settings(ARM, 1e-17, 0.02),
    "accelerations beyond rounding": lambda: recommend_settings(ARM, 1e-18, None),
}


@all_in_one(MISUSE)
def test_what_cannot_be_recommended_is_named(what):
    with refused((torchdq.ArgumentError, torchdq.UnknownNameError)):
        MISUSE[what]()


@all_in_one(thinned([128, 2**13], (128,)))
def test_the_search_costs_little_more_than_what_it_finds(most, monkeypatch):
    """Where stiff joints make a method of low order hopeless, it is soon left: no candidate costs much more.

    And no trajectory has more steps than are allowed, neither that of a reference nor that of a candidate.
    """
    told = []
    monkeypatch.setattr(progress.Progress, "at", lambda _, text: told.append(str(text)))  # what a long search shows
    scene = falling("two_link", effects.Servo(200.0, 20.0), dt=0.05)
    found = recommend_settings(scene, 1e-3, 0.2, most_steps=most, target=torch.zeros(2, dtype=F64))
    assert max(int(steps) for steps in re.findall(r"^\w+, (\d+) steps, float", "\n".join(told), re.MULTILINE)) <= most
    exact = [c.operations for c in found.others if c.arithmetic.dtype == F64]
    assert max(exact) <= 4.0 * min(exact)


def test_the_allowed_number_of_steps_is_no_part_of_the_answer():
    robot = ROBOTS["two_link"]
    assert recommend_settings(robot, 1e-3, 0.2, most_steps=2048).others == recommend_settings(robot, 1e-3, 0.2).others
