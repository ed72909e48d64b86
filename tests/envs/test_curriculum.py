"""Curricula: ranges that change between episodes, without a new program, and what would need one."""

from dataclasses import replace

import pytest
import torch
from helpers import exhaustive
from messages import refused
from small_envs import ON_FOUR, PUSHES, policy_of, same, started, steps, stool

from torchdq import effects
from torchdq.envs import Absolute, Pushes, RobotVectorEnv, Simulation, TorchTask
from torchdq.errors import ArgumentError, TorchdqError, UnknownNameError
from torchdq.program import program

BACKEND = "auto"
DRAWN = {"mass": (1.0, 1.0), "payload": (0.0, 0.0), "delay": (0.0, 2.0), "Gravity.acceleration": (1.0, 1.0)}
PARTS = {"effects": (effects.Gravity(), effects.Push()), "max_episode_steps": 4, "pushes": PUSHES}
FIRM = Pushes((0.0, 0.0, 40.0, 0.0, 0.0, 0.0), (0.0, 0.0), 0.06)
MOON = Absolute([0.0, 0.0, -2.0], [0.0, 0.0, -1.0])


def range_of(envs, name):
    low, high = envs.get_state()[name].aminmax()
    return float(low), float(high)


def test_new_ranges_are_drawn_from_the_next_episode_on_without_a_new_program(monkeypatch):
    """Steps, resets and rollouts of one call; what is drawn is what environments made with these ranges draw."""
    new = {"mass": (2.0, 3.0), "payload": 1.0, "Gravity.acceleration": MOON}
    envs, made = (started(64, randomise=DRAWN | more, **PARTS) for more in ({}, new))
    policy = policy_of(envs)
    envs.rollout(policy, 5), made.rollout(policy, 5), steps(envs, 5), steps(made, 5)
    monkeypatch.delattr(program, "recording")
    envs.reset(seed=1), made.reset(seed=1)
    before, name = envs.get_state(), next(x for x in envs.get_state() if x.endswith(".factor"))
    envs.set(randomise=new)
    assert same(envs.get_state(), before) and range_of(envs, name) == (1.0, 1.0)
    envs.reset(seed=1)
    assert same(envs.get_state(), made.get_state())
    low, high = range_of(envs, name)
    assert 2.0 <= low < 2.1 and 2.9 < high <= 3.0
    assert same(envs.rollout(policy, 9), made.rollout(policy, 9)) and same(steps(envs, 9), steps(made, 9))


def test_pushes_follow_new_ranges_from_the_next_one_on():
    envs = started(16, **PARTS)
    under_way = envs.get_state()["push"]
    envs.set(pushes={"push": FIRM})
    assert same(envs.get_state()["push"], under_way)
    envs.rollout(policy_of(envs), 12)
    push = envs.get_state()["push"]
    assert float(push[:, 2].abs().max()) > 5.0 and torch.allclose(push[:, 7] - push[:, 6], torch.tensor(0.06))


@exhaustive
def test_commands_of_a_walk_grow_without_a_new_program(monkeypatch):
    envs = RobotVectorEnv(64, replace(ON_FOUR, forward=(0.0, 0.1)), stool(), simulation=Simulation(substeps=1))
    envs.reset(seed=0)
    envs.step(torch.zeros(64, 4))
    monkeypatch.delattr(program, "recording")
    for fastest in (0.5, 1.0):
        envs.set(task=replace(ON_FOUR, forward=(0.0, fastest)))
        envs.reset()
        envs.step(torch.zeros(64, 4))
        assert 0.9 * fastest < float(envs.get_state()["goal"][:, 0].max()) <= fastest


def test_functions_of_tensors_act_at_once():
    easy = TorchTask("reach", reward=lambda now: now.time)
    envs = started(task=easy)
    envs.set(task=replace(easy, reward=lambda now: -2.0 * now.time))
    assert torch.allclose(envs.step(torch.zeros(5, 2))[1], torch.tensor(-0.04))


REFUSED = {
    "a parameter that was not drawn": {"randomise": {"friction": 0.1}},
    "a delay that is not remembered": {"randomise": {"delay": (0.0, 3.0)}},
    "a name that is not there": {"randomise": {"masss": 0.1}},
    "what an effect refuses": {"randomise": {"mass": (-1.0, 1.0)}},
    "no names": {"randomise": 0.1},
    "an unknown push": {"pushes": {"pull": FIRM}},
    "another task": {"task": "track"},
    "another observation": {"task": TorchTask("reach", observation=lambda now: now.q, bounds=[(-9, 9)] * 2)},
}


def test_a_task_with_other_fields_is_refused_by_their_names():
    envs = RobotVectorEnv(2, replace(ON_FOUR, forward=(0.0, 0.1)), stool())
    with refused(ArgumentError) as caught:
        envs.set(task=replace(ON_FOUR, forward=(0.0, 1.0), stiffness=1.5, feet="foot[01]"))
    assert "another feet and stiffness;" in str(caught.value)


@pytest.mark.parametrize("what", REFUSED)
def test_what_needs_another_program_is_refused_and_changes_nothing(what):
    envs, twin = (started(randomise=DRAWN, **PARTS) for _ in range(2))
    with refused(TorchdqError) as caught:
        envs.set(**REFUSED[what])
    assert isinstance(caught.value, UnknownNameError) == (what in ("a name that is not there", "an unknown push"))
    assert same(steps(envs, 5), steps(twin, 5))
