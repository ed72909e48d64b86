"""A hand that turns a cube: rewards and observations of the example's task, and its policy, here and in MuJoCo."""

import math
import sys
from functools import cache
from importlib import import_module
from types import SimpleNamespace

import pytest
from helpers import exhaustive
from places import EXAMPLES

from torchdq.backends import c_library as build

sys.path.append(str(EXAMPLES))
BACKEND = "auto"  # many steps
example = import_module("34_turn")
TASK = example.Turn()
LEARNED, HELD = 0.95, 0.7  # shares of the stored policy's test that succeed, and of starts in MuJoCo
PLACE = (*example.PLACE, 0.025)


@cache
def hand():
    return example.load()


def cube(yaw=0.0, tilt=0.0, at=PLACE):
    """Pose of a cube that is turned about the vertical, and then about x."""
    a, b = 0.5 * yaw, 0.5 * tilt
    turn = (math.cos(a) * math.cos(b), math.cos(a) * math.sin(b), math.sin(a) * math.sin(b), math.sin(a) * math.cos(b))
    return example.dual_quaternion.from_pose(turn, at)


def view(X_WO, qd=(0.0,) * 16, **inputs):
    """Rows of the task for a hand at its home, some of whose links press on the cube."""
    spec = SimpleNamespace(robot=hand(), dt=0.05)
    return SimpleNamespace(
        scene=SimpleNamespace(spec=spec),
        **{"q": TASK.home, "qd": qd, "reading": (*TASK.home, *qd), "poses": (*X_WO[0], *X_WO[1])},
        **{"twists": (0.0,) * 6, "inputs": {"goal": PLACE, **inputs}},
        pressing=lambda name: dict(zip(TASK.parts(hand()), (1.0, 0.6, 0.4, 2.0, 0.0, 9.0, 0.0), strict=True)),
    )


def test_a_cube_that_is_held_is_rewarded_for_turning_to_the_left():
    qd, step, carry = (0.2,) * 16, 0.1, TASK.rows(view(cube()))["carry"]
    for k in range(1, 17):
        rows = TASK.rows(view(cube(step * k), qd, carry=carry))
        carry = rows["carry"]
        assert rows["turned"] == [pytest.approx(k * math.sin(step))]
        assert rows["reward"] == [pytest.approx(0.3 * math.sin(step) / 0.05 - 0.01 * 0.8, abs=1e-5)]
        assert rows["success"] == [float(k == 16)]  # a quarter is 15.7 steps, and sines are 0.2 % less
    rows = TASK.rows(view(cube(at=(PLACE[0], 0.03, 0.025)), carry=(0.3, math.cos(0.2), math.sin(0.2))))
    assert rows["turned"] == [pytest.approx(0.3 - math.sin(0.2))]
    assert rows["reward"] == [pytest.approx(0.3 * -2.0 - 5.0 * 0.03, abs=1e-5)]  # no worse than at 2 rad/s


@pytest.mark.parametrize(
    ("X_WO", "held"),
    [
        (cube(tilt=0.7), True),
        (cube(tilt=0.9), False),
        (cube(at=(PLACE[0], 0.0, 0.060)), True),
        (cube(at=(PLACE[0], 0.0, 0.070)), False),
    ],
)
def test_an_episode_ends_with_a_cube_that_is_lost(X_WO, held):
    rows = TASK.rows(view(X_WO, carry=(3.0, 1.0, 0.0)))
    assert rows["terminated"] == [float(not held)] and rows["success"] == [float(held)]
    assert held or rows["reward"] == [-2.0]


def test_quarters_of_a_turn_look_the_same():
    seen = [TASK.rows(view(cube(0.3 + yaw)))["observation"] for yaw in (0.0, math.pi / 2, math.pi, math.pi / 4)]
    assert len(seen[0]) == len(TASK.bounds(hand())) and seen[0][-7:] == [1.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0]
    assert seen[1] == pytest.approx(seen[0]) and seen[2] == pytest.approx(seen[0])
    assert max(abs(a - b) for a, b in zip(seen[0], seen[3], strict=True)) > 0.5


def test_targets_are_within_the_limits():
    limits, scale = hand().limits, TASK.defaults(hand())["scale"]
    for home, most, lower, upper in zip(TASK.home, scale, *map(list, (limits.lower, limits.upper)), strict=True):
        assert most > 0.4 and lower <= home - most + 1e-12 and home + most <= upper + 1e-12


@exhaustive
@pytest.mark.skipif(build.compiler() is None, reason="thousands of steps need a C compiler")
def test_the_stored_policy_turns_the_cube_here_and_holds_it_in_mujoco():
    test = example.hands.Test(TASK, hand())
    policy = example.play.policy_of(EXAMPLES / "hands_turn.pt", test.envs)
    assert test(policy)[0] >= LEARNED
    test.envs.reset(seed=3_000_000_000)
    state, goals = test.envs.state, test.envs.get_state()["goal"]
    held, turned = example.in_mujoco(
        example.play.Hand(TASK, hand()), policy, (state.q[:16], state.X_WO[:16, 0], goals[:16])
    )
    assert held >= HELD and turned > math.pi / 2
