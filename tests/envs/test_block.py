"""Blocks of steps as one call: equal to stepping with the same actions, to the bit."""

import pytest
from helpers import thinned
from small_envs import ALL_DRAWN, FREE, ON_FOUR, PARTS, PUSHES, assert_as_stepped, policy_of, same, started, stool

from torchdq import effects
from torchdq.program.program import Largest

BACKEND = "auto"
SENSED = (effects.Gravity(), effects.Push(), effects.CommandDelay(2), effects.MeasurementDelay(2), effects.Noise(0.01))
SHIPPED = {"robot": None, "action": None, "scale": None}  # what the task is made for
GROUND = {"Contact.friction": (0.3, 1.5), "Contact.stiffness": (0.2, 2.0)}
ONE_CALL = {
    "several episodes of some joints": {"joints": "*2", "max_episode_steps": 3},
    "positions that a controller follows": {"action": "reference", "scale": None, "dtype": "float64"},
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


@pytest.mark.parametrize("name", thinned(ONE_CALL, ONE_CALL.keys() - {"wipe", "positions that a controller follows"}))
def test_a_block_is_its_steps(name):
    """Of rows that fill no vector of the processor, with ends of episodes, and pushes, more than one in a block."""
    envs, twin = (started(11, **ONE_CALL[name]) for _ in range(2))
    found = assert_as_stepped(envs, twin, policy_of(envs), 13)
    assert bool(found.observations.isfinite().all())
    if envs.max_episode_steps < 13:
        assert found.truncated.sum(0).min() >= 1


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
    monkeypatch.setattr("torchdq.backends.precision.LARGEST_GROWTH", Largest(1.05, double))
    found = assert_as_stepped(envs, twin, policy_of(envs), 6, blocks=1)
    monkeypatch.undo()
    assert not same(single.rollout(policy_of(single), 6, found.actions, 0.5).rewards, found.rewards)
    assert bool(found.info["nonfinite"].any()) == (double == 1.05)
