"""Integrators have their order, keep what they promise to keep, and stay stable where they say so.

References are closed solutions, scipy's DOP853 on pinocchio's accelerations, and DormandPrince, which is compared with
those first. Numbers in tolerances are measured ones with a margin of three to ten.
"""

import math
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import EVERYTHING, FIXED, INERTIA, WHEEL, called, double, random, thinned
from messages import refused
from oracles import shipped
from scenes import ARM, TREE, rolled, swinging, trace
from scipy.integrate import solve_ivp

import torchdq
from torchdq import Scene, effects
from torchdq.backends import c_library as build
from torchdq.scene import State, model
from torchdq.scene.integrators import (
    DormandPrince,
    ExplicitEuler,
    LinearlyImplicit,
    RungeKutta4,
    SemiImplicitEuler,
    StoermerVerlet,
)

PANDA = shipped("panda")


@pytest.fixture
def compiled():
    """Compiled programs, for thousands of steps."""
    if build.compiler() is None:
        pytest.skip("there is no C compiler")
    with torchdq.backend("c"), torch.no_grad():
        yield


def distance(a, b):
    return float(torch.cat([x - y for x, y in zip(a, b, strict=True) if x is not None], -1).norm())


# --- order -----------------------------------------------------------------------------------------------------------

STEPS = {1: (64, 128), 2: (32, 64), 4: (16, 32)}  # every number of them is a program of its own
CONTINUOUS = (
    effects.Gravity(),
    effects.RotorInertia(0.3),
    effects.Payload(double(0.5).squeeze(), (0.1, 0.0, 0.1)),
    effects.Viscous(0.3),
    effects.Stribeck(0.2, 0.4, velocity=1.0, sign_width=1.0),
    effects.Spring(3.0, 0.2),
    effects.Servo(2.0, 0.1),
    effects.Drag(0.1, 0.1, 0.02, sign_width=0.5),
    effects.Push(),
    effects.Elastic(30.0, 0.2, 0.5),
)


@cache
def under_continuous_effects():
    """Scene of an adaptive step with effects of all kinds that act continuously, its start, inputs, and end."""
    scene = Scene(TREE, CONTINUOUS, integrator=DormandPrince(1e-12, 1e-13), dt=0.1)
    q, qd, torque = random(3, 4, TREE.n) * 0.7
    inputs = {"torque": torque, "target": random(3, seed=3), "push": random(6, seed=4)}
    start = scene.start(q, qd)
    return scene, start, inputs, scene.step(start, **inputs)


@pytest.mark.case("T1")
@pytest.mark.parametrize("integrator", thinned(FIXED, FIXED[2:4]), ids=str)
def test_the_error_falls_with_the_stated_order(integrator, compiled, margin):
    """With effects of all kinds; hard_cases/test_time.py has the arm alone."""
    scene, start, inputs, end = under_continuous_effects()
    order = {"RungeKutta4": 4, "StoermerVerlet": 2}.get(called(integrator), 1)
    coarse, fine = (
        distance(rolled(scene.replace(integrator=integrator, dt=scene.dt / k), start, k, **inputs), end)
        for k in STEPS[order]
    )
    assert integrator.order == order and fine > 1e-11  # far above rounding
    margin(abs(math.log2(coarse / fine) - order), 0.15, called(integrator))


def test_many_substeps_are_a_loop(monkeypatch):
    """Whose program is that of one, so that a thousand of them are at hand at once."""
    monkeypatch.setattr(model, "MOST_OPERATIONS", 1000)
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(0.1)), dt=0.04, substeps=1000)
    start, torque = State(*random(2, 3, 2)), double(1.0, -1.0)
    assert not scene.replace(substeps=2).looped and scene.looped
    with torchdq.backend("auto"):
        exact = scene.replace(integrator=RungeKutta4()).step(start, torque)
        assert distance(scene.step(start, torque), exact) < 1e-3


def test_substeps_are_steps():
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(0.1)), dt=0.04, substeps=4)
    start, torque = State(*random(2, 3, 2)), double(1.0, -1.0)
    at_once = scene.step(start, torque)
    one_by_one = rolled(scene.replace(dt=0.01, substeps=1), start, 4, torque)
    assert distance(at_once, one_by_one) < 1e-13


# --- the adaptive one ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "case", thinned([PANDA, shipped("two_link")], [shipped("two_link")]), ids=lambda case: case.robot.name
)
def test_dormand_prince_agrees_with_scipy_on_pinocchios_accelerations(case, compiled):
    n, T = case.robot.n, 0.3
    q, qd, torque = random(3, n, seed=5)
    data = case.model.createData()

    def rates(_, y):
        a = pin.aba(case.model, data, case.configuration(y[:n]), case.velocity(y[n:]), case.velocity(torque))
        return np.concatenate([y[n:], a[case.order]])

    start = np.concatenate([q, qd])
    solution = solve_ivp(rates, (0.0, T), start, method="DOP853", rtol=1e-12, atol=1e-13)
    parts = (effects.Gravity(),) if case.robot.armature is None else (effects.Gravity(), effects.RotorInertia())
    found = Scene(case.robot, parts, integrator=DormandPrince(1e-11, 1e-12), dt=T).step(State(q, qd), torque)
    assert np.abs(np.concatenate(found[:2]) - solution.y[:, -1]).max() < 1e-9


def attempts(end):
    """Least number of attempts with which an adaptive step arrives."""
    low, high = 0, 4096
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if bool(end(middle).q.isfinite()) else (middle, high)
    return high


def test_dormand_prince_meets_its_tolerance_with_steps_of_its_order(compiled):
    """On x'' = -x, ten times the work buys five digits."""
    errors, numbers = [], []
    scene = Scene(WHEEL, (effects.Spring(INERTIA),), dt=5.0)
    for rtol in (1e-6, 1e-11):

        def end(most, rtol=rtol):
            return scene.replace(integrator=DormandPrince(rtol, rtol, most)).step(State(double(1.0), double(0.0)))

        found = end(4096)
        errors.append(max(abs(float(found.q) - math.cos(5.0)), abs(float(found.qd) + math.sin(5.0))) / rtol)
        numbers.append(attempts(end))
    assert all(0.01 < error < 20 for error in errors)
    assert 7 < numbers[1] / numbers[0] < 14


@pytest.mark.parametrize("integrator", thinned(FIXED, FIXED[2:4]), ids=called)
def test_substeps_in_a_loop_are_those_of_one_program(integrator):
    """Compiled, or one by one by torch, with their gradients."""
    coefficient = double(0.5, 0.3).requires_grad_()
    parts = (effects.Gravity(), effects.Viscous(coefficient), effects.Spring(20.0))
    unrolled = Scene(ARM, parts, integrator=integrator, dt=0.03, substeps=3)
    looped = unrolled.replace(unroll=False)
    given = [x.requires_grad_() for x in (*random(2, 4, 2, seed=2), random(4, 2, seed=3))]

    def found(scene):
        q, qd = scene.step(State(*given[:2]), given[2])[:2]
        return [q, qd, *torch.autograd.grad((q + qd * q).sum(), [*given, coefficient])]

    expected = found(unrolled)
    for backend in ("auto", "eager") if integrator.order == 4 or EVERYTHING else ("eager",):
        for a, b in zip(expected, found(looped.replace(backend=backend)), strict=True):
            torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)


@pytest.mark.case("T5", "T6")
def test_substeps_in_double_precision_round_once():
    q, qd = (x.float() for x in random(2, 4, 2, seed=2))
    scene = Scene(ARM, (effects.Gravity(),), integrator=RungeKutta4(), dt=0.1, substeps=4, precision="double")
    looped = scene.replace(unroll=False)
    for a, b in zip(scene.step(State(q, qd))[:2], looped.step(State(q, qd))[:2], strict=True):
        torch.testing.assert_close(a, b, rtol=2 * 2.0**-24, atol=0)


MISUSE = {
    "half a substep": lambda: Scene(ARM, substeps=2.5),
    "count of substeps in a loop": lambda: Scene(ARM, substeps=2, unroll=False).count(),
    "adaptive substeps": lambda: Scene(ARM, integrator=DormandPrince(), substeps=2),
    "no tolerance": lambda: DormandPrince(0.0, 1e-9),
    "negative tolerance": lambda: DormandPrince(1e-9, -1.0),
    "tolerance as text": lambda: DormandPrince("1e-9"),
    "no steps": lambda: DormandPrince(most=0),
    "truth value": lambda: StoermerVerlet(True),
    "count of adaptive steps": lambda: Scene(ARM, integrator=DormandPrince()).count(),
}


@pytest.mark.parametrize("what", MISUSE)
def test_integrators_that_cannot_be_are_refused(what):
    with refused(torchdq.ArgumentError):
        MISUSE[what]()


@pytest.mark.case("T5")
def test_a_sample_that_does_not_arrive_is_nan():
    scene = Scene(ARM, (effects.Gravity(),), integrator=DormandPrince(most=3), dt=0.5)
    assert scene.step(State(*random(2, 3, 2))).q.isnan().all()


def test_an_adaptive_step_drives_and_senses_as_a_recorded_one_does():
    parts = (
        effects.Gravity(),
        effects.Elastic(30.0, 0.2, 0.5),
        effects.FirstOrderLag(0.05),
        effects.CommandDelay(1),
        effects.Saturation(2.0),
        effects.Push(),
        effects.Bias(0.1, 0.2),
        effects.MeasurementDelay(2),
    )
    adaptive = Scene(ARM, parts, integrator=DormandPrince(1e-11, 1e-12), dt=0.02)
    recorded = adaptive.replace(integrator=RungeKutta4(), substeps=8)
    a = b = adaptive.start(*random(2, 3, 2))
    for k in range(4):
        torque, push = random(3, 2, seed=k) * 3, random(6, seed=k)
        a, b = adaptive.step(a, torque, push=push), recorded.step(b, torque, push=push)
    for x, y in zip(a.rows().values(), b.rows().values(), strict=True):
        assert (x - y).abs().max() < 2e-7
    assert a.memory.abs().min(0).values.max() > 0


# --- energy ----------------------------------------------------------------------------------------------------------


@pytest.mark.case("T2")
def test_the_band_of_the_energy_is_narrower_by_four_at_half_the_step(compiled):
    bands = []
    for steps, dt in ((1000, 1e-2), (2000, 5e-3)):
        scene = Scene(ARM, (effects.Gravity(),), integrator=StoermerVerlet(), dt=dt)
        energy = scene.energy(trace(scene, swinging(), steps)).sum(-1)
        bands.append(float((energy - energy[0]).abs().max()))
    assert bands[0] / bands[1] == pytest.approx(4.0, rel=0.2)


# --- dry friction ----------------------------------------------------------------------------------------------------


@pytest.mark.case("T10")
def test_explicit_dry_friction_chatters_on_a_light_joint():
    """Beyond a ratio of 2 the velocity changes its sign at every step and never dies."""
    scene = Scene(WHEEL, (effects.Coulomb(1.0, 0.01),), integrator=SemiImplicitEuler(), dt=0.01)
    qd = trace(scene, State(double(0.0), double(1e-3)), 100).qd[1:]
    signs = qd[20:, 0].sign()
    assert (signs[1:] == -signs[:-1]).all()
    kick = 0.01 * 1.0 / INERTIA
    assert torch.allclose((qd[1:] - qd[:-1]).abs()[20:], torch.full((79, 1), kick, dtype=torch.float64), rtol=0.01)


@pytest.mark.case("T10")
def test_a_joint_breaks_loose_by_the_ratio_of_torque_and_level_per_step():
    """Damping as it was at the beginning of a step: a joint at rest leaves the width geometrically, then freely."""
    scene = Scene(WHEEL, (effects.Coulomb(1.0, 1e-6),), integrator=LinearlyImplicit(), dt=0.001)
    qd = trace(scene, State(double(0.0), double(0.0)), 400, double(1.25)).qd[1:, 0]
    creeping = qd[10:30]
    assert torch.allclose(creeping[1:] / creeping[:-1], torch.full((19,), 1.25, dtype=torch.float64), rtol=1e-2)
    assert float(qd[-1] - qd[-2]) == pytest.approx(0.25 / INERTIA * 0.001, rel=0.03)


# --- limits ----------------------------------------------------------------------------------------------------------


@pytest.mark.case("T11")
def test_an_arm_falling_on_its_limits_stays_within_them(compiled):
    scene = Scene(ARM, (effects.Gravity(), effects.JointLimits(-0.5, 0.5, 1e8)), integrator=LinearlyImplicit(), dt=2e-3)
    state = scene.start((random(50, 2) * 0.2).clamp(-0.45, 0.45), random(50, 2, seed=1))
    before = scene.energy(state).sum(-1)
    deepest = 0.0
    for _ in range(2000):
        state = scene.step(state)
        deepest = max(deepest, float((state.q.abs() - 0.5).max()))
    assert deepest < 0.05
    # what is left is the energy of an arm that lies on its limits
    assert (scene.energy(state).sum(-1) < before + 0.05).all()
    assert state.qd.abs().max() < 0.1


@pytest.mark.case("T11")
def test_the_speed_after_a_bounce_is_that_of_hunt_and_crossley():
    """v1^2 = 2 (v0 / c - log(1 + c v0) / c^2) for a contact that is damped while it grows, whatever its stiffness."""
    speed, c = double(0.1, 0.5, 1.0, 3.0)[:, None], double(0.5, 2.0, 10.0)[:, None, None]
    scene = Scene(WHEEL, (effects.JointLimits(-1.0, 0.0, 1e4, c),), integrator=RungeKutta4(), dt=1e-5)
    with torch.no_grad():
        state = rolled(scene, State(torch.zeros_like(speed), speed), 600)
    assert (state.q < 0).all()
    expected = (2 * (speed / c - (1 + c * speed).log() / c**2)).sqrt()
    assert torch.allclose(-state.qd, expected, rtol=1e-3)


# --- elastic joints --------------------------------------------------------------------------------------------------


def test_an_elastic_wheel_swings_as_two_masses_on_a_spring():
    """x1 - x2 swings with w^2 = k (1/I + 1/J) about the twist that the torque gives; the centre of mass is pushed."""
    k, J, u, T = 5.0, 0.03, 0.2, 0.5
    scene = Scene(WHEEL, (effects.Elastic(k, 0.0, J),), integrator=RungeKutta4(), dt=1e-3)
    start = State(double(0.1), double(0.0), double(0.4, 0.0))
    end = rolled(scene, start, 500, double(u))
    w = math.sqrt(k * (1 / INERTIA + 1 / J))
    rest = u / J / w**2  # of the twist
    twist = rest + (0.3 - rest) * math.cos(w * T)
    middle = (INERTIA * 0.1 + J * 0.4 + u * T**2 / 2) / (INERTIA + J)
    q, theta = middle - J / (INERTIA + J) * twist, middle + INERTIA / (INERTIA + J) * twist
    assert abs(float(end.q) - q) < 1e-8
    assert abs(float(end.memory[0]) - theta) < 1e-8


@cache
def of_elastic_joints():
    """Scene in short steps of Runge-Kutta, its start, and the state after 0.1 s."""
    scene = Scene(ARM, (effects.Gravity(), effects.Elastic(200.0, 0.5, 0.2)), integrator=RungeKutta4(), dt=1e-4)
    start = scene.start(double(0.3, 0.4), double(1.0, -1.0))
    with torchdq.backend("auto"):
        return scene, start, rolled(scene, start, 1000, double(1.0, 0.5))


@pytest.mark.parametrize(
    ("integrator", "error"),
    [
        *thinned([(ExplicitEuler(), 0.1), (SemiImplicitEuler(), 0.03), (RungeKutta4(), 1e-6)], []),
        *((LinearlyImplicit(), 0.1), (StoermerVerlet(), 1e-3), (DormandPrince(1e-9, 1e-11), 1e-7)),
    ],
    ids=called,
)
def test_all_integrators_move_elastic_joints_alike(integrator, error):
    """Within errors of their order at 1 ms."""
    scene, start, exact = of_elastic_joints()
    dt = 1e-3 if integrator in FIXED else 0.02
    scene = scene.replace(integrator=integrator, dt=dt)
    assert distance(rolled(scene, start, round(0.1 / dt), double(1.0, 0.5)), exact) < error
    assert (exact.memory[:2] - exact.q).abs().max() > 1e-3


@pytest.mark.parametrize("damping", [0.0, 10.0])
def test_stiff_elastic_joints_are_stable_when_integrated_implicitly(damping):
    """1e6 N m/rad at 10 ms, the springs wound up by a tenth of a radian."""
    scene = Scene(ARM, (effects.Elastic(1e6, damping, 0.1),), integrator=LinearlyImplicit(), dt=1e-2)
    start = State(double(0.3, 0.4), double(0.5, -0.5), double(0.4, 0.3, 0.0, 0.0))
    end = rolled(scene, start, 100)
    assert (end.q - end.memory[:2]).abs().max() < 1e-6
    assert torch.cat([end.qd, end.memory]).abs().max() < 10
    assert not rolled(scene.replace(integrator=SemiImplicitEuler()), start, 50).q.abs().max() < 1e3


def test_ordinary_effects_hold_at_the_default_integrator_and_step():
    """A Panda of the file, whose last link is light, for a second; each row has one of them alone."""
    home = double(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
    viscous, coulomb, stribeck, servo, spring, limits = torch.eye(6, dtype=torch.float64)[..., None].expand(6, 6, 7)
    parts = (
        *(effects.Viscous(5.0 * viscous), effects.Coulomb(0.5 * coulomb), effects.Stribeck(0.5 * stribeck, stribeck)),
        *(effects.Servo(1e3 * servo, 1e2 * servo), effects.Spring(1e3 * spring, home)),
        effects.JointLimits(stiffness=1e4 * limits),
    )
    scene = Scene(PANDA.robot, (effects.Gravity(), *parts))
    speeds = trace(scene, scene.start(home.expand(6, 7)), 100 if EVERYTHING else 40, target=home).qd.abs()
    assert speeds.max() < 50.0  # a joint that falls reaches 20 rad/s
    assert (speeds.amax((0, 2)) > 1e-3).sum() >= 4  # servos and springs that hold the start are at rest
