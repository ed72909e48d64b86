"""Wrong logs are named with their joints, and logs of robots that differ from their description are not doubted."""

import contextlib
import math
import warnings

import pytest
import torch
from helpers import thinned

import torchdq
from torchdq.learning import LogWarning, Samples, fit, identify
from torchdq.learning.evaluation import diagnostics as plausibility

ROBOTS = ("two_link", "panda", "ur10e", "puma560")


def recorded(name, seed=0, rows=600, noise=0.05):
    """Description, and samples of a robot whose masses are off by 30 %, with dry friction of 30 % of the torque."""
    robot = torchdq.robots.load(name).replace(on_unphysical="repair")  # one of them breaks the triangle inequality
    g = torch.Generator().manual_seed(seed)
    n, t = robot.n, torch.linspace(0, 30, rows, dtype=torch.float64)[:, None, None]

    def uniform(*shape):
        return torch.rand(shape, generator=g, dtype=torch.float64)

    rate = 2 * math.pi * 0.1 * torch.arange(1, 6).double()
    size, phase = (0.2 + 0.5 * uniform(n, 5)) / rate.sqrt(), rate * t + 6.3 * uniform(n, 5)
    q, qd = (size * phase.sin()).sum(-1), (size * rate * phase.cos()).sum(-1)
    qdd = -(size * rate**2 * phase.sin()).sum(-1)
    factor = 0.7 + 0.6 * uniform(n)
    real = robot.replace(mass=factor * robot.mass, inertia=factor[:, None] * robot.inertia)
    tau = torchdq.inverse_dynamics(real, q, qd, qdd)
    size = tau.std(0)
    tau = tau + 0.3 * size.clamp_min(0.02 * size.max()) * (qd / (qd**2 + 1e-4).sqrt() + 0.3 * qd)
    tau = tau + noise * tau.std(0) * torch.randn(tau.shape, generator=g, dtype=torch.float64)
    return robot, Samples(q, qd, qdd, tau)


def told(robot, data, **options):
    """Doubts about samples, of one fit without a choice among models, which takes far longer and doubts the same."""
    options = {"friction": True, "prior": 1.0} | options
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        identify(robot, *data, **options)
    return [str(w.message) for w in found if w.category is LogWarning]


def doubted(robot, data):
    """Doubts about samples, without the least squares that follow."""

    def torques(q, qd, qdd):
        return torchdq.inverse_dynamics(robot, q, qd, qdd)

    return plausibility.doubts(robot, torques, data, 1e-2)


def exchanged(x, i, j):
    order = list(range(x.shape[1]))
    order[i], order[j] = order[j], order[i]
    return x[:, order]


def negative(x, j):
    return torch.cat([x[:, :j], -x[:, j : j + 1], x[:, j + 1 :]], 1)


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_robot_that_differs_from_its_description_is_not_doubted(name, seed):
    robot, data = recorded(name, seed)
    assert told(robot, data) == told(robot, data, armature=True, offset=True) == []
    if not seed:
        wider = told(robot, data, armature=True, offset=True, width=0.02)  # twice the true width
        assert all(words.startswith("dry friction of ") for words in wider)
    gains = torch.linspace(0.7, 1.4, robot.n).double()  # gains of the torque sensors
    assert doubted(robot, data._replace(tau=gains * data.tau)) == ""


def test_nothing_is_doubted_where_friction_is_chosen():
    robot, data = recorded("ur10e")
    assert told(robot, data, friction="choose", prior=None) == []


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_torques_in_another_unit_are_named(name, factor):
    robot, data = recorded(name, seed=1)
    expected = "is the unit right. give tau in N m"
    # the least squares may have no solution on such torques, after the warning
    with pytest.warns(LogWarning, match=expected) as found, contextlib.suppress(torchdq.ArgumentError):
        identify(robot, *data._replace(tau=factor * data.tau), friction=True, prior=1.0)
    assert any(f"{joint} (" in str(found[0].message) for joint in robot.joint_names)


@pytest.mark.parametrize("name", ROBOTS)
def test_torques_in_hundredths_are_named_with_all_joints_that_share_the_factor(name):
    robot, data = recorded(name, seed=1)
    for factor in (1e-2, 1e2):
        found = doubted(robot, data._replace(tau=factor * data.tau))
        assert "is the unit right" in found
        # joints whose torque is friction alone tell no factor
        assert all(f"{joint} (" in found for joint in robot.joint_names[1 if name == "puma560" else 0 : 3])


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("seed", [0, 1])
def test_torques_without_gravity_are_named(name, seed):
    robot, data = recorded(name, seed)
    gravity = torchdq.inverse_dynamics(robot, data.q)
    expected = "the torques seem to be without gravity; add torchdq.inverse_dynamics(robot, q) to them"
    assert doubted(robot, data._replace(tau=data.tau - gravity)) == expected
    assert doubted(robot, data) == ""
    for factor in (-1, 1e-3, 1e3):
        assert "without gravity" not in doubted(robot, data._replace(tau=factor * data.tau))


@pytest.mark.parametrize("name", ROBOTS)
def test_currents_without_a_gain_are_named(name):
    robot, data = recorded(name, seed=1)
    gain = torch.linspace(6.0, 14.0, robot.n).double()  # torque per ampere at the joints
    found = doubted(robot, data._replace(tau=data.tau / gain))
    assert "are they currents of drives whose gain is missing? give Layout(gain=...)" in found
    assert "without gravity" not in found and any(f"{joint} (0." in found for joint in robot.joint_names)
    assert doubted(robot, data._replace(tau=data.tau / 1.5)) == doubted(robot, data._replace(tau=1.5 * data.tau)) == ""


@pytest.mark.parametrize("value", [0.0, -3.7])
def test_a_torque_that_never_changes_is_named(value):
    robot, data = recorded("panda", seed=1)
    tau = data.tau.clone()
    tau[:, 3] = value
    wrong = data._replace(tau=tau)
    expected = f"never change although the joints move: panda_joint4 ({value:.3g} in all rows, described as varying by"
    (found,) = told(robot, wrong)
    assert expected in found and "is the sensor connected" in found
    assert not any(other in found for other in robot.joint_names if other != "panda_joint4")
    with pytest.warns(LogWarning, match="never change although the joints move: panda_joint4"):
        fit(torchdq.DQRNEA(robot, learn=("mass",)), Samples(*(x.float() for x in wrong)), steps=1)
    held = Samples(*(x.clone() for x in wrong))  # a joint that is held, and one that has nothing to carry
    held.qd[:, 3] = held.qdd[:, 3] = 0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*never move faster")
        assert not any("never change" in found for found in told(robot, held))


@pytest.mark.parametrize("name", ROBOTS)
def test_torques_of_the_opposite_sign_are_named(name):
    robot, data = recorded(name, seed=1)
    for j, joint in list(enumerate(robot.joint_names))[1::3]:
        (found,) = told(robot, data._replace(tau=negative(data.tau, j)))
        assert joint in found and ("the opposite sign in the" in found or "explains only" in found)
        assert not any(other in found for other in robot.joint_names if other != joint)


@pytest.mark.parametrize("name", thinned(ROBOTS, ("two_link", "ur10e")))
def test_columns_in_another_order_are_named(name):
    robot, data = recorded(name, seed=1)
    found = doubted(robot, data._replace(tau=data.tau.flip(1)))
    assert "all joints in reverse in the torques; are they in the order of the robot's joints?" in found
    found = doubted(robot, Samples(*(x.flip(1) for x in data)))
    assert "all joints in reverse in the columns of all signals" in found
    if robot.n > 2:
        found = doubted(robot, data._replace(q=data.q.flip(1)))
        assert "all joints in reverse in the positions" in found
        a, b = robot.joint_names[1:3]
        found = doubted(robot, data._replace(tau=exchanged(data.tau, 1, 2)))
        assert f"{a} and {b} exchanged in the torques" in found
    if robot.n > 2 and name != "puma560":  # other masses of a puma explain these torques; its log is refused when read
        found = doubted(robot, data._replace(q=exchanged(data.q, 1, 2)))
        assert f"{a} and {b} exchanged in the positions" in found


def test_joints_sorted_by_name_are_named():
    robot, data = recorded("ur10e", seed=1)
    order = sorted(range(6), key=lambda j: robot.joint_names[j])
    found = doubted(robot, Samples(*(x[:, order] for x in data)))
    assert "the joints sorted by their names in the columns of all signals" in found or "exchanged" in found


def test_torques_that_nothing_explains_are_named():
    robot, data = recorded("panda")
    other = torch.randn(data.tau.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    (found,) = told(robot, data._replace(tau=10 * other))
    assert "explains only these parts" in found and all(name in found for name in robot.joint_names)


def test_the_warning_can_be_silenced_and_a_few_rows_are_not_doubted():
    robot, data = recorded("two_link")
    wrong = data._replace(tau=-data.tau)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", LogWarning)
        identify(robot, *wrong, friction=True, prior=1.0)
    assert told(robot, Samples(*(x[:90] for x in wrong))) == []


@pytest.mark.parametrize("residual", [False, True])
def test_a_fit_of_a_model_that_holds_a_robot_says_it_too(residual):
    robot, data = recorded("panda", seed=1)
    model = torchdq.DQRNEA(robot, learn=("mass", "friction"))
    model = torchdq.ResidualDynamics(model) if residual else model
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fit(model, data, steps=1)
    with pytest.warns(LogWarning, match="opposite sign in the torques of panda_joint2"):
        fit(model, data._replace(tau=negative(data.tau, 1)), steps=1)
    with pytest.warns(LogWarning, match="is the unit right"):
        fit(model, Samples(*(x.float() for x in data._replace(tau=data.tau / 1000))), steps=1)


def in_degrees(data, joints=slice(None)):
    """Samples whose positions, velocities and accelerations are in degrees."""
    scale = torch.ones(data.q.shape[1], dtype=torch.float64)
    scale[joints] = 180 / math.pi
    return Samples(*(x * scale for x in data[:3]), data.tau)


@pytest.mark.parametrize("name", thinned(ROBOTS, ("two_link", "ur10e")))
def test_small_motions_in_degrees_are_named(name):
    """A few degrees look like radians, and keep all limits of an arm whose joints turn far."""
    robot, data = recorded(name, seed=1)
    small = 0.03  # the largest positions are below 7 degrees
    q, qd, qdd = (small * x for x in data[:3])
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd)
    tau = tau + 0.02 * tau.std(0) * torch.randn(tau.shape, generator=torch.Generator().manual_seed(0)).double()
    right = Samples(q, qd, qdd, tau)
    assert float(in_degrees(right).q.abs().max()) < 7
    assert "in degrees" in doubted(robot, in_degrees(right)) and "pi/180" in doubted(robot, in_degrees(right))
    assert doubted(robot, right) == ""


def test_motions_beyond_the_limits_of_the_description_are_named():
    robot, data = recorded("panda", seed=1)
    lower, upper = robot.limits.lower, robot.limits.upper
    inside = data._replace(q=(lower + upper) / 2 + 0.3 * data.q, qd=0.3 * data.qd, qdd=0.3 * data.qdd)
    inside = inside._replace(tau=torchdq.inverse_dynamics(robot, *inside[:3]) + 0.1 * torch.randn_like(data.tau))
    assert doubted(robot, inside) == ""
    far = inside._replace(q=torch.where(torch.arange(7) == 3, 57.3 * inside.q, inside.q))
    found = doubted(robot, far)
    assert "far beyond the limits of the description: panda_joint4 moves from" in found and "degrees" in found
    assert "its limits are -3.07 and -0.0698" in found and "panda_joint1" not in found
    fast = doubted(robot, inside._replace(qd=57.3 * inside.qd))
    assert "rad/s, its limit is 2.17" in fast and "panda_joint1" in fast


def test_a_joint_that_slides_has_its_own_units():
    text = """<robot name="gantry"><link name="base"/>
      <link name="cart"><inertial><mass value="4"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
      </inertial></link>
      <joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/><axis xyz="1 0 0"/>
        <limit lower="-1" upper="1" velocity="2" effort="100"/></joint></robot>"""
    robot = torchdq.Robot.from_urdf(text)
    t = torch.linspace(0, 20, 400).double()[:, None]
    q, qd, qdd = t.sin(), t.cos(), -t.sin()
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + qd
    found = doubted(robot, Samples(1000 * q, 1000 * qd, 1000 * qdd, tau))
    assert "rail moves from -1e+03 to 1e+03 m" in found and "millimetres (multiply by 0.001)" in found


def test_rows_that_leap_away_are_named_and_not_dropped():
    robot, data = recorded("panda", seed=1)
    tau = data.tau.clone()
    tau[[100, 333], 2] = torch.tensor([1e4, -1e4]).double()
    found = doubted(robot, data._replace(tau=tau))
    assert "tau of panda_joint3 is 1e+04 in row 100, -1e+04 in row 333, elsewhere up to" in found
    assert "least squares follow" in found and found.count("tau of") == 1
    with pytest.warns(LogWarning, match="tau of panda_joint3 is 1e.04 in row 100"):
        identify(robot, *data._replace(tau=tau), friction=True, prior=1.0)
