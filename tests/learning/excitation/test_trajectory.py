"""Motions for identification: they keep their limits at all times, tell as much as they say, and more than others.

The references are the definition of a limit at random times, numpy's least squares on pinocchio's regressor, and
`identify` on simulated torques.
"""

import math
import re
import sys
import warnings

import numpy as np
import oracles
import pinocchio as pin
import pytest
import torch
from helpers import EVERYTHING, all_in_one, double, exhaustive, thinned
from messages import refused, warned

import torchdq
from torchdq import effects
from torchdq.errors import ArgumentError, MissingLibraryError
from torchdq.learning import HalfSpace, Model, Motion, MotionLimits, Samples, excitation_trajectory, identify
from torchdq.learning.excitation import search
from torchdq.learning.excitation.fourier import Family, grid
from torchdq.learning.excitation.information import BaseParameters

ARM = torchdq.robots.load("two_link")
LIMITS = MotionLimits(lower=-1.0, upper=[1.5, 0.5], velocity=[2.0, 3.0], effort=60.0)
BACKEND = "auto"  # a search calls the same programs hundreds of times
ROUNDING = 1 + 1e-12
DRAWS = 12 if EVERYTHING else 6  # of noise, whose errors are held to their predicted variances

PLAIN = Model((effects.Viscous(), effects.Coulomb()))


def random_times(found, count=20_000):
    return float(found.time[-1]) * torch.from_numpy(np.random.default_rng(1).uniform(size=count))


def torques_at(found, robot, time):
    """Torques with the described friction, whose dry part is taken at its greatest."""
    q, qd, qdd = found.series.at(found.series.rate * time)
    rigid = torchdq.inverse_dynamics(robot, q, qd, qdd) + robot.damping * qd
    return q, qd, qdd, rigid.abs() + robot.friction


@pytest.fixture(scope="module")
def panda():
    return torchdq.robots.load("panda")


@pytest.fixture(scope="module")
def exciting(panda):
    walls = [HalfSpace("panda_link5", axis, -0.4) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
    limits = MotionLimits(workspace=(HalfSpace("tip", (0, 0, 2), 0.3), *walls))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search, "STAGES", (*search.STAGES[:-1], (64, 240 if EVERYTHING else 100)))
        return excitation_trajectory(panda, 10.0, limits, restarts=2), limits


# --- series ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("harmonics", thinned([2, 5, 12], [5]))
def test_series_keep_their_limits_between_the_points_and_rest_at_their_ends(panda, harmonics):
    bounds = MotionLimits(acceleration=9.0, share=1.0).bounds(panda)
    family = Family(bounds, harmonics)
    generator = torch.Generator().manual_seed(3)
    x = family.start(50, generator) * 3
    rate = 0.5 + 3 * torch.rand(50, dtype=torch.float64, generator=generator)
    series = family.motions(x, rate)
    q, qd, qdd = series.at(2 * math.pi * torch.rand(10_000, dtype=torch.float64, generator=generator))
    assert bool((q <= bounds.upper + 1e-12).all()) and bool((q >= bounds.lower - 1e-12).all())
    assert bool((qd.abs() <= bounds.velocity * ROUNDING).all())
    assert bool((qdd.abs() <= bounds.acceleration * ROUNDING).all())
    # and one of the three is used up, but for what the sigmoid leaves and the bound costs
    left = torch.stack([(q.amax(1) - q.amin(1)) / (bounds.upper - bounds.lower), (qd.abs() / bounds.velocity).amax(1)])
    used = torch.maximum(left.amax(0), (qdd.abs() / bounds.acceleration).amax(1))
    assert torch.allclose(used, x[..., -2].sigmoid(), rtol=0.03)
    _, *ends = series.at(double(0.0, 2 * math.pi))
    assert max(float(x.abs().max()) for x in ends) < 1e-12


def test_velocities_and_accelerations_are_derivatives(panda):
    family = Family(MotionLimits().bounds(panda), 5)
    series = family.motions(family.start(3, torch.Generator().manual_seed(0)), double(1.0, 2.0, 0.5))
    step, phases = 1e-5, grid(17)
    (before, v0, _), (_, v, a), (after, v1, _) = (series.at(phases + shift) for shift in (-step, 0.0, step))
    w = series.rate[:, None, None]
    assert torch.allclose((after - before) * w / (2 * step), v, atol=1e-8)
    assert torch.allclose((v1 - v0) * w / (2 * step), a, atol=1e-8)


def test_the_gradient_of_the_information_is_exact():
    bounds = LIMITS.bounds(ARM)
    family, generator = Family(bounds, 2), torch.Generator().manual_seed(0)
    states = 2 * torch.rand(3, 100, 2, dtype=torch.float64, generator=generator) - 1
    parameters = BaseParameters.of(ARM, ("viscous", "coulomb"), 0.05, bounds.effort, tuple(states))

    def gain(x):
        return torch.linalg.slogdet(parameters.information(*family.motions(x, double(1.0, 2.0)).at(grid(30))))[1]

    assert torch.autograd.gradcheck(gain, family.start(2, generator).requires_grad_())


# --- limits ----------------------------------------------------------------------------------------------------------


def test_no_limit_is_exceeded_at_any_time(panda, exciting):
    found, limits = exciting
    q, qd, _, tau = torques_at(found, panda, random_times(found))
    share, (lower, upper, velocity, effort) = 0.9, panda.limits
    middle, reach = (upper + lower) / 2, (upper - lower) / 2
    assert bool(((q - middle).abs() <= share * reach + 1e-12).all())
    assert bool((qd.abs() <= share * velocity * ROUNDING).all()) and bool((tau <= share * effort).all())
    assert bool((limits.clearance(panda, q) >= 0).all())
    tip = torchdq.dq.translation(torchdq.forward_kinematics(panda, q, "tip"))
    elbow = torchdq.dq.translation(torchdq.forward_kinematics(panda, q, "panda_link5"))
    assert 0.3 <= float(tip[:, 2].min()) < 0.5  # the table is near
    assert float(elbow.min()) >= -0.4
    assert max(float(x[[0, -1]].abs().max()) for x in (found.qd, found.qdd)) < 1e-9  # from rest to rest
    assert float(found.time[-1]) == 10.0 and len(found.time) == 1001


@exhaustive
def test_torques_that_bind_are_kept_between_the_rows():
    robot = ARM.replace(damping=double(1.0, 2.0), friction=double(0.5, 0.2))
    limits = MotionLimits(lower=-1.0, upper=1.0, velocity=8.0, effort=[36.0, 10.0], share=1.0)
    found = excitation_trajectory(robot, 8.0, limits, restarts=8)
    *_, tau = torques_at(found, robot, random_times(found, 100_000))
    used = (tau / double(36.0, 10.0)).amax(0)
    assert bool((used <= 1).all()) and float(used.max()) > 0.93


def test_half_spaces_measure_lengths():
    q = torch.zeros(2, dtype=torch.float64)  # the tip is at (2, 0, 0)
    assert torch.allclose(HalfSpace("tip", (-3, 0, 4), -2.0)(ARM, q), double(-1.2 + 2.0))


def test_own_functions_keep_the_arm_where_they_say(short):
    limits = MotionLimits(
        lower=-1.0, upper=1.0, velocity=2.0, effort=60.0, workspace=[lambda _, q: -0.6 - q[..., :1] - q[..., 1:]]
    )
    found = excited(limits, restarts=2)
    q, *_ = found.series.at(found.series.rate * random_times(found))
    assert -0.8 < float(q.sum(-1).max()) <= -0.6


@pytest.fixture
def short(monkeypatch):
    """A search of a few steps."""
    monkeypatch.setattr(search, "STAGES", ((1, 5), (2, 5)))


def excited(limits=LIMITS, seconds=5.0, **options):
    return excitation_trajectory(ARM, seconds, limits, **{"restarts": 1, **options})


@all_in_one(
    [
        # limits that are missing
        lambda: excited(MotionLimits(velocity=1.0, effort=1.0)),
        lambda: excited(MotionLimits(-1.0, [1.0, -2.0], 1.0, effort=1.0)),
        lambda: excited(MotionLimits(-1.0, 1.0, effort=50.0)),
        lambda: excited(MotionLimits(-1.0, 1.0, [1.0, 2.0])),
        lambda: excited(MotionLimits(-1.0, 1.0, 1.0, -3.0, 50.0)),
        lambda: excited(MotionLimits(-1.0, 1.0, [1.0, 2.0, 3.0], effort=1.0)),
        # or cannot be kept
        lambda: excited(MotionLimits(-0.1, 0.1, 1.0, effort=[60.0, 1.0])),
        lambda: excited(MotionLimits(-1.0, 1.0, 1.0, effort=99.0, workspace=[HalfSpace("tip", (1, 0, 0), 3.0)])),
        lambda: excited(period=3.0),
        lambda: excited(harmonics=1),
        lambda: excited(noise=[1.0, -1.0]),
        lambda: excited(3),
        lambda: excited(seconds=0.0),
        lambda: HalfSpace("tip", (0, 0, 0), 1.0),
        lambda: HalfSpace("tip", (0, 0), 1.0),
        lambda: MotionLimits(share=1.2),
        lambda: MotionLimits(workspace=HalfSpace("tip", (0, 0, 1), 0.0)),
    ]
)
def test_arguments_are_checked_and_limits_that_cannot_be_kept_are_named(call, short):
    with refused(ArgumentError):
        call()


def test_limits_in_degrees_are_told_with_their_joints(panda):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        MotionLimits().bounds(panda)
        MotionLimits(velocity=1.0, lower=-1.0, upper=1.0, effort=60.0).bounds(ARM)
    for limits, robot in (
        (MotionLimits(lower=-90, upper=90), panda),
        (MotionLimits(velocity=120.0), panda),
        (MotionLimits(lower=-90, upper=90, velocity=1.0, effort=60.0), ARM),
    ):
        with warned(UserWarning):
            limits.bounds(robot)


# --- information -----------------------------------------------------------------------------------------------------


def test_errors_are_those_of_least_squares_on_pinocchios_regressor(panda, exciting):
    found, _ = exciting
    case = oracles.case("shipped-panda")
    data = case.model.createData()
    states, v = zip(found.q.numpy(), found.qd.numpy(), found.qdd.numpy(), strict=True), found.qd.numpy()
    Y = np.stack([pin.computeJointTorqueRegressor(case.model, data, *state).copy() for state in states])
    friction = [np.einsum("sj,jk->sjk", x, np.eye(7)) for x in (v, v / np.hypot(v, 1e-2))]
    Z = np.concatenate([Y, *friction], -1) / found.parameters.noise.numpy()[:, None]
    Z = Z.reshape(-1, Z.shape[-1])
    rank = np.linalg.matrix_rank(Z, tol=1e-9 * np.linalg.norm(Z))
    assert len(found.base_errors) == rank == 43 + 14
    base, lead = found.parameters.base.numpy(), Z[:, found.parameters.leading]
    assert np.abs(Z - lead @ base).max() < 1e-9 * np.abs(Z).max()
    expected = np.sqrt(np.linalg.inv(lead.T @ lead).diagonal())
    assert found.base_errors.numpy() == pytest.approx(expected, rel=1e-8)
    assert found.condition == pytest.approx(np.linalg.cond(lead), rel=1e-6)


def test_identification_from_the_motion_errs_as_predicted(short):
    """Mean square over the base parameters and draws of the noise, in predicted variances."""
    found = excited(noise=[0.5, 0.2], rate=18.0)  # fewer rows than are checked for what a model lacks
    friction = found.qd + 2 * found.qd / (found.qd**2 + 1e-4).sqrt()
    rigid = torchdq.inverse_dynamics(ARM, found.q, found.qd, found.qdd)
    rng, base = np.random.default_rng(0), found.parameters.base
    truth = torch.cat([ARM.inertial_parameters, double(1.0, 1.0, 2.0, 2.0)])
    squares = []
    for _ in range(DRAWS):
        noise = torch.from_numpy(rng.normal(size=rigid.shape)) * found.parameters.noise
        tau = rigid + friction + noise
        again = identify(ARM, Samples(found.q, found.qd, found.qdd, tau), PLAIN, prior=1e-6)
        assert again.rank == len(base) and again.names == found.names
        squares.append(((base @ (again.parameters - truth)) / found.base_errors) ** 2)
    assert [name.split()[:2] for name in again.base_names] == [name.split()[:2] for name in found.base_names]
    assert torch.allclose((found.base @ again.spread).norm(dim=1), found.base_errors, rtol=0.2)
    mean = float(torch.stack(squares).mean())
    assert abs(mean - 1) < 5 * math.sqrt(2 / (DRAWS * len(base)))


def test_parameters_that_a_motion_does_not_tell_have_infinite_errors(exciting):
    q = exciting[0].q[:100]
    errors = exciting[0].parameters.errors(q, 0 * q, 0 * q)
    assert bool(errors[-14:].isinf().all()) and bool(errors.isfinite().any())


def test_the_search_improves_on_random_motions(panda, exciting):
    found, limits = exciting
    family = Family(limits.bounds(panda), 5)
    rate = torch.full((200,), float(found.series.rate)).double()
    some = family.motions(family.start(200, torch.Generator().manual_seed(9)), rate).at(grid(60))
    volume, own = (
        torch.linalg.slogdet(found.parameters.information(*rows)).logabsdet
        for rows in (some, (found.q[1:], found.qd[1:], found.qdd[1:]))
    )
    # a mean error 1.3 times smaller than the best random motion's, which need not keep torques and workspace
    assert float(own - volume.max()) > 2 * len(found.base_errors) * math.log(1.3)


def test_seeds_reproduce_motions(short):
    one, same, other = (excited(restarts=4, seed=seed) for seed in (1, 1, 2))
    assert torch.equal(one.q, same.q) and not torch.equal(one.q, other.q)


# --- what is done with it --------------------------------------------------------------------------------------------


def test_a_file_is_read_back(exciting, tmp_path):
    found, _ = exciting
    for rate, rows in ((None, 1001), (250.0, 2501)):
        found.to_csv(tmp_path / "motion.csv", rate)
        log = torchdq.learning.read_log(tmp_path / "motion.csv")
        motion = found.sampled(rate or 100.0)
        assert len(log.time) == rows
        for name in ("time", "q", "qd", "qdd", "tau"):
            assert np.allclose(getattr(log, name), getattr(motion, name), rtol=1e-10, atol=1e-11)
    assert np.array_equal(found.sampled(100.0).q, found.q.numpy())


def test_printed_it_is_the_table_of_errors(exciting):
    found, _ = exciting
    assert repr(found) == "Excitation(panda: 10 s of 7 joints for 57 base parameters)"
    assert re.search(r"panda_joint7 coulomb +\d", str(found)) and "velocity" in str(found)


def test_a_plot_shows_every_joint(exciting, monkeypatch):
    pytest.importorskip("matplotlib")
    found, _ = exciting
    figure = found.plot()
    assert len(figure.axes) == 21 and all(axes.lines for axes in figure.axes)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with refused(MissingLibraryError):
        found.plot()


def test_predicted_torques_are_drawn_beside_measured_ones(panda, exciting):
    pytest.importorskip("matplotlib")
    motion = exciting[0].sampled(50.0)
    found = identify(panda, motion, PLAIN, prior=1.0)
    apart = motion._replace(time=np.where(motion.time > 4, motion.time + 2, motion.time))  # a line is broken there
    figure = torchdq.learning.plot_torques(found, [motion, apart])
    titles = ["".join(axes.get_title(place) for place in ("left", "center")) for axes in figure.axes]
    assert [title.split(":")[0] for title in titles] == list(panda.joint_names)
    measured, predicted = (line.get_ydata() for line in figure.axes[1].lines)
    assert np.isnan(measured).sum() == 2 and len(measured) == 2 * 501 + 2
    assert np.nanmax(abs(measured - predicted)) < 0.02 * np.nanmax(abs(measured))
    for other, moved in ((found, Motion(motion.time, *(x[:, :2] for x in motion[1:5]))), (panda, motion)):
        with refused(ArgumentError):
            torchdq.learning.plot_torques(other, moved)
