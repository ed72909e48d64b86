"""Control of a frame as a layer: the function's torques, with those of the motors, of robots and of trained modules."""

import math

import pytest
import torch
from helpers import all_in_one, double, exhaustive, random, thinned
from messages import refused
from torch.autograd import gradcheck

import torchdq
from torchdq import dq, nn
from torchdq.errors import ArgumentError

PANDA, TWO = torchdq.robots.load("panda"), torchdq.robots.load("two_link")
Q, QD, X, V, A = random(4, 7), random(4, 7, seed=1), random(4, 8, seed=2), random(4, 6, seed=3), random(4, 6, seed=4)
AT = Q[:, :2], QD[:, :2]  # of the small arm
SIX = double(1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
LAWS = {
    nn.OperationalSpaceControl: (torchdq.operational_space_control, ("kp", "kd"), (X, V, A)),
    nn.CartesianImpedance: (torchdq.cartesian_impedance, ("stiffness", "damping"), (X, V)),
}


def law_of(module, gains, more, robot=PANDA, goal=None):
    """Torques of the function."""
    law, names, usual = LAWS[module]
    q, qd = Q[:, : robot.n], QD[:, : robot.n]
    return law(robot, q, qd, *(usual if goal is None else goal), **dict(zip(names, gains, strict=True)), **more)


@pytest.mark.parametrize("module", thinned(LAWS, [nn.CartesianImpedance]))
def test_learned_gains_are_those_of_the_function(module):
    names = LAWS[module][1]
    layer = module(PANDA, 90.0, 2 * SIX, learn=names, friction=False)
    assert {n: tuple(p.shape) for n, p in layer.named_parameters()} == {names[0]: (), names[1]: (6,)}
    gains = [getattr(layer, name) for name in names]
    found = torch.autograd.grad(layer(Q, QD, X, V).square().sum(), gains)
    expected = torch.autograd.grad(law_of(module, gains, {}, goal=(X, V)).square().sum(), gains)
    assert all(torch.allclose(a, b, rtol=1e-12) for a, b in zip(found, expected, strict=True))
    assert gradcheck(lambda q: layer(q, QD[0], X[0], V[0]), Q[0].clone().requires_grad_(), atol=1e-4, fast_mode=True)


@all_in_one(LAWS)
def test_a_trained_layer_brings_its_masses_friction_and_offset(module):
    trained = nn.InverseDynamics(TWO, learn=("mass", "friction", "offset"))
    trained.mass, trained.offset = 1.1 * TWO.mass, random(2)
    layer, goal, (q, qd) = module(trained, 100.0, 20.0, axes=("x", "y")), LAWS[module][2], AT
    expected = law_of(module, (100.0, 20.0), {"axes": ("x", "y")}, robot=trained.robot)
    expected = expected + trained.friction_torque(qd) + trained.offset
    assert torch.allclose(layer(q, qd, *goal), expected, rtol=1e-12)
    assert {name for name, _ in layer.named_parameters()} == {f"model.{name}" for name, _ in trained.named_parameters()}
    program = torchdq.compile(layer.program())
    assert torch.allclose(program(q, qd, *goal), layer(q, qd, *goal), rtol=1e-12)


class Learned(torch.nn.Module):
    """Torques of the rigid bodies and of something else."""

    robot = PANDA

    def forward(self, q, qd, qdd, f_tip=None):
        return torchdq.inverse_dynamics(PANDA, q, qd, qdd) + 3 * q.sin() - qd


@all_in_one(LAWS)
def test_a_module_adds_what_it_found_beyond_the_rigid_bodies(module):
    layer, goal = module(Learned(), 100.0, 20.0, learn=LAWS[module][1]), LAWS[module][2]
    expected = law_of(module, (100.0, 20.0), {}) + 3 * Q.sin() - QD
    assert torch.allclose(layer(Q, QD, *goal), expected, rtol=1e-9, atol=1e-9)
    assert all(x is not None for x in torch.autograd.grad(layer(Q, QD, *goal).sum(), list(layer.parameters())))
    with refused(ArgumentError):
        layer.program()


@pytest.mark.parametrize("module", thinned([*LAWS, nn.ComputedTorque], [nn.CartesianImpedance]))
def test_controllers_are_one_graph_of_the_compiler(module):
    torch._dynamo.reset()
    more = {"axes": ("x", "y")} if module in LAWS else {}
    control = module(TWO, 100.0, 20.0, friction=True, **more).double()
    given = (*AT, X) if module in LAWS else (*AT, *AT, AT[0])
    compiled = torch.compile(control, backend="eager", fullgraph=True)
    assert torch.allclose(compiled(*given), control(*given), rtol=1e-12, atol=1e-12)


@exhaustive
@pytest.mark.parametrize("module", thinned(LAWS, [nn.OperationalSpaceControl]))
def test_controllers_are_exported_for_any_number_of_rows_with_one_goal(module):
    control, batch = module(TWO, 100.0, 20.0, axes=("x", "y")), torch.export.Dim("batch")
    shapes = {"q": {0: batch}, "qd": {0: batch}, "X_des": None}
    torch.export.export(control, AT, {"X_des": X[0]}, dynamic_shapes=shapes)


@exhaustive
def test_an_error_of_170_degrees_is_a_scalar_oscillator_in_every_component():
    """By fourth-order Runge-Kutta steps of 4 ms, against e = e_0 (1 + w t) exp(-w t)."""
    w, h, q = 5.0, 4e-3, double(0.1, -0.5, 0.2, -1.9, 0.3, 1.6, 0.4)
    e0 = torch.cat([torch.nn.functional.normalize(double(0.7, -1.1, 0.6), dim=0) * math.radians(170), 0.1 * V[0, :3]])
    goal = dq.mul(torchdq.forward_kinematics(PANDA, q, PANDA.tip), dq.exp(0.5 * e0))
    layer = nn.OperationalSpaceControl(PANDA, w * w, 2 * w, damping=None, friction=False)

    def rate(q, qd):
        return torchdq.forward_dynamics(PANDA, q, qd, layer(q, qd, goal))

    qd = 0 * q
    with torchdq.backend("auto"), torch.no_grad():  # 600 evaluations
        for k in range(1, 151):
            a = rate(q, qd)
            b = rate(q + h / 2 * qd, qd + h / 2 * a)
            c = rate(q + h / 2 * (qd + h / 2 * a), qd + h / 2 * b)
            d = rate(q + h * (qd + h / 2 * b), qd + h * c)
            q, qd = q + h * qd + h * h / 6 * (a + b + c), qd + h / 6 * (a + 2 * b + 2 * c + d)
            if k % 10 == 0:
                e = 2 * dq.log_shortest(dq.mul(dq.conj(torchdq.forward_kinematics(PANDA, q, PANDA.tip)), goal))
                assert (e - e0 * (1 + w * k * h) * math.exp(-w * k * h)).abs().max() < 1e-8


WRONG = {
    "a quantity of no law": lambda: nn.CartesianImpedance(PANDA, 1.0, 1.0, learn="kp"),
    "learned beside a module": lambda: nn.CartesianImpedance(Learned(), 1.0, 1.0, learn="mass"),
}


@all_in_one(WRONG)
def test_what_cannot_be_learned_is_refused(case):
    with refused(ArgumentError):
        WRONG[case]()
