"""The example of a policy that is learned through the simulation: it learns. Processes share its gradients."""

import os
import socket
import sys
from importlib import import_module

import pytest
import torch
from forked import Forked
from places import ROOT

for needed in ("matplotlib", "tyro"):
    pytest.importorskip(needed, reason="the examples need the extra 'examples'")
from matplotlib.image import imread  # noqa: E402

from torchdq.envs import Actions, RobotVectorEnv  # noqa: E402

BACKEND = "auto"
SHARED = """
import sys
sys.path[:] = {paths}
from test_through_the_simulation import found, learned
from processes import team
import torch
with team(torch.device("cpu")) as share:
    torch.save([*found(share), *learned(share)], f"{folder}/{{share.rank}}.pt")
"""


@pytest.fixture(scope="module")
def example():
    return import_module("11_through_the_simulation")


def found(share):
    """Loss and gradients of an untrained policy, in float64."""
    example = import_module("11_through_the_simulation")
    torch.manual_seed(0)
    policy, drawn = example.Policy().double(), example.drawn(31, example.Args())
    task = example.Task(*(x.double() for x in drawn))
    total, gradients = example.gradients(policy, task, example.Args(steps=10), share)
    return [total, *gradients]


def learned(share):
    """Rewards and policy of PPO on 64 arms of all processes, some of whose episodes end, in float64."""
    ppo = import_module("21_walk_ppo")
    torch.set_default_dtype(torch.float64)
    try:
        arms = RobotVectorEnv(
            64 // share.size, "reach", "two_link", action=Actions(scale=0.5), max_episode_steps=40, dtype="float64"
        )
        learner, rewards = ppo.PPO(arms, seed=1), []
        for _ in range(3):
            samples, means = learner.rollout()
            learner.update(samples)
            rewards.append(means["reward"])
        return [torch.tensor(rewards), *(x.detach() for x in learner.policy.parameters())]
    finally:
        torch.set_default_dtype(torch.float32)


def test_it_learns(example, tmp_path, capsys):
    """Arms that it did not learn from end at a fifth of their distance."""
    medians = example.main(example.Args(arms=32, iterations=40, out=tmp_path))
    assert medians[-1] < 0.2 * medians[0]
    assert "1 processes on cpu" in capsys.readouterr().out
    assert imread(tmp_path / "through_the_simulation.png")[..., :3].std() > 0.03


def test_two_processes_learn_what_one_does(tmp_path):
    """Of 31 arms, one process has 16; of those of PPO each has half. The environment is that of `torchrun`."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    paths = [*filter(None, sys.path), str(ROOT / "tests" / "docs"), str(ROOT / "examples")]
    code = SHARED.format(paths=paths, folder=str(tmp_path))
    common = {**os.environ, "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    started = []
    for rank in "01":
        folder = tmp_path / f"process{rank}"
        folder.mkdir()
        started.append(Forked(code, {**common, "RANK": rank, "LOCAL_RANK": rank}, folder))
    for process in started:
        _, errors = process.communicate(timeout=300)
        assert process.returncode == 0, errors
    ranks = [torch.load(tmp_path / f"{rank}.pt") for rank in (0, 1)]
    share = import_module("processes").Team()
    for one, two, alone in zip(*ranks, [*found(share), *learned(share)], strict=True):
        assert torch.equal(one, two)
        torch.testing.assert_close(one, alone, rtol=1e-10, atol=1e-12)
