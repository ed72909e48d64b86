"""Initial states: sensors are read once, and states that are not finite or far outside the limits are reported."""

import math
import warnings

import pytest
import torch
from helpers import random
from messages import refused, warned
from scenes import ARM, PANDA, equal, inputs_of, rich, uniform

import torchdq
from torchdq import Scene, effects

SCENE = Scene(PANDA, (effects.Gravity(), effects.JointLimits()))
HOME = torch.tensor([0.0, -0.8, 0.0, -2.4, 0.0, 1.6, 0.8]).double().repeat(3, 1)


def moved(row, joint, value):
    q = HOME.clone()
    q[row, joint] = value
    return q


@pytest.mark.parametrize(("value", "limit"), [(84.0, "2.9"), (-84.0, "-2.9")])
def test_a_start_far_outside_the_limits_is_named_once(value, limit):
    with pytest.warns(UserWarning) as found:
        SCENE.start(moved(1, 2, value))
    (message,) = (str(w.message) for w in found)
    assert (
        f"1 of 3 rows start far outside their JointLimits: joint 'panda_joint3' is at {value:g}, its limit {limit}"
        in message
    )


def test_ordinary_starts_and_scenes_without_limits_are_silent():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        SCENE.start(HOME)
        SCENE.start(moved(0, 2, 3.2))  # pressed against its stop
        Scene(PANDA).start(moved(0, 2, 84.0))
        open_ended = effects.JointLimits(lower=-math.inf, upper=math.inf)
        Scene(PANDA, (open_ended,)).start(moved(0, 2, 84.0))
        torch.func.vmap(lambda q: SCENE.start(q).q)(moved(0, 2, 84.0))


def test_limits_that_are_tensors_are_compared_row_by_row():
    upper = torch.full((3, 7), 100.0).double()
    upper[2] = 3.0
    scene = Scene(PANDA, (effects.JointLimits(lower=-100.0, upper=upper),))
    with warned(UserWarning):
        scene.start(torch.full((3, 7), 50.0).double())


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_rows_that_are_not_finite_at_the_start_are_named(value):
    scene = Scene(PANDA, (effects.Gravity(),))
    start = scene.start(moved(1, 3, value))
    with warned(UserWarning):
        scene.rollout(start, steps=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene.rollout(start, steps=1, nonfinite="ignore")
        scene.rollout(scene.start(HOME), steps=1)
    with warned(UserWarning):
        scene.rollout(scene.start(HOME[0], moved(0, 0, math.nan)[0]), steps=1)


def test_a_check_takes_no_state_that_is_not_finite():
    for q in (moved(1, 2, math.nan), moved(0, 3, math.inf)):
        state = SCENE._begin({"q": q, "qd": torch.zeros_like(q)}, {})[0]
        with warned(UserWarning):
            SCENE.check(state, seconds=0.05)
        bad = state._replace(q=state.q[[0, 1]] + math.nan, qd=state.qd[[0, 1]])
        with refused(torchdq.ArgumentError):
            SCENE.check(bad)


def test_states_are_named_tuples_with_what_is_needed():
    scene = rich(ARM)
    state = scene.start(random(4, 2), random(4, 2, seed=1))
    after = scene.step(state, **inputs_of(scene, 4))
    for found in (state, after):
        assert isinstance(found, tuple)
        assert found._fields == ("q", "qd", "memory", "reading", "X_WB", "V_WB_B", "poses", "twists")
        assert [tuple(x.shape) for x in found.rows().values()] == [(4, 2), (4, 2), (4, 2 + 8 + 8), (4, 4)]
    assert equal(after.measured, after.reading.split(2, -1))
    bare = Scene(ARM).start(random(4, 2))
    assert bare.memory is None and bare.reading is None
    assert equal(bare.measured, (bare.q, bare.qd))
    assert not bare.qd.any()


def test_a_start_reads_the_sensors_once():
    q, qd, noise = random(4, 2), random(4, 2, seed=1), uniform(Scene(ARM, (effects.Noise(0.1, 0.1),)), 4)
    scene = Scene(ARM, (effects.Noise(0.1, 0.2), effects.Bias(1.0, 2.0)))
    state = scene.start(q, qd, noise)
    radius, angle = (-2 * noise[:, 0::2].log()).sqrt(), 2 * math.pi * noise[:, 1::2]
    expected = torch.cat([q + 1 + 0.1 * radius * angle.cos(), qd + 2 + 0.2 * radius * angle.sin()], -1)
    assert torch.allclose(state.reading, expected, rtol=1e-14)


@pytest.mark.parametrize(
    ("q", "qd"),
    [
        ([0.0, 0.0], None),
        (torch.zeros(3), None),
        (torch.zeros(2, dtype=torch.int64), None),
        (torch.zeros(2), torch.zeros(2, dtype=torch.float64)),
        (torch.zeros(3, 2), torch.zeros(4, 2)),
    ],
)
def test_a_start_that_does_not_fit_is_refused_by_name(q, qd):
    with refused((torchdq.ArgumentError, torchdq.DtypeError)):
        Scene(ARM).start(q, qd)


def test_a_state_does_not_follow_later_changes_of_what_it_was_made_from():
    q = torch.zeros(2, dtype=torch.float64)
    state = Scene(torchdq.robots.load("two_link")).start(q, q)
    q.add_(1.0)
    assert not state.q.any() and not state.qd.any()
