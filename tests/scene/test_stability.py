"""Scenes say which steps are stable, and which rows diverge on the way."""

import math
from dataclasses import replace

import pytest
import torch
from helpers import INERTIA, WHEEL, called, double, exhaustive, thinned
from messages import refused, warned
from on_ground import body
from scenes import ARM, PANDA
from urdf_text import joint, link, urdf

import torchdq
from torchdq import Scene, dq, effects
from torchdq.effects import contact
from torchdq.robot import ContactPoint
from torchdq.scene import stability
from torchdq.scene.controllers import PD, ComputedTorque
from torchdq.scene.integrators import (
    DormandPrince,
    ExplicitEuler,
    LinearlyImplicit,
    RungeKutta4,
    SemiImplicitEuler,
    StoermerVerlet,
)

HOME = double(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
EXPLICIT = [ExplicitEuler(), SemiImplicitEuler(), RungeKutta4(), StoermerVerlet()]

# --- the step --------------------------------------------------------------------------------------------------------

# damping times step over inertia, and angular frequency times step, up to which textbooks say that methods are stable
DAMPED = {ExplicitEuler(): 2.0, SemiImplicitEuler(): 2.0, RungeKutta4(): 2.785293563405282}
SWINGING = {SemiImplicitEuler(): 2.0, RungeKutta4(): 2 * math.sqrt(2)}


def verdict(effect, integrator, dt=0.01, **inputs):
    scene = Scene(WHEEL, (effect,), integrator=integrator, dt=dt)
    return scene.check(scene.start(double(0.1), double(0.1)), seconds=dt, **inputs)


@pytest.mark.parametrize("integrator", DAMPED, ids=called)
def test_the_bound_of_damping_is_that_of_the_textbook(integrator):
    coefficient = DAMPED[integrator] * INERTIA / 0.01
    assert verdict(effects.Viscous(0.99 * coefficient), integrator)
    assert not verdict(effects.Viscous(1.01 * coefficient), integrator)
    assert verdict(effects.Viscous(1e6 * coefficient), LinearlyImplicit())


@pytest.mark.parametrize("integrator", SWINGING, ids=called)
def test_the_bound_of_stiffness_is_that_of_the_textbook(integrator):
    stiffness = INERTIA * (SWINGING[integrator] / 0.01) ** 2
    assert verdict(effects.Spring(0.98 * stiffness), integrator)
    assert not verdict(effects.Spring(1.02 * stiffness), integrator)
    assert verdict(effects.Spring(1e6 * stiffness), LinearlyImplicit())


def test_explicit_euler_swings_up_at_any_step():
    assert not verdict(effects.Spring(10.0), ExplicitEuler())


@pytest.mark.parametrize("integrator", thinned(EXPLICIT, EXPLICIT[1:3]), ids=called)
def test_elastic_joints_are_part_of_it(integrator):
    """A wheel and a rotor of half its inertia swing at w^2 = k (1/I + 2/I)."""
    bound = {"RungeKutta4": 2 * math.sqrt(2)}.get(called(integrator), 2.0)
    stiffness = (bound / 0.01) ** 2 * INERTIA / 3
    hard, soft = (effects.Elastic(f * stiffness, 1e-4, INERTIA / 2) for f in (1.1, 0.5))
    assert not verdict(hard, integrator)
    assert verdict(soft, integrator) or called(integrator) in ("ExplicitEuler", "StoermerVerlet")
    assert verdict(hard, LinearlyImplicit())


def test_friction_at_rest_is_as_stiff_as_its_width_is_small():
    scene = Scene(WHEEL, (effects.Coulomb(0.1, 0.01),), integrator=SemiImplicitEuler())
    at_rest = scene.check(scene.start(double(0.0)), seconds=0.01)
    assert at_rest.growth == pytest.approx(0.01 * 0.1 / 0.01 / INERTIA - 1, rel=1e-6)
    assert scene.replace(dt=1e-3).check(scene.start(double(0.0)), seconds=0.01)


STIFF = {
    "Viscous": (effects.Viscous(500.0), {}),
    "Servo": (effects.Servo(1e5, 1e3), {"target": double(0.3, 0.3)}),
    "Limits": (effects.JointLimits(-0.5, 0.5, 1e6), {}),
    "Spring": (effects.Spring(1e6), {}),
    "Elastic": (effects.Elastic(1e6, 1.0, 0.1), {}),
}


@pytest.mark.parametrize("kind", thinned(STIFF, ["Viscous"]))
def test_unstable_steps_come_with_stable_ones(kind):
    effect, inputs = STIFF[kind]
    scene = Scene(ARM, (effects.Gravity(), effect), integrator=SemiImplicitEuler())
    start = scene.start(double(0.45, 0.45), double(1.0, 1.0))
    found = scene.check(start, 0.2, **inputs)
    assert not found
    assert bool(found.diverged)
    first, second = found.alternatives
    assert (first.integrator, first.substeps) == (LinearlyImplicit(), 1)
    assert (second.integrator, second.step) == (SemiImplicitEuler(), 0.01 / second.substeps)
    assert "unstable" in str(found) and f"substeps={second.substeps}" in str(found)
    for other in found.alternatives:
        held = scene.replace(integrator=other.integrator, substeps=other.substeps).check(start, 0.2, **inputs)
        assert held and held.alternatives == () and str(held).endswith(" are stable")


def test_the_joint_with_the_least_inertia_is_named():
    scene = Scene(PANDA, (effects.Gravity(), effects.Viscous(5.0)), integrator=SemiImplicitEuler())
    found = scene.check(scene.start(HOME), seconds=0.05)
    assert found.joint == "panda_joint7"
    assert "of panda_joint7" in str(found)


@pytest.mark.parametrize("integrator", thinned([*EXPLICIT, LinearlyImplicit()], [RungeKutta4()]), ids=called)
def test_a_falling_arm_is_not_stiff(integrator):
    scene = Scene(PANDA, (effects.Gravity(), effects.RotorInertia(0.1)), integrator=integrator)
    assert scene.check(scene.start(HOME), seconds=0.2)


def test_rows_diverge_one_by_one():
    """A sample whose step is too long is found; a row that was not finite at the start does not diverge."""
    damping = double(0.1, 500.0, 0.1)[:, None].expand(3, 2)
    scene = Scene(ARM, (effects.Viscous(damping),), integrator=SemiImplicitEuler())
    start = scene.start(double((0.1, 0.2), (0.1, 0.2), (math.nan, 0.2)), double(0.1, 0.2))
    with warned(UserWarning):
        found = scene.check(start, seconds=0.2)
    assert found.diverged.tolist() == [False, True, False]
    assert len(found.alternatives) == 2


def test_controllers_hold_the_start_and_are_run(monkeypatch):
    """Gains that a sampled controller cannot have are not a stiffness of the joints, but the rows diverge."""
    monkeypatch.setattr(stability, "FEW", 64)  # of trials of shorter steps
    calm, wild = (Scene(ARM, (effects.Gravity(),), ComputedTorque(100.0, kd)) for kd in (20.0, 500.0))
    assert calm.check(calm.start(double(0.3, 0.4)))
    found = wild.check(wild.start(double(0.3, 0.4), double(0.1, 0.1)), seconds=6.0)
    assert not found and found.growth <= 1.001 and bool(found.diverged)


def test_adaptive_steps_are_only_run():
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(100.0)), integrator=DormandPrince(1e-6))
    assert scene.check(scene.start(double(0.3, 0.4)), seconds=0.05)


@pytest.mark.parametrize("given", [{"state": ARM.mass}, {"seconds": 0.0}, {"seconds": 1e6}, {"target": None}])
def test_a_check_of_nothing_is_refused(given):
    scene = Scene(ARM, (effects.Servo(1.0),))
    with refused(torchdq.ArgumentError):
        scene.check(**{"state": scene.start(double(0.0, 0.0)), "target": double(0.0, 0.0), **given})


# --- ground ----------------------------------------------------------------------------------------------------------

BOX = body(2.0, (0.01, 0.01, 0.01))
CORNERS = tuple(ContactPoint("body", (x, y, -0.05)) for x in (-0.1, 0.1) for y in (-0.1, 0.1))
NONE = double().reshape(0)


def on_ground(dt=0.005, substeps=1, turn=0.0, heights=(0.05,), **contact):
    """Scene of the box on a plane that is turned about y, and its start above it; tensors make its programs few."""
    normal = double(math.sin(turn), 0.0, math.cos(turn))
    given = {"stiffness": 5e3, "dissipation": 1.0, "friction": 0.8, **contact}
    ground = effects.Contact(CORNERS, normal=normal, **{name: double(x)[0] for name, x in given.items()})
    scene = Scene(BOX, (effects.Gravity(), ground), dt=dt, substeps=substeps, backend="auto")
    turned = double(math.cos(turn / 2), 0.0, math.sin(turn / 2), 0.0)
    return scene, scene.start(NONE, X_WB=dq.from_pose(turned, double(*heights)[:, None] * normal))


def test_points_at_rest_sink_by_their_share_of_the_weight():
    scene, state = on_ground(stiffness=2e3, dissipation=100.0)
    check = scene.check(state, seconds=2.0)
    assert check and check.ground.deepest == pytest.approx(2 * 9.81 / 4 / 2e3, rel=1e-3)
    assert check.ground.slip < 1e-9 and (check.ground.aloft, check.ground.rows) == (0, 1)
    assert check.ground.stiffness == 2e3 and "up to 2.5 mm" in str(check)


def test_a_box_that_slides_is_seen_to_slide():
    turn, mu = math.radians(30.0), 0.2
    scene, state = on_ground(turn=turn, friction=mu)
    speed = 9.81 * (math.sin(turn) - mu * math.cos(turn))
    ground = scene.check(state).ground
    assert ground.slip == pytest.approx(speed, rel=0.02) and ground.cone == pytest.approx(1.0, abs=0.01)
    sticking, state = on_ground(turn=turn, friction=0.8)
    ground = sticking.check(state).ground
    assert ground.slip < 1e-6 and ground.cone < 1.0


def test_rows_that_do_not_touch_the_ground_are_not_said_to_be_checked():
    scene, state = on_ground(heights=(0.06, 30.0))
    flying = torch.zeros(2, 6, dtype=torch.float64)
    flying[1, 3] = 3.0
    ground = scene.check(state._replace(V_WB_B=flying)).ground
    assert (ground.aloft, ground.rows) == (1, 2) and ground.slip < 1e-3
    assert "not checked in 1 of 2 rows" in str(ground)
    aloft = scene.check(scene.start(NONE, X_WB=state.X_WB[1]))
    assert aloft.ground.aloft == 1 and str(aloft.ground).startswith("- contact: not checked in 1 of 1 rows")


def test_soft_ground_is_named():
    scene, state = on_ground(stiffness=100.0)
    assert "firmer" in str(scene.check(state)) and "firmer" not in str(scene.check(state, seconds=0.01))


def test_a_base_that_turns_far_in_a_step_is_pointed_out():
    scene = Scene(BOX, dt=0.01)
    for speed, far in ((100.0, False), (200.0, True)):
        start = scene.start(NONE, X_WB=double(1.0, *[0.0] * 7), V_WB_B=double(speed, *[0.0] * 5))
        check = scene.check(start, seconds=0.1)
        assert check.turn == pytest.approx(speed * 0.01) and ("turns by up to" in str(check)) is far


@exhaustive
def test_a_base_that_spins_while_its_joints_swing_is_given_to_runge_kutta(monkeypatch):
    """Inertial torques of links at the start of a step give energy."""
    monkeypatch.setattr(stability, "FEW", 512)  # of trials of shorter steps
    arm = (link(name, 1.0, (0.01, 0, 0.02, 0, 0, 0.02), (0.2, 0, 0)) for name in "ab")
    joints = (
        joint("j", "base", "a", "continuous", axis=(0, 1, 0)),
        joint("k", "a", "b", "continuous", xyz=(0.3, 0, 0)),
    )
    text = urdf(link("base", 4.0, (0.2, 0, 0.3, 0, 0, 0.1), (0, 0, 0)), *arm, *joints)
    robot = torchdq.Robot.from_urdf(text, base="floating")
    scene = Scene(robot, dt=0.02, backend="auto")
    start = scene.start(double(0.3, 0.3), V_WB_B=double(2.0, 6.0, 5.0, 0.0, 0.0, 0.0))
    check = scene.check(start, seconds=7.0)
    assert not check and bool(check.diverged) and str(check).endswith("integrator=RungeKutta4(), steps of 0.02 s")


@pytest.mark.parametrize("make", thinned([PD, ComputedTorque], [PD]), ids=lambda make: make.__name__)
def test_a_controller_too_stiff_for_the_step_is_named_with_the_joint(make):
    """Torques held over a step: kp h^2 / I + 2 kd h / I = 4 is the edge (Jury's criterion)."""
    inertia = INERTIA if make is PD else 1.0
    for share, stiff in ((0.98, False), (1.02, True)):
        kp, kd = 0.5 * inertia / 0.01**2, share * 0.5 * 3.5 * inertia / 0.01
        scene = Scene(WHEEL, controller=make(kp, kd), dt=0.01)
        check = scene.check(scene.start(double(0.1)), seconds=0.01)  # at rest: the run shows nothing
        assert bool(check) is not stiff and not bool(check.diverged)
        moving = scene.check(scene.start(double(0.1), double(0.1)), seconds=12.0)
        assert bool(moving) is not stiff and bool(moving.diverged) is stiff
    assert WHEEL.joint_names[0] in str(check) and "effects.Servo" in str(check) and "motion itself" not in str(check)


@pytest.mark.parametrize("integrator", [RungeKutta4(), DormandPrince()], ids=called)
def test_torques_held_over_an_exact_step_are_judged_by_the_sampled_double_integrator(integrator):
    """Its poles are within the circle for kd h < 2 and kp h < 2 kd: kp h^2 + 2 kd h may exceed 4."""
    for kp, kd, settles in ((0.3, 1.9, True), (0.3, 2.1, False), (1.0, 0.6, True), (1.4, 0.6, False)):
        scene = Scene(WHEEL, controller=PD(kp * INERTIA / 0.01**2, kd * INERTIA / 0.01), integrator=integrator, dt=0.01)
        assert bool(scene.check(scene.start(double(0.1)), seconds=0.01)) is settles


def test_friction_lets_a_controller_be_stiffer():
    """With a damper d in the step, the edge is kp h^2 / I + 2 kd h / I = 4 + 2 h d / I."""
    for kd, settles in ((5.4, True), (5.6, False)):
        scene = Scene(
            WHEEL, (effects.Viscous(4 * INERTIA / 0.01),), PD(INERTIA / 0.01**2, kd * INERTIA / 0.01), dt=0.01
        )
        assert bool(scene.check(scene.start(double(0.1)), seconds=0.01)) is settles
        moving = scene.check(scene.start(double(0.1), double(0.1)), seconds=8.0)
        assert bool(moving.diverged) is not settles


def test_rotors_take_the_torques_of_a_controller_that_sees_the_links():
    """Gains that let a rigid joint settle make a springy one swing up, in the matrix and in a run."""
    for damping, settles in ((1e-3, False), (0.2, True)):
        elastic = effects.Elastic(INERTIA * 50.0**2, damping * INERTIA * 50.0, INERTIA)
        scene = Scene(WHEEL, (elastic,), PD(INERTIA * 10.0**2, INERTIA * 10.0), RungeKutta4(), 0.01)
        check = scene.check(scene.start(double(0.1)), seconds=0.01)
        assert bool(check) is settles and check.growth <= stability.GROWTH
        start, reference = scene.start(double(0.1), double(0.1)), double(0.1, 0.0, 0.0).expand(2000, 3)
        path = scene.replace(backend="auto").rollout(start, reference=reference)
        assert bool((path.q[-100:] - 0.1).abs().max() < 1e-3) is settles


@exhaustive
def test_rows_that_are_not_finite_leave_the_others_their_own_ground():
    scene, state = on_ground(heights=(0.05, 0.05))
    gravity, ground = scene.effects
    scene = scene.replace(effects=(gravity, replace(ground, height=double(-9.0, 0.0))))
    X_WB = state.X_WB.clone()
    X_WB[0] = torch.nan
    with warned(UserWarning):
        found = scene.check(state._replace(X_WB=X_WB), seconds=0.5)
    assert (found.ground.aloft, found.ground.rows) == (0, 1)


def test_a_scene_without_contact_has_no_ground():
    assert Scene(ARM).check(Scene(ARM).start(double(0.0, 0.0)), seconds=0.05).ground is None


def test_the_stiffness_of_contact_that_is_not_given_is_the_one_that_follows_from_the_object():
    box = torchdq.objects.Box("box", mass=0.1, size=(0.04,) * 3)
    scene = Scene(torchdq.robots.load("panda"), (effects.Gravity(), effects.Contact("box")), objects=(box,), dt=0.002)
    X = dq.from_pose(double(1.0, 0.0, 0.0, 0.0), double(0.9, 0.0, 0.02))[None]
    found = scene.check(scene.start(torch.zeros(7, dtype=X.dtype), X_WO=X), seconds=0.02).ground
    assert found.stiffness == pytest.approx(0.1 * contact.STIFF)
