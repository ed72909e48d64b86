"""Joint effects: springs, servos, limits and memoryless friction have the torques of their formulas."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from effect_harness import CASES, JOINT, ON_ROBOTS, TARGET, agrees, bare, close, double, forms_of, given, pinocchio
from helpers import thinned

import torchdq
from torchdq import Scene, effects
from torchdq.scene import State
from torchdq.scene.integrators import ExplicitEuler, LinearlyImplicit, RungeKutta4, SemiImplicitEuler


def joint_effect(b, kind, form):
    """An effect, its inputs, and the damping, stiffness and rest that its formula gives in the states."""
    ranges, formula = JOINT[kind]
    parameters, values = forms_of(ranges, form, b.n)
    inputs = {"target": double(TARGET[:, : b.n])} if kind == "Servo" else {}
    return getattr(effects, kind)(**parameters), inputs, formula(b.q.numpy(), b.qd.numpy(), **values)


@pytest.mark.parametrize("kind", JOINT)
@pytest.mark.parametrize(("name", "form"), ON_ROBOTS)
def test_an_effect_at_the_joints_adds_the_torques_of_its_formula(name, kind, form):
    b = bare(name)
    effect, inputs, (damping, stiffness, rest) = joint_effect(b, kind, form)
    torques = -damping * b.qd.numpy() - stiffness * (b.q.numpy() - rest)
    assert np.abs(torques).max() > 0.1
    assert agrees(b, effect, torques=torques, **inputs)


@pytest.mark.parametrize("kind", JOINT)
@pytest.mark.parametrize(("name", "form"), [x for x in ON_ROBOTS if x[1] in thinned(("list", "batched"), ("batched",))])
def test_the_implicit_integrator_takes_the_state_at_the_end_of_the_step(name, kind, form):
    """(M + h D + h^2 K) (v' - v) = h (tau - nle - D v - K (q - rest) - h K v)."""
    b, h = bare(name), 0.05
    effect, inputs, (D, K, rest) = joint_effect(b, kind, form)
    q, qd = b.q.numpy(), b.qd.numpy()
    D, K = np.broadcast_to(D, q.shape), np.broadcast_to(K, q.shape)
    expected = pinocchio(b, -D * qd - K * (q - rest) - h * K * qd, implicit=h * D + h**2 * K)
    scene = Scene(b.robot, (effect,), integrator=LinearlyImplicit(), dt=h)
    after = scene.step(scene.start(b.q, b.qd), torque=b.u, **inputs)
    assert close((after.qd - b.qd).numpy() / h, expected.accelerations, expected.size + np.abs(qd) / h)
    assert close(after.q.numpy(), q + h * after.qd.numpy(), np.abs(q) + np.abs(h * after.qd.numpy()))


@pytest.mark.parametrize("h", [0.0, 0.05])
@pytest.mark.parametrize(("name", "form"), ON_ROBOTS)
def test_a_servo_with_a_limit_is_scaled_to_it(name, h, form):
    """Explicit integrators (h = 0) clip the torque; in an implicit step stiffness, damping and force scale together."""
    b, ranges = bare(name), ((5.0, 20.0), (0.5, 2.0), (1.0, 9.0))
    kp, kd, most = (given(form, *x, b.n, seed) for seed, x in enumerate(ranges))
    q, qd, target = b.q.numpy(), b.qd.numpy(), TARGET[:, : b.n]
    tau = kp.values * (target - q - h * qd) - kd.values * qd
    s = np.minimum(1.0, most.values / np.abs(tau))
    assert (s < 1).any()
    expected = pinocchio(b, s * tau, implicit=s * (h * kd.values + h * h * kp.values))
    integrator, dt = (LinearlyImplicit(), h) if h else (ExplicitEuler(), 1.0)
    scene = Scene(b.robot, (effects.Servo(kp.parameter, kd.parameter, most.parameter),), integrator=integrator, dt=dt)
    after = scene.step(scene.start(b.q, b.qd), torque=b.u, target=double(target))
    assert close((after.qd - b.qd).numpy() / dt, expected.accelerations, expected.size + np.abs(qd) / dt)


WHEEL = torchdq.Robot.from_screws([[0, 0, 1, 0, 0, 0]], [1.0], [[0.0] * 3], [torch.eye(3)], gravity=None)


@pytest.mark.parametrize("h", thinned([0.001, 0.005, 0.02], [0.02]))
def test_a_servo_alone_never_exceeds_its_limit_nor_gains_energy(h):
    """Energy of the wheel and of a spring whose force ends at the limit: 3 % of Euler's error are allowed at 20 ms."""
    limit, generator = 2.0, torch.Generator().manual_seed(1)
    kp = double([1.0, 1e4, 1e12]).repeat_interleave(192)[:, None]
    kd = kp * double([0.0, 0.1, 1.0]).repeat(192)[:, None]
    q, qd = torch.randn(2, 576, 1, generator=generator, dtype=torch.float64) * double([[[1.0]], [[5.0]]])

    def energy(q, qd):
        stretch = (q.abs() - limit / kp).clamp(min=0)
        return 0.5 * qd**2 + 0.5 * kp * (q.abs() - stretch) ** 2 + limit * stretch

    scene = Scene(WHEEL, (effects.Servo(kp, kd, limit),), dt=h)
    path = scene.rollout(scene.start(q, qd), target=torch.zeros(int(1 / h), 576, 1, dtype=torch.float64))
    torques = torch.diff(torch.cat([qd[None], path.qd]), dim=0) / h
    assert torques.abs().max() <= limit * (1 + 1e-9)
    assert torques.abs().max() > 0.99 * limit
    assert (energy(path.q, path.qd) <= energy(q, qd) * (1 + 1.5 * h)).all()


def test_the_torque_of_a_limited_servo_converges_to_the_clipped_one():
    """A chain that swings by servos at their limits, against small Runge-Kutta steps of the clipped torque: order 1."""
    b, T = bare("two_link"), 0.2
    servo, target = effects.Servo(80.0, 4.0, [3.0, 1.5]), double([0.8, -0.6])

    def end(dt, integrator):
        scene = Scene(b.robot, (servo,), integrator=integrator, dt=dt)
        return scene.rollout(scene.start(b.q, b.qd), target=target.expand(round(T / dt), 2)).q[-1]

    exact = end(1e-3, RungeKutta4())
    errors = [float((end(dt, LinearlyImplicit()) - exact).abs().max()) for dt in (2e-3, 1e-3)]
    assert errors[1] < 0.01 and 1.7 < errors[0] / errors[1] < 2.3


def test_an_infinite_limit_is_none_and_costs_nothing():
    robot, servo = CASES["two_link"].robot, effects.Servo(5.0, 1.0)
    counts = [Scene(robot, (e,)).count().total for e in (servo, effects.Servo(5.0, 1.0, math.inf))]
    assert counts[0] == counts[1] < Scene(robot, (effects.Servo(5.0, 1.0, 3.0),)).count().total
    q, target = double([0.4, -0.7]), double([1e6, 0.1])
    ends = [
        (scene := Scene(robot, (replace(servo, limit=most),), dt=0.01)).step(scene.start(q), target=target).qd
        for most in (None, double([math.inf, math.inf]))
    ]
    assert torch.equal(*ends)


def test_effects_at_the_joints_add_up():
    b = bare("tree")
    parts = [joint_effect(b, kind, "list") for kind in JOINT]
    torques = sum(-D * b.qd.numpy() - K * (b.q.numpy() - rest) for _, _, (D, K, rest) in parts)
    inputs = {name: x for _, given, _ in parts for name, x in given.items()}
    assert agrees(b, tuple(effect for effect, _, _ in parts), torques=torques, **inputs)


def limit_torque(q, qd, **parameters):
    """Torque of limits at -1 and 1 on a joint, from the acceleration it causes alone."""
    x = [double([[float(value), 0.0]]) for value in (q, qd)]
    robot = CASES["two_link"].robot
    made = Scene(robot, (effects.JointLimits(-1.0, 1.0, **parameters),), integrator=ExplicitEuler(), dt=1.0)
    difference = made.step(State(*x)).qd - Scene(robot, integrator=ExplicitEuler(), dt=1.0).step(State(*x)).qd
    return float((torchdq.mass_matrix(robot, x[0])[0] @ difference[0])[0])


@pytest.mark.parametrize("qd", [-3.0, 0.0, 3.0])
@pytest.mark.parametrize("q", [-1.0, -0.999, 0.0, 0.7, 1.0])
def test_limits_do_nothing_within_them(q, qd):
    assert limit_torque(q, qd) == 0.0


@pytest.mark.case("T11")
@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("qd", [-100.0, -1.0, 0.0, 1.0, 100.0])
def test_limits_never_pull(side, qd):
    torque = limit_torque(side * 1.01, qd, dissipation=5.0)
    assert torque * side < 0
    assert abs(torque) >= 1e4 * 0.01 * (1 - 1e-9)  # at least that of the spring
    assert (abs(torque) > 1e4 * 0.01 * (1 + 1e-9)) == (qd * side > 0)  # damped only while it goes deeper


def test_infinite_limits_cost_nothing():
    bare = Scene(CASES["two_link"].robot, integrator=SemiImplicitEuler())
    one = bare.replace(effects=(effects.JointLimits([-1.0, -math.inf], [1.0, math.inf]),)).count().total
    both = bare.replace(effects=(effects.JointLimits(-1.0, 1.0),)).count().total
    assert both - one == one - bare.count().total > 0


FRICTION = {
    "Viscous": effects.Viscous([0.3, 0.1]),
    "Coulomb": effects.Coulomb([0.5, 2.0], sign_width=1e-3),
    "Stribeck": effects.Stribeck([0.5, 1.0], [1.0, 1.5], sign_width=1e-3),
    "Drag": effects.Drag(0.5, 0.5, 0.1),
}


@pytest.mark.case("T10")
@pytest.mark.parametrize("kind", FRICTION)
def test_friction_only_takes_power(kind):
    robot = CASES["two_link"].robot
    generator = torch.Generator().manual_seed(1)
    q, qd = torch.randn(2, 1000, 2, generator=generator, dtype=torch.float64) * 3
    qd = qd * 10 ** (-6 * torch.rand(1000, 1, generator=generator, dtype=torch.float64))
    made, empty = (
        Scene(robot, parts, integrator=ExplicitEuler(), dt=1.0).step(State(q, qd)) for parts in ((FRICTION[kind],), ())
    )
    tau = torch.einsum("bij,bj->bi", torchdq.mass_matrix(robot, q), made.qd - empty.qd)
    each = tau * qd if kind != "Drag" else (tau * qd).sum(-1)  # the drag of a link acts on all joints below it
    assert (each <= 1e-12 * tau.abs().amax() * qd.abs().amax()).all()
    assert (each < 0).double().mean() > 0.9
