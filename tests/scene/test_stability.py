"""Scenes say which steps are stable, and which rows diverge on the way."""

import math

import pytest
from helpers import INERTIA, WHEEL, called, double, thinned
from messages import refused, warned
from scenes import ARM, PANDA

import torchdq
from torchdq.envs import Scene, effects
from torchdq.scene import stability
from torchdq.scene.controllers import ComputedTorqueController
from torchdq.scene.integrators import (
    DormandPrince,
    ExplicitEuler,
    LinearlyImplicit,
    Repeated,
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


@pytest.mark.parametrize("integrator", [*EXPLICIT, Repeated(SemiImplicitEuler(), 1)], ids=called)
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


@pytest.mark.parametrize("kind", thinned(STIFF, [kind for kind in STIFF if kind != "Limits"]))
def test_unstable_steps_come_with_stable_ones(kind):
    effect, inputs = STIFF[kind]
    scene = Scene(ARM, (effects.Gravity(), effect), integrator=SemiImplicitEuler())
    start = scene.start(double(0.45, 0.45), double(1.0, 1.0))
    found = scene.check(start, **inputs)
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


@pytest.mark.parametrize("integrator", [*EXPLICIT, LinearlyImplicit()], ids=called)
def test_a_falling_arm_is_not_stiff(integrator):
    scene = Scene(PANDA, (effects.Gravity(), effects.RotorInertia(0.1)), integrator=integrator)
    assert scene.check(scene.start(HOME), seconds=0.5)


def test_rows_diverge_one_by_one():
    """A sample whose step is too long is found; a row that was not finite at the start does not diverge."""
    damping = double(0.1, 500.0, 0.1)[:, None].expand(3, 2)
    scene = Scene(ARM, (effects.Viscous(damping),), integrator=SemiImplicitEuler())
    start = scene.start(double((0.1, 0.2), (0.1, 0.2), (math.nan, 0.2)), double(0.1, 0.2))
    with warned(UserWarning):
        found = scene.check(start, seconds=2.0)
    assert found.diverged.tolist() == [False, True, False]
    assert len(found.alternatives) == 2


def test_controllers_hold_the_start_and_are_run(monkeypatch):
    """Gains that a sampled controller cannot have are not a stiffness of the joints, but the rows diverge."""
    monkeypatch.setattr(stability, "FEW", 64)  # of trials of shorter steps
    calm, wild = (Scene(ARM, (effects.Gravity(),), ComputedTorqueController(100.0, kd)) for kd in (20.0, 500.0))
    assert calm.check(calm.start(double(0.3, 0.4)))
    found = wild.check(wild.start(double(0.3, 0.4), double(0.1, 0.1)), seconds=6.0)
    assert not found and found.growth <= 1.001 and bool(found.diverged)


def test_adaptive_steps_are_only_run():
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(100.0)), integrator=DormandPrince(1e-6))
    assert scene.check(scene.start(double(0.3, 0.4)), seconds=0.05)


@pytest.mark.parametrize(
    "given",
    [
        {"state": ARM.mass},
        {"seconds": 0.0},
        {"seconds": 1e6},
        {"target": None},
    ],
)
def test_a_check_of_nothing_is_refused(given):
    scene = Scene(ARM, (effects.Servo(1.0),))
    with refused(torchdq.ArgumentError):
        scene.check(**{"state": scene.start(double(0.0, 0.0)), "target": double(0.0, 0.0), **given})
