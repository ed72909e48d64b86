"""Identification: exact data give the exact robot, noise the stated errors, and nothing gives an impossible robot.

The references are numpy's least squares on pinocchio's regressor, the robots the data were made from, and the
definition of a body that can exist.
"""

import itertools
import math
import re
import time
from functools import cache, partial
from importlib import import_module

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from helpers import EVERYTHING, all_in_one, exhaustive, thinned
from messages import refused
from recorded_logs import WIDTH, fitted, noise, plain, sign, states, whitened, with_findings

import torchdq
from torchdq import effects
from torchdq.base import progress
from torchdq.errors import ArgumentError, DtypeError
from torchdq.learning import Layout, Motion, Samples, identify, read_log
from torchdq.learning.identification import regression
from torchdq.robot.arrays import matrices, second_moments
from torchdq.robot.check import consistency as physical
from torchdq.robot.pseudo_inertia import pseudo_inertia
from torchdq.robot.robot import arguments

ROBOT = torchdq.robots.load("two_link")


DRAWS = 25 if EVERYTHING else 10  # of noise


def double(x):
    return torch.as_tensor(x, dtype=torch.float64)


def moving(n, rows, seed=0):
    """Random positions, velocities and accelerations, each [rows, n]."""
    return double(np.random.default_rng([n, rows, seed]).normal(size=(3, rows, n)))


def altered(robot, seed=0):
    """A robot that differs from the description and can exist, with friction and offsets."""
    rng, n = np.random.default_rng(seed), robot.n
    mass = robot.mass * double(rng.uniform(0.8, 1.2, n))
    # a rigid motion of the body about its centre of mass, and a change of size: both keep it possible
    inertia = robot.inertia * double(rng.uniform(0.8, 1.2, (n, 1)))
    real = robot.replace(mass=mass, com=robot.com + double(rng.normal(size=(n, 3)) * 0.02), inertia=inertia)
    return real, [double(rng.uniform(0.5, 2.0, n)) for _ in range(3)]


def torques(real, viscous, coulomb, offset, q, qd, qdd):
    return torchdq.inverse_dynamics(real, q, qd, qdd) + viscous * qd + coulomb * sign(qd) + offset


def assert_can_exist(found):
    assert physical.bodies(found.robot.link_names, found.robot.mass, matrices(found.robot.inertia)) == []
    assert float(torch.linalg.eigvalsh(second_moments(found.robot.inertia)).min()) >= -1e-12
    assert all(bool((x >= 0).all()) for x in (found.viscous, found.coulomb) if x is not None)


# --- exact data ------------------------------------------------------------------------------------------------------


EXACT = ("shipped-panda", "shipped-ur10e", "shipped-two_link", "tree3", "tree5", "tree7")


@pytest.mark.parametrize("name", thinned(EXACT, ("shipped-ur10e", "tree3")))
def test_exact_data_give_the_exact_robot(name):
    robot = oracles.case(name).robot
    real, (viscous, coulomb, offset) = altered(robot)
    q, qd, qdd = moving(robot.n, 1000)
    found = fitted(robot, q, qd, qdd, torques(real, viscous, coulomb, offset, q, qd, qdd), offset=True, prior=1e-6)
    truth = torch.cat([real.inertial_parameters, viscous, coulomb, offset])
    # normal equations square the condition: parameters lose twice the digits that they hardly matter by
    assert oracles.worst(found.base @ found.parameters, found.base @ truth, (found.base * truth).abs().sum(1)) < 1e-7
    assert torch.allclose(found.viscous, viscous, rtol=1e-8) and torch.allclose(found.coulomb, coulomb, rtol=1e-8)

    states = moving(robot.n, 50, seed=1)
    expected = torques(real, viscous, coulomb, offset, *states)
    again = torques(found.robot, found.viscous, found.coulomb, found.offset, *states)
    size = expected.abs().amax(0)
    assert oracles.worst(found.predict(*states).tau, expected, size) < 1e-8
    assert oracles.worst(again, expected, size) < 1e-8  # the robot itself says the same as its parameters
    assert_can_exist(found)


def test_the_trees_have_what_they_are_for():
    robots = [oracles.case(name).robot for name in ("tree3", "tree5", "tree7")]
    assert {"prismatic", "helical", "revolute"} <= {kind for robot in robots for kind in robot.kinds}
    assert any(robot.parents != tuple(range(-1, robot.n - 1)) for robot in robots)
    assert any(robot.armature is not None for robot in robots)


def test_rotors_are_left_as_described_or_found():
    robot = ROBOT.replace(armature=double([0.3, 0.3]))
    q, qd, qdd = moving(2, 300)
    tau = torchdq.inverse_dynamics(robot.replace(armature=2 * robot.armature), q, qd, qdd)
    kept = fitted(robot, q, qd, qdd, tau, friction=None)
    assert torch.equal(kept.robot.armature, robot.armature) and float(kept.rms[1]) > 0.1
    found = fitted(robot, q, qd, qdd, tau, friction=None, armature=True)
    # the first rotor cannot be told from the inertia of the first link
    assert float(found.robot.armature[1]) == pytest.approx(0.6, rel=1e-6)
    assert found.viscous is None and found.coulomb is None and found.offset is None


# --- noise -----------------------------------------------------------------------------------------------------------


def test_the_errors_are_those_that_noise_makes(monkeypatch):
    """Mean squares of deviations, in their stated covariance, are one over draws of the noise."""
    monkeypatch.setattr(import_module("torchdq.learning.identification.identify"), "FEW", 1000)  # of no findings
    robot = oracles.case("tree3").robot
    real, friction = altered(robot)
    q, qd, qdd = moving(robot.n, 300)
    tau = torques(real, *friction, q, qd, qdd)
    noise = double([0.2, 0.5, 1.0, 2.0])
    truth = torch.cat([real.inertial_parameters, *friction])
    states = moving(robot.n, 100, seed=1)
    expected = torques(real, *friction, *states)
    generator = torch.Generator().manual_seed(0)
    of_base, of_torques, sizes = [], [], []
    with torchdq.backend("auto"):  # which compiles what every draw asks for
        for _ in range(DRAWS):
            measured = tau + noise * torch.randn(tau.shape, generator=generator, dtype=torch.float64)
            found = fitted(robot, q, qd, qdd, measured, offset=True, prior=1e-3)
            of_base.append(whitened(found, truth))
            prediction = found.predict(*states)
            of_torques.append((prediction.tau - expected) / prediction.error)
            sizes.append(found.noise)
    of_base = torch.stack(of_base)
    assert 0.9 < float(of_base.square().mean()) < 1.1
    assert 0.85 < float(torch.stack(of_torques).square().mean()) < 1.15
    assert float((of_base.abs() > 4).double().mean()) < 1e-3
    assert torch.allclose(torch.stack(sizes).mean(0), noise, rtol=0.03)


def test_without_a_prior_it_is_numpys_least_squares_on_pinocchios_regressor():
    case = oracles.case("shipped-panda")
    real, (viscous, coulomb, offset) = altered(case.robot)
    s = oracles.states(case.robot, 400)
    t = oracles.states(case.robot, 20, seed=1)
    noise = double(np.random.default_rng(0).normal(size=(400, 7)) * 0.01)
    tau = torques(real, viscous, coulomb, offset, s.q, s.qd, s.qdd) + noise
    found = fitted(case.robot, s.q, s.qd, s.qdd, tau, offset=True, prior=1e-9)

    def columns(states):
        Y = oracles.over(lambda m, d, q, v, a, *_: pin.computeJointTorqueRegressor(m, d, q, v, a).copy(), case, states)
        qd = states.qd.numpy()
        diagonal = [x[..., None] * np.eye(7) for x in (qd, qd / np.sqrt(qd**2 + WIDTH**2), np.ones_like(qd))]
        return np.concatenate([Y, *diagonal], -1)

    weight = 1 / found.noise.numpy()[:, None]
    Z = (columns(s) * weight).reshape(400 * 7, -1)
    phi, _, rank, _ = np.linalg.lstsq(Z, (tau.numpy() * weight[:, 0]).ravel(), rcond=1e-9)
    assert rank == found.rank
    expected = columns(t) @ phi
    assert oracles.worst(found.predict(t.q, t.qd, t.qdd).tau, expected, abs(expected).max(0)) < 1e-8
    covariance = np.linalg.pinv(Z.T @ Z, rcond=1e-14)
    error = np.sqrt(np.einsum("sij,jk,sik->si", columns(t), covariance, columns(t)))
    assert oracles.worst(found.predict(t.q, t.qd, t.qdd).error, error, error) < 1e-4


@all_in_one(thinned([1, 3, 12, 40], [1, 12]))
def test_what_is_found_can_exist_where_least_squares_cannot(rows):
    robot = torchdq.robots.load("panda")
    q, qd, qdd = moving(7, rows)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 5 * moving(7, rows, seed=2)[0]
    pi = torch.linalg.pinv(torchdq.regressor(robot, q, qd, qdd).reshape(-1, 70)) @ tau.flatten()
    least = torch.linalg.eigvalsh(pseudo_inertia(pi.reshape(7, 10))).min()
    assert float(least) < -1e-3  # plain least squares finds what cannot exist
    found = fitted(robot, q, qd, qdd, tau)
    assert_can_exist(found)
    assert bool((found.robot.mass > 0).all()) and bool(found.covariance.isfinite().all())


def test_friction_that_pushes_is_found_to_be_none():
    q, qd, qdd = moving(2, 500)
    found = fitted(ROBOT, q, qd, qdd, torchdq.inverse_dynamics(ROBOT, q, qd, qdd) - qd)
    assert 0 <= float(found.viscous.max()) < 1e-2


# --- the description -------------------------------------------------------------------------------------------------


def test_what_the_samples_do_not_tell_stays_as_described():
    robot = torchdq.robots.load("panda").replace(damping=double([0.7] * 7), gravity=double([0.0] * 3))
    real, still = robot.replace(mass=1.2 * robot.mass), double([0.0] * 6 + [1.0])
    q, qd, qdd = moving(7, 90)
    qd, qdd = still * qd, still * qdd
    tau = torchdq.inverse_dynamics(real, q, qd, qdd) * still + 0.01 * moving(7, 90, seed=3)[0]
    found, findings = with_findings(fitted, robot, q, qd, qdd, tau, prior=4.0)
    assert [x.subject for x in findings if x.code == "joint.unexcited"] == [*robot.joint_names[:6]]
    assert not bool(found.identifiable[70:].reshape(2, 7)[:, :6].any())
    identified = found.base[:, :70].abs().amax(0).reshape(7, 10).amax(1)
    assert identified.nonzero()[:, 0].tolist() == [6]
    assert torch.allclose(found.robot.mass[:6], robot.mass[:6], rtol=1e-9)
    # the second link is described thinner than 1 % of its size
    off = (found.robot.inertia - robot.inertia).abs() / robot.inertia.abs().amax(1, keepdim=True)
    assert bool((off[:6] <= double([1e-7, 1e-3, *[1e-7] * 4])[:, None]).all())
    assert torch.allclose(found.viscous[:6], robot.damping[:6], rtol=1e-9)
    # and has the width of the prior
    assert torch.allclose(found.errors[:60:10], robot.mass[:6] / 4.0**0.5, rtol=1e-9)
    assert torch.allclose(found.errors[70:76], robot.damping[:6] / 4.0**0.5, rtol=1e-9)


def test_a_stronger_prior_stays_nearer():
    real, friction = altered(ROBOT)
    q, qd, qdd = moving(2, 30)
    tau = torques(real, *friction, q, qd, qdd) + moving(2, 30, seed=4)[0]
    far = [
        float((fitted(ROBOT, q, qd, qdd, tau, prior=prior).robot.mass / ROBOT.mass).log().square().sum())
        for prior in (1e-2, 1.0, 1e2, 1e6)
    ]
    assert far[0] > far[1] > far[2] > far[3] and far[3] < 1e-3


def test_links_without_mass_points_and_impossible_ones():
    panda = torchdq.robots.load("panda")
    mass, inertia = panda.mass.clone(), panda.inertia.clone()
    mass[2], inertia[2] = 0, 0  # nothing
    inertia[3] = 0  # a point
    inertia[4] = double([1.0, 0.0, 0.1, 0.0, 0.0, 0.1]) * 1e-2  # no body: 1 > 0.1 + 0.1
    robot = panda.replace(mass=mass, inertia=inertia, on_unphysical="ignore")
    q, qd, qdd = moving(7, 90)  # fewer rows than are checked for what a model lacks
    with refused(torchdq.UnphysicalError):
        fitted(robot, q, qd, qdd, 0 * q)
    robot = robot.replace(on_unphysical="repair")
    tau = torchdq.inverse_dynamics(panda, q, qd, qdd)
    found = fitted(robot, q, qd, qdd, tau, friction=None)
    assert_can_exist(found)
    assert float(found.robot.mass[2]) == 0 and not found.robot.inertia[2].any()
    left = tau - torchdq.inverse_dynamics(robot, q, qd, qdd)
    assert float(found.rms.sum()) < 0.5 * float(left.square().mean(0).sqrt().sum())


# --- excitation ------------------------------------------------------------------------------------------------------


def hardly_moving(noise=0.05):
    """Two-link arm whose second joint moves by 1e-5 rad, with noise of so many N m."""
    t, generator = torch.linspace(0, 10, 1000).double(), torch.Generator().manual_seed(0)
    still = 1e-5 * (3 * t).sin(), 3e-5 * (3 * t).cos(), -9e-5 * (3 * t).sin()
    states = [torch.stack(x, -1) for x in zip((t.sin(), t.cos(), -t.sin()), still, strict=True)]
    white = torch.randn(1000, 2, generator=generator, dtype=torch.float64)
    return ROBOT, *states, torchdq.inverse_dynamics(ROBOT, *states) + noise * white


@all_in_one([0.05, 1e-9])
def test_joints_that_do_not_move_are_named(noise):
    """However little noise there is, since so small a motion is that of the sensors."""
    found, (one,) = with_findings(fitted, *hardly_moving(noise), armature=True)
    assert (one.code, one.subject) == ("joint.unexcited", "joint2") and one.value == pytest.approx(3e-5, rel=0.01)
    identifiable = dict(zip(found.names, found.identifiable.tolist(), strict=True))
    for name in ("rotor", "viscous", "coulomb"):
        assert not identifiable[f"joint2 {name}"], name
    assert any(re.match(r"link2: .*Izz", line) for line in found.unidentifiable)
    assert identifiable["joint1 viscous"] and identifiable["joint1 coulomb"]


@pytest.mark.filterwarnings("error")
def test_what_the_samples_decide_is_said_and_nothing_warned_when_all_joints_move():
    robot = torchdq.robots.load("panda")
    q, qd, qdd = moving(7, 150)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 0.3 * qd + 0.01 * moving(7, 150, seed=4)[0]
    found = fitted(robot, q, qd, qdd, tau, prior=2.0)
    one = fitted(robot, q[:1], qd[:1], qdd[:1], tau[:1])
    assert bool(found.identifiable[70:].all())  # friction of all joints
    alone = (found.base != 0).sum(1) == 1  # base parameters of one term are told by themselves
    lead = [int(row.nonzero()[0]) for row in found.base[alone]]
    assert len(lead) > 10 and bool(found.identifiable[lead].all())
    assert not bool(found.identifiable[:4].any())  # mass and moment of the first link, which turns about the vertical
    assert int(one.identifiable.sum()) < int(found.identifiable.sum()) / 2


def serial(joints, generator, **changes):
    """Arm of random bodies and frames, each of which lies on its joint's axis; the first axis is vertical."""
    draw = partial(torch.rand, generator=generator, dtype=torch.float64)
    a, alpha = 0.1 + 0.4 * draw(joints), math.pi / 2 * (4 * draw(joints)).floor()
    a[:2] = alpha[0] = 0  # the second axis meets the first
    alpha[1] = math.pi / 2
    mass, com, radii = 1 + 4 * draw(joints), 0.3 * (draw(joints, 3) - 0.5), (0.03 + 0.08 * draw(joints, 3)) ** 2
    inertia = (mass[:, None] * (radii.sum(1, keepdim=True) - radii))[:, [0, 0, 1, 0, 0, 2]]
    inertia[:, [1, 3, 4]] = 0
    frames = {"a": a, "alpha": alpha, "d": 0.2 * draw(joints), "theta": torch.zeros(joints)}
    bodies = {"mass": mass, "com": com, "inertia": inertia} | changes
    return torchdq.Robot.from_dh(**{k: x.tolist() for k, x in frames.items()}, **bodies, convention="modified")


@pytest.mark.parametrize("arms", thinned([200, 12], [12]))
def test_identifiable_parameters_are_as_far_off_as_their_errors_say(arms):
    """Over arms, motions and noise; masses and centres differ from those described by a fifth of their size."""
    far = list[float]()
    for seed in range(arms):
        g = torch.Generator().manual_seed(seed)
        described = serial(3, g)
        factor = (0.2 * torch.randn(3, generator=g, dtype=torch.float64)).exp()
        moved = described.com + 0.02 * torch.randn(3, 3, generator=g, dtype=torch.float64)
        real = described.replace(mass=factor * described.mass, inertia=factor[:, None] * described.inertia, com=moved)
        q, qd, qdd = states(3, 400, seed=seed, joints=3)
        tau = torchdq.inverse_dynamics(real, q, qd, qdd)
        size = tau.std((0, 1)).clamp_min(0.03 * float(tau.std((0, 1)).max()))
        tau = tau + 0.05 * size * qd + 0.1 * size * qd / (qd**2 + 1e-4).sqrt()
        tau = tau + 0.01 * size * noise(tau.shape, 0.0, seed=seed)
        found = identify(described, Samples(q, qd, qdd, tau))
        off = (found.parameters[:30] - real.inertial_parameters.flatten()) / found.errors[:30]
        far += off[found.identifiable[:30]].tolist()
        assert not bool(found.identifiable[[0, 10]].any())  # masses of links about fixed points load no joint
    assert len(far) > 3 * arms and 0.8 < float(torch.tensor(far).square().mean().sqrt()) < 1.2


def test_what_is_found_prints_as_a_table_with_units():
    robot = oracles.case("tree7").robot
    q, qd, qdd = moving(robot.n, 50)
    tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + qd + qd / (qd**2 + 1e-4).sqrt()
    found = fitted(robot, q, qd, qdd, tau, armature=True, offset=True)
    lines = str(found).splitlines()
    assert lines[0] == f"{robot.name}, identified: {len(found.names)} parameters, rank {found.rank}"
    header = next(i for i, line in enumerate(lines) if line.startswith("parameter"))
    assert lines[header].split() == ["parameter", "estimate", "standard", "error", "unit", "identifiable"]
    rows = dict(zip(found.names, lines[header + 1 :], strict=False))
    assert all(re.search(rf"^{re.escape(name)}  .*(yes|no)$", row) for name, row in rows.items())
    assert 0 < sum(kind == "prismatic" for kind in robot.kinds) < robot.n
    units = {
        "rotor": ("kg m^2", "kg"),
        "viscous": ("N m s/rad", "N s/m"),
        "coulomb": ("N m", "N"),
        "offset": ("N m", "N"),
    }
    for name, joint in itertools.product(units, range(robot.n)):
        full = f"{robot.joint_names[joint]} {name}"
        k = found.names.index(full)
        unit, known = units[name][robot.kinds[joint] == "prismatic"], "yes" if found.identifiable[k] else "no"
        expected = [f"{found.parameters[k]:.4g}", f"{found.errors[k]:.2g}", *unit.split(), known]
        assert rows[full].removeprefix(full).split() == expected
    assert "tensor(" not in str(found) and len(lines) < len(found.names) + robot.n + 13
    assert len(repr(found)) < 120 and "\n" not in repr(found) and robot.name in repr(found)


def test_predictions_print_as_tables():
    predicted = quick().predict(*moving(2, 300))
    lines = str(predicted).splitlines()
    assert lines[0].split() == ["Prediction", "shape", "least", "mean", "greatest", "unit"]
    assert lines[1].split()[:3] == ["tau", "[300,", "2]"] and len(lines) == 5 and repr(predicted) == str(predicted)


# --- waiting ---------------------------------------------------------------------------------------------------------


def test_long_work_says_how_far_it_is_and_can_be_interrupted(monkeypatch, capfd):
    states, seen = moving(2, 200), []
    monkeypatch.setattr(progress, "FIRST", 0.01)
    monkeypatch.setattr(progress, "EVERY", 0.01)
    monkeypatch.setattr(regression, "CHUNK", 2 * 23 * 50)
    plain = regression.regressor

    def slow(*arguments):
        time.sleep(0.1)
        seen.append(len(arguments[1]))
        if len(seen) == 7:
            raise KeyboardInterrupt  # as Ctrl-C does
        return plain(*arguments)

    monkeypatch.setattr(regression, "regressor", slow)
    with pytest.raises(KeyboardInterrupt):
        fitted(ROBOT, *states, states[0])
    assert seen == [57, 57, 57, 29, 50, 50, 50]  # described torques, and least squares
    told = capfd.readouterr().err
    assert re.search(r"torchdq: identifying two_link, 50 of 200 samples, \d+ s", told)
    time.sleep(0.1)
    assert capfd.readouterr().err == ""  # it has ended
    monkeypatch.undo()
    monkeypatch.setattr(progress, "FIRST", 60.0)
    fitted(ROBOT, *states, states[0])
    assert capfd.readouterr().err == ""


def test_a_joint_whose_residuals_are_correlated_keeps_its_weight():
    """Where a constant torque is missing, few rows are independent, and a described damping is far off."""
    robot = torchdq.robots.load("ur10e").replace(damping=torch.full((6,), 10.0).double())
    q, qd, qdd = (x[0] for x in states(1, 1000, joints=6))
    rigid = torchdq.inverse_dynamics(robot.replace(mass=1.1 * robot.mass), q, qd, qdd)
    spread = rigid.std(0)
    tau = rigid + 0.1 * qd + 0.5 * sign(qd) + spread * (torch.linspace(-0.1, 0.1, 6) + 0.003 * noise(q.shape, 0.0))
    found, _ = with_findings(fitted, robot, q, qd, qdd, tau)
    assert float(found.correlation.max()) == 250  # a quarter of the rows
    assert float(((found.predict(q, qd, qdd).tau - tau).square().mean(0).sqrt() / tau.std(0)).max()) < 0.3


# --- form ------------------------------------------------------------------------------------------------------------


def test_rows_may_come_in_any_shape_order_and_in_pieces(monkeypatch):
    real, friction = altered(ROBOT)
    states = moving(2, 90)
    tau = torques(real, *friction, *states) + moving(2, 90, seed=5)[0]
    whole = fitted(ROBOT, *states, tau).parameters
    shaped = fitted(ROBOT, *(x.reshape(1, 90, 2) for x in (*states, tau))).parameters
    turned = fitted(ROBOT, *(x.flip(0) for x in (*states, tau))).parameters
    single = fitted(ROBOT, *(x.float() for x in (*states, tau))).parameters
    monkeypatch.setattr(regression, "CHUNK", 7 * 2 * 24)  # numbers at a time
    pieces = fitted(ROBOT, *states, tau).parameters
    for other, tolerance in ((shaped, 1e-9), (turned, 1e-5), (pieces, 1e-5), (single, 1e-2)):
        assert torch.allclose(other, whole, rtol=tolerance, atol=tolerance)


def test_the_robot_is_ready_for_scenes_and_layers():
    q, qd, qdd = moving(2, 100)
    found = fitted(ROBOT, q, qd, qdd, torchdq.inverse_dynamics(ROBOT, q, qd, qdd) + 0.5 * qd, armature=True)
    assert arguments(found.robot) == ()
    assert torch.equal(found.robot.damping, found.viscous) and torch.equal(found.robot.friction, found.coulomb)
    assert len(found.names) == len(found.parameters) == 26 and found.names[20] == "joint1 rotor"
    assert torch.allclose(found.robot.inertial_parameters, found.parameters[:20], atol=1e-12)
    assert len(found.base_names) == found.rank == len(found.base_errors)
    assert found.predict(q.reshape(10, 10, 2), qd.reshape(10, 10, 2), qdd[0]).tau.shape == (10, 10, 2)


X = torch.zeros(5, 2, dtype=torch.float64)
BATCH = ROBOT.replace(mass=ROBOT.mass * torch.ones(3, 1).double())
EMPTY = ROBOT.replace(mass=0 * ROBOT.mass, on_unphysical="ignore")
MISUSE = {
    "torques of three joints": lambda: fitted(ROBOT, X, X, X, torch.zeros(5, 3).double()),
    "fewer torques": lambda: fitted(ROBOT, X, X, X, X[:4]),
    "other precision": lambda: fitted(ROBOT, X, X.float(), X, X),
    "not finite": lambda: fitted(ROBOT, X, X, X / 0, X),
    "no rows": lambda: fitted(ROBOT, *[X[:0]] * 4),
    "prior of zero": lambda: fitted(ROBOT, *[X] * 4, prior=0.0),
    "prior as text": lambda: fitted(ROBOT, *[X] * 4, prior="1"),
    "prior as truth": lambda: fitted(ROBOT, *[X] * 4, prior=True),
    "width of zero": lambda: identify(ROBOT, Samples(*[X] * 4), plain(), sign_width=0.0),
    "width not a number": lambda: identify(ROBOT, Samples(*[X] * 4), plain(), sign_width=float("nan")),
    "many robots": lambda: fitted(BATCH, *[X[:3]] * 4),
    "huge torques": lambda: fitted(ROBOT, *scaled(tau=1e300)),
    "huge velocities": lambda: fitted(ROBOT, *scaled(qd=1e150)),
    "huge accelerations": lambda: fitted(ROBOT, *scaled(qdd=1e150)),
    "no mass": lambda: fitted(EMPTY, *[X] * 4, friction=None),
    "no motions": lambda: identify(ROBOT, []),
    "layout": lambda: identify(ROBOT, Layout()),
    "log": lambda: identify(
        ROBOT, read_log({"time": np.arange(5) / 100, "q": X.numpy(), "qd": X.numpy(), "tau": X.numpy()})
    ),
    "motion of another arm": lambda: identify(torchdq.robots.load("ur10e"), motion(X)),
    "unknown gains": lambda: identify(ROBOT, motion(X, known_gains=(True, False))),
    "velocities besides a motion": lambda: quick().predict(motion(X), X),
    "no accelerations": lambda: quick().predict(X, X),
    "no friction": lambda: fitted(ROBOT, *[X] * 4, friction=effects.Gravity()),
    "warming friction": lambda: fitted(ROBOT, *[X] * 4, friction=effects.Viscous(warming=0.1)),
    "bristles that settle": lambda: fitted(ROBOT, *[X] * 4, friction=effects.LuGre(ratio=1.5)),
    "memory that is not wanted": lambda: fitted(ROBOT, *[X] * 4, friction=(effects.LuGre(),), memory=False),
}


def motion(x, **changes):
    """Motion whose signals are all the same."""
    return Motion(np.arange(len(x)) * 0.01, *[x.numpy()] * 4, **changes)


@cache
def quick():
    """Robot identified from few rows."""
    q, qd, qdd = moving(2, 20)
    return fitted(ROBOT, q, qd, qdd, torchdq.inverse_dynamics(ROBOT, q, qd, qdd))


def scaled(**factors):
    """Random signals, some times a factor."""
    signals = zip(("q", "qd", "qdd", "tau"), (*moving(2, 100), moving(2, 100, seed=1)[0]), strict=True)
    return [factors.get(name, 1.0) * x for name, x in signals]


@pytest.mark.filterwarnings("ignore")
@all_in_one(MISUSE)
def test_misuse_is_refused(misuse):
    with refused((ArgumentError, DtypeError)):
        MISUSE[misuse]()


@exhaustive
def test_the_example_finds_the_arm(tmp_path, capsys):
    for needed in ("matplotlib", "rich", "scipy", "tyro"):
        pytest.importorskip(needed, reason="the examples need the extra 'examples'")
    example = import_module("09_identify")
    with torchdq.backend("auto"):
        result = example.main(example.Args(quick=True, out=tmp_path / "new"))
    assert result.chi_square < 3
    assert bool((result.after < 0.2 * result.before).all())
    assert bool((result.after < 1.3 * result.found.noise).all())
    assert_can_exist(result.found)
    from matplotlib.image import imread

    assert imread(tmp_path / "new" / "identify.png")[..., :3].std() > 0.03
    assert "identifiable" in capsys.readouterr().out
