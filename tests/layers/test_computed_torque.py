"""Computed torque (73)-(78): e'' + kd e' + kp e = 0 with the right model, and a small error with a wrong one.

The closed loop is the two-link arm, pressing on something with its tip, tracking a sine by fourth-order Runge-Kutta.
All its variants are rows of one batch. The error's own equation is solved by a matrix exponential.
"""

import math

import numpy as np
import pinocchio as pin
import pytest
import torch
from helpers import all_in_one, double, random
from messages import refused
from oracles import EPS, random_tree, shipped, states
from robots import ARMS

import torchdq
from torchdq.scene import controllers

F64 = torch.float64
ARMS = {name: shipped(name).robot for name in ARMS}
ARMS |= {"tree": random_tree(8, seed=3, armature=True).robot}


# --- one instant -----------------------------------------------------------------------------------------------------


def commanded(q, qd, q_des, qd_des, qdd_des, kp, kd):
    return qdd_des + kd * (qd_des - qd) + kp * (q_des - q)


@all_in_one(ARMS)
def test_the_robot_accelerates_as_commanded(name):
    robot = ARMS[name]
    s = states(robot, batch=10)
    q_des, qd_des, qdd_des = random(3, 10, robot.n, seed=1)
    expected = commanded(s.q, s.qd, q_des, qd_des, qdd_des, 25.0, 10.0)
    inverse = torch.linalg.inv(torchdq.mass_matrix(robot, s.q)).abs().sum(-1).amax(-1)
    for f_tip in (None, s.f_tip):
        tau = torchdq.computed_torque(robot, s.q, s.qd, q_des, qd_des, qdd_des, 25.0, 10.0, f_tip)
        found = torchdq.forward_dynamics(robot, s.q, s.qd, tau, f_tip)
        # torques are exact to some roundings of their largest; M^-1 turns those into accelerations
        allowed = 100 * robot.n * EPS[F64] * inverse * tau.abs().amax(-1)
        assert ((found - expected).abs().amax(-1) <= allowed).all()


PER_JOINT = torch.linspace(4.0, 25.0, 7, dtype=F64)
GIVEN = {
    "numbers": (9.0, 5.0),
    "one per joint": (PER_JOINT, PER_JOINT.sqrt()),
    "a number and one per joint": (9.0, PER_JOINT),
    "one per row": tuple(random(2, 4, 7, seed=2).abs()),
}


@all_in_one(GIVEN.values())
def test_it_is_the_closed_form_with_the_commanded_acceleration(gains):
    robot, (q, qd, q_des, qd_des, qdd_des) = ARMS["panda"], random(5, 4, 7)
    f_tip = random(4, 6, seed=1)
    M, c, g, Jt = torchdq.closed_form(robot, q, qd)
    a = commanded(q, qd, q_des, qd_des, qdd_des, *gains)
    expected = torch.einsum("bij,bj->bi", M, a) + c + g + torch.einsum("bij,bj->bi", Jt, f_tip)  # (73)
    found = torchdq.computed_torque(robot, q, qd, q_des, qd_des, qdd_des, *gains, f_tip)
    assert (found - expected).abs().max() <= 1000 * EPS[F64] * expected.abs().max()


# --- the module ------------------------------------------------------------------------------------------------------


@all_in_one([(25.0, 10.0), (double(25.0, 4.0), double(10.0, 0.0))])
def test_the_module_equals_the_function(gains):
    robot, state = ARMS["two_link"], random(5, 3, 2)
    controller = torchdq.ComputedTorque(robot, *gains)
    for f_tip in (None, random(3, 6, seed=1)):
        assert torch.equal(controller(*state, f_tip), torchdq.computed_torque(robot, *state, *gains, f_tip))
    assert controller(*state.float()).dtype == torch.float32
    assert not list(controller.parameters()) and {"kp", "kd"} <= controller.state_dict().keys()


@all_in_one(["kp", "kd"])
def test_the_gradient_of_a_gain_is_the_mass_matrix_times_its_error(gain):
    """The torque is M (.. + kp e + kd e'), so its derivative in kp is M e."""
    robot, (q, qd, q_des, qd_des, qdd_des) = ARMS["two_link"], random(5, 2)
    controller = torchdq.ComputedTorque(robot, 25.0, 10.0, learn=(gain, "mass"))
    assert {*dict(controller.named_parameters())} == {gain, "parametrizations.mass.original"}
    tau, weights = controller(q, qd, q_des, qd_des, qdd_des), double(0.7, -1.3)
    (found,) = torch.autograd.grad(tau @ weights, [getattr(controller, gain)])
    expected = weights @ torchdq.mass_matrix(robot, q) @ (q_des - q if gain == "kp" else qd_des - qd)
    assert abs(found - expected) <= 100 * EPS[F64] * abs(expected)


NO_GAINS = [
    *(-1.0, [25.0, -1e-9], math.nan, math.inf, 10**400),  # not positive, or not finite
    *(1j, [1j, 1.0], np.array([1j, 1.0]), torch.tensor([1j, 1.0]), torch.tensor(1j)),
    *(True, [True, False], "1", ["1", "2"], None, {"joint1": 1.0}),
    *([1.0, 2.0, 3.0], [1.0], [[1.0, 2.0], [3.0, 4.0]], [[1.0], [3.0, 4.0]]),  # of another shape
]


@pytest.mark.parametrize("bad", NO_GAINS, ids=lambda x: repr(x)[:24])
@pytest.mark.parametrize("gain", ["kp", "kd"])
def test_what_is_no_gain_is_refused_by_name_everywhere(gain, bad):
    robot, gains = ARMS["two_link"], {"kp": 25.0, "kd": 10.0, gain: bad}
    for made in (
        lambda: torchdq.ComputedTorque(robot, **gains),
        lambda: torchdq.computed_torque(robot, *torch.zeros(5, 2, dtype=F64), **gains),
        lambda: torchdq.Scene(robot, controller=controllers.ComputedTorque(**gains)),
        lambda: torchdq.Scene(robot, controller=controllers.PD(**gains)),
    ):
        with refused((torchdq.ArgumentError, torchdq.DtypeError), gain=gain):
            made()


@all_in_one([[25, 16], (25.0, 16.0), np.array([25.0, 16.0], np.float32), torch.tensor([25, 16])])
def test_gains_may_be_any_row_of_real_numbers(gain):
    assert torchdq.ComputedTorque(ARMS["two_link"], gain, np.float32(10)).kp.tolist() == [25.0, 16.0]


# --- the closed loop -------------------------------------------------------------------------------------------------

SECONDS, DT = 2.0, 2e-3  # steps short enough for eleven digits
WRENCH = double(1.0, -2.0, 0.0, 0.0, 0.0, 0.3)  # what the tip exerts
Q0, QD0 = double(0.5, -0.3), double(0.0, 0.0)

# row: mass of the arm over mass of the model, kp, kd
ROWS = {
    "exact": (1.0, (25.0, 25.0), (10.0, 10.0)),
    "pinocchio": (1.0, (25.0, 25.0), (10.0, 10.0)),  # the arm is pinocchio's
    "vectors": (1.0, (16.0, 36.0), (8.0, 12.0)),
    "swinging": (1.0, (25.0, 49.0), (0.0, 3.0)),
    "printed": (1.0, (25.0, 25.0), (10.0, 10.0)),  # (75) without its dot
    "1.01": (1.01, (25.0, 25.0), (10.0, 10.0)),
    "1.05": (1.05, (25.0, 25.0), (10.0, 10.0)),
    "1.1": (1.1, (25.0, 25.0), (10.0, 10.0)),
    "1.1 stiff": (1.1, (100.0, 100.0), (20.0, 20.0)),
}
NAMES = list(ROWS)


def wanted(t):
    t = torch.as_tensor(t, dtype=torch.float64)
    return (
        torch.stack([t.sin(), 0.5 * (2 * t).cos()], -1),
        torch.stack([t.cos(), -(2 * t).sin()], -1),
        torch.stack([-t.sin(), -2 * (2 * t).cos()], -1),
    )


def pinocchio_arm():
    """The arm as pinocchio's model, and what its links feel."""
    model, parent = pin.Model(), 0
    model.gravity.linear = np.array([0.0, -9.81, 0.0])
    rod = pin.Inertia(1.0, np.array([0.5, 0.0, 0.0]), np.diag([0.0, 1.0, 1.0]) / 12.0)
    for i in range(2):
        parent = model.addJoint(parent, pin.JointModelRZ(), pin.SE3(np.eye(3), np.array([float(i), 0, 0])), f"joint{i}")
        model.appendBodyToJoint(parent, rod, pin.SE3.Identity())
    tip = pin.SE3(np.eye(3), np.array([1.0, 0.0, 0.0]))
    on_arm = -tip.act(pin.Force(WRENCH[:3].numpy(), WRENCH[3:].numpy()))
    return model, [pin.Force.Zero(), pin.Force.Zero(), on_arm]


@pytest.fixture(scope="module")
def run():
    """Errors e [row, step, 2] at times t [step], and the acceleration the arm falls short of, [row, step, 2]."""
    model = ARMS["two_link"]
    ratios, kp, kd = (double(*column) for column in zip(*ROWS.values(), strict=True))
    # the rods' inertia grows with their mass
    arm = model.replace(mass=model.mass * ratios[:, None], inertia=model.inertia * ratios[:, None, None])
    other, felt = pinocchio_arm()
    data, theirs, printed = other.createData(), NAMES.index("pinocchio"), NAMES.index("printed")

    def accelerations(t, q, qd):
        q_des, qd_des, qdd_des = wanted(t)
        qd_des = qd_des.expand_as(qd).clone()
        # (75) as printed has kd (qd_des - q) in place of kd (qd_des - qd)
        qd_des[printed] += qd[printed] - q[printed]
        tau = torchdq.computed_torque(model, q, qd, q_des, qd_des, qdd_des, kp, kd, WRENCH)
        qdd = torchdq.forward_dynamics(arm, q, qd, tau, WRENCH)
        ours = (q[theirs].numpy(), qd[theirs].numpy(), tau[theirs].numpy())
        qdd[theirs] = torch.from_numpy(pin.aba(other, data, *ours, felt))
        return qdd

    q, qd = (x.expand(len(ROWS), 2) for x in (Q0, QD0))
    errors, shortfalls = [wanted(0.0)[0] - q], []
    steps = round(SECONDS / DT)
    with torchdq.backend("auto"):  # thousands of evaluations
        for k in range(steps):
            t = k * DT
            a1 = accelerations(t, q, qd)
            a2 = accelerations(t + DT / 2, q + DT / 2 * qd, qd + DT / 2 * a1)
            a3 = accelerations(t + DT / 2, q + DT / 2 * qd + DT**2 / 4 * a1, qd + DT / 2 * a2)
            a4 = accelerations(t + DT, q + DT * qd + DT**2 / 2 * a2, qd + DT * a3)
            shortfalls.append(commanded(q, qd, *wanted(t), kp, kd) - a1)
            q, qd = q + DT * qd + DT**2 / 6 * (a1 + a2 + a3), qd + DT / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            errors.append(wanted(t + DT)[0] - q)
    t = DT * torch.arange(steps + 1, dtype=torch.float64)
    return t, torch.stack(errors, 1), torch.stack(shortfalls, 1)


def solution(t, kp, kd):
    """Errors e [step, 2] of e'' + kd e' + kp e = 0 from the run's start."""
    q_des, qd_des, _ = wanted(0.0)
    columns = []
    for i in range(2):
        generator = double([0.0, 1.0], [-kp[i], -kd[i]])
        start = torch.stack([q_des[i] - Q0[i], qd_des[i] - QD0[i]])
        columns.append((torch.linalg.matrix_exp(t[:, None, None] * generator) @ start)[:, 0])
    return torch.stack(columns, -1)


def errors_of(run, row):
    """Times, errors, and the errors a right model would leave."""
    t, e, _ = run
    _, kp, kd = ROWS[row]
    return t, e[NAMES.index(row)], solution(t, kp, kd)


@all_in_one(["exact", "pinocchio", "vectors", "swinging"])
def test_the_error_follows_its_equation_all_the_way(row, run):
    _, e, expected = errors_of(run, row)
    assert (e - expected).abs().max() < 1e-9  # of Runge-Kutta, before it has died out with the error
    if row != "swinging":
        assert (e[-1] - expected[-1]).abs().max() < 1e-11 and e[-1].abs().max() > 1e-6  # not yet gone
    assert row != "exact" or e[-1].abs().max() > 1e-4


def test_without_its_dot_75_leaves_a_fifth_of_a_radian(run):
    _, e, _ = errors_of(run, "printed")
    assert 0.15 < e[-1].abs().max() < 0.25


@all_in_one(["1.01", "1.05", "1.1", "1.1 stiff"])
def test_a_wrong_mass_leaves_no_more_than_its_mismatch_over_the_gain(row, run):
    """The response of a critically damped joint to a disturbance never exceeds the largest disturbance over kp."""
    _, e, expected = errors_of(run, row)
    mismatch = run[2][NAMES.index(row)].abs().amax(0)
    left = (e - expected).abs().amax(0)
    assert (left <= mismatch / ROWS[row][1][0]).all()
    assert (left > 1e-4).all()  # and the mismatch is felt


def test_the_error_grows_smoothly_with_a_wrong_mass_and_falls_with_stiffer_gains(run):
    slight, more, wrong, stiff = (
        (e - expected)[-1] for row in ("1.01", "1.05", "1.1", "1.1 stiff") for _, e, expected in [errors_of(run, row)]
    )
    assert torch.allclose(more, 5.0 * slight, rtol=0.1) and torch.allclose(wrong, 10.0 * slight, rtol=0.2)
    assert stiff.abs().max() < 0.4 * wrong.abs().max()


# --- models that were trained, and friction --------------------------------------------------------------------------


TWO = ARMS["two_link"]
RUBBING = TWO.replace(damping=torch.full_like(TWO.damping, 2.0), friction=torch.full_like(TWO.friction, 0.7))


def rubs(qd, width=1e-2):
    """Friction of the description."""
    return 2.0 * qd + 0.7 * qd / (qd.square() + width**2).sqrt()


def test_friction_of_the_description_is_compensated():
    """The joints of a scene with that friction follow the desired acceleration."""
    q, qd, *desired = state = random(5, 3, 2)
    tau = torchdq.ComputedTorque(RUBBING, 25.0, 10.0)(*state)
    found = torchdq.forward_dynamics(RUBBING, q, qd, tau - rubs(qd))
    assert torch.allclose(found, commanded(q, qd, *desired, 25.0, 10.0), rtol=1e-11, atol=1e-11)
    rigid = torchdq.ComputedTorque(RUBBING, 25.0, 10.0, friction=False)(*state)
    assert torch.equal(rigid, torchdq.computed_torque(RUBBING, *state, 25.0, 10.0))


@all_in_one([(), "mass", "offset", "friction"])
def test_a_model_that_learned_no_friction_is_compensated_as_its_robot(learn):
    """The described friction, unless it is switched off; the learned one instead where there is one; never both."""
    state = random(5, 4, 2)
    model = torchdq.DQRNEA(RUBBING, learn=learn, sign_width=0.3)
    rigid = torchdq.ComputedTorque(RUBBING, 25.0, 10.0, friction=False)(*state)
    for friction in (True, False):
        found = torchdq.ComputedTorque(model, 25.0, 10.0, friction=friction)(*state)
        alike = torchdq.ComputedTorque(RUBBING, 25.0, 10.0, learn=learn, sign_width=0.3, friction=friction)
        torch.testing.assert_close(found, alike(*state), rtol=1e-12, atol=1e-12)
        expected = rigid + rubs(state[1], 0.3) if friction or learn == "friction" else rigid
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_a_residual_that_was_trained_on_torques_with_friction_gets_no_other():
    """Its network learned measured torques less those of the model, which has none of the described friction."""
    state = random(5, 4, 2)
    model = torchdq.ResidualDynamics(torchdq.DQRNEA(RUBBING))
    with torch.no_grad():  # a network that found the friction
        model.residual = lambda q, qd: rubs(qd)
        found = torchdq.ComputedTorque(model, 25.0, 10.0)(*state)
    torch.testing.assert_close(found, torchdq.ComputedTorque(RUBBING, 25.0, 10.0)(*state), rtol=1e-12, atol=1e-12)


def test_a_layer_that_computes_something_else_is_asked_itself():
    class Heavier(torchdq.InverseDynamics):
        def forward(self, *motion):
            return 2 * super().forward(*motion)

    state = random(5, 3, 2)
    found = torchdq.ComputedTorque(Heavier(TWO), 25.0, 10.0)(*state)
    torch.testing.assert_close(found, 2 * torchdq.ComputedTorque(TWO, 25.0, 10.0)(*state), rtol=1e-13, atol=0.0)


@pytest.mark.parametrize("kind", ["layer", "residual"])
def test_a_trained_model_is_taken_at_the_commanded_acceleration(kind):
    q, qd, q_des, qd_des, qdd_des = random(5, 3, 2)
    wrench = random(3, 6)
    model = torchdq.DQRNEA(RUBBING, learn=("mass", "friction"))
    model.mass = 1.3 * model.mass.detach()
    if kind == "residual":
        model = torchdq.ResidualDynamics(model)
        torch.nn.init.normal_(model.network[-2].weight, std=0.3)
    controller = torchdq.ComputedTorque(model, 25.0, double(10.0, 9.0), learn="kp")
    tau = controller(q, qd, q_des, qd_des, qdd_des, wrench)
    a = commanded(q, qd, q_des, qd_des, qdd_des, 25.0, double(10.0, 9.0))
    expected = model(q, qd, a, wrench)
    # one program of a layer, which may round a product and a sum at once; a network is added to its model's torques
    assert (tau - expected).abs().max() <= (8 * EPS[F64] * expected.abs().max() if kind == "layer" else 0.0)
    tau.sum().backward()
    assert controller.kp.grad is not None and all(p.grad is not None for p in model.parameters())


TRACKED = ("q", "qd", "q_des", "qd_des", "qdd_des")
MISUSE = [
    lambda layer: torchdq.ComputedTorque(torchdq.ForwardDynamics(layer.robot), 1.0, 1.0),
    lambda layer: torchdq.ComputedTorque(layer, 1.0, 1.0, learn="mass"),
    *(
        lambda layer, wrong=wrong: torchdq.ComputedTorque(layer, 1.0, 1.0)(
            **{name: torch.zeros(3 if name == wrong else 2) for name in TRACKED}
        )
        for wrong in TRACKED
    ),
]


@all_in_one(MISUSE)
def test_models_without_torques_and_arguments_that_do_not_fit_one_are_refused(call):
    with refused(torchdq.ArgumentError):
        call(torchdq.DQRNEA(TWO))
