"""Rollouts of environments: what cannot be one call is stepped, episodes go on, and what is refused."""

import pytest
import torch
from gymnasium.error import ResetNeeded
from messages import refused
from small_envs import assert_as_stepped, make, policy_of, same, started
from torch import nn

from torchdq.envs import TorchTask
from torchdq.errors import ArgumentError

BACKEND = "auto"
STEPPED = {
    "functions of tensors": {"task": TorchTask("reach", reward=lambda now: -now.q.square().sum(1))},
    "resets at the next step": {"autoreset_mode": "NextStep", "max_episode_steps": 4},
    "torch": {"backend": "eager", "max_episode_steps": 4},
}


@pytest.mark.parametrize("arguments", STEPPED.values(), ids=STEPPED)
def test_what_cannot_be_one_call_is_stepped(arguments, monkeypatch):
    monkeypatch.delattr("torchdq.envs.rollout.repeat")
    envs, twin = (started(**arguments) for _ in range(2))
    assert_as_stepped(envs, twin, policy_of(envs), 6)


def test_any_function_is_a_policy(monkeypatch):
    monkeypatch.delattr("torchdq.envs.rollout.repeat")
    envs, twin = started(max_episode_steps=4, output="numpy"), started(max_episode_steps=4)
    policies = policy_of(twin, nn.GELU), lambda observation: observation[:, :2].sin()
    for policy in policies:
        found, expected = (x.rollout(policy, 6) for x in (envs, twin))
        assert same(found, expected) and not isinstance(found.rewards, torch.Tensor)


def test_what_is_handed_out_may_be_written_into():
    """By a policy, too."""
    envs, twin = (started(max_episode_steps=4) for _ in range(2))
    policies = (
        policy_of(envs),
        lambda observation: observation.sin_()[:, :2],
        lambda observation: observation.sin()[:, :2],
    )
    envs.reset(seed=0)[0].zero_()
    for mine, other in ((policies[0],) * 2, policies[1:], (policies[0],) * 2):
        found = envs.rollout(mine, 3)
        assert same(found, twin.rollout(other, 3))
        found.observations.zero_()
    (mine, *_), (other, *_) = (x.step(torch.zeros(5, 2)) for x in (envs, twin))
    mine.zero_()
    assert not same(mine, other) and same(envs.rollout(policies[0], 3), twin.rollout(policies[0], 3))


def test_blocks_follow_resets_and_states_that_are_restored():
    envs, twin = (started(max_episode_steps=4, randomise={"mass": 0.2}) for _ in range(2))
    policy = policy_of(envs)
    assert_as_stepped(envs, twin, policy, 6)
    saved = envs.get_state()
    first = envs.rollout(policy, 6)
    envs.set_state(saved)
    assert same(envs.rollout(policy, 6), first)
    for x in (envs, twin):
        x.reset(seed=5)
    assert_as_stepped(envs, twin, policy, 6)


def late(envs):
    """Rollout whose noise is not finite when every environment has begun another episode."""
    noise = torch.zeros(9, 5, 2)
    noise[8, 2, 0] = torch.nan
    return envs.rollout(policy_of(envs), 9, noise)


MISUSE = {
    "late noise that is not finite": late,
    "a policy that returns an array": lambda envs: envs.rollout(lambda observation: observation[:, :2].numpy(), 2),
    "no policy": lambda envs: envs.rollout(None, 2),
    "noise of another length": lambda envs: envs.rollout(policy_of(envs), 6, noise=torch.zeros(5, 5, 2)),
    "noise that is not finite": lambda envs: envs.rollout(policy_of(envs), 6, noise=torch.full((6, 5, 2), torch.nan)),
    "no steps": lambda envs: envs.rollout(policy_of(envs), 0),
    "another number of actions": lambda envs: envs.rollout(nn.Sequential(nn.Linear(12, 3)), 2),
    "another number of observations": lambda envs: envs.rollout(nn.Sequential(nn.Linear(7, 2)), 2),
}


@pytest.mark.parametrize("what", MISUSE)
def test_wrong_arguments_are_refused(what):
    envs = started(max_episode_steps=3, randomise={"mass": 0.2})
    before = envs.get_state()
    with refused(ArgumentError):
        MISUSE[what](envs)
    assert same(before, envs.get_state())


def test_a_rollout_begins_after_a_reset():
    with pytest.raises(ResetNeeded):
        make().rollout(torch.sin, 3)
