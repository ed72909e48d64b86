"""Wrong logs have findings about their joints, and logs of robots that differ from their description have none."""

import contextlib
import math
import warnings
from functools import partial

import pytest
import torch
from helpers import all_in_one, thinned
from messages import refused
from recorded_logs import codes, fitted, plain, recorded, with_findings
from urdf_text import joint, link, urdf

import torchdq
from torchdq.learning import LogWarning, Model, Samples, fit, identify
from torchdq.learning.evaluation.diagnostics import diagnose

ROBOTS = ("two_link", "panda", "ur10e", "puma560")
ARMS = thinned(ROBOTS, ("two_link", "puma560"))


def found(robot, data):
    """Findings about samples, without the least squares that follow."""
    return diagnose(robot, partial(torchdq.inverse_dynamics, robot), data, 1e-2)


def warned(robot, data, **options):
    """Findings of an identification without selection, which takes far less time than with it."""
    return with_findings(fitted, robot, *data, **options)[1]


def exchanged(x):
    """Columns of a signal, of which the second and the third have changed places."""
    return x[:, [0, 2, 1, *range(3, x.shape[1])]]


def negative(x, j):
    return torch.where(torch.arange(x.shape[1]) == j, -x, x)


@pytest.mark.parametrize("name", thinned(ROBOTS, ("two_link",)))
@pytest.mark.parametrize("seed", thinned([0, 1], [0]))
def test_a_robot_that_differs_from_its_description_has_no_findings(name, seed):
    robot, data = recorded(name, seed)
    assert warned(robot, data) == warned(robot, data, armature=True, offset=True) == []
    if not seed:
        wider = warned(robot, data, armature=True, offset=True, sign_width=0.02)  # twice the true width
        assert set(codes(wider)) <= {"friction.shape"}
    gains = torch.linspace(0.7, 1.4, robot.n).double()  # gains of the torque sensors
    assert found(robot, data._replace(tau=gains * data.tau)) == []


@all_in_one(thinned(("two_link", "ur10e"), ("two_link",)))
def test_there_are_none_where_the_model_is_selected(name):
    assert with_findings(identify, *recorded(name))[1] == []


@pytest.mark.parametrize("name", ARMS)
def test_torques_in_another_unit_have_findings(name):
    robot, data = recorded(name, seed=1)
    for factor in (1e-3, 1e3, 1e-2, 1e2):
        wrong = found(robot, data._replace(tau=factor * data.tau))
        assert codes(wrong) == ["torque.unit"] and all(0.2 < one.value / factor < 5 for one in wrong), factor
        if 1e-3 < factor < 1e3:  # all joints that share the factor; those whose torque is friction alone show none
            least = robot.joint_names[1 if name == "puma560" else 0 : 3]
            assert {one.subject for one in wrong} >= set(least), factor


@pytest.mark.parametrize("name", thinned(ROBOTS, ("ur10e",)))
def test_torques_in_another_unit_are_named_before_least_squares_that_may_have_no_solution(name):
    robot, data = recorded(name, seed=1)
    with pytest.warns(LogWarning) as given, contextlib.suppress(torchdq.ArgumentError):
        fitted(robot, *data._replace(tau=1e3 * data.tau))
    assert codes(given[0].message.findings) == ["torque.unit"]


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("seed", thinned([0, 1], [1]))
def test_torques_without_gravity_have_a_finding(name, seed):
    robot, data = recorded(name, seed)
    gravity = torchdq.inverse_dynamics(robot, data.q)
    (one,) = found(robot, data._replace(tau=data.tau - gravity))
    assert one.code == "torque.weightless" and "torchdq.inverse_dynamics(robot, q)" in one.cure
    assert found(robot, data) == []
    for factor in (-1, 1e-3, 1e3):
        assert "torque.weightless" not in codes(found(robot, data._replace(tau=factor * data.tau)))


@all_in_one(ARMS)
def test_currents_without_a_gain_have_findings(name):
    robot, data = recorded(name, seed=1)
    gain = torch.linspace(6.0, 14.0, robot.n).double()  # torque per ampere at the joints
    currents = found(robot, data._replace(tau=data.tau / gain))
    assert codes(currents) == ["torque.current"] and all(0 < one.value < 1 / 3 for one in currents)
    assert "Layout(gain=...)" in currents[0].cure and "--estimate-gains" in currents[0].option
    for factor in (1 / 1.5, 1.5):
        assert found(robot, data._replace(tau=factor * data.tau)) == []


@all_in_one([0.0, -3.7])
def test_a_torque_that_never_changes_has_a_finding(value):
    robot, data = recorded("ur10e", seed=1)
    wrong = data._replace(tau=torch.where(torch.arange(6) == 3, value, data.tau))
    (one,) = found(robot, wrong)
    assert (one.code, one.subject, one.value) == ("torque.constant", robot.joint_names[3], value)
    held = Samples(*(x.clone() for x in wrong))  # a joint that is held, and one that has nothing to carry
    held.qd[:, 3] = held.qdd[:, 3] = 0
    assert "torque.constant" not in codes(found(robot, held))


@pytest.mark.parametrize("name", ARMS)
def test_torques_of_the_opposite_sign_have_a_finding(name):
    robot, data = recorded(name, seed=1)
    for j, subject in list(enumerate(robot.joint_names))[1::3]:
        (one,) = found(robot, data._replace(tau=negative(data.tau, j)))
        assert one.code in ("torque.sign", "motion.sign", "torque.unexplained") and one.subject == subject


@pytest.mark.parametrize("name", thinned(ROBOTS, ("two_link", "ur10e")))
def test_columns_in_another_order_have_a_finding(name):
    robot, data = recorded(name, seed=1)

    def code_and_signals(wrong):
        (one,) = found(robot, wrong)
        return one.code, one.expected.removeprefix("the ").partition(" should be")[0], one.subject

    everyone, (a, b) = ", ".join(robot.joint_names), (robot.joint_names * 2)[1:3]
    assert code_and_signals(data._replace(tau=data.tau.flip(1))) == ("columns.reversed", "torques", everyone)
    flipped = Samples(*(x.flip(1) for x in data))
    assert code_and_signals(flipped) == ("columns.reversed", "columns of all signals", everyone)
    if robot.n > 2:
        assert code_and_signals(data._replace(q=data.q.flip(1))) == ("columns.reversed", "positions", everyone)
        swapped = data._replace(tau=exchanged(data.tau))
        assert code_and_signals(swapped) == ("columns.swapped", "torques", f"{a}, {b}")
    if robot.n > 2 and name != "puma560":  # other masses of a puma explain these torques; its log is refused when read
        swapped = data._replace(q=exchanged(data.q))
        assert code_and_signals(swapped) == ("columns.swapped", "positions", f"{a}, {b}")


def test_joints_sorted_by_name_have_a_finding():
    robot, data = recorded("ur10e", seed=1)
    order = sorted(range(6), key=lambda j: robot.joint_names[j])
    (one,) = found(robot, Samples(*(x[:, order] for x in data)))
    assert one.code == "columns.swapped" or (one.code == "columns.sorted" and "all signals" in one.expected)


def test_a_joint_that_swings_freely_has_no_finding():
    """Its measured torque is noise, and hardly any of what the description needs for the motion."""
    robot, data = recorded("two_link")
    noise = torch.randn(len(data.tau), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    for part, said in ((0.1, False), (1.0, True)):
        tau = data.tau.clone()
        tau[:, 1] = part * tau[:, 1].std() * noise
        assert ("torque.unexplained" in codes(warned(robot, data._replace(tau=tau)))) == said


def test_torques_that_nothing_explains_have_findings():
    robot, data = recorded("two_link")
    other = torch.randn(data.tau.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    wrong = warned(robot, data._replace(tau=10 * other))
    assert codes(wrong) == ["torque.unexplained"] and tuple(one.subject for one in wrong) == robot.joint_names
    assert all(0 <= one.value < 0.5 for one in wrong)


def test_the_warning_can_be_silenced_and_a_few_rows_have_no_findings():
    robot, data = recorded("two_link")
    wrong = Samples(*(x[:200] for x in data._replace(tau=-data.tau)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", LogWarning)
        assert codes(identify(robot, wrong, plain(), prior=1.0).findings)  # they are in the result
    assert warned(robot, Samples(*(x[:90] for x in wrong))) == []


@pytest.mark.parametrize("residual", thinned([False, True], [True]))
def test_a_fit_of_a_model_that_holds_a_robot_has_them_too(residual):
    robot, data = recorded("two_link", seed=1)
    model = torchdq.DQRNEA(robot, learn=("mass", "friction"))
    model = torchdq.ResidualDynamics(model) if residual else model
    assert with_findings(fit, model, data, steps=1)[1] == []
    _, wrong = with_findings(fit, model, data._replace(tau=negative(data.tau, 1)), steps=1)
    assert ("torque.sign", "joint2") in [(x.code, x.subject) for x in wrong]
    small, dead = (
        Samples(*(x.float() for x in data._replace(tau=data.tau * torch.tensor(factors))))
        for factors in ((1e-3, 1e-3), (1.0, 0.0))
    )
    assert codes(with_findings(fit, model, small, steps=1)[1]) == ["torque.unit"]
    _, wrong = with_findings(fit, model, dead, steps=1)
    assert [x.subject for x in wrong if x.code == "torque.constant"] == ["joint2"]


@pytest.mark.parametrize("factor", [10.2, 5.0])
def test_a_factor_of_all_torques_is_a_unit_and_a_payload_is_none(factor):
    robot, data = recorded("ur10e")
    assert {one.code for one in found(robot, data._replace(tau=factor * data.tau))} == {"torque.unit"}
    held = robot.with_payload(3.0, (0.0, 0.0, 0.05))
    more = torchdq.inverse_dynamics(held, *data[:3]) - torchdq.inverse_dynamics(robot, *data[:3])
    assert not found(robot, data._replace(tau=data.tau + more))


@all_in_one(thinned(ROBOTS, ("two_link", "ur10e")))
def test_small_motions_in_degrees_have_a_finding(name):
    """A few degrees look like radians, and keep all limits of an arm whose joints turn far."""
    robot, data = recorded(name, seed=1)
    q, qd, qdd = (0.03 * x for x in data[:3])  # the largest positions are below 7 degrees
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    tau = tau + 0.02 * tau.std(0) * torch.randn(tau.shape, generator=torch.Generator().manual_seed(0)).double()
    assert found(robot, Samples(q, qd, qdd, tau)) == []
    degrees = [180 / math.pi * x for x in (q, qd, qdd)]
    assert float(degrees[0].abs().max()) < 7
    (one,) = found(robot, Samples(*degrees, tau))
    assert one.code == "motion.unit" and one.value == math.pi / 180 and "multiply them by pi/180" in one.cure


def test_motions_beyond_the_limits_of_the_description_have_findings():
    robot, data = recorded("panda", seed=1)
    lower, upper = robot.limits.lower, robot.limits.upper
    inside = data._replace(q=(lower + upper) / 2 + 0.3 * data.q, qd=0.3 * data.qd, qdd=0.3 * data.qdd)
    inside = inside._replace(tau=torchdq.inverse_dynamics(robot, *inside[:3]) + 0.1 * torch.randn_like(data.tau))
    assert found(robot, inside) == []
    far = inside._replace(q=torch.where(torch.arange(7) == 3, 57.3 * inside.q, inside.q))
    (one,) = found(robot, far)
    assert (one.code, one.subject) == ("position.limits", "panda_joint4") and "degrees" in one.cure
    assert one.value == pytest.approx(float(far.q[:, 3].abs().max()), rel=0.01) and "-3.07 and -0.0698" in one.expected
    fast = found(robot, inside._replace(qd=57.3 * inside.qd))
    assert codes(fast) == ["velocity.limits"] and fast[0].subject == "panda_joint1" and "2.17 rad/s" in fast[0].expected


def test_a_joint_that_slides_has_its_own_units():
    limit = '<limit lower="-1" upper="1" velocity="2" effort="100"/>'
    rail = joint("rail", "base", "cart", "prismatic", axis=(1, 0, 0), more=limit)
    robot = torchdq.Robot.from_urdf(urdf(link("base", None), link("cart", 4), rail))
    t = torch.linspace(0, 20, 400).double()[:, None]
    q, qd, qdd = t.sin(), t.cos(), -t.sin()
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + qd
    (one,) = found(robot, Samples(1000 * q, 1000 * qd, 1000 * qdd, tau))
    assert (one.code, one.subject) == ("position.limits", "rail") and one.value == pytest.approx(1000, rel=1e-3)
    assert "millimetres" in one.cure and "0.001" in one.cure and one.expected.endswith(" m")


def test_rows_that_leap_away_have_a_finding_and_are_not_dropped():
    robot, data = recorded("two_link", seed=1)
    tau = data.tau.clone()
    tau[[100, 333], 1] = torch.tensor([1e4, -1e4]).double()
    (one,) = found(robot, data._replace(tau=tau))
    assert (one.code, one.subject, one.value) == ("torque.outliers", "joint2", 2)
    assert "1e+04 in row 100, -1e+04 in row 333, elsewhere up to" in one.found
    assert "torque.outliers" in codes(warned(robot, data._replace(tau=tau)))


def test_a_model_is_one():
    for options in ({"friction": "yes"}, {"friction": True}, {"offset": "yes"}):
        with refused(torchdq.ArgumentError):
            Model(**options)
    with refused(torchdq.ArgumentError):
        identify(*recorded("two_link"), "auto")
