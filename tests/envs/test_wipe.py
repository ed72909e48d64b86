"""The task of wiping: its path, its reference, and its ends; observation and reward are held by its page."""

import pytest
import torch
from helpers import thinned
from messages import refused

import torchdq
from torchdq import effects
from torchdq.envs import RobotVectorEnv
from torchdq.envs.wipe import Wipe

BACKEND = "auto"
BENT = (0.0, -1.2, 1.8, -2.2, -1.5708, 0.0)  # a UR10e with its tool downwards
ARMS = {"panda": (Wipe(), 0.25), "ur10e": (Wipe(home=BENT), None)}


def tips(envs, q):
    return torchdq.dq.translation(torchdq.forward_kinematics(envs.robot, q, envs.robot.tip))


@pytest.mark.parametrize("arm", thinned(ARMS, ("ur10e",)))
def test_the_reference_follows_an_ellipse_below_the_table(arm):
    """From the start above the path, and sweeping equal areas in equal times."""
    task, _ = ARMS[arm]
    envs = RobotVectorEnv(40, task, arm, dtype="float64")
    envs.reset(seed=0)
    now, table = envs.get_state(), Wipe.table(task, envs.robot)
    start, goal = tips(envs, now["q"]), now["goal"]
    assert (start - torch.cat([goal[:, :2], torch.full((40, 1), table + 0.02)], 1)).abs().max() < 1e-4
    assert not bool(now["qd"].any())
    path = []
    for _ in range(100):
        envs.step(torch.zeros(40, 7 if arm == "panda" else 6))
        path.append(envs.get_state()["reference"])
    q, qd, _ = torch.stack(path).chunk(3, -1)
    p = tips(envs, q)
    assert (p[40:, :, 2] - (table - 0.03)).abs().max() < 1e-4  # it has landed
    assert (qd[1:] - (q[1:] - q[:-1]) / 0.02).abs().max() < 1e-9
    first, ratio, rate = goal[:, 2:4], goal[:, 4], goal[:, 5]
    x, y = (p[..., :2] - (goal[:, :2] - first)).unbind(-1)
    square = first.square().sum(1)
    along, across = (x * first[:, 0] + y * first[:, 1]) / square, (y * first[:, 0] - x * first[:, 1]) / square
    assert ((along.square() + (across / ratio).square()).sqrt() - 1)[5:].abs().max() < 1e-3
    swept = along[:-1] * across[1:] - along[1:] * across[:-1]
    assert (swept / (ratio * torch.sin(0.02 * rate)) - 1)[5:].abs().max() < 0.02
    assert 0.5 <= ratio.min() < 0.55 and 0.95 < ratio.max() <= 1


def test_without_a_policy_the_arm_presses_and_stays_near_the_path():
    envs = RobotVectorEnv(50, "wipe", "panda")
    envs.reset(seed=0)
    for k in range(120):
        *_, info = envs.step(torch.zeros(50, 7))
        if k > 50:
            assert (info["force"] > 1).all() and (info["force"] < 60).all() and (info["distance"] < 0.06).all()


def test_an_episode_ends_far_from_the_path_and_where_the_force_is_large():
    envs = RobotVectorEnv(3, "wipe", "panda", dtype="float64", max_episode_steps=None)
    envs.reset(seed=0)
    for _ in range(50):
        envs.step(torch.zeros(3, 7))
    now = envs.get_state()
    goal = now["goal"].clone()
    goal[1, 0] += 0.2
    memory = next(name for name in now if name.startswith("memory"))
    pressed = now[memory].clone()
    pressed[2, 3] = 1.0  # a spring that the table may compress as far as it rises
    height = now["5.height"] + torch.tensor([0.0, 0.0, 0.1])
    envs.set_state({**now, "goal": goal, "5.height": height, memory: pressed})
    _, _, terminated, _, info = envs.step(torch.zeros(3, 7))
    assert terminated.tolist() == [False, True, True] and info["nonfinite"].tolist() == [False] * 3


def test_what_is_random_are_the_table_and_the_path_unless_other_effects_are_given():
    envs = RobotVectorEnv(500, "wipe", "panda")
    envs.reset(seed=0)
    drawn = {name.partition(".")[2]: x for name, x in envs.get_state().items() if name.startswith("5.")}
    ranges = {"friction": (0.25, 0.75), "stiffness": (6e3, 6e4), "height": (0.245, 0.255)}
    assert drawn.keys() == ranges.keys()
    for name, (low, high) in ranges.items():
        x = drawn[name]
        assert low - 1e-4 < x.min() < low + 0.05 * (high - low) and high - 0.05 * (high - low) < x.max() < high + 1e-4
    plain = RobotVectorEnv(5, "wipe", "panda", effects=(effects.Gravity(), effects.Contact(height=0.25)))
    plain.reset(seed=0)
    assert not any("." in name for name in plain.get_state())


def test_another_arm_needs_another_home():
    with refused(torchdq.ArgumentError):
        RobotVectorEnv(2, "wipe", "ur10e")
