"""Actions that displace a desired pose: what they mean, how far it may be ahead, and how an arm follows."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import exhaustive, random, thinned
from messages import refused
from small_envs import PARTS, ROBOT, started

import torchdq
from torchdq import dq, effects
from torchdq.dq.formulas import computed
from torchdq.dynamics.task_space import Task
from torchdq.envs import Actions, RobotVectorEnv, Simulation
from torchdq.envs.pose_actions import PoseActions
from torchdq.errors import ArgumentError
from torchdq.scene import controllers

PLANAR = controllers.OperationalSpaceControl(100.0, 20.0, axes=("x", "y"), expressed="world")
POSE = {"action": "pose", "scale": None, "controller": PLANAR, "dtype": torch.float64, "backend": "auto"}
ONE = ((1.0, 0.0, 0.0, 0.0), (0.0,) * 4)


def turned(v):
    """Rotation matrices of rotation vectors."""
    x, y, z = v.unbind(-1)
    skew = torch.stack([0 * x, -z, y, z, 0 * x, -x, -y, x, 0 * x], -1).unflatten(-1, (3, 3))
    return torch.matrix_exp(skew)


@pytest.mark.parametrize("world", [True, False], ids=["world", "body"])
def test_an_action_turns_about_the_frame_and_displaces_it_in_the_controllers_axes(world):
    """A rotation vector longer than one full component is cut to that."""
    X, action = dq.exp(random(20, 6)), 2 * torch.rand(20, 6, dtype=torch.float64, generator=torch.Generator()) - 1
    scale = torch.tensor([0.5] * 3 + [0.05] * 3, dtype=torch.float64)
    found = dq.to_matrix(computed(PoseActions(Task(1, ONE, world), (1.0, 1.0)).moved, x=X, action=action, scale=scale))
    turn = action[:, :3] / action[:, :3].norm(dim=-1, keepdim=True).clamp(min=1.0)
    step, before = turned(0.5 * turn), dq.to_matrix(X)
    R, d = before[:, :3, :3], 0.05 * action[:, 3:]
    assert torch.allclose(found[:, :3, :3], step @ R if world else R @ step, atol=1e-14)
    moved = d if world else (R @ d.unsqueeze(-1)).squeeze(-1)
    assert torch.allclose(found[:, :3, 3], before[:, :3, 3] + moved, atol=1e-14)
    assert (action[:, :3].norm(dim=-1) > 1).any()


def test_axes_that_the_controller_leaves_out_are_not_moved():
    X, task = dq.exp(random(5, 6)), Task(1, ONE, True, (5, 2))
    found = computed(PoseActions(task, (1.0, 1.0)).moved, x=X, action=random(5, 2), scale=torch.ones(2).double())
    step = dq.to_matrix(dq.mul(found, dq.conj(X)))[:, :3, :3]
    assert torch.allclose(step[:, 2, :], torch.eye(3).double()[2], atol=1e-14)
    assert torch.allclose(found[:, :1] * 0, (dq.translation(found) - dq.translation(X))[:, :1], atol=1e-14)


def test_no_action_holds_the_desired_pose_under_a_load_and_follows_the_measured_one_down():
    """The controller knows nothing of the load, and rounding errors do not add up."""
    loaded = (effects.Gravity(), effects.Viscous(2.0), effects.Payload(0.5))
    own = POSE | {"controller": replace(PLANAR, model=ROBOT), "dtype": torch.float32}
    heights = []
    for leash in ((1.0, 0.3), (0.0, 0.0)):
        envs = started(4, effects=loaded, leash=leash, max_episode_steps=None, **own)
        before = envs.get_state()["reference"]
        for _ in range(300):
            envs.step(torch.zeros(4, 2))
        assert torch.allclose(envs.get_state()["reference"], before, atol=1e-6) == (leash[0] > 0)
        after = torchdq.forward_kinematics(ROBOT, envs.state.q, ROBOT.tip)
        heights.append((dq.translation(before) - dq.translation(after)).norm(dim=-1))
    assert (heights[0] < 0.3).all() and (heights[1] > 2 * heights[0]).all()


@pytest.mark.parametrize(
    ("axes", "leash"), thinned([(("x", "y"), (1.0, 0.04)), (("rz",), (0.2, 1.0))], [(("rz",), (0.2, 1.0))]), ids=str
)
def test_the_desired_pose_stays_within_the_leash_of_the_measured_one(axes, leash):
    """Of its turn, and of its place."""
    own = POSE | {"controller": replace(PLANAR, axes=axes), "backend": "eager"}
    envs, longest = started(4, leash=leash, max_episode_steps=None, effects=PARTS[:4], **own), 0.0
    for k in range(30):
        envs.step(torch.ones(4, len(axes)) if k < 15 else -torch.ones(4, len(axes)))
        X, goal = torchdq.forward_kinematics(ROBOT, envs.state.q, ROBOT.tip), envs.get_state()["reference"]
        turn = 2 * dq.log_shortest(dq.mul(dq.conj(X), goal))[:, :3]
        ahead = torch.stack([turn.norm(dim=-1), (dq.translation(goal) - dq.translation(X)).norm(dim=-1)], -1)
        longest = ahead.amax(0).clamp(min=longest)
    share = longest / torch.tensor(leash, dtype=torch.float64)
    assert (share < 1 + 1e-12).all() and share.max() > 0.75


@pytest.mark.parametrize("leash", thinned([(0.5, 0.05), (0.0, 0.0)], [(0.5, 0.05)]), ids=str)
def test_an_episode_begins_with_the_pose_at_which_the_arm_is(leash):
    envs, before = started(3, leash=leash, max_episode_steps=4, effects=PARTS[:4], **POSE), None
    for _ in range(4):
        before = envs.get_state()["reference"]
        envs.step(torch.ones(3, 2))
    expected = torchdq.forward_kinematics(ROBOT, envs.state.q, ROBOT.tip)
    assert torch.allclose(dq.to_matrix(envs.get_state()["reference"]), dq.to_matrix(expected), atol=1e-13)
    assert not torch.allclose(before, expected, atol=1e-2)


def test_a_proportional_policy_reaches():
    """The tip of 95 % of Pandas is within 2 cm of its goal after 1.5 s, with friction that the controller ignores."""
    control = controllers.OperationalSpaceControl(400.0, 40.0, axes="position", expressed="world")
    envs = RobotVectorEnv(1024, "reach", "panda", action=Actions("pose", controller=control))
    observation, _ = envs.reset(seed=1)
    for _ in range(75):
        observation, *_, info = envs.step(observation[:, 21:24] / 0.1)
    assert (info["distance"] < 0.02).float().mean() >= 0.95


@pytest.mark.parametrize("axes", [{"world": True}, {"world": False}, {"world": True, "rows": (5, 2)}], ids=str)
def test_an_absolute_pose_is_reached_by_its_action_or_approached(axes):
    """Poses of any sign and norm; of the axes that the controller leaves out there is no action."""
    X, pose = dq.exp(random(20, 6)), PoseActions(Task(1, ONE, **axes), (1.0, 1.0))
    k = len(pose.names)
    scale = torch.tensor([0.5 if name.startswith("r") else 0.05 for name in pose.names], dtype=torch.float64)
    action = (2 * torch.rand(20, k, dtype=torch.float64, generator=torch.Generator()) - 1) / 3**0.5  # full at most
    near = computed(pose.moved, x=X, action=action, scale=scale)
    assert torch.allclose(computed(pose.towards, x=X, goal=-3 * near, scale=scale), action, atol=1e-14)
    far = computed(pose.moved, x=X, action=action, scale=3 * scale)
    found = computed(pose.towards, x=X, goal=far, scale=scale)
    halves = [[i for i, name in enumerate(pose.names) if name.startswith("r") == turns] for turns in (True, False)]
    for half in halves:
        expected = 3 * action[:, half]
        expected = expected / expected.norm(dim=-1, keepdim=True).clamp(min=1.0)
        assert torch.allclose(found[:, half], expected, atol=1e-14)


@exhaustive
def test_the_default_controller_follows_absolute_poses():
    envs = RobotVectorEnv(16, "reach", "panda", action="pose", dtype="float64")
    envs.reset(seed=1)
    before, lost = envs.get_state()["reference"], 0.0
    for k in range(1, 61):
        told = dq.mul(before, dq.exp(0.5 * min(k, 30) * torch.tensor([0.01, 0.0, 0.0, 0.0, 0.002, 0.0]).double()))
        envs.step(envs.pose_action(told))
        found = [dq.to_matrix(x) for x in (told, envs.get_state()["reference"])]
        lost = (found[0] - found[1]).abs().amax((-2, -1)).clamp(min=lost)
    tip = dq.to_matrix(torchdq.forward_kinematics(envs.robot, envs.state.q, envs.robot.tip))
    assert envs.single_action_space.shape == (6,)
    # some of the starts are at the end of the arm's reach, or of a joint's
    assert (lost < 1e-12).float().mean() > 0.8
    assert ((tip - found[0]).abs().amax((-2, -1)) < 2e-3).float().mean() > 0.8


def test_the_default_controller_moves_a_planar_arm_in_its_plane():
    envs = started(2, **{**POSE, "controller": None})
    assert envs.scene.controller.axes == "x y" and envs.single_action_space.shape == (2,)


def test_the_default_controller_is_stable_at_slow_rates():
    """An error whose acceleration is held over a time step dies out."""
    for dt in (0.02, 0.05, 0.2):
        control = RobotVectorEnv(1, "reach", "panda", action="pose", simulation=Simulation(dt)).scene.controller
        kp, kd = control.kp[0], control.kd[0]
        step = [[1 - kp * dt**2 / 2, dt - kd * dt**2 / 2], [-kp * dt, 1 - kd * dt]]
        assert torch.linalg.eigvals(torch.tensor(step)).abs().max() < 0.9


def test_wrong_actions_are_refused():
    envs = started(2, **POSE)
    for call in (
        lambda: envs.step(torch.zeros(2, 3)),
        lambda: envs.step(torch.full((2, 2), math.nan)),
        lambda: envs.pose_action(torch.zeros(3, 8)),
        lambda: started(2).pose_action(torch.zeros(8)),
    ):
        with refused(ArgumentError):
            call()
