"""Elastic joints, against the equations of joints and rotors solved as a whole."""

import numpy as np
import pinocchio as pin
import pytest
import torch
from effect_harness import CASES, ON_ROBOTS, SAMPLES, bare, close, double, forms_of, pinocchio

from torchdq import Scene, effects
from torchdq.scene import State
from torchdq.scene.integrators import ExplicitEuler, LinearlyImplicit


@pytest.mark.parametrize(("name", "form"), ON_ROBOTS)
def test_elastic_joints_are_two_masses_with_a_spring_between(name, form):
    b = bare(name)
    ranges = {"stiffness": (10.0, 50.0), "damping": (0.1, 1.0), "inertia": (0.1, 1.0)}
    parameters, p = forms_of(ranges, form, b.n)
    scene = Scene(b.robot, (effects.Elastic(**parameters),), integrator=ExplicitEuler(), dt=1.0)
    rng = np.random.default_rng(8)
    theta, omega = b.q.numpy() + rng.normal(size=b.q.shape), rng.normal(size=b.q.shape)
    state = State(b.q, b.qd, double(np.concatenate([theta, omega], -1)))
    after = scene.step(state, torque=b.u)
    spring = p["stiffness"] * (theta - b.q.numpy()) + p["damping"] * (omega - b.qd.numpy())
    expected = pinocchio(b, spring - b.u.numpy())
    assert close((after.qd - b.qd).numpy(), *expected)
    rotors = np.concatenate([theta + omega, omega + (b.u.numpy() - spring) / p["inertia"]], -1)
    assert close(after.memory.numpy(), rotors, 1e3)


def test_rotors_start_with_their_joints():
    q, qd = double([0.3, 0.4]), double([1.0, -1.0])
    state = Scene(CASES["two_link"].robot, (effects.Elastic(10.0, 0.1, 0.1),)).start(q, qd)
    assert torch.equal(state.memory, torch.cat([q, qd]))


def test_the_implicit_integrator_takes_elastic_springs_at_the_end_of_the_step():
    """One linear system for joints and rotors: the elimination of the rotors is checked against solving it whole."""
    b, h = bare("tree"), 0.05
    k, d, J, D, K = np.random.default_rng(9).uniform(1, 9, (5, b.n))
    elastic = effects.Elastic(k.tolist(), d.tolist(), J.tolist())
    others = (effects.Viscous(D.tolist()), effects.Spring(K.tolist()))
    scene = Scene(b.robot, (elastic, *others), integrator=LinearlyImplicit(), dt=h)
    theta, omega = b.q.numpy() + 0.3, b.qd.numpy() - 0.5
    after = scene.step(State(b.q, b.qd, double(np.concatenate([theta, omega], -1))), torque=b.u)
    for i in range(SAMPLES):
        q, qd, u = b.q[i].numpy(), b.qd[i].numpy(), b.u[i].numpy()
        data = b.model.createData()
        configuration, velocity = b.case.configuration(q), b.case.velocity(qd)
        M = pin.crba(b.model, data, configuration)
        M = (np.triu(M) + np.triu(M, 1).T)[np.ix_(b.case.order, b.case.order)]
        nle = pin.nle(b.model, data, configuration, velocity)[b.case.order]
        # unknowns v', w': every impedance with the state at the end, q + h v'
        A = np.block(
            [
                [M + np.diag(h * (D + d) + h**2 * (K + k)), -np.diag(h * d + h**2 * k)],
                [-np.diag(h * d + h**2 * k), np.diag(J + h * d + h**2 * k)],
            ]
        )
        right = np.concatenate(
            [M @ qd + h * (-nle - K * q + k * (theta[i] - q)), J * omega[i] + h * (u - k * (theta[i] - q))]
        )
        ends = np.linalg.solve(A, right)
        assert np.abs(after.qd[i].numpy() - ends[: b.n]).max() < 1e-11
        assert np.abs(after.memory[i, b.n :].numpy() - ends[b.n :]).max() < 1e-11
        assert np.abs(after.memory[i, : b.n].numpy() - (theta[i] + h * ends[b.n :])).max() < 1e-11


def test_a_very_stiff_elastic_joint_is_a_rotor():
    robot = CASES["two_link"].robot
    q, u = double([0.3, 0.4]), double([1.0, -0.5])
    elastic = Scene(robot, (effects.Elastic(1e8, 1e3, 0.2),), integrator=LinearlyImplicit())
    rigid = Scene(robot, (effects.RotorInertia(0.2),), integrator=LinearlyImplicit())
    a, b = elastic.start(q), rigid.start(q)
    for _ in range(20):
        a, b = elastic.step(a, u), rigid.step(b, u)
    assert (a.q - b.q).abs().max() < 1e-6
