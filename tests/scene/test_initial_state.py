"""A scene says so if it starts from states that are not finite, or far outside the limits it simulates."""

import math
import warnings

import pytest
import torch

import torchdq
from torchdq.envs import Scene, effects

PANDA = torchdq.robots.load("panda")
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
    with pytest.warns(
        UserWarning, match="1 of 3 rows start far outside their JointLimits: joint 'panda_joint1' is at 50"
    ):
        scene.start(torch.full((3, 7), 50.0).double())


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_rows_that_are_not_finite_at_the_start_are_named(value):
    scene = Scene(PANDA, (effects.Gravity(),))
    start = scene.start(moved(1, 3, value))
    expected = f"1 of 3 rows have a non-finite initial state .*: the first is row 1, where q of joint 'panda_joint4' is {value:g}"
    with pytest.warns(UserWarning, match=expected):
        scene.rollout(start, steps=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene.rollout(start, steps=1, nonfinite="ignore")
        scene.rollout(scene.start(HOME), steps=1)
    with pytest.warns(
        UserWarning, match=r"1 of 1 rows have a non-finite initial state .*: qd of joint 'panda_joint1' is nan"
    ):
        scene.rollout(scene.start(HOME[0], moved(0, 0, math.nan)[0]), steps=1)


def test_a_check_takes_no_state_that_is_not_finite():
    for q in (moved(1, 2, math.nan), moved(0, 3, math.inf)):
        state = SCENE.begin({"q": q, "qd": torch.zeros_like(q)}, {})[0]
        with pytest.warns(UserWarning, match="1 of 3 rows have a non-finite initial state.*; the others are checked"):
            SCENE.check(state, seconds=0.05)
        bad = state._replace(q=state.q[[0, 1]] + math.nan, qd=state.qd[[0, 1]])
        with pytest.raises(
            torchdq.ArgumentError, match=r"state must be finite .* 2 of 2 rows have a non-finite initial state"
        ):
            SCENE.check(bad)
