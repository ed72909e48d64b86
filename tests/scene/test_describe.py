"""Costs of the effects of a scene, and the parts of a robot's description that it does not simulate."""

import importlib
import pickle
import types
import warnings

import numpy as np
import pytest
import torch
from effect_harness import described
from messages import refused, warned
from scenes import ARM, PANDA, TREE

import torchdq
from torchdq import Scene, effects
from torchdq.base import progress
from torchdq.scene.controllers import ComputedTorque

describing = importlib.import_module("torchdq.scene.describe")


def test_a_description_of_a_scene_with_limits_warns_of_nothing():
    scene = Scene(PANDA, (effects.Gravity(), effects.JointLimits()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert scene.describe(64, seconds=0.1).costs


def test_the_cost_of_the_controller_is_described():
    scene = Scene(TREE, (effects.Gravity(),), ComputedTorque(25.0, 10.0))
    costs = scene.describe(batch=2, seconds=0.0).costs
    assert [cost.effect for cost in costs] == ["bare step", "Gravity", "ComputedTorque"]
    assert sum(cost.operations for cost in costs) == scene.count().total


ASKED = {
    "gravity": (effects.Gravity(),),
    "damping of joint1, joint2": (effects.Viscous(),),
    "dry friction of joint1, joint2": (effects.Coulomb(), effects.Stribeck(static=1.0)),
    "position limits of joint1, joint2": (effects.JointLimits(),),
    "torque limits of joint1, joint2": (effects.Saturation(), effects.TorqueSpeed(), effects.Servo(1.0, limit=2.0)),
    "velocity limits of joint1, joint2": (effects.TorqueSpeed(),),
    "rotor inertia": (effects.RotorInertia(), effects.Elastic(10.0)),
}


def left_out(*parts):
    """Described quantities that a scene leaves out, of a robot that is described in everything."""
    robot = described().replace(armature=torch.ones(2, dtype=torch.float64)).bake()
    return {line.split(":")[0] for line in Scene(robot, parts).describe(batch=1, seconds=0.0).left_out}


def test_what_a_file_asks_for_and_a_scene_leaves_out_is_listed():
    assert left_out() == left_out(effects.Servo(1.0)) == set(ASKED)


@pytest.mark.parametrize("what", ASKED)
def test_what_is_simulated_is_not_left_out(what):
    for effect in ASKED[what]:
        assert what not in left_out(effect)
        assert len(left_out(effect)) >= len(ASKED) - 2


def test_what_a_robot_has_no_field_for_is_listed():
    text = """<mujoco><option density="1.2"/><worldbody>
      <body name="b" gravcomp="0.5"><joint name="j" stiffness="2"/><geom size="1"/>
      <body name="c" pos="1 0 0"><joint name="k"/><geom size="1"/></body></body></worldbody>
      <actuator><motor name="m" joint="j"/></actuator></mujoco>"""
    with warned(UserWarning):
        robot = torchdq.Robot.from_mjcf(text)
    carried = pickle.loads(pickle.dumps(torchdq.robots.load("two_link").attach(robot, "link2")))
    for form, start in ((robot, ""), (robot.lock("k"), ""), (carried, f"{robot.name}: ")):
        lines = Scene(form, (effects.Gravity(),)).describe(batch=1, seconds=0.0).left_out
        assert [line.removeprefix(start).partition(";")[0].split(": ")[:2] for line in lines] == [
            ["b", "gravcomp ignored"],
            ["j", "springs given but not simulated"],
            ["m", "actuators not simulated"],
            ["geoms", "contacts given but not simulated"],
            ["air or water", "resistance not used"],
        ]


def test_a_description_prints_as_a_table():
    text = str(Scene(ARM, (effects.Viscous(0.1), effects.Push())).describe(batch=2, seconds=0.0))
    head, bare, viscous, push, total, measured, *rest = text.splitlines()
    assert head.split() == ["effect", "slot", "operations", "ns", "per", "step"]
    assert bare.startswith("bare step  rigid bodies, integrator")
    assert viscous.split()[:2] == ["Viscous", "joint"] and push.split()[:2] == ["Push", "body"]
    assert total.split()[1] == str(Scene(ARM, (effects.Viscous(0.1), effects.Push())).count().total)
    assert measured.startswith("(2 samples of float64, ")
    assert rest[-1].startswith("- gravity: ")


def faked(monkeypatch, *rounds):
    """Times of the steps of a described scene, by their order, in place of measured ones."""

    def measure(calls, batch, seconds):
        return {name: list(rounds[int(name)]) for name in calls}

    monkeypatch.setattr(describing, "measure", measure)


def test_costs_within_their_spread_are_bounds_and_none_is_negative(monkeypatch):
    """Bare step, then three effects: one that costs, one within the noise, and one that makes the step faster."""
    bare, noise = [100.0, 120.0, 90.0, 110.0, 100.0], [0.0, 30.0, -25.0, 5.0, -10.0]
    costly = [t + 50 + d for t, d in zip(bare, (0, 1, -1, 2, 0), strict=True)]
    noisy = [t + d for t, d in zip(costly, noise, strict=True)]
    faster = [t - 40 for t in noisy]
    faked(monkeypatch, bare, costly, noisy, faster)
    scene = Scene(ARM, (effects.Viscous(0.1), effects.Coulomb(0.2), effects.Push()))
    found = scene.describe(batch=2, seconds=60.0)
    assert [cost.nanoseconds for cost in found.costs] == [100.0, 50.0, 0.0, 0.0]
    assert [cost.time for cost in found.costs] == ["100", "50", "< 7.5", "< 0.1"]
    assert found.total.nanoseconds == 110.0
    rows = [line.split()[-2:] for line in str(found).splitlines()[1:5]]
    assert [row[-1] for row in rows] == ["100", "50", "7.5", "0.1"]


def test_a_description_ends_in_time_and_says_what_it_did_not_measure(monkeypatch):
    """Each program takes a second: the whole scene and two more fit into four seconds, with the measuring."""
    now = [0.0]
    step = Scene.step

    def slow(*args, **inputs):
        now[0] += 1.0
        return step(*args, **inputs)

    monkeypatch.setattr(Scene, "step", slow)
    monkeypatch.setattr(describing, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    faked(monkeypatch, [1.0] * 5, [3.0] * 5, [4.0] * 5, [8.0] * 5)
    scene = Scene(ARM, (effects.Viscous(0.1), effects.Coulomb(0.2), effects.Push()))
    found = scene.describe(batch=2, seconds=4.0)
    assert now[0] <= 4.0
    assert [cost.time for cost in found.costs] == ["1", "2", "-", "-"]
    assert found.total.time == "8"
    assert sum(cost.operations for cost in found.costs) == scene.count().total
    nothing = scene.describe(batch=2, seconds=0.0)
    assert [cost.time for cost in (*nothing.costs, nothing.total)] == ["-"] * 5


def test_a_description_says_what_it_is_doing(monkeypatch, capsys):
    monkeypatch.setattr(progress, "FIRST", 0.01)
    monkeypatch.setattr(progress, "EVERY", 0.01)
    Scene(ARM, (effects.Viscous(0.1),)).describe(batch=2, seconds=0.5)
    lines = [line for line in capsys.readouterr().err.splitlines() if "describe the scene of 'two_link'" in line]
    assert any("of 2 programs are ready" in line or "measuring" in line for line in lines)


@pytest.mark.parametrize("dtype", ["float32", np.float32, torch.float32])
def test_the_dtype_of_a_description_may_be_a_name(dtype):
    assert "samples of float32, " in Scene(ARM).describe(batch=2, dtype=dtype, seconds=0.0).measured_on


@pytest.mark.parametrize("wrong", [{"dtype": "float16"}, {"batch": 0}, {"seconds": None}, {"seconds": -1}])
def test_wrong_arguments_of_a_description_are_named(wrong):
    with refused(torchdq.TorchdqError):
        Scene(ARM).describe(**{"batch": 2, "seconds": 0.0, **wrong})
