"""Rollouts of environments: equal to steps with the same actions, to the bit, and what is refused."""

import pytest
import torch
from gymnasium.error import ResetNeeded
from helpers import thinned
from messages import refused
from small_envs import (
    ALL_DRAWN,
    FREE,
    ON_FOUR,
    PARTS,
    PUSHES,
    assert_as_stepped,
    make,
    policy_of,
    same,
    started,
    stool,
)
from torch import nn

from torchdq import effects
from torchdq.backends.fast_call import FAST
from torchdq.envs import TorchTask
from torchdq.errors import ArgumentError
from torchdq.program.program import Largest
from torchdq.scene import controllers

BACKEND = "auto"
SENSED = (effects.Gravity(), effects.Push(), effects.CommandDelay(2), effects.MeasurementDelay(2), effects.Noise(0.01))
SHIPPED = {"robot": None, "action": None, "scale": None}  # what the task is made for
GROUND = {"Contact.friction": (0.3, 1.5), "Contact.stiffness": (0.2, 2.0)}
PLANAR = controllers.OperationalSpaceControl(100.0, 20.0, axes=("x", "y"), expressed="world")
POSED = {"action": "pose", "scale": None, "controller": PLANAR, "effects": PARTS, "max_episode_steps": 4}
ONE_CALL = {
    "several episodes of some joints": {"joints": "*2", "max_episode_steps": 3},
    "positions that a controller follows": {"action": "reference", "scale": None, "dtype": "float64"},
    "poses": {**POSED, "dtype": "float64"},
    "everything drawn": {
        **{"task": "track", "action": "residual", "effects": PARTS, "randomise": ALL_DRAWN},
        "max_episode_steps": 7,
    },
    "pushed, and sensed late": {
        **{"robot": FREE, "effects": SENSED, "pushes": PUSHES, "randomise": {"mass": 0.2}},
        "max_episode_steps": 14,
    },
    "walk": {**SHIPPED, "task": ON_FOUR, "robot": stool(), "randomise": GROUND, "substeps": 1, "max_episode_steps": 20},
    "wipe": {"task": "wipe", "max_episode_steps": 16, **SHIPPED},
}
STEPPED = {
    "functions of tensors": {"task": TorchTask("reach", reward=lambda now: -now.q.square().sum(1))},
    "resets at the next step": {"autoreset_mode": "NextStep", "max_episode_steps": 4},
    "torch": {"backend": "eager", "max_episode_steps": 4},
}
LONG = {"wipe", "positions that a controller follows", "torch"}


@pytest.mark.parametrize("name", thinned([*ONE_CALL, *STEPPED], [x for x in (*ONE_CALL, *STEPPED) if x not in LONG]))
def test_a_rollout_is_its_steps(name, monkeypatch):
    """Of rows that fill no vector of the processor, with ends of episodes, and pushes, more than one in a call."""
    if name in STEPPED:  # one by one
        monkeypatch.delattr("torchdq.envs.rollout.repeat")
    envs, twin = (started(11, **{**ONE_CALL, **STEPPED}[name]) for _ in range(2))
    found = assert_as_stepped(envs, twin, policy_of(envs), 13)
    assert bool(found.observations.isfinite().all())
    if envs.max_episode_steps < 13:
        assert found.truncated.sum(0).min() >= 1


@pytest.mark.parametrize("name", thinned(ONE_CALL, [x for x in ONE_CALL if x not in LONG]))
def test_a_step_at_once_is_its_links(name, monkeypatch):
    """Also where a row fails, and where episodes end."""
    envs, twin = (started(11, **ONE_CALL[name]) for _ in range(2))
    state = envs.get_state()
    state["qd"][3, 0] = 1e30
    for x in (envs, twin):
        x.set_state(state)
    for _ in range(6):
        action = 1.5 * torch.randn(envs.action_space.shape, dtype=envs.dtype)
        with monkeypatch.context() as at_once:
            at_once.delattr("torchdq.envs.rollout.Steps._by_links")
            found = envs.step(action)[:4]
        with monkeypatch.context() as by_links:
            by_links.setattr("torchdq.envs.rollout.dispatching", lambda: True)
            by_links.delattr("torchdq.envs.rollout.Steps._at_once")
            assert same(found, twin.step(action)[:4])
        assert same(envs.get_state(), twin.get_state())


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


def test_a_row_that_fails_begins_again_and_no_other_notices():
    envs, twin = (started(21, effects=(effects.Gravity(),)) for _ in range(2))
    state = envs.get_state()
    state["qd"][3, 0], state["qd"][7, 1] = 1e30, -1e30
    for x in (envs, twin):
        x.set_state(state)
    found = assert_as_stepped(envs, twin, policy_of(envs), 5, blocks=1)
    assert found.info["nonfinite"].nonzero().tolist() == [[0, 3], [0, 7]]
    assert found.rewards[0, [3, 7]].tolist() == [-1000.0, -1000.0] and bool(found.info["distance"][0, 3].isnan())


@pytest.mark.parametrize("double", [2.0**46, 1.05])
def test_a_row_whose_errors_grow_is_computed_in_double_precision_or_fails_as_in_a_step(double, monkeypatch):
    envs, twin, single = (started(9, effects=(effects.Gravity(),), max_episode_steps=4) for _ in range(3))
    monkeypatch.setattr("torchdq.backends.backend.LARGEST_GROWTH", Largest(1.05, double))
    FAST.clear()  # which hold the limit
    found = assert_as_stepped(envs, twin, policy_of(envs), 6, blocks=1)
    monkeypatch.undo()
    FAST.clear()
    assert not same(single.rollout(policy_of(single), 6, found.actions, 0.5).rewards, found.rewards)
    assert bool(found.info["nonfinite"].any()) == (double == 1.05)


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
