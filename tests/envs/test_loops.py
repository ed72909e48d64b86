"""Environments of robots with loops: episodes start closed, each row as alone, and steps keep them closed."""

import pytest
import torch
from closed_loops import four_bar
from messages import refused

import torchdq
from torchdq import Closure, TorchdqError, effects
from torchdq.envs import Actions, RobotEnv, RobotVectorEnv, TorchTask

BACKEND = "auto"
CRANK = Actions("torque", joints="ja", scale=1.0)


def made(number, robot=None, action=CRANK, **more):
    return RobotVectorEnv(number, more.pop("task", "reach"), robot or four_bar(), action=action, **more)


def gap(envs, q=None):
    return float(torchdq.closure_errors(envs.robot, envs.state.q if q is None else q).distance.max())


def test_episodes_start_closed_on_one_branch_with_the_crank_where_it_was_drawn_each_row_as_alone():
    envs, one = made(256, dtype="float64"), made(1, dtype="float64")
    envs.reset(seed=3)
    q = envs.state.q
    assert gap(envs) < 1e-11 and float(q[:, 0].max() - q[:, 0].min()) > 3.0
    assert len(q[:, 2].sin().sign().unique()) == 1  # the rocker is on one side of the coupler
    drawn = torchdq.envs.tasks.ranges(envs.robot)[0]
    assert bool((q[:, 0] >= drawn.lower + 0.25 * drawn.span).all())
    seen, _ = RobotEnv(task="reach", robot=four_bar(), action=CRANK).reset(seed=3)
    assert seen.shape == envs.single_observation_space.shape
    for row in (0, 100, 255):
        one.reset(seed=3 + row)
        assert torch.equal(one.state.q[0], q[row])
    # goals are places of the closed linkage, whose end is at the pivot
    assert torch.allclose(one.get_state()["goal"], torch.tensor([[0.4, 0.0, 0.0]], dtype=torch.float64), atol=1e-10)


@pytest.mark.parametrize("mode", ["SameStep", "NextStep"])
def test_loops_stay_closed_over_steps_and_resets(mode):
    envs = made(32, max_episode_steps=60, autoreset_mode=mode)
    envs.reset(seed=0)
    generator = torch.Generator().manual_seed(0)
    moved = 0.0
    for _ in range(200):
        _, _, terminated, _, _ = envs.step(2 * torch.rand(32, 1, generator=generator) - 1)
        assert gap(envs) < 1e-5 and not bool(terminated.any())
        moved = max(moved, float(envs.state.qd[:, 0].abs().max()))
    assert moved > 0.5


def test_a_rollout_with_resets_within_it_is_that_of_steps_to_the_bit():
    envs, again = made(16, max_episode_steps=7), made(16, max_episode_steps=7)
    observations, _ = envs.reset(seed=1)
    again.reset(seed=1)
    policy = torch.nn.Sequential(torch.nn.Linear(observations.shape[1], 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
    found = envs.rollout(policy, 30)
    for k in range(30):
        seen, reward, *_ = again.step(found.actions[k])
        assert torch.equal(seen, found.observations[k + 1]) and torch.equal(reward, found.rewards[k])
    assert torch.equal(envs.state.q, again.state.q) and gap(envs) < 1e-5


def test_starts_that_cannot_be_closed_within_the_limits_are_at_a_closed_home():
    robot = four_bar()
    low, high = torch.tensor([0.5, -3.0, -2.6]).double(), torch.tensor([1.5, 0.0, -0.5]).double()
    robot = robot.replace(limits=robot.limits._replace(lower=low, upper=high))
    wild = TorchTask("reach", start=lambda robot, u: {"q": 6.0 * u - 3.0}, draws=3)
    envs = made(64, robot, task=wild, dtype="float64")
    envs.reset(seed=0)
    q = envs.state.q
    assert gap(envs) < 1e-11 and bool(((q >= low) & (q <= high)).all())
    assert len(q.unique(dim=0)) > 10 and bool((q == envs._reset.loops.home).all(1).any())


def test_starts_that_a_task_closes_are_kept_and_velocities_keep_loops_closed():
    robot = four_bar()

    def start(robot, u):
        q = torch.tensor([1.0, -0.6, -1.2], dtype=u.dtype).repeat(len(u), 1) + 0.2 * u
        return {"q": torchdq.closed(robot, q, hold="ja"), "qd": u}

    envs = made(4, robot, task=TorchTask("reach", start=start, draws=3), dtype="float64")
    envs.reset(seed=0)
    q, qd = envs.state.q, envs.state.qd
    assert torch.allclose(q, torchdq.closed(robot, q), rtol=0, atol=1e-12)
    assert gap(envs, q + 1e-6 * qd) < 1e-11 and float(qd.abs().max()) > 0.1


def test_servos_move_the_crank_to_targets():
    servo = effects.Servo((20.0, 0.0, 0.0), (2.0, 0.0, 0.0))
    envs = made(4, action=Actions("target", joints="ja"), effects=(effects.Gravity(), servo), dtype="float64")
    envs.reset(seed=0)
    before = envs.state.q[:, 0]
    for _ in range(10):
        envs.step(torch.ones(4, 1))
    assert bool((envs.state.q[:, 0] > before + 0.1).all()) and gap(envs) < 1e-5


def test_joints_with_actuators_in_a_file_are_those_of_actions_and_others_have_no_rotors():
    bar = """<body name="{0}" pos="{1} 0 0"><joint name="j{0}" axis="0 -1 0"/>
      <geom type="capsule" size=".01" fromto="0 0 0 {2} 0 0"/>"""
    text = f"""<mujoco><option gravity="0 0 -9.81"/><worldbody><body name="a" euler="0 -60 0">
      <joint name="ja" axis="0 -1 0"/><geom type="capsule" size=".01" fromto="0 0 0 .2 0 0"/>
      {bar.format("b", 0.2, 0.4)}</body></body>{bar.format("c", 0.4, 0.4)}</body></worldbody>
      <equality><connect body1="b" body2="c" anchor=".4 0 0"/></equality>
      <actuator><motor joint="ja"/></actuator></mujoco>"""
    robot = torchdq.Robot.from_mjcf(text, tip="b")
    envs = made(8, robot, action=Actions(scale=1.0))
    envs.reset(seed=0)
    assert envs.single_action_space.shape == (1,) and gap(envs) < 1e-5
    rotors = next(x for x in envs.scene.effects if isinstance(x, effects.RotorInertia))
    assert rotors.inertia[0] > 0 and rotors.inertia[1:] == (0.0, 0.0)


def test_what_does_not_serve_loops_is_refused():
    robot = four_bar()
    far = robot.replace(closures=(Closure("ground", "end"),))  # 0.2 m and 0.4 m are no triangle with these limits
    limits = robot.limits._replace(lower=torch.zeros(3).double(), upper=torch.full((3,), 0.1).double())
    for given in (
        {"robot": robot, "action": None},
        {"robot": robot, "action": Actions("torque", joints="ja")},
        {"robot": robot, "action": Actions("reference", joints="*")},
        {"robot": robot, "task": "track"},
        {"robot": far.replace(limits=limits)},
    ):
        with refused(TorchdqError):
            made(2, **given)
