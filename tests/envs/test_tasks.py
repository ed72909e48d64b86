"""Tasks: what is observed, rewarded and followed, and a task of one's own."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from helpers import exhaustive
from messages import refused
from small_envs import FREE, ROBOT, make, started, steps

import torchdq
from torchdq import dq, effects, floating
from torchdq.envs import RobotVectorEnv, TorchTask
from torchdq.envs.render import Painter
from torchdq.envs.tasks import Reach, Track
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import at_least
from torchdq.scene import State, controllers
from torchdq.scene.defaults import nominal_robot

BACKEND = "auto"


def test_an_episode_starts_within_limits_and_its_goal_is_within_reach():
    """Observation and reward are held by docs/test_environment_pages.py."""
    envs = started(200, robot="panda", dtype=torch.float64, backend="eager", action=None, scale=None)
    envs.reset(seed=0)
    found, (lower, upper, *_) = envs.get_state(), envs.robot.limits
    shoulder = torch.tensor([0, 0, 0.333])
    assert (found["goal"] - shoulder).norm(dim=1).max() < 1.2  # the length of the arm
    assert bool(((found["q"] > lower) & (found["q"] < upper)).all())


def test_what_is_seen_is_measured_and_what_is_rewarded_is_true():
    envs = make(5, effects=(effects.Gravity(), effects.Bias(0.3, 0.1)), dtype=torch.float64, backend="eager")
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
    envs = RobotVectorEnv(50, robot="panda", action="reference")
    observations, _ = envs.reset(seed=0)
    for _ in range(150):
        way, q = observations[:, -6:-3, None], envs._buffers["q"]
        J = torchdq.jacobian(envs.robot, q, "tip", expressed="world")[:, 3:]
        offset = J.mT @ torch.linalg.solve(J @ J.mT + 0.01 * torch.eye(3), way)
        observations, rewards, _, _, info = envs.step((offset[..., 0] / envs._scale).clamp(-1, 1))
    assert info["distance"].quantile(0.9) < 0.01 and rewards.quantile(0.1) > 0.9


def test_the_reference_is_smooth_and_within_limits():
    envs, n = started(300, "track", action="reference", scale=None, dtype=torch.float64), ROBOT.n
    lower, upper, velocity, _ = ROBOT.limits
    positions = []
    for _ in range(100):
        q, qd, qdd = envs.get_state()["reference"].split(n, 1)
        assert bool(((q > lower) & (q < upper)).all()) and bool((qd.abs() <= velocity / 2).all())
        assert bool((qdd.abs() <= velocity).all())
        positions.append((q, qd, qdd))
        envs.step(torch.zeros(300, n))
    q, qd, qdd = (torch.stack(x) for x in zip(*positions, strict=True))
    h = envs.scene.dt
    assert torch.allclose((q[2:] - q[:-2]) / (2 * h), qd[1:-1], atol=1e-3)
    assert torch.allclose((q[2:] - 2 * q[1:-1] + q[:-2]) / h**2, qdd[1:-1], atol=1e-3)
    assert Track().inputs(7) == {"goal": 49, "action": 7, "time": 1}


def errors(**arguments):
    """Root mean square error after two seconds of a controller that is left alone."""
    envs = started(20, "track", action="residual", **arguments)
    for _ in range(100):
        *_, info = envs.step(torch.zeros(20, 2))
    return info["error"].square().mean().sqrt().item()


@exhaustive
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
    pd = controllers.PD(200.0, 40.0, model=nominal_robot(make(1, effects=(effects.Gravity(),)).scene))
    steps(started(4, "track", action="residual", controller=pd), 3)


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
    _, rewards, terminated, _, info = started(5, undefined, effects=(), backend="eager").step(torch.zeros(5, 2))
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
        lambda x: {**x, "X_WB": [1.0] * 8},
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


def test_a_task_whose_attributes_are_no_fields_is_refused():
    """Two such tasks would be equal, and share the program of the first."""

    class Weighted(Reach):
        def __init__(self, weight):
            object.__setattr__(self, "weight", weight)

    with refused(ArgumentError):
        make(2, Weighted(5.0))


# --- floating bases, servos, limits, and what a task remembers --------------------------------------------------------


@dataclass(frozen=True)
class Remembers(Reach):
    """Counts its steps and keeps the last action."""

    def inputs(self, n):
        return {**super().inputs(n), "carry": 1 + n}

    def rows(self, view):
        before = view.inputs.get("carry", [0.0] * 3)
        action = view.inputs.get("action", [0.0] * 2)
        rows = super().rows(view)
        return {**rows, "reward": [before[0]], "last": before[1:], "carry": [before[0] + 1.0, *action]}


@pytest.mark.parametrize("mode", ["SAME_STEP", "NEXT_STEP"])
def test_what_a_task_remembers_comes_back_at_the_next_step_and_not_in_the_next_episode(mode):
    envs = started(3, Remembers(), max_episode_steps=4, autoreset_mode=mode, backend="eager")
    envs.set_state({**envs.get_state(), "steps": torch.tensor([0.0, 1.0, 2.0])})
    last, found = torch.zeros(3, 2), []
    for k in range(4):
        action = torch.full((3, 2), 0.1 * (k + 1))
        _, reward, *_, info = envs.step(action)
        running = reward > 1
        assert torch.equal(info["last"][running], last[running]) and "carry" not in info
        last = action
        found.append(reward.tolist())
    # the start of an episode carries 1, as its row says; a step of NEXT_STEP that resets has the reward 0
    expected = {
        "SAME_STEP": [[1, 1, 1], [2, 2, 2], [3, 3, 1], [4, 1, 2]],
        "NEXT_STEP": [[1, 1, 1], [2, 2, 2], [3, 3, 0], [4, 0, 1]],
    }
    assert found == expected[mode]


def free(**arguments):
    """Environments of a free robot in motion."""
    envs = started(4, robot=FREE, dtype="float64", backend="eager", **{"effects": (effects.Gravity(),), **arguments})
    steps(envs, 5)
    return envs


def test_a_step_of_a_floating_robot_is_that_of_its_scene():
    envs, action = free(), torch.full((4, 2), 0.3, dtype=torch.float64)
    before = State(**{name: envs.get_state()[name] for name in ("q", "qd", "X_WB", "V_WB_B")})
    envs.step(action)
    expected, found = envs.scene.step(before, torque=20.0 * action), envs.get_state()
    assert all(torch.equal(found[name], x) for name, x in expected.rows().items())


def test_a_floating_robot_is_drawn_where_its_base_is():
    pytest.importorskip("matplotlib")
    envs = free(render_mode="rgb_array")
    now, (frame, *_) = envs.get_state(), envs.render()
    painter = Painter(envs.scene)
    assert (frame == painter.frame(now["q"][0], now["goal"][0], X_WB=now["X_WB"][0])).all()
    assert (frame != painter.frame(now["q"][0], now["goal"][0])).any()


def test_an_object_is_drawn_where_it_is():
    pytest.importorskip("matplotlib")
    envs = RobotVectorEnv(1, "push", render_mode="rgb_array")
    envs.reset(seed=0)
    now, (frame,), painter = envs.get_state(), envs.render(), Painter(envs.scene)
    assert (frame == painter.frame(now["q"][0], now["goal"][0], X_WO=envs.state.X_WO[0])).all()
    assert (frame != painter.frame(now["q"][0], now["goal"][0])).any()


def test_a_floating_robot_sees_its_base_and_the_way_of_its_end_effector_in_the_world():
    envs = free()
    spinning = torch.linspace(-2.0, 2.0, 24, dtype=torch.float64).reshape(4, 6)
    envs.set_state({**envs.get_state(), "V_WB_B": spinning})
    steps(envs, 5)
    observation, now = envs.step(torch.zeros(4, 2))[0], envs.get_state()
    tip = floating.forward_kinematics(FREE, now["X_WB"], now["q"], FREE.tip)
    up = dq.rotate(dq.conj(dq.rotation(now["X_WB"])), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    p = dq.translation(tip)
    expected = torch.cat([up, now["V_WB_B"], now["goal"] - p, p], 1)
    assert torch.allclose(observation[:, 6:], expected, atol=1e-9)


POSED = TorchTask(
    reward=lambda now: now.X_WB[:, 0] + now.V_WB_B[:, 5],
    start=lambda robot, u: {"q": u[:, :2], "V_WB_B": u[:, 3:], "X_WB": dq.from_pose(torch.eye(1, 4).to(u), u[:, :3])},
    draws=9,
)


def test_a_floating_robot_starts_where_its_task_says():
    envs = started(4, POSED, robot=FREE, dtype="float64", effects=(), backend="eager")
    now = envs.get_state()
    assert bool(((now["V_WB_B"] > 0) & (now["V_WB_B"] < 1)).all()) and len(now["V_WB_B"].unique()) == 24
    assert torch.equal(now["X_WB"][:, 0], torch.ones(4))
    rewards = envs.step(torch.zeros(4, 2))[1]
    now = envs.get_state()
    assert torch.equal(rewards, now["X_WB"][:, 0] + now["V_WB_B"][:, 5])
    twice = replace(POSED, start=lambda robot, u: {"X_WB": 2 * dq.from_pose(torch.eye(1, 4).to(u), u[:, :3])})
    with refused(ArgumentError):
        started(4, twice, robot=FREE, effects=())


def test_actions_are_offsets_of_the_targets_of_servos():
    """Of those of the start, where no task has others; a joint without a gain is free."""
    held = effects.Servo((200.0, 0.0), (20.0, 0.0))
    still = TorchTask(reward=lambda now: now.time, start=lambda robot, u: {"q": u}, draws=2)
    envs = started(5, still, effects=(held, effects.RotorInertia(0.1)), action=None, scale=None, dtype="float64")
    before = envs.get_state()["q"]
    for _ in range(100):
        envs.step(torch.tensor([1.0, -0.4]).expand(5, 2))
    found = envs.get_state()["q"] - before
    assert torch.allclose(found[:, 0], torch.full((5,), 0.25, dtype=torch.float64), atol=1e-3)
    reference = envs.get_state()["reference"][:, :2]
    assert torch.equal(reference, before)


def test_starts_and_goals_are_within_the_limits_that_are_simulated():
    lower, upper = torch.tensor([-0.4, 0.1]), torch.tensor([0.4, 0.9])
    limits = effects.JointLimits(lower.expand(200, 2), tuple(upper.tolist()))
    reach, track = (started(200, task, effects=(limits,), backend="eager") for task in ("reach", "track"))
    for envs in (reach, track):
        q, reference = (envs.get_state()[name][:, :2] for name in ("q", "reference"))
        assert bool(((q > lower) & (q < upper) & (reference > lower) & (reference < upper)).all())
        assert torch.equal(torch.stack(envs.robot.limits[:2]).float(), torch.stack([lower, upper]))
    q = torch.cartesian_prod(*(torch.linspace(a, b, 33) for a, b in zip(lower, upper, strict=True)))
    near = dq.translation(torchdq.forward_kinematics(ROBOT, q, ROBOT.tip))
    goal = reach.get_state()["goal"]
    assert torch.cdist(goal, near).amin(1).max() < 0.02


def test_a_base_that_flies_off_has_failed():
    envs = free(effects=())
    now = envs.get_state()
    fast = now["V_WB_B"].clone()
    fast[1, 5] = 1e7
    envs.set_state({**now, "V_WB_B": fast})
    _, rewards, terminated, _, info = envs.step(torch.zeros(4, 2))
    assert info["nonfinite"].tolist() == terminated.tolist() == [False, True, False, False]
    assert rewards[1] == -1000
