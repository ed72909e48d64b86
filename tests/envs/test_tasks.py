"""Tasks: what is observed, rewarded and followed, and a task of one's own."""

import math
from dataclasses import dataclass

import pytest
import torch
from messages import refused
from small_envs import ROBOT, make, started, steps

import torchdq
from torchdq.envs import ArmVectorEnv, effects
from torchdq.envs.tasks import Reach, Track
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import at_least
from torchdq.scene import controllers
from torchdq.scene.defaults import nominal_robot

BACKEND = "auto"


def test_an_episode_starts_within_limits_and_its_goal_is_within_reach():
    """Observation and reward are held by claims/test_environment_pages.py."""
    envs = ArmVectorEnv(200, robot="panda", dtype=torch.float64)
    envs.reset(seed=0)
    found, (lower, upper, *_) = envs.get_state(), envs.robot.limits
    shoulder = torch.tensor([0, 0, 0.333])
    assert (found["goal"] - shoulder).norm(dim=1).max() < 1.2  # the length of the arm
    assert bool(((found["q"] > lower) & (found["q"] < upper)).all())


def test_what_is_seen_is_measured_and_what_is_rewarded_is_true():
    envs = make(5, effects=(effects.Gravity(), effects.Bias(0.3, 0.1)), dtype=torch.float64)
    for call in (lambda: envs.reset(seed=0), lambda: envs.step(torch.zeros(5, 2))):
        observations, *_, info = call()
        now = envs.get_state()
        assert torch.allclose(observations[:, 0], (now["q"][:, 0] + 0.3).sin(), atol=1e-12)
    tip = torchdq.dq.translation(torchdq.forward_kinematics(ROBOT, now["q"], ROBOT.tip))
    assert torch.allclose(info["distance"], (now["goal"] - tip).norm(dim=1), atol=1e-6)
    near = tip + torch.tensor([0.01, 0.049, 0.051, 0.2, 1.0])[:, None] * torch.tensor([0.0, 0.0, 1.0])
    envs.set_state({**now, "qd": torch.zeros_like(now["qd"]), "goal": near})
    info = envs.step(torch.zeros(5, 2, dtype=torch.float64))[4]
    assert (info["success"] == (info["distance"] <= 0.05)).all() and {0.0, 1.0} == set(info["success"].tolist())


def test_a_goal_can_be_reached():
    # by the damped inverse of the Jacobian, with offsets as actions
    envs = ArmVectorEnv(50, robot="panda", action="reference")
    observations, _ = envs.reset(seed=0)
    for _ in range(150):
        way, q = observations[:, -6:-3, None], envs._buffers["q"]
        J = torchdq.jacobian(envs.robot, q, "tip", expressed="world")[:, 3:]
        offset = J.mT @ torch.linalg.solve(J @ J.mT + 0.01 * torch.eye(3), way)
        observations, rewards, _, _, info = envs.step((offset[..., 0] / envs._actions.scale).clamp(-1, 1))
    assert info["distance"].quantile(0.9) < 0.01 and rewards.quantile(0.1) > 0.9


def test_the_reference_is_smooth_and_within_limits():
    robot, task = torchdq.robots.load("panda"), Track()
    envs = ArmVectorEnv(300, "track", robot, dtype=torch.float64, action="reference")
    envs.reset(seed=0)
    lower, upper, velocity, _ = robot.limits
    positions = []
    for _ in range(100):
        q, qd, qdd = envs._buffers["reference"].split(7, 1)
        assert bool(((q > lower) & (q < upper)).all()) and bool((qd.abs() <= velocity / 2).all())
        assert bool((qdd.abs() <= velocity).all())
        positions.append((q, qd, qdd))
        envs.step(torch.zeros(300, 7))
    q, qd, qdd = (torch.stack(x) for x in zip(*positions, strict=True))
    h = envs.scene.dt
    assert torch.allclose((q[2:] - q[:-2]) / (2 * h), qd[1:-1], atol=1e-3)
    assert torch.allclose((q[2:] - 2 * q[1:-1] + q[:-2]) / h**2, qdd[1:-1], atol=1e-3)
    assert task.inputs(7) == {"goal": 49, "action": 7, "time": 1}


def errors(**arguments):
    """Root mean square error after two seconds of a controller that is left alone."""
    envs = started(20, "track", action="residual", **arguments)
    for _ in range(100):
        *_, info = envs.step(torch.zeros(20, 2))
    return info["error"].square().mean().sqrt().item()


def test_a_controller_that_is_left_alone_tracks_with_the_true_model_and_not_with_a_wrong_one():
    right = errors(effects=(effects.Gravity(),))
    heavy = errors(effects=(effects.Gravity(), effects.Payload(1.0)))
    stuck = errors(effects=(effects.Gravity(), effects.Coulomb(1.0)))
    varied = errors(effects=(effects.Gravity(),), randomise={"mass": 0.3})
    assert right < 3e-3
    assert min(heavy, stuck, varied) > 3 * right


def rolled(envs, actions, number=50):
    """Positions before and after a number of equal steps."""
    before = envs.get_state()["q"]
    for _ in range(number):
        envs.step(torch.tensor(actions).expand(10, 2))
    return before, envs.get_state()["q"]


def test_an_arm_stands_still_by_itself_a_residual_pushes_it_and_a_reference_moves_it_on():
    pushed = started(10, "reach", action="residual", effects=(effects.Gravity(),))
    before, after = rolled(pushed, [0.0, 0.0])
    assert torch.allclose(after, before, atol=1e-3)
    before, after = rolled(pushed, [1.0, 1.0], 1)
    assert bool((after[:, 1] != before[:, 1]).all())
    moved = started(10, "reach", action="reference", effects=(effects.Gravity(),), scale=None)
    before, after = rolled(moved, [1.0, -0.5])  # for a second, at five times an offset of 0.4 and -0.2
    assert torch.allclose(after - before, torch.tensor([2.0, -1.0]), rtol=0.2)


def test_the_controller_may_be_ones_own():
    pd = controllers.PD(200.0, 40.0, nominal_robot(make(1, effects=(effects.Gravity(),)).scene))
    steps(started(4, "track", action="residual", controller=pd), 3)
    with refused(torchdq.ArgumentError):
        make(4, controller=pd)


def changed(method, change):
    """Task of which a method returns something else, a function of what it returns and of its arguments."""

    def other(self, *given):
        return change(getattr(Reach, method)(self, *given), *given)

    return dataclass(frozen=True)(type("Changed", (Reach,), {method: other}))()


def test_a_task_may_be_ones_own_and_end_episodes():
    fall = changed("rows", lambda rows, view: {**rows, "terminated": [at_least(-0.5, view.q[0])]})
    envs = started(5, fall, effects=(effects.Gravity(),))
    ended = torch.zeros(5, dtype=torch.bool)
    for _ in range(200):
        _, _, terminated, _, info = envs.step(torch.zeros(5, 2))
        assert not bool(info["nonfinite"].any())
        ended |= terminated
    assert bool(ended.any())


def test_a_reward_that_is_not_a_number_is_a_failure():
    undefined = changed("rows", lambda rows, view: {**rows, "reward": [math.nan], "where": view.q})
    _, rewards, terminated, _, info = started(5, undefined, effects=()).step(torch.zeros(5, 2))
    assert bool(info["nonfinite"].all()) and bool(terminated.all()) and rewards.tolist() == [-1000] * 5
    assert info["where"].shape == (5, 2)


def without(name):
    """Function that leaves a row out."""
    return lambda x: {k: v for k, v in x.items() if k != name}


CHANGES = {
    "rows": [
        without("reference"),
        lambda x: None,
        lambda x: {**x, "observation": x["observation"][:-1]},
        lambda x: {**x, "reference": x["reference"][:-1]},
        lambda x: {**x, "reward": [x["distance"][0]] * 2},
        lambda x: {**x, "terminated": [1.0, 0.0]},
        lambda x: {**x, "reward": x["distance"][0]},
        lambda x: {**x, "reward": [torch.zeros(1)]},
        lambda x: {**x, "q": [0.0, 0.0]},
        lambda x: {**x, "clipped": [0.0]},
    ],
    "start": [
        without("goal"),
        lambda x: {**x, "goal": x["goal"][:2]},
        lambda x: list(x),
        lambda x: {**x, "torque": [0.0]},
    ],
    "inputs": [without("goal"), lambda x: {**x, "action": 7}, lambda x: {**x, "velocity": 2}],
}


@pytest.mark.parametrize("method, change", [(name, one) for name, changes in CHANGES.items() for one in changes])
def test_a_task_that_returns_other_rows_is_refused(method, change):
    with refused(torchdq.TorchdqError):
        started(2, changed(method, lambda x, *_: change(x)))


def test_limits_hold_a_usual_arm():
    envs = ArmVectorEnv(32, robot="panda", max_episode_steps=None)
    envs.reset(seed=0)
    lower, upper, velocity, _ = envs.robot.limits
    fastest = torch.zeros(7)
    for _ in range(100):
        *_, info = envs.step(torch.ones(32, 7))
        fastest = torch.maximum(fastest, envs._buffers["qd"].abs().amax(0))
    assert not bool(info["nonfinite"].any())
    assert bool((envs._buffers["q"] > lower - 0.1).all()) and bool((envs._buffers["q"] < upper + 0.1).all())
    assert bool((fastest < 6 * velocity).all())  # light joints are thrown about by heavy ones


def test_a_task_whose_attributes_are_no_fields_is_refused():
    """Two such tasks would be equal, and share the program of the first."""

    class Weighted(Reach):
        def __init__(self, weight):
            object.__setattr__(self, "weight", weight)

    with refused(ArgumentError):
        ArmVectorEnv(2, Weighted(5.0), "two_link", scale=10.0)
