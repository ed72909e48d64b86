"""Files of identified robots: the friction in them stands for all that was found, and the verdict is about the file."""

import pickle
import warnings

import numpy as np
import pytest
import torch
from helpers import PAIR, double, random
from messages import warned
from recorded_logs import WIDTH, fitted, motion_of, sign, states, torques
from scipy.optimize import nnls

import torchdq
from torchdq import Scene, effects
from torchdq.base.tables import table
from torchdq.findings import Finding
from torchdq.learning import Evaluation, Model, Samples, Verdict, evaluate, identify
from torchdq.learning.evaluate import FAIR
from torchdq.learning.identification.friction_selection import _nonnegative
from torchdq.learning.identification.identified import FRICTION

DESCRIBED = torchdq.Robot.from_urdf(PAIR)
MOVED = [x[0] for x in states(1, 600, seed=9)]


def test_the_friction_of_a_file_comes_nearest_to_all_friction_found():
    """Of a pair of links whose friction is in proportion to the load."""
    q, qd, qdd = MOVED
    load = torchdq.inverse_dynamics(DESCRIBED, *MOVED)
    tau = load + 0.4 * load.abs() * sign(qd)
    tau = tau + 0.01 * tau.std(0) * random(*tau.shape)
    friction = (effects.Viscous(), effects.Coulomb(sign_width=WIDTH), effects.LoadDependent(sign_width=WIDTH))
    found = fitted(DESCRIBED, q, qd, qdd, tau, friction=friction)
    motion = motion_of(q, qd, qdd, tau)
    assert float(found.coefficients("load").min()) > 0.3
    with warned(UserWarning):
        file = torchdq.Robot.from_urdf(found.to_urdf(PAIR))
        alone = torchdq.Robot.from_urdf(found.to_urdf())
    assert torch.allclose(alone.mass, file.mass, rtol=1e-12) and torch.allclose(alone.damping, file.damping)
    rigid = torchdq.inverse_dynamics(found.robot, q, qd, qdd)
    whole, signs = found.predict(q, qd, qdd).tau - rigid, sign(qd)
    for j in range(2):
        nearest, _ = nnls(torch.stack([qd[:, j], signs[:, j]], 1).numpy(), whole[:, j].numpy())
        written = [float(file.damping[j]), float(file.friction[j])]
        assert np.allclose(written, nearest, rtol=1e-3)  # loads are of the round before
    measured = evaluate(DESCRIBED, found, motion, found.with_simple_friction())
    by_file = torchdq.inverse_dynamics(file, q, qd, qdd) + file.damping * qd + file.friction * signs
    assert torch.allclose(measured.file, (tau - by_file).square().mean(0).sqrt() / tau.std(0))
    # what the file had before: the viscous and Coulomb friction beside the other
    before = torchdq.inverse_dynamics(found.robot, q, qd, qdd) + found.viscous * qd + found.coulomb * signs
    assert bool((measured.file < 0.7 * (tau - before).square().mean(0).sqrt() / tau.std(0)).all())
    assert bool((measured.found < 0.05).all()) and bool((measured.file > 2 * measured.found).all())
    assert " by the file is " in measured.summary and "The identified model: Good, " in measured.summary
    still = evaluate(DESCRIBED, found, motion._replace(tau=motion.tau * [1.0, 0.0]))  # no effort at one joint
    assert bool(still.found.isfinite().all()) and bool(still.described.isfinite().all())


def test_the_forecast_is_the_error_in_motions_like_those_that_were_learned_from():
    robot, several = torchdq.robots.load("two_link"), [[x[0] for x in states(1, 600, seed=k)] for k in (1, 2)]
    heavier = robot.replace(mass=1.2 * robot.mass)

    def moved(rows, real):
        tau = torchdq.inverse_dynamics(real, *rows)
        return motion_of(*rows, tau + 0.05 * tau.std(0) * random(600, 2))

    found = identify(robot, moved(several[0], heavier), Model(friction=None, offset=False))
    like = evaluate(robot, found, moved(several[1], heavier))
    assert torch.allclose(like.forecast, like.found, rtol=0.15) and like.table()[0][2] == "forecast"
    assert like.table()[1][0][2] == f"{float(like.forecast[0]):.3f}" and "The forecast was" not in like.summary
    loaded = evaluate(robot, found, moved(several[1], heavier.with_payload(3.0)))
    assert torch.equal(loaded.forecast, like.forecast) and "The forecast was 5." in loaded.summary


def test_plain_friction_is_written_as_it_was_found():
    tau = torchdq.inverse_dynamics(DESCRIBED, *MOVED) + 0.5 * MOVED[1]
    found = fitted(DESCRIBED, *MOVED, tau)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        file = torchdq.Robot.from_urdf(found.to_urdf(PAIR))
    assert torch.equal(file.damping, found.viscous) and torch.equal(file.friction, found.coulomb)
    # a robot without friction keeps that of its description
    none = fitted(DESCRIBED, *MOVED, tau, friction=None)
    assert torch.equal(none.simple, torch.stack([none.robot.damping, none.robot.friction]))


def test_the_friction_at_named_speeds_is_right_where_its_parts_are_not():
    """Of a shape between those that are tried, so that several of them share it."""

    def real(qd):
        return 0.6 * qd / (qd * qd + 0.2**2).sqrt() + 0.1 * qd

    q, qd, qdd = states(2, 2000)
    tau = torchdq.inverse_dynamics(DESCRIBED, q, qd, qdd) + real(qd)
    found = identify(DESCRIBED, Samples(q, qd, qdd, tau + 0.005 * random(*tau.shape)))
    rows = found.friction_rows()
    assert [row[0] for row in rows] == ["one", "two"] and found.coulomb.max() < 0.3
    stated = double(*[[float(x) for x in row[2:4]] for row in rows])
    speeds = torch.stack([torch.full((2,), 0.1), qd.abs().amax((0, 1))], 1)
    torch.testing.assert_close(stated, real(speeds.double()), rtol=0.05, atol=0)
    assert [float(row[4]) for row in rows] == pytest.approx(speeds[:, 1].tolist(), rel=5e-3)
    assert table(FRICTION, rows) in str(found)


def test_base_parameters_are_tabled_with_all_their_terms():
    q, qd, qdd = states(2, 200)
    found = fitted(DESCRIBED, q, qd, qdd, torchdq.inverse_dynamics(DESCRIBED, q, qd, qdd), friction=None)
    for row, (name, value, error, unit) in zip(found.base, found.base_rows(), strict=True):
        assert len(name.split(" + ")) + name.count(" - ") == int((row != 0).sum())
        assert value == pytest.approx(float(row @ found.parameters)) and error > 0
        assert unit == found.units[found.names.index(" ".join(name.split()[:2]))] and f"{value:.4g}" in found.base_table


def test_no_friction_of_a_file_is_negative():
    X, y = random(40, 30, 2, seed=1), random(40, 30, seed=2)
    X[0], X[1, :, 0], X[2, :, 1] = 0.0, 0.0, X[2, :, 0]  # joints at rest, and columns that are the same
    found = _nonnegative(X.mT @ X, (X.mT @ y[..., None])[..., 0])
    assert bool((found >= 0).all())
    for x, t, near in zip(X, y, found, strict=True):
        _, left = nnls(x.numpy(), t.numpy())
        assert float((t - x @ near).norm()) == pytest.approx(left, rel=1e-9)


def test_a_verdict_is_not_good_where_one_joint_of_the_file_is_far_off():
    def of(*file, found=0.02):
        errors = torch.tensor(file) if file else None
        return Evaluation(tuple("abcde"), 5.0, torch.full((5,), 0.9), torch.full((5,), found), torch.ones(5), errors)

    assert of().verdict is Verdict.GOOD and "by the file" not in of().summary
    assert of(0.02, 0.02, 0.02, 0.02, 0.02).verdict is Verdict.GOOD
    one = of(0.02, 0.02, 0.02, 0.02, FAIR + 0.1)
    assert one.verdict is Verdict.FAIR and "Worst is e with 40.0%, 2.0% with all that was found." in one.summary
    assert of(*[0.9] * 5).verdict is Verdict.KEEP_DESCRIPTION and of(found=0.5).verdict is Verdict.POOR
    far = (Finding("mass.far", "link2", value=0.26), Finding("mass.far", "link3", value=5.0))
    assert "far from those described, link2 (0.26 times), link3 (5 times):" in of()._replace(far=far).summary
    for kind, some in ((Verdict.GOOD, of()), (Verdict.KEEP_DESCRIPTION, of(*[0.9] * 5))):
        assert some.summary.startswith(f"{kind.value}: in 5.0 s") and str(some).endswith(some.summary)


def test_a_layer_a_scene_and_a_file_have_all_that_was_found():
    real = DESCRIBED.replace(mass=DESCRIBED.mass * double(1.2, 0.85))
    q, qd, qdd = states(4, 600)
    load = torchdq.inverse_dynamics(real, q, qd, qdd)
    tau = torques(real, q, qd, qdd, size=0.01) + 0.1 * load.abs() * sign(qd) + double(0.4, -0.3)
    found = identify(DESCRIBED, Samples(q, qd, qdd, tau), Model(offset=True))
    assert found.coefficients("load") is not None
    expected = found.predict(q, qd, qdd).tau
    assert torch.allclose(found.layer()(q, qd, qdd), expected, rtol=1e-9, atol=1e-9)
    assert torch.allclose(found.layer(learn=("mass",)).mass, found.robot.mass)
    kinds = [type(effect) for effect in found.effects()]
    assert kinds[0] is effects.Gravity and effects.LoadDependent in kinds and effects.Viscous in kinds
    scene = Scene(found.robot, found.effects(), dt=1e-4)
    state = scene.start(q[0, ::50], qd[0, ::50])
    after = scene.step(state, expected[0, ::50] - found.offset)
    assert torch.allclose((after.qd - state.qd) / 1e-4, qdd[0, ::50], atol=0.05 * float(qdd.std()))
    with warned(UserWarning):
        text = found.to_urdf(PAIR)
    again = torchdq.Robot.from_urdf(text)
    assert torch.allclose(again.mass, found.robot.mass)


def test_an_identified_robot_can_be_pickled():
    q, qd, qdd = states(3, 100)
    found = identify(DESCRIBED, Samples(q, qd, qdd, torques(DESCRIBED, q, qd, qdd)))
    again = pickle.loads(pickle.dumps(found))
    assert torch.equal(again.predict(q, qd, qdd).high, found.predict(q, qd, qdd).high)
