"""Actuators change commanded torques as their formulas say, in their order."""

import math

import numpy as np
import pytest
import torch
from effect_harness import CASES, FORMS, U, agrees, bare, double, forms_of
from oracles import states

import torchdq
from torchdq import Scene, effects
from torchdq.scene import State
from torchdq.scene.integrators import LinearlyImplicit, RungeKutta4


def driven(effect, u, robot=None, qd=None):
    """Torques behind an actuator for a series of commands [steps, n]: those that a robot without it would need."""
    robot = robot or CASES["two_link"].robot
    scene, plain = (Scene(robot, parts, dt=0.02) for parts in ((effect,), ()))
    state = scene.start(torch.zeros(u.shape[-1], dtype=u.dtype), qd)
    found = []
    for row in u:
        after = scene.step(state, row)
        free = plain.step(State(state.q, state.qd))
        found.append(torchdq.mass_matrix(robot, state.q) @ (after.qd - free.qd) / 0.02)
        state = after
    return torch.stack(found)


def test_saturation_is_exactly_its_limit_beyond_it():
    robot = CASES["panda"].robot
    scene = Scene(robot, (effects.Saturation(2.0), effects.Gravity()))
    state = scene.start(states(robot).q)
    assert torch.equal(
        scene.step(state, double([100.0, -3.0] * 3 + [2.0])).qd, scene.step(state, double([2.0, -2.0] * 3 + [2.0])).qd
    )
    unbounded = Scene(robot, (effects.Gravity(),))
    u = double([1.0, -1.999999, 0.0, 1.5, -2.0, 2.0, 0.3])
    assert torch.equal(scene.step(state, u).qd, unbounded.step(state, u).qd)


# ranges of the parameters, and torques behind the actuator for commands u and velocities v
MEMORYLESS = {
    "TorqueSpeed": (
        {"stall": (5.0, 20.0), "speed": (1.0, 4.0)},
        lambda u, v, stall, speed: np.clip(
            u, -stall * np.clip(1 + v / speed, 0, 1), stall * np.clip(1 - v / speed, 0, 1)
        ),
    ),
    "DeadBand": ({"width": (1.0, 20.0)}, lambda u, v, width: np.sign(u) * np.maximum(np.abs(u) - width, 0)),
    "QuantisedCommand": ({"step": (1.0, 5.0)}, lambda u, v, step: np.round(u / step) * step),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("kind", MEMORYLESS)
def test_an_actuator_without_memory_is_its_formula(kind, form):
    b = bare("panda")
    ranges, formula = MEMORYLESS[kind]
    parameters, values = forms_of(ranges, form, b.n)
    u = b.u.numpy()
    torques = formula(u, b.qd.numpy(), **values)
    assert (torques != u).any()
    assert agrees(b, getattr(effects, kind)(**parameters), torques=torques - u)


@pytest.mark.parametrize("parameter", [0.05, [0.05, 0.05], double([0.05, 0.05]), double(0.05)])
def test_a_lag_is_the_mean_of_the_exponential_of_its_time(parameter):
    """T tau' = u - tau has the solution tau + (1 - exp(-t/T)) (u - tau) while u is constant; its mean over dt acts."""
    found, tau, expected = driven(effects.FirstOrderLag(parameter), U), np.zeros(2), []
    decay = math.exp(-0.02 / 0.05)
    for u in U.numpy():
        expected.append(u + 0.05 / 0.02 * (1 - decay) * (tau - u))
        tau = tau + (1 - decay) * (u - tau)
    assert np.abs(found.numpy() - np.array(expected)).max() < 1e-11


@pytest.mark.parametrize("integrator", [LinearlyImplicit(), RungeKutta4()], ids=["implicit", "fourth order"])
@pytest.mark.parametrize("substeps", [1, 4])
@pytest.mark.parametrize("dt", [0.001, 0.01, 0.05])
def test_the_impulse_of_a_lag_is_exact_at_any_step(dt, substeps, integrator):
    """A slide of 2 kg under a torque of 2 N from rest has the velocity t - T (1 - exp(-t/T))."""
    slide = torchdq.Robot.from_screws([(0, 0, 0, 1, 0, 0)], [2.0], [[0.0] * 3], [torch.eye(3)], gravity=None)
    scene = Scene(slide, (effects.FirstOrderLag(0.02),), integrator=integrator, dt=dt, substeps=substeps)
    state = scene.start(double([0.0]))
    for k in range(1, 4):
        state = scene.step(state, double([2.0]))
        exact = k * dt - 0.02 * (1 - math.exp(-k * dt / 0.02))
        assert float(state.qd) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("time", [1e-3, 0.39, 0.41, 10.0, 1e9])
def test_a_lag_keeps_its_digits_whatever_its_time(time, dtype):
    robot = CASES["two_link"].robot
    tensor, number = (
        Scene(robot, (effects.FirstOrderLag(x),), dt=0.02) for x in (torch.tensor(time, dtype=dtype), time)
    )
    q, u = torch.zeros(2, dtype=dtype), torch.ones(2, dtype=dtype)
    found, expected = (scene.step(scene.start(q), u).qd for scene in (tensor, number))
    free = Scene(robot, dt=0.02)
    size = float(free.step(free.start(q), u).qd.abs().max())
    assert (found - expected).abs().max() < 100 * torch.finfo(dtype).eps * size


def test_a_lag_of_no_time_is_none():
    assert (driven(effects.FirstOrderLag(0.0), U) - U).abs().max() < 1e-11
    assert (driven(effects.FirstOrderLag([0.0, 1.0]), U) - U)[:, 0].abs().max() < 1e-11


@pytest.mark.parametrize("steps", [1, 3, 20])
def test_a_delay_shifts_by_whole_steps(steps):
    expected = torch.cat([torch.zeros(steps, 2, dtype=torch.float64), U])[: len(U)]
    assert (driven(effects.CommandDelay(steps), U) - expected).abs().max() < 1e-11


def test_what_is_delayed_is_exactly_what_was_commanded():
    scene = Scene(CASES["two_link"].robot, (effects.CommandDelay(2),))
    state = scene.start(torch.zeros(2, dtype=torch.float64))
    for u in U[:5]:
        state = scene.step(state, u)
    assert torch.equal(state.memory, U[3:5].flatten())


def test_actuators_act_in_their_order():
    saturated_late = driven(effects.Saturation(1.0), 2 * U)
    robot = CASES["two_link"].robot
    state = State(torch.zeros(2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64))
    first = Scene(robot, (effects.DeadBand(1.0), effects.Saturation(1.0))).step(state, double([1.5, 9.0])).qd
    then = Scene(robot, (effects.Saturation(1.0), effects.DeadBand(1.0))).step(state, double([1.5, 9.0])).qd
    assert torch.equal(first, Scene(robot).step(state, double([0.5, 1.0])).qd)
    assert torch.equal(then, state.qd)
    assert saturated_late.abs().max() < 1 + 1e-11
