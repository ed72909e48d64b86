"""Scenes: what is off is absent, controllers are what their equations say, and tensors go in and out as they should.

What each effect does is the claim of test_effects.py, how time passes that of test_integrators.py.
"""

import dataclasses
import importlib
import itertools
import math
import pickle
import types
import warnings

import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import FIXED, called, double, random, thinned
from oracles import random_tree, shipped, states

import torchdq
from torchdq.backends import c_library as build
from torchdq.base import progress as notice
from torchdq.envs import Scene, State, effects
from torchdq.errors import ArgumentError, DtypeError
from torchdq.scene import recording as plans
from torchdq.scene.controllers import PD, ComputedTorque
from torchdq.scene.integrators import (
    DormandPrince,
    ExplicitEuler,
    LinearlyImplicit,
    RungeKutta4,
    SemiImplicitEuler,
    StoermerVerlet,
)

EPS = 2.0**-52
describing = importlib.import_module("torchdq.scene.describe")
ARM = shipped("two_link").robot
TREE = random_tree(3, seed=6, armature=True).robot
PANDA = shipped("panda").robot
needs_compiler = pytest.mark.skipif(build.compiler() is None, reason="there is no C compiler")


def equal(a, b):
    return all((x is None and y is None) or torch.equal(x, y) for x, y in zip(a, b, strict=True))


# --- off is absent ---------------------------------------------------------------------------------------------------

NOTHING = {
    "Viscous": effects.Viscous(0.0),
    "Coulomb": effects.Coulomb(0.0),
    "Stribeck": effects.Stribeck(0.0, 0.0),
    "Quadratic": effects.Quadratic(0.0),
    "Directional": effects.Directional(0.0, 0.0),
    "LoadDependent": effects.LoadDependent(0.0),
    "Ripple": effects.Ripple(0.1, 0.0, 0.0),
    "Spring": effects.Spring(0.0, 0.3),
    "Servo": effects.Servo(0.0, 0.0),
    "Limits": effects.Limits(-math.inf, math.inf),
    "Limits without stiffness": effects.Limits(-1.0, 1.0, 0.0),
    "Drag": effects.Drag(0.0, 0.0, 0.0),
    "Contact": effects.Contact(stiffness=0.0),
    "RotorInertia": effects.RotorInertia(0.0),
    "MassScale": effects.MassScale(1.0),
    "Payload": effects.Payload(0.0, (0.1, 0.2, 0.3)),
    "Gravity": effects.Gravity((0.0, 0.0, 0.0)),
    "Saturation": effects.Saturation(math.inf),
    "TorqueSpeed": effects.TorqueSpeed(math.inf, 1.0),
    "Bias": effects.Bias(0.0, 0.0),
    "QuantisedReading": effects.QuantisedReading(0.0, 0.0),
}


@pytest.mark.case("T14")
@pytest.mark.parametrize("robot", [ARM, PANDA], ids=["two_link", "panda"])
@pytest.mark.parametrize("kind", NOTHING)
def test_an_effect_of_no_size_is_no_operation(kind, robot):
    """Constants fold, so nothing is left of it; results are the same bit by bit."""
    bare, made = Scene(robot), Scene(robot, (NOTHING[kind],))
    assert made.count() == bare.count()
    s = states(robot)
    inputs = {"target": s.q} if kind == "Servo" else {}
    assert equal(made.step(made.start(s.q, s.qd), s.qdd, **inputs)[:2], bare.step(State(s.q, s.qd), s.qdd)[:2])


@pytest.mark.case("T14")
@pytest.mark.parametrize("kind", ["Viscous", "Coulomb", "Spring", "Limits", "Saturation", "RotorInertia"])
@pytest.mark.parametrize("integrator", FIXED, ids=called)
def test_an_effect_of_no_size_leaves_the_very_same_program(kind, integrator):
    bare = Scene(TREE, integrator=integrator)
    assert bare.replace(effects=(NOTHING[kind],)).program().ops == bare.program().ops


SOMETHING = (
    effects.Gravity(),
    effects.RotorInertia(),
    effects.Payload(0.5),
    effects.MassScale(1.1),
    effects.Viscous(0.1),
    effects.Coulomb(0.1),
    effects.Stribeck(0.1, 0.2),
    effects.Quadratic(0.1),
    effects.Directional(0.1, 0.2),
    effects.LoadDependent(0.1),
    effects.Ripple(0.2, 0.1, 0.1),
    effects.LuGre(0.1),
    effects.Spring(0.3),
    effects.Servo(3.0),
    effects.Limits(-1.0, 1.0),
    effects.Elastic(30.0),
    effects.Residual(torch.mul),
    effects.Push(),
    effects.Drag(0.1),
    effects.Contact(),
    effects.Saturation(1.0),
    effects.TorqueSpeed(1.0, 1.0),
    effects.Lag(0.1),
    effects.Delay(1),
    effects.DeadBand(0.1),
    effects.QuantisedCommand(0.1),
    effects.Noise(0.1),
    effects.Bias(0.1),
    effects.QuantisedReading(0.1),
    effects.ReadingDelay(1),
)


def test_every_effect_is_switched_off_and_on():
    assert {type(effect).__name__ for effect in SOMETHING} == set(effects.__all__) - {"Effect"}


@pytest.mark.case("T14")
@pytest.mark.parametrize("effect", SOMETHING, ids=lambda e: type(e).__name__)
def test_a_scene_that_lost_its_effect_is_one_that_never_had_it(effect):
    bare, without = Scene(TREE), Scene(TREE, (effect,)).replace(effects=())
    assert without.spec is bare.spec  # and so are its programs
    q, qd, torque = random(3, 4, 3)
    assert equal(without.step(State(q, qd), torque), bare.step(State(q, qd), torque))
    kept = Scene(TREE, (effect, effects.Viscous(0.2))).replace(effects=(effects.Viscous(0.2),))
    assert kept.count() == Scene(TREE, (effects.Viscous(0.2),)).count()


@pytest.mark.case("T14")
@pytest.mark.parametrize("effect", SOMETHING, ids=lambda e: type(e).__name__)
def test_an_effect_costs_what_its_description_says(effect):
    """Operations of the bare step and of its parts add up to those of the scene."""
    description = Scene(TREE, (effects.Viscous(0.2), effect)).describe(batch=2, seconds=0.0)
    bare, first, second = description.costs
    assert bare.operations == Scene(TREE).count().total
    assert bare.operations + first.operations == Scene(TREE, (effects.Viscous(0.2),)).count().total
    assert (second.effect, second.slot) == (type(effect).__name__, effect.SLOT)
    assert sum(cost.operations for cost in description.costs) == description.total.operations
    assert description.total.operations == Scene(TREE, (effects.Viscous(0.2), effect)).count().total
    # moved, or folded into constants, as a second viscous friction is into the first
    free = (effects.Delay, effects.ReadingDelay, effects.Payload, effects.MassScale, effects.Viscous)
    assert (second.operations == 0) == isinstance(effect, free)


def test_a_description_of_a_scene_with_limits_warns_of_nothing():
    scene = Scene(PANDA, (effects.Gravity(), effects.Limits()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert scene.describe(64, seconds=0.1).costs


def test_the_cost_of_the_controller_is_described():
    scene = Scene(TREE, (effects.Gravity(),), ComputedTorque(25.0, 10.0))
    costs = scene.describe(batch=2, seconds=0.0).costs
    assert [cost.effect for cost in costs] == ["bare step", "Gravity", "ComputedTorque"]
    assert sum(cost.operations for cost in costs) == scene.count().total


@pytest.mark.parametrize("robot", [ARM, TREE, PANDA], ids=["two_link", "tree", "panda"])
@pytest.mark.parametrize("integrator", FIXED, ids=called)
def test_a_resting_arm_of_a_bare_scene_stays_where_it_is(integrator, robot):
    """No gravity, whatever the robot has: bit by bit the same place."""
    q = states(robot).q
    state = Scene(robot, integrator=integrator).rollout(State(q, torch.zeros_like(q)), steps=3)
    assert torch.equal(state.q, q.expand(3, *q.shape))
    assert not state.qd.any()


def test_a_bare_scene_has_no_rotors_limits_or_friction_of_its_robot():
    limits = torchdq.robot.robot.Limits(*(double(-0.1, -0.1, -0.1) * sign for sign in (1, -1, -1, -1)))
    described = TREE.replace(limits=limits, damping=double(9.0, 9.0, 9.0), friction=double(9.0, 9.0, 9.0))
    plain = TREE.replace(gravity=None, armature=None)
    q, qd, torque = random(3, 4, 3)
    found = Scene(described, integrator=ExplicitEuler(), dt=1.0).step(State(q, qd), torque).qd - qd
    expected = torchdq.forward_dynamics(plain, q, qd, torque)
    assert torch.allclose(found, expected, rtol=1e-11, atol=1e-11)


# --- what a description asks for -------------------------------------------------------------------------------------

BODY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
FILE = f"""
<robot name="asking"><link name="base"/><link name="arm">{BODY}</link><link name="tool">{BODY}</link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="5" velocity="2"/><dynamics damping="0.5" friction="0.25"/></joint>
  <joint name="wrist" type="continuous"><parent link="arm"/><child link="tool"/><axis xyz="0 0 1"/></joint>
</robot>"""
ASKED = {
    "gravity": (effects.Gravity(),),
    "damping of shoulder": (effects.Viscous(),),
    "dry friction of shoulder": (effects.Coulomb(), effects.Stribeck(static=1.0)),
    "position limits of shoulder": (effects.Limits(),),
    "torque limits of shoulder": (effects.Saturation(), effects.TorqueSpeed()),
    "velocity limits of shoulder": (effects.TorqueSpeed(),),
}


def test_what_a_file_asks_for_and_a_scene_leaves_out_is_listed():
    lines = Scene(torchdq.Robot.from_urdf(FILE)).describe(batch=1, seconds=0.0).left_out
    assert [line.split(":")[0] for line in lines] == list(ASKED)


@pytest.mark.parametrize("what", ASKED)
def test_what_is_simulated_is_not_left_out(what):
    for effect in ASKED[what]:
        lines = Scene(torchdq.Robot.from_urdf(FILE), (effect,)).describe(batch=1, seconds=0.0).left_out
        assert what not in [line.split(":")[0] for line in lines]
        assert len(lines) >= len(ASKED) - 2


def test_what_a_robot_has_no_field_for_is_listed():
    text = """<mujoco><option density="1.2"/><worldbody>
      <body name="b" gravcomp="0.5"><joint name="j" stiffness="2"/><geom size="1"/>
      <body name="c" pos="1 0 0"><joint name="k"/><geom size="1"/></body></body></worldbody>
      <equality><connect name="loop" body1="c" body2="b" anchor="0 0 0"/></equality>
      <actuator><motor name="m" joint="j"/></actuator></mujoco>"""
    with pytest.warns(UserWarning, match="gravcomp"):
        robot = torchdq.Robot.from_mjcf(text)
    carried = pickle.loads(pickle.dumps(torchdq.robots.load("two_link").attach(robot, "link2")))
    for form, start in ((robot, ""), (robot.lock("k"), ""), (carried, f"{robot.name}: ")):
        lines = Scene(form, (effects.Gravity(),)).describe(batch=1, seconds=0.0).left_out
        assert [line.removeprefix(start).split(": ")[:2] for line in lines] == [
            ["b", "gravcomp ignored"],
            ["j", "springs given but not simulated"],
            ["m", "actuators not simulated; their greatest efforts, damping and rotor inertia are read"],
            ["connect 'loop'", "equality constraints not used"],
            ["geoms", "contacts given but not simulated"],
            ["air or water", "resistance not used"],
        ]


def test_rotors_are_listed_until_they_are_simulated():
    def lines(*parts):
        return [line.split(":")[0] for line in Scene(TREE, parts).describe(batch=1, seconds=0.0).left_out]

    assert lines() == ["gravity", "rotor inertia"]
    assert lines(effects.Gravity(), effects.RotorInertia()) == []
    assert lines(effects.Elastic(10.0)) == ["gravity"]


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
    """Bare step, then three effects: one that costs, one lost in the noise, and one that makes the step faster."""
    bare, noise = [100.0, 120.0, 90.0, 110.0, 100.0], [0.0, 30.0, -25.0, 5.0, -10.0]
    costly = [t + 50 + d for t, d in zip(bare, (0, 1, -1, 2, 0), strict=True)]
    lost = [t + d for t, d in zip(costly, noise, strict=True)]
    faster = [t - 40 for t in lost]
    faked(monkeypatch, bare, costly, lost, faster)
    scene = Scene(ARM, (effects.Viscous(0.1), effects.Coulomb(0.2), effects.Push()))
    found = scene.describe(batch=2, seconds=60.0)
    assert [cost.nanoseconds for cost in found.costs] == [100.0, 50.0, 0.0, 0.0]
    assert [cost.time for cost in found.costs] == ["100.0", "50.0", "< 7.5", "< 0.1"]
    assert found.total.nanoseconds == 110.0
    rows = [line.split()[-2:] for line in str(found).splitlines()[1:5]]
    assert [row[-1] for row in rows] == ["100.0", "50.0", "7.5", "0.1"]


@needs_compiler
def test_measured_costs_are_not_negative():
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(1.0), effects.Coulomb(0.5)))
    found = scene.describe(batch=256, seconds=60.0)
    assert all(cost.nanoseconds >= 0 and cost.spread >= 0 for cost in (*found.costs, found.total))
    assert "-" not in "".join(line.split("  ")[-1] for line in str(found).splitlines()[:6])


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
    assert [cost.time for cost in found.costs] == ["1.0", "2.0", "-", "-"]
    assert found.total.time == "8.0"
    assert sum(cost.operations for cost in found.costs) == scene.count().total
    nothing = scene.describe(batch=2, seconds=0.0)
    assert [cost.time for cost in (*nothing.costs, nothing.total)] == ["-"] * 5


def test_a_description_says_what_it_is_doing(monkeypatch, capsys):
    monkeypatch.setattr(notice, "FIRST", 0.01)
    monkeypatch.setattr(notice, "EVERY", 0.01)
    Scene(ARM, (effects.Viscous(0.1),)).describe(batch=2, seconds=0.5)
    lines = [line for line in capsys.readouterr().err.splitlines() if "describe the scene of 'two_link'" in line]
    assert any("of 2 programs are ready" in line or "measuring" in line for line in lines)


@pytest.mark.parametrize("dtype", ["float32", np.float32, torch.float32])
def test_the_dtype_of_a_description_may_be_a_name(dtype):
    assert "samples of float32, " in Scene(ARM).describe(batch=2, dtype=dtype, seconds=0.0).measured_on


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"dtype": "float16"}, "dtype must be torch.float32 or torch.float64, found 'float16'"),
        ({"batch": 0}, "batch must be a whole number from 1, found 0"),
        ({"seconds": None}, "seconds must be a finite number from 0, found None"),
        ({"seconds": -1}, "seconds must be a finite number from 0, found -1"),
    ],
)
def test_wrong_arguments_of_a_description_are_named(wrong, message):
    with pytest.raises(torchdq.TorchdqError, match=message):
        Scene(ARM).describe(**{"batch": 2, "seconds": 0.0, **wrong})


# --- controllers -----------------------------------------------------------------------------------------------------

KP, KD = 25.0, 8.0


def wanted(t):
    """Reference of seven joints, positions, velocities and accelerations."""
    w = torch.arange(1, 8, dtype=torch.float64) / 3
    return torch.cat([0.5 * (w * t).sin(), 0.5 * w * (w * t).cos(), -0.5 * w**2 * (w * t).sin()])


def reference(t, n):
    return wanted(t).reshape(3, 7)[:, :n].flatten()


HELD = (effects.Gravity(), effects.RotorInertia(0.2), effects.Payload(double(0.3, 1.0, 2.0), (0.0, 0.05, 0.1)))


@pytest.mark.parametrize("integrator", [ExplicitEuler(), SemiImplicitEuler()], ids=called)
@pytest.mark.parametrize("robot", [ARM, PANDA], ids=["two_link", "panda"])
def test_computed_torque_makes_any_arm_a_double_integrator(robot, integrator):
    """Gravity, rotors and payload of the scene included, Euler's steps are those of q'' = commanded, to 1e-9."""
    n, h, q, qd = robot.n, 0.01, random(3, robot.n) * 0.3, random(3, robot.n, seed=1)
    scene = Scene(robot, HELD, ComputedTorque(KP, KD), integrator, dt=h)
    state = scene.start(q, qd)
    for k in range(100):
        r = reference(k * h, n)
        state = scene.step(state, reference=r)
        a = r[2 * n :] + KD * (r[n : 2 * n] - qd) + KP * (r[:n] - q)
        q, qd = (q + h * qd, qd + h * a) if integrator == ExplicitEuler() else (q + h * (qd + h * a), qd + h * a)
        assert (state.q - q).abs().max() < 1e-9
        assert (state.qd - qd).abs().max() < 1e-9
    assert (q - reference(1.0, n)[:n]).abs().max() < 0.1


def tracking_error(dt, integrator):
    """Of the arm after a second, less that of e'' + kd e' + kp e = 0 by a matrix exponential."""
    scene = Scene(ARM, (effects.Gravity(),), ComputedTorque(KP, KD), integrator, dt)
    state = scene.start(double(0.5, -0.3), double(0.2, 0.1))
    start = torch.stack([reference(0.0, 2)[:2] - state.q, reference(0.0, 2)[2:4] - state.qd])
    for k in range(round(1 / dt)):
        state = scene.step(state, reference=reference(k * dt, 2))
    e = (torch.matrix_exp(double((0.0, 1.0), (-KP, -KD))) @ start)[0]
    return reference(1.0, 2)[:2] - state.q - e


@pytest.mark.parametrize("integrator", [SemiImplicitEuler(), RungeKutta4()], ids=called)
def test_the_error_equation_holds_up_to_holding_the_torque_over_a_step(integrator):
    errors = [float(tracking_error(dt, integrator).norm()) for dt in (0.02, 0.01, 0.005)]
    assert errors[0] < 0.02
    assert [errors[0] / errors[1], errors[1] / errors[2]] == pytest.approx([2.0, 2.0], rel=0.15)


def test_a_wrong_model_degrades_smoothly():
    """Masses believed 0, 2, 5 and 10 % too small leave an error that grows with them and stays below tau / (kp M)."""
    errors, h = [], 0.005
    for wrong in (0.0, 0.02, 0.05, 0.1):
        believed = ARM.replace(mass=ARM.mass * (1 - wrong), inertia=ARM.inertia * (1 - wrong)).bake()
        scene = Scene(ARM, (effects.Gravity(),), ComputedTorque(KP, KD, believed), dt=h)
        state = scene.start(double(0.0, 0.0), reference(0.0, 2)[2:4])
        found = []
        for k in range(600):
            state = scene.step(state, reference=reference(k * h, 2))
            found.append(float((state.q - reference((k + 1) * h, 2)[:2]).abs().max()))
        errors.append(max(found))
    exact, *others = errors
    assert exact < 0.02  # of the step
    assert exact < others[0] < others[1] < others[2] < 0.3
    slopes = [(e - exact) / wrong for e, wrong in zip(others, (0.02, 0.05, 0.1), strict=True)]
    assert max(slopes) < 2 * min(slopes)


@pytest.mark.parametrize("robot", [ARM, TREE], ids=["two_link", "tree"])
def test_computed_torque_of_the_robots_own_model_is_the_function(robot):
    q, qd, r = random(4, robot.n), random(4, robot.n, seed=1), random(4, 3 * robot.n, seed=2)
    tau = torchdq.computed_torque(robot, q, qd, *r.split(robot.n, -1), 20.0, 5.0)
    gravity = (effects.Gravity(),)
    found = Scene(robot, gravity, ComputedTorque(20.0, 5.0, robot)).step(State(q, qd), reference=r)
    expected = Scene(robot, gravity).step(State(q, qd), tau)
    assert torch.allclose(found.qd, expected.qd, rtol=1e-11, atol=1e-11)


def test_pd_is_its_formula_and_torques_add_to_it():
    q, qd, r, u = random(4, 3), random(4, 3, seed=1), random(4, 9, seed=2), random(4, 3, seed=3)
    kp, kd = [1.0, 2.0, 3.0], double(0.1, 0.2, 0.3)
    tau = u + double(*kp) * (r[:, :3] - q) + kd * (r[:, 3:6] - qd)
    gravity = torchdq.inverse_dynamics(TREE, q, torch.zeros_like(q), torch.zeros_like(q))
    for model, more in ((None, 0.0), (TREE, gravity)):
        found = Scene(TREE, controller=PD(kp, kd, model)).step(State(q, qd), u, reference=r)
        assert torch.allclose(found.qd, Scene(TREE).step(State(q, qd), tau + more).qd, rtol=1e-12, atol=1e-11)


def test_a_controller_sees_readings():
    """A position read a tenth too large is a reference a tenth too small."""
    q, qd, r = double(0.3, -0.4), double(0.5, 0.6), random(6)
    biased = Scene(ARM, (effects.Bias(0.1, -0.2),), PD(10.0, 1.0))
    shifted = r - double(0.1, 0.1, -0.2, -0.2, 0.0, 0.0)
    found = biased.step(biased.start(q, qd), reference=r)
    assert torch.allclose(found.qd, Scene(ARM, controller=PD(10.0, 1.0)).step(State(q, qd), reference=shifted).qd)


def test_gains_may_be_learned():
    q, qd, r = random(5, 2), random(5, 2, seed=1), random(5, 6, seed=2)

    def end(kp, kd):
        return Scene(ARM, (effects.Gravity(),), ComputedTorque(kp, kd)).step(State(q, qd), reference=r).qd

    assert torch.autograd.gradcheck(
        end, [double(3.0, 4.0).requires_grad_(), random(5, 2, seed=3).abs().requires_grad_()]
    )


@pytest.mark.parametrize("controller", [ComputedTorque, PD])
def test_a_model_that_is_no_single_robot_with_these_joints_is_refused(controller):
    with pytest.raises(torchdq.ArgumentError, match=f"model of {controller.__name__} must have the 2 joints"):
        Scene(ARM, controller=controller(1.0, 1.0, PANDA))
    many = ARM.replace(mass=ARM.mass * double(1.0, 2.0)[:, None])
    with pytest.raises(torchdq.ArgumentError, match=rf"model of {controller.__name__} must be one robot, .* its mass"):
        Scene(ARM, controller=controller(1.0, 1.0, many))


@pytest.mark.parametrize("controller", [ComputedTorque, PD])
def test_a_model_is_copied_when_a_scene_is_made(controller):
    """Writing into its mass changes no scene that is there, and every later one, although the object is the same."""
    mass = ARM.mass.clone()
    given = controller(20.0, 5.0, ARM.replace(mass=mass))

    def stepped(scene):
        return scene.step(State(double(0.3, -0.4), double(0.0, 0.0)), reference=random(6)).qd

    def made(controller):
        return Scene(ARM, (effects.Gravity(),), controller, dt=0.05)

    before = made(given)
    found = stepped(before)
    mass.mul_(2)
    assert torch.equal(stepped(before), found)
    assert torch.equal(before.controller.model.mass, ARM.mass)
    later = dataclasses.replace(given, model=ARM.replace(mass=2 * ARM.mass))
    assert torch.equal(stepped(made(given)), stepped(made(later)))
    assert not torch.equal(stepped(made(given)), found)


@pytest.mark.parametrize("controller", [ComputedTorque, PD])
def test_a_model_that_requires_grad_is_refused(controller):
    learned = ARM.replace(mass=ARM.mass.clone().requires_grad_())
    with pytest.raises(ArgumentError, match=rf"model of {controller.__name__} must have constants.* mass .*model.bake"):
        Scene(ARM, controller=controller(1.0, 1.0, learned))
    Scene(ARM, controller=controller(1.0, 1.0, learned.bake()))


# --- effects that take nothing ---------------------------------------------------------------------------------------

# parts of a description, and what the shipped arm without friction and limits says of each
TAKING = {
    effects.Viscous(): ("coefficient from", "no damping", "coefficient is 0"),
    effects.Coulomb(): ("level from", "no friction", "level is 0"),
    effects.Stribeck(static=0.0): ("coulomb from", "no friction", "coulomb is 0, static is 0"),
    effects.Limits(): ("lower and upper from", "no limits.lower and limits.upper", "lower is -inf, upper is inf"),
    effects.Saturation(): ("limit from", "no limits.effort", "limit is inf"),
    effects.TorqueSpeed(): ("stall and speed from", "no limits.effort and limits.velocity", "stall is inf"),
}


@pytest.mark.parametrize("effect", TAKING, ids=lambda e: type(e).__name__)
def test_a_description_that_has_nothing_to_take_is_told_once(effect):
    torchdq.clear_caches()
    name, (wanted, absent, value) = type(effect).__name__, TAKING[effect]
    with pytest.warns(
        UserWarning, match=f"{name} takes {wanted} .* 'two_link', which has {absent}: it acts on no joint"
    ):
        scene = Scene(ARM, (effect,))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Scene(ARM, (effect,))
        lines = scene.describe(batch=1, seconds=0.0).left_out
    assert f"{name} acts on no joint: {value}" in lines


def test_effects_that_act_are_not_told():
    """Nor are numbers that were given, and limits of zero are limits."""
    torchdq.clear_caches()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for effect in (effects.Viscous(0.0), effects.Stribeck(static=1.0), effects.Saturation(0.0), effects.Gravity()):
            Scene(ARM, (effect,))
        Scene(PANDA, (effects.Viscous(double(*[0.0] * 7)), effects.Saturation(), effects.Limits()))
    held = Scene(ARM, (effects.Saturation(0.0), effects.Limits(0.0, 0.0))).describe(batch=1, seconds=0.0).left_out
    assert not any("acts on no joint" in line for line in held)


# --- what is refused -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"robot": "panda"}, "robot must be a torchdq.Robot, found str"),
        ({"effects": (effects.Gravity,)}, "it is a class, call it"),
        ({"effects": effects.Gravity()}, "effects must be a sequence"),
        ({"effects": ("gravity",)}, "effects must be objects of torchdq.effects, found 'gravity'"),
        ({"controller": PD}, "controller must be an object of .* it is a class, call it"),
        ({"integrator": RungeKutta4}, "integrator must be an object of .* it is a class, call it"),
        ({"dt": 0.0}, "dt must be a positive number"),
        ({"dt": math.inf}, "dt must be a positive number"),
        ({"dt": "fast"}, "dt must be a positive number"),
        ({"dt": True}, "dt must be a positive number, found True"),
        ({"substeps": True}, "substeps must be a whole number from 1, found True"),
        ({"effects": (effects.Delay(True),)}, "steps of Delay must be a whole number from 1, found True"),
        ({"substeps": 0}, "substeps must be a whole number"),
        ({"substeps": 1.5}, "substeps must be a whole number"),
        ({"effects": (effects.Elastic(1.0, 0.0, 1.0),) * 2}, "must not hold Elastic twice"),
        ({"effects": (effects.Push(), effects.Push("link1"))}, "the input 'push' belongs to 2 effects"),
        ({"effects": (effects.Servo(1.0), effects.Servo(2.0))}, "the input 'target' belongs to 2 effects"),
        ({"effects": (effects.Push("base"),)}, "frame of Push is 'base', which is fixed to the base"),
        ({"effects": (effects.Push(axes="tool"),)}, "axes of Push must be 'world' or 'body'"),
        ({"effects": (effects.Delay(0),)}, "steps of Delay must be a whole number from 1"),
        ({"effects": (effects.ReadingDelay(1.5),)}, "steps of ReadingDelay must be a whole number from 1"),
        ({"effects": (effects.Viscous(-1.0),)}, "coefficient of Viscous must not be negative"),
        ({"effects": (effects.Viscous(math.nan),)}, "coefficient of Viscous must be finite"),
        ({"effects": (effects.Viscous([1.0, 2.0, 3.0]),)}, "coefficient of Viscous must be one number or 2, found 3"),
        ({"effects": (effects.Viscous(torch.ones(3)),)}, r"coefficient of Viscous must have the shape \[..., 2\]"),
        (
            {"effects": (effects.Viscous(torch.ones(2, dtype=torch.int64)),)},
            "coefficient of Viscous must be a floating",
        ),
        ({"effects": (effects.Viscous("much"),)}, "coefficient of Viscous must be a number"),
        ({"effects": (effects.Coulomb(1.0, 0.0),)}, "width of Coulomb must be positive"),
        ({"effects": (effects.Stribeck(1.0, 2.0, velocity=0.0),)}, "velocity of Stribeck must be positive"),
        ({"effects": (effects.Stribeck(1.0),)}, "static of Stribeck must be given"),
        ({"effects": (effects.Elastic(1.0, 0.0, [0.1, 0.0]),)}, "inertia of Elastic must be positive"),
        ({"effects": (effects.Drag(1.0, width=0.0),)}, "width of Drag must be positive"),
        ({"effects": (effects.Contact(width=0.0),)}, "width of Contact must be positive"),
        ({"effects": (effects.TorqueSpeed(1.0, 0.0),)}, "speed of TorqueSpeed must be positive"),
        ({"effects": (effects.QuantisedCommand(0.0),)}, "step of QuantisedCommand must be positive"),
        ({"effects": (effects.Gravity((0.0, 9.81)),)}, "acceleration of Gravity must be one number or 3, found 2"),
    ],
)
def test_a_scene_that_makes_no_sense_is_refused_by_name(arguments, message):
    with pytest.raises(torchdq.ArgumentError, match=message):
        Scene(**{"robot": ARM, **arguments})


def test_an_unknown_frame_is_refused_by_name():
    for effect in (effects.Push("nowhere"), effects.Contact("nowhere"), effects.Payload(1.0, frame="nowhere")):
        with pytest.raises(torchdq.UnknownNameError, match=r"no frame .* named 'nowhere'"):
            Scene(ARM, (effect,))


STRICT = Scene(ARM, (effects.Servo(1.0), effects.Push(), effects.Delay(1), effects.Noise(0.1)), PD(1.0, 1.0))
ZERO = torch.zeros(2, dtype=torch.float64)


@pytest.mark.case("P8", "P14")
@pytest.mark.parametrize("integrator", [SemiImplicitEuler(), DormandPrince()], ids=called)
@pytest.mark.parametrize(
    "change, message",
    [
        ({"trgt": ZERO}, "trgt is no input of this scene; it has torque, reference, target, push"),
        ({"trgt": None}, "trgt is no input of this scene; it has torque, reference, target, push"),
        ({"q": ZERO}, "q is no input of this scene"),
        ({"target": None}, "target must be given"),
        ({"reference": None}, "reference must be given"),
        ({"target": torch.zeros(3, dtype=torch.float64)}, r"target must have the shape \[..., 2\] .*\(3,\)"),
        ({"torque": ZERO[:1]}, r"torque must have the shape \[..., 2\]"),
        ({"push": ZERO}, r"push must have the shape \[..., 6\]"),
        ({"noise": ZERO}, r"noise must have the shape \[..., 4\]"),
        (
            {"torque": ZERO.float()},
            "torque is torch.float32 but q is torch.float64",
        ),
        ({"torque": [0.0, 0.0]}, "torque must be a tensor, found list"),
        ({"torque": torch.zeros(7, 2, dtype=torch.float64)}, "batch axes .* must broadcast, found .*torque"),
        ({"state": {"q": torch.zeros(5, 7, dtype=torch.float64)}}, r"q must have the shape \[..., 2\]"),
        ({"state": {"qd": torch.zeros(5, 3, dtype=torch.float64)}}, r"qd must have the shape \[..., 2\]"),
        ({"state": {"memory": None}}, "memory must be part of the state"),
        ({"state": {"reading": None}}, "reading must be part of the state"),
        ({"state": {"memory": torch.zeros(5, 3, dtype=torch.float64)}}, r"memory must have the shape \[..., 2\]"),
    ],
)
def test_what_does_not_fit_at_a_step_is_refused_by_name(change, message, integrator):
    scene = STRICT.replace(integrator=integrator)
    state = scene.start(torch.zeros(5, 2, dtype=torch.float64))
    state = state._replace(**change.get("state", {}))
    given = {"target": ZERO, "reference": torch.zeros(6, dtype=torch.float64), **change}
    given.pop("state", None)
    with pytest.raises((torchdq.ArgumentError, torchdq.DtypeError), match=message):
        scene.step(state, **given)


def test_a_misspelt_input_is_refused_even_if_it_is_none():
    scene = Scene(torchdq.robots.load("two_link"))
    state = scene.start(ZERO)
    for use in (scene.check, scene.linearize, lambda state, **inputs: scene.rollout(state, steps=2, **inputs)):
        with pytest.raises(torchdq.ArgumentError, match="trgt is no input of this scene; it has torque"):
            use(state, trgt=None)


@pytest.mark.parametrize(
    "q, qd, message",
    [
        ([0.0, 0.0], None, "q must be a tensor, found list"),
        (torch.zeros(3), None, r"q must have the shape \[..., 2\]"),
        (torch.zeros(2, dtype=torch.int64), None, "q must be float32 or float64"),
        (torch.zeros(2), torch.zeros(2, dtype=torch.float64), "qd is torch.float64 but q is torch.float32"),
        (torch.zeros(3, 2), torch.zeros(4, 2), "batch axes of the arguments must broadcast"),
    ],
)
def test_a_start_that_does_not_fit_is_refused_by_name(q, qd, message):
    with pytest.raises((torchdq.ArgumentError, torchdq.DtypeError), match=message):
        Scene(ARM).start(q, qd)


@pytest.mark.parametrize(
    "given, message",
    [
        ({}, "steps must be given where there is no torque"),
        ({"steps": 3, "torque": torch.zeros(4, 2)}, "steps and the first axes of the inputs must agree"),
        ({"steps": -1}, "steps must be a whole number from 0"),
        ({"steps": 3, "checkpoint": -1}, "checkpoint must be a whole number from 0"),
    ],
)
def test_a_rollout_of_no_certain_length_is_refused(given, message):
    scene = Scene(ARM)
    with pytest.raises(torchdq.ArgumentError, match=message):
        scene.rollout(scene.start(torch.zeros(2)), **given)


# --- tensors ---------------------------------------------------------------------------------------------------------

RICH = (
    effects.Gravity(),
    effects.RotorInertia(0.1),
    effects.Viscous(0.3),
    effects.Coulomb(0.2),
    effects.Limits(-1.0, 1.0, 100.0),
    effects.Drag(0.1, 0.1, 0.1),
    effects.Contact(height=0.3, stiffness=100.0, friction=0.5),
    effects.Push(),
    effects.Lag(0.05),
    effects.Saturation(5.0),
    effects.Noise(0.1, 0.2),
    effects.ReadingDelay(2),
)


def rich(robot, **fields):
    return Scene(robot, RICH, ComputedTorque(KP, KD), LinearlyImplicit(), **fields)


def inputs_of(scene, *batch, seed=0, dtype=torch.float64):
    return {
        name: random(*batch, width, seed=seed + k).to(dtype) for k, (name, width) in enumerate(scene.inputs.items())
    }


def uniform(scene, *batch):
    generator = torch.Generator().manual_seed(9)
    return torch.rand(*batch, scene.noises, generator=generator, dtype=torch.float64)


def test_states_are_named_tuples_with_what_is_needed():
    scene = rich(ARM)
    state = scene.start(random(4, 2), random(4, 2, seed=1))
    after = scene.step(state, **inputs_of(scene, 4))
    for found in (state, after):
        assert isinstance(found, tuple)
        assert found._fields == ("q", "qd", "memory", "reading", "X_WB", "V_WB_B")
        assert [tuple(x.shape) for x in found.rows().values()] == [(4, 2), (4, 2), (4, 2 + 8), (4, 4)]
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


@pytest.mark.case("P2")
@pytest.mark.parametrize("integrator", FIXED[1:4], ids=called)
def test_batch_axes_broadcast(integrator):
    """State, inputs and parameters each with their own axes are the same, bit by bit, as all of them written out."""
    q, qd, torque, push = random(4, 1, 2), random(2, seed=1), random(3, 2, seed=2), random(4, 3, 6, seed=3)
    d, g = random(4, 1, 2, seed=4).abs(), random(3, 3, seed=5)
    full = [x.expand(4, 3, x.shape[-1]).contiguous() for x in (q, qd, torque, push, d, g)]

    def end(q, qd, torque, push, d, g):
        scene = Scene(
            ARM, (effects.Viscous(d), effects.Gravity(g), effects.Push(), effects.Lag(0.1)), integrator=integrator
        )
        return scene.step(scene.start(q, qd), torque, push=push)

    found = end(q, qd, torque, push, d, g)
    assert found.q.shape == (4, 3, 2)
    assert equal(found, end(*full))


def test_an_adaptive_step_broadcasts_too():
    scene = Scene(
        ARM, (effects.Elastic(20.0, 0.1, 0.1), effects.Viscous(random(3, 1, 2).abs())), integrator=DormandPrince()
    )
    found = scene.step(scene.start(random(2)), random(4, 2, seed=1))
    assert [tuple(x.shape) for x in found if x is not None] == [(3, 4, 2), (3, 4, 2), (3, 4, 4)]


@pytest.mark.case("P1")
@pytest.mark.parametrize("shape", [(0,), (3, 0), (0, 4)])
@pytest.mark.parametrize("integrator", [*FIXED, DormandPrince()], ids=called)
def test_a_batch_may_be_empty(integrator, shape):
    scene = Scene(ARM, (effects.Gravity(), effects.Lag(0.1), effects.Bias(0.1)), integrator=integrator)
    q = torch.zeros(*shape, 2, dtype=torch.float64, requires_grad=True)
    after = scene.step(scene.start(q), ZERO)
    assert [tuple(x.shape) for x in after.rows().values()] == [(*shape, 2), (*shape, 2), (*shape, 2), (*shape, 4)]
    after.q.sum().backward()
    assert q.grad.shape == q.shape


@pytest.mark.parametrize("robot", [ARM, PANDA], ids=["two_link", "panda"])
def test_single_precision_stays_single(robot):
    scene = rich(robot)
    state = scene.start(random(4, robot.n) * 0.3, random(4, robot.n, seed=1), uniform(scene, 4))
    exact = scene.step(state, noise=uniform(scene, 4), **inputs_of(scene, 4))
    single = state.to(torch.float32)
    found = scene.step(single, noise=uniform(scene, 4).float(), **inputs_of(scene, 4, dtype=torch.float32))
    for a, b in zip(found.rows().values(), exact.rows().values(), strict=True):
        assert a.dtype == torch.float32
        assert (a - b).abs().max() < 1e-3 * (1 + b.abs().max())


def test_parameters_follow_the_dtype_of_the_state():
    scene = Scene(ARM, (effects.Viscous(double(0.1, 0.2)), effects.Gravity()))
    assert scene.step(scene.start(torch.zeros(3, 2))).q.dtype == torch.float32


@pytest.mark.case("T13", "P9")
def test_a_sample_that_is_lost_takes_no_other_with_it():
    scene, d = rich(ARM), random(5, 2, seed=6).abs()
    scene = scene.replace(effects=(*RICH, effects.Spring(d)))
    noise, inputs = uniform(scene, 5), inputs_of(scene, 5)
    good = scene.start(random(5, 2), random(5, 2, seed=1), noise)
    bad = State(**{name: x.clone() for name, x in good.rows().items()})
    bad.q[2] = math.nan
    bad.qd[3] = math.inf
    others = [0, 1, 4]

    def end(state):
        q = state.q.clone().requires_grad_()
        after = scene.step(state._replace(q=q), noise=noise, **inputs)
        (gradient,) = torch.autograd.grad(after.q[others].sum() + after.qd[others].sum(), q)
        return *after.rows().values(), gradient

    for a, b in zip(end(good), end(bad), strict=True):
        assert torch.equal(a[others], b[others])
    assert end(bad)[0][2].isnan().any()


F32, F64 = torch.float32, torch.float64
RECORDED = [*itertools.product(["arm", "arm Runge-Kutta", "tree Verlet", "panda"], [F64, F32])]
SOME = [("arm", F64), ("arm", F32), ("arm Runge-Kutta", F32), ("tree Verlet", F64), ("panda", F64)]


@needs_compiler
@pytest.mark.parametrize(("which", "dtype"), thinned(RECORDED, SOME), ids=str)
def test_compiled_scenes_agree_with_eager_ones(which, dtype):
    """Values and gradients, of state, inputs and parameters, over three steps."""
    robot = {"a": ARM, "t": TREE, "p": PANDA}[which[0]]
    scene = rich(robot)
    if "Verlet" in which:
        scene = scene.replace(integrator=StoermerVerlet(2), effects=RICH[:4], controller=None)
    if "Kutta" in which:
        scene = scene.replace(integrator=RungeKutta4())
    if which == "panda":
        scene = scene.replace(effects=RICH[:6], controller=None)
    tolerance = 1e-11 if dtype == torch.float64 else 2e-3

    def end(backend):
        d = torch.full((4, robot.n), 0.3, dtype=dtype, requires_grad=True)
        inputs = {name: x.requires_grad_() for name, x in inputs_of(scene, 4, dtype=dtype).items()}
        q, qd = ((0.3 * random(4, robot.n, seed=k)).to(dtype).requires_grad_() for k in range(2))
        run = scene.replace(backend=backend, effects=(*scene.effects, effects.Viscous(d)))
        noise = uniform(run, 4).to(dtype) if run.noises else None
        state = run.start(q, qd, noise)
        for _ in range(3):
            state = run.step(state, noise=noise, **inputs)
        total = sum((x * x).sum() for x in state if x is not None)
        return *state, *torch.autograd.grad(total, [d, q, qd, *inputs.values()])

    for a, b in zip(end("c"), end("eager"), strict=True):
        assert (a is None and b is None) or (a - b).abs().max() <= tolerance * (1 + b.abs().max())


# --- programs --------------------------------------------------------------------------------------------------------


def test_new_values_of_tensors_need_no_new_recording():
    def scene(k):
        parts = (effects.Viscous(random(2, seed=k).abs()), effects.Payload(random(4, seed=k).abs()))
        return Scene(ARM.replace(mass=ARM.mass * (1 + k)), parts, ComputedTorque(random(2, seed=k).abs(), 1.0))

    def step(k):
        return scene(k).step(State(random(4, 2), random(4, 2, seed=1)), reference=random(6)).qd

    first = step(0)
    before = plans._program.cache_info().misses
    assert not torch.equal(step(1), first)
    assert not torch.equal(step(2), first)
    assert plans._program.cache_info().misses == before


def test_equal_scenes_share_their_programs():
    assert rich(ARM).spec is rich(ARM).spec
    assert rich(ARM).spec is not rich(ARM, dt=0.02).spec
    assert Scene(ARM, (effects.Viscous(0.1),)).spec is not Scene(ARM, (effects.Viscous(0.2),)).spec
    assert Scene(ARM, (effects.Viscous(double(0.1)),)).spec is Scene(ARM, (effects.Viscous(double(0.2)),)).spec


def test_a_scene_cannot_be_changed_but_replaced():
    scene = Scene(ARM)
    with pytest.raises(dataclasses.FrozenInstanceError):
        scene.dt = 0.1
    assert scene.replace(dt=0.1).dt == 0.1 and scene.dt == 0.01


# --- rollouts --------------------------------------------------------------------------------------------------------


def test_a_rollout_is_its_steps():
    scene = rich(ARM)
    noise = uniform(scene, 6, 4)
    inputs = {name: random(6, 4, width, seed=k) for k, (name, width) in enumerate(scene.inputs.items())}
    start = state = scene.start(random(4, 2), random(4, 2, seed=1), uniform(scene, 4))
    found = scene.rollout(start, noise=noise, **inputs)
    for k in range(6):
        state = scene.step(state, noise=noise[k], **{name: x[k] for name, x in inputs.items()})
        assert equal([x[k] for x in found.rows().values()], list(state.rows().values()))


@pytest.mark.parametrize("checkpoint", [0, 2])
def test_a_rollout_of_no_steps_is_empty(checkpoint):
    scene = Scene(ARM, (effects.Lag(0.1),))
    found = scene.rollout(scene.start(random(4, 2)), steps=0, checkpoint=checkpoint)
    assert [tuple(x.shape) for x in found.rows().values()] == [(0, 4, 2), (0, 4, 2), (0, 4, 2)]


@pytest.mark.parametrize("checkpoint", [1, 4, 7, 100])
def test_checkpoints_change_neither_values_nor_gradients(checkpoint):
    """Not even with noise that is drawn within."""
    d, q, torque = (x.requires_grad_() for x in (random(2).abs(), random(3, 2, seed=1), random(20, 3, 2, seed=2)))
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(d), effects.Noise(0.1)), PD(3.0, 1.0))
    reference = random(20, 6, seed=3)

    def end(checkpoint):
        torch.manual_seed(0)
        found = scene.rollout(scene.start(q), torque, reference=reference, checkpoint=checkpoint)
        return *found[:2], *torch.autograd.grad(found.q.square().sum(), [d, q, torque])

    for a, b in zip(end(checkpoint), end(0), strict=True):
        assert torch.equal(a, b) or (a - b).abs().max() <= 1e-12 * b.abs().max()


@pytest.mark.parametrize("checkpoint, computed", [(0, 60), (8, 120)])
def test_checkpoints_keep_less_and_compute_again(checkpoint, computed, monkeypatch):
    """Without them the graph keeps every step's inputs; with them none, and each step is computed twice."""
    kept, calls, step = {}, [], Scene.step

    def pack(x):
        kept[x.untyped_storage().data_ptr()] = x.untyped_storage().nbytes()
        return x

    def counted(*args, **given):
        calls.append(1)
        return step(*args, **given)

    monkeypatch.setattr(Scene, "step", counted)
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(random(2).abs().requires_grad_())))
    start = scene.start(random(64, 2))
    with torch.autograd.graph.saved_tensors_hooks(pack, lambda x: x):
        found = scene.rollout(start, steps=60, checkpoint=checkpoint)
    assert (sum(kept.values()) >= 60 * 64 * 4 * 8) == (checkpoint == 0)
    assert checkpoint == 0 or sum(kept.values()) <= 8 * 64 * 4 * 8
    found.q.sum().backward()
    assert len(calls) == computed


def test_a_coefficient_is_found_from_a_rollout():
    true, torque = double(0.3, 0.7), random(25, 4, 2, seed=1)
    start = State(random(4, 2), random(4, 2, seed=2))

    def motion(d):
        return (
            Scene(ARM, (effects.Gravity(), effects.Viscous(d)), integrator=LinearlyImplicit()).rollout(start, torque).q
        )

    recorded = motion(true)
    found = double(1.0, 0.1).requires_grad_()
    optimiser = torch.optim.LBFGS(
        [found], max_iter=30, line_search_fn="strong_wolfe", tolerance_grad=1e-14, tolerance_change=1e-16
    )

    def loss():
        optimiser.zero_grad()
        value = 1e4 * (motion(found) - recorded).square().mean()
        value.backward()
        return value

    optimiser.step(loss)
    assert torch.allclose(found, true, rtol=1e-5)


def test_the_energy_is_that_of_pinocchio():
    case = shipped("panda")
    data, s = case.model.createData(), states(PANDA)
    found = Scene(PANDA, (effects.Gravity(),)).energy(State(s.q, s.qd)).numpy()
    for k in range(len(found)):
        q, qd = case.configuration(s.q[k]), case.velocity(s.qd[k])
        assert found[k, 0] == pytest.approx(pin.computeKineticEnergy(case.model, data, q, qd), rel=1e-12)
    rise = [pin.computePotentialEnergy(case.model, data, case.configuration(q)) for q in s.q]
    assert np.diff(found[:, 1]) == pytest.approx(np.diff(rise), rel=1e-11)


# --- what strangers trip over ----------------------------------------------------------------------------------------


def test_a_payload_on_the_base_is_refused():
    with pytest.raises(ArgumentError, match="fixed to the base"):
        Scene(PANDA, (effects.Payload(1.0, frame=PANDA.frame_names[0]),))


def test_a_column_of_numbers_for_the_samples_is_refused():
    scene = Scene(ARM, (effects.Payload(torch.rand(3, 1, dtype=torch.float64)),))
    with pytest.raises(ArgumentError, match=r"mass is one number for each sample: shape \(3,\), found \(3, 1\)"):
        scene.step(scene.start(random(3, 2)))


def test_a_rotor_is_not_counted_twice():
    geared = ARM.replace(armature=double(0.1, 0.1)).bake()
    with pytest.raises(ArgumentError, match="rotor inertia of the description"):
        Scene(geared, (effects.RotorInertia(), effects.Elastic(1e3)))


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_readings_are_the_same_from_the_first_in_any_order_of_bias_and_delay(order):
    sensors = (effects.Bias(0.1), effects.ReadingDelay(2))
    scene = Scene(ARM, [sensors[i] for i in order])
    state = scene.start(double(0.3, -0.2))
    for _ in range(4):
        assert torch.allclose(state.measured[0], double(0.4, -0.1))
        state = scene.step(state)


def test_a_motor_behind_a_spring_runs_out_of_torque_at_its_own_speed():
    scene = Scene(ARM, (effects.Elastic(50.0, inertia=0.5), effects.TorqueSpeed(10.0, 1.0)), dt=1e-3)
    state = scene.start(ZERO)
    fast = state._replace(memory=torch.cat([ZERO, double(5.0, 5.0)]))  # the rotors, at five times that speed
    after = scene.step(fast, double(10.0, 10.0))
    assert torch.allclose(after.memory[2:], double(5.0, 5.0), atol=1e-3)


def test_a_learned_damping_of_the_robot_is_learned_in_a_scene():
    damping = double(0.1, 0.2).requires_grad_()
    scene = Scene(ARM.replace(damping=damping), (effects.Viscous(),))
    state = scene.step(scene.start(ZERO, double(1.0, 1.0)))
    (gradient,) = torch.autograd.grad(state.qd.sum(), damping)
    assert bool((gradient != 0).any())


@pytest.mark.case("P8")
def test_inputs_are_checked_at_every_step_not_only_at_the_first():
    scene = Scene(ARM)
    state = scene.start(random(3, 2))
    scene.step(state, random(3, 2))
    with pytest.raises(DtypeError, match=r"torque is torch\.float32 but q is torch\.float64"):
        scene.step(state, random(3, 2).float())
    with pytest.raises(ArgumentError, match="torque must be a tensor"):
        scene.step(state, random(3, 2).numpy())


# --- graphs ----------------------------------------------------------------------------------------------------------


@pytest.mark.case("P4")
@pytest.mark.parametrize("backend", ["c", "eager"])
def test_steps_are_traced_whole(backend):
    """torch.compile without a break; eager tracing, since what torch makes of the graph is not our claim."""
    if backend == "c" and build.compiler() is None:
        pytest.skip("there is no C compiler")
    learned = double(0.1, 0.2).requires_grad_()
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(learned), effects.Coulomb(0.2)), backend=backend)

    def roll(q, qd):
        state = State(q, qd)
        for _ in range(2):
            state = scene.step(state, q)
        return state.q

    traced = torch.compile(roll, fullgraph=True, backend="aot_eager")
    for batch in (3, 5):
        q = random(batch, 2)
        found, expected = traced(q, 0 * q), roll(q, 0 * q)
        assert torch.equal(found, expected)
        gradients = [torch.autograd.grad(x.sum(), learned)[0] for x in (found, expected)]
        assert torch.allclose(*gradients, rtol=1e-13)


def test_a_state_does_not_follow_later_changes_of_what_it_was_made_from():
    q = torch.zeros(2, dtype=torch.float64)
    state = Scene(torchdq.robots.load("two_link")).start(q, q)
    q.add_(1.0)
    assert not state.q.any() and not state.qd.any()


def test_limits_that_leave_nothing_between_them_are_refused():
    with pytest.raises(torchdq.ArgumentError, match="lower of Limits must not be above upper, found 1 and -1"):
        Scene(torchdq.robots.load("two_link"), (effects.Limits(1.0, -1.0),))
