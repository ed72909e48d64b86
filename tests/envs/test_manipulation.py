"""Pushing, lifting and picking: starts, rewards, policies that were learned, here and in MuJoCo."""

import math
import sys
from functools import cache
from importlib import import_module

import pytest
import torch
from helpers import exhaustive
from messages import refused
from mjcf_text import panda_hand_mjcf
from places import EXAMPLES

import torchdq
from torchdq import dq
from torchdq.backends import c_library as build
from torchdq.envs import RobotVectorEnv, Simulation
from torchdq.envs.manipulation import PANDA, Lift, Pick, Push
from torchdq.objects import Ball, Box

sys.path.append(str(EXAMPLES))
F64 = torch.float64
BACKEND = "auto"  # many steps
TASKS = {"push": Push(), "lift": Lift(), "pick": Pick()}
LEARNED = 0.95  # share of a stored policy's test that succeeds


@cache
def robot():
    return torchdq.robots.load("panda_hand")


@cache
def started(name, num=32):
    envs = RobotVectorEnv(num, TASKS[name], robot(), dtype=F64, max_episode_steps=None)
    envs.reset(seed=0)
    return envs


def cube(envs):
    return dq.translation(envs.state.X_WO[:, 0])


# --- starts ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TASKS)
def test_an_episode_starts_with_an_object_on_the_table_and_the_arm_above(name):
    envs = started(name)
    p, goal = cube(envs), envs.get_state()["goal"]
    tip = dq.translation(torchdq.forward_kinematics(robot(), envs.state.q, "tcp"))
    assert (p[:, 2] - 0.022).abs().max() < 1e-12
    assert (p[:, :2] - torch.tensor([0.55 if name == "push" else 0.45, 0.0])).abs().max() < 0.101
    assert tip[:, 2].min() > 0.06
    assert {
        "push": goal[:, 0] - p[:, 0] - 0.2,
        "lift": goal[:, 2] - 0.12,
        "pick": goal[:, 2].clamp(0.04, 0.3) - goal[:, 2],
    }[name].abs().max() < 1e-12
    # fingers are closed to push, and open otherwise
    assert (envs.state.q[:, 7] < 1e-3).all() if name == "push" else (envs.state.q[:, 7] > 0.039).all()


def test_objects_and_friction_differ_from_row_to_row():
    scene = started("lift").scene
    masses, sizes = scene.objects[0].mass, scene.objects[0].size
    assert 0.07 <= float(masses.min()) < 0.08 and 0.12 < float(masses.max()) <= 0.13
    assert sizes.shape == (32, 3) and 0.036 <= float(sizes.min()) < float(sizes.max()) <= 0.044
    assert len(scene.effects[4].friction.unique()) == 32


# --- rewards ---------------------------------------------------------------------------------------------------------


def test_the_rewards_are_those_of_their_definitions():
    """ManiSkill's PushCube and PickCube and robosuite's Lift, with the terms of the docstrings."""

    def near(x, scale=5.0):
        return 1 - math.tanh(scale * x)

    tip, p, goal, still = (0.5, 0.1, 0.1), (0.55, 0.12, 0.05), (0.6, 0.1, 0.2), 0.3
    there, away = math.dist(tip, p), math.dist(goal, p)
    for grasped in (0.0, 1.0):
        reward, success = Pick().earned(tip, p, goal, grasped, still)
        assert success == 0.0
        assert reward == pytest.approx((near(there) + grasped * (1 + near(away))) / 5)
        reward, success = Pick().earned(tip, p, (0.55, 0.12, 0.06), grasped, still)
        assert success == grasped
        wanted = near(there) + grasped * (1 + near(0.01)) + grasped * (1 + near(still))
        assert reward == pytest.approx(wanted / 5, abs=1e-6)
        reward, success = Lift().earned(tip, (0.55, 0.12, 0.07), goal, grasped, still)
        assert success == grasped
    behind = math.dist(tip, (0.55 - 0.035, 0.12, 0.05))
    assert Push().earned(tip, p, goal, 0.0, still) == (pytest.approx(near(behind) / 3), 0.0)
    reward, success = Push().earned((0.565, 0.1, 0.02), (0.6, 0.1, 0.02), (0.65, 0.1, 0.02), 0.0, still)
    assert (reward, success) == (pytest.approx((3 - math.tanh(10 * 0.05)) / 3, abs=1e-6), 1.0)


# --- actions and policies ---------------------------------------------------------------------------------------------


@exhaustive
@pytest.mark.skipif(build.compiler() is None, reason="thousands of steps need a C compiler")
def test_a_script_picks_the_cube_up():
    """By inverse kinematics alone: down, close, up; without a policy."""
    envs = RobotVectorEnv(8, Lift(), robot(), dtype=F64, max_episode_steps=None, randomise={"cube.mass": (1.0, 1.0)})
    envs.reset(seed=1)
    p = cube(envs)
    turn = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=F64)
    spin = dq.rotation(envs.state.X_WO[:, 0])
    info = {}
    for height, gap, steps in ((0.1, 1.0, 12), (0.02, 1.0, 15), (0.02, -1.0, 8), (0.12, -1.0, 20)):
        place = torch.cat([p[:, :2], torch.full((8, 1), height, dtype=F64)], 1)
        X = dq.from_pose(
            dq.rotation(dq.mul(dq.from_pose(spin, place), dq.from_pose(turn, torch.zeros(3, dtype=F64)))), place
        )
        goal = torchdq.inverse_kinematics(robot(), X, "tcp", start=envs.state.q).q
        for _ in range(steps):
            q = envs.state.q
            action = torch.cat([(goal - q)[:, :7] / 0.1, torch.full((8, 1), gap, dtype=F64)], 1)
            *_, info = envs.step(action)
    assert info["success"].tolist() == [1.0] * 8


@pytest.mark.skipif(build.compiler() is None, reason="thousands of steps need a C compiler")
@pytest.mark.parametrize(
    "name", [pytest.param("push", marks=exhaustive), "lift", pytest.param("pick", marks=exhaustive)]
)
def test_stored_policies_do_their_task_here_and_in_mujoco(name):
    play = import_module("32_hands_in_mujoco")
    test = play.hands.Test(TASKS[name], robot())
    policy = play.policy_of(EXAMPLES / f"hands_{name}.pt", test.envs)
    assert test(policy)[0] >= LEARNED
    test.envs.reset(seed=3_000_000_000)
    state, goals, hand = test.envs.state, test.envs.get_state()["goal"], play.Hand(TASKS[name], robot())
    found, _ = hand.run(policy, state.q[:16], state.X_WO[:16, 0], goals[:16])
    assert float(found.double().mean()) >= 0.85


@pytest.mark.skipif(build.compiler() is None, reason="thousands of steps need a C compiler")
def test_a_policy_lifts_with_the_pads_that_a_file_of_the_arm_has(tmp_path):
    """MuJoCo Menagerie's Panda, whose five boxes on each finger are no spheres."""
    play, path = import_module("32_hands_in_mujoco"), tmp_path / "panda.xml"
    path.write_text(panda_hand_mjcf())
    envs = started("lift")
    policy, state, goals = play.policy_of(EXAMPLES / "hands_lift.pt", envs), envs.state, envs.get_state()["goal"]
    hand = play.Hand(TASKS["lift"], robot(), file=path)
    assert sorted(hand.model.geom_type) == [0] + [6] * 11  # the table, and the object among the boxes
    found, _ = hand.run(policy, *(x[:16] for x in (state.q, state.X_WO[:, 0], goals)))
    assert float(found.double().mean()) >= 0.8


def test_a_file_of_another_arm_or_without_pads_is_refused(tmp_path):
    play, path = import_module("32_hands_in_mujoco"), tmp_path / "panda.xml"
    path.write_text(panda_hand_mjcf().replace('mass="0.73"', 'mass="0.74"'))
    with pytest.raises(ValueError, match="another robot"):
        play.Hand(TASKS["lift"], robot(), file=path)
    path.write_text(panda_hand_mjcf(pad=""))
    with pytest.raises(ValueError, match="left_finger"):
        play.Hand(TASKS["lift"], robot(), file=path)


# --- arguments -------------------------------------------------------------------------------------------------------

WRONG = {
    "a home of another robot": lambda: RobotVectorEnv(2, Lift(home=(0.0,) * 6), robot()),
    "a home beyond a limit": lambda: RobotVectorEnv(2, Lift(home=(*PANDA[:7], 0.05)), robot()),
    "a home that is not finite": lambda: RobotVectorEnv(2, Lift(home=(math.nan, *PANDA[1:])), robot()),
    "a home in words": lambda: RobotVectorEnv(2, Lift(home=("0", *PANDA[1:])), robot()),
    "fingers that are not there": lambda: RobotVectorEnv(2, Lift(fingers="thumb"), robot()),
    "pads that are not there": lambda: RobotVectorEnv(2, Lift(pads="*_palm"), robot()),
    "an object with the name of a frame": lambda: RobotVectorEnv(
        2, Lift(object=Box("hand", 0.1, size=(0.04,) * 3)), robot()
    ),
    "a robot without a gripper": lambda: RobotVectorEnv(2, Lift(), "panda"),
}


@pytest.mark.parametrize("what", WRONG)
def test_what_is_wrong_is_refused_with_its_name(what):
    with refused(torchdq.TorchdqError):
        WRONG[what]()


def test_other_objects_have_tasks_too():
    simple = Simulation(substeps=1, backend="eager")
    envs = RobotVectorEnv(4, Lift(object=Ball("ball", 0.05, radius=0.02)), robot(), simulation=simple)
    envs.reset(seed=0)
    observation, *_ = envs.step(torch.zeros(4, 8))
    assert bool(observation.isfinite().all()) and envs.scene.objects[0].radius.shape == (4,)
