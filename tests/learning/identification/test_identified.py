"""Files of identified robots: the friction in them stands for all that was found, and the verdict is about the file."""

import warnings

import numpy as np
import pytest
import torch
from helpers import PAIR
from scipy.optimize import nnls

import torchdq
from torchdq import effects
from torchdq.learning import Motion, identify
from torchdq.learning.evaluate import FAIR, TorqueTrial, trial, with_file
from torchdq.learning.identification.simple import _nonnegative

WIDTH, STEP = 1e-2, 0.02


def states(rows=600):
    """Positions, velocities and accelerations [rows, 2]."""
    t = STEP * torch.arange(rows, dtype=torch.float64)[:, None, None]
    w = torch.tensor([[1.3, 2.9], [1.9, 0.7]], dtype=torch.float64)
    a, p = torch.tensor([[0.9, 0.4], [0.6, 0.8]]).double(), torch.tensor([[0.0, 1.0], [2.0, 0.5]]).double()
    angle = w * t + p
    return (a * angle.sin()).sum(-1), (a * w * angle.cos()).sum(-1), -(a * w * w * angle.sin()).sum(-1)


def loaded(share):
    """Motion of a pair of links whose friction is in proportion to the load, and what was identified from it."""
    described = torchdq.Robot.from_urdf(PAIR)
    q, qd, qdd = states()
    load = torchdq.inverse_dynamics(described, q, qd, qdd)
    tau = load + share * load.abs() * qd / torch.hypot(qd, torch.tensor(WIDTH).double())
    tau = tau + 0.01 * tau.std(0) * torch.randn(tau.shape, generator=torch.Generator().manual_seed(0)).double()
    friction = (effects.Viscous(), effects.Coulomb(sign_width=WIDTH), effects.LoadDependent(sign_width=WIDTH))
    found = identify(described, q, qd, qdd, tau, friction=friction, prior=1.0, width=WIDTH)
    signals = (x.numpy() for x in (q, qd, qdd, tau))
    return described, found, Motion(STEP * np.arange(len(q)), *signals), (q, qd, qdd, tau)


def test_the_friction_of_a_file_comes_nearest_to_all_friction_found():
    described, found, motion, (q, qd, qdd, tau) = loaded(0.4)
    assert float(found.coefficients("load").min()) > 0.3
    with pytest.warns(UserWarning, match="viscous and Coulomb friction alone; they stand for .*: load"):
        file = torchdq.Robot.from_urdf(found.to_urdf(PAIR))
    rigid = torchdq.inverse_dynamics(found.robot, q, qd, qdd)
    whole, sign = found.predict(q, qd, qdd).tau - rigid, qd / torch.hypot(qd, torch.tensor(WIDTH).double())
    for j in range(2):
        nearest, _ = nnls(torch.stack([qd[:, j], sign[:, j]], 1).numpy(), whole[:, j].numpy())
        assert np.allclose(
            [float(file.damping[j]), float(file.friction[j])], nearest, rtol=1e-3
        )  # loads are of the round before
    measured = with_file(trial(described, found, [motion]), found.with_simple_friction(), found, [motion])
    by_file = torchdq.inverse_dynamics(file, q, qd, qdd) + file.damping * qd + file.friction * sign
    assert torch.allclose(measured.file, (tau - by_file).square().mean(0).sqrt() / tau.std(0))
    # what the file had before: the viscous and Coulomb friction beside the other
    before = torchdq.inverse_dynamics(found.robot, q, qd, qdd) + found.viscous * qd + found.coulomb * sign
    assert bool((measured.file < 0.7 * (tau - before).square().mean(0).sqrt() / tau.std(0)).all())
    assert bool((measured.found < 0.05).all()) and bool((measured.file > 2 * measured.found).all())
    assert " by the file is " in measured.verdict and "with all that was found" in measured.verdict


def test_plain_friction_is_written_as_it_was_found():
    described = torchdq.Robot.from_urdf(PAIR)
    q, qd, qdd = states()
    tau = torchdq.inverse_dynamics(described, q, qd, qdd) + 0.5 * qd
    found = identify(described, q, qd, qdd, tau, friction=True, prior=1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        file = torchdq.Robot.from_urdf(found.to_urdf(PAIR))
    assert torch.equal(file.damping, found.viscous) and torch.equal(file.friction, found.coulomb)
    # a robot without friction keeps that of its description
    none = identify(described, q, qd, qdd, tau, friction=False, prior=1.0)
    assert torch.equal(none.simple, torch.stack([none.robot.damping, none.robot.friction]))


def test_no_friction_of_a_file_is_negative():
    g = torch.Generator().manual_seed(1)
    X = torch.randn(40, 30, 2, generator=g, dtype=torch.float64)
    y = torch.randn(40, 30, generator=g, dtype=torch.float64)
    X[0], X[1, :, 0], X[2, :, 1] = 0.0, 0.0, X[2, :, 0]  # joints at rest, and columns that are the same
    found = _nonnegative(X.mT @ X, (X.mT @ y[..., None])[..., 0])
    assert bool((found >= 0).all())
    for x, t, near in zip(X, y, found, strict=True):
        _, left = nnls(x.numpy(), t.numpy())
        assert float((t - x @ near).norm()) == pytest.approx(left, rel=1e-9)


def test_a_verdict_is_not_good_where_one_joint_of_the_file_is_far_off():
    def of(*file):
        size = torch.full((5,), 0.02)
        errors = torch.tensor(file) if file else None
        return TorqueTrial(tuple("abcde"), 5.0, torch.full((5,), 0.9), size, torch.ones(5), errors).verdict

    assert of().startswith("Good: ") and "by the file" not in of()
    assert of(0.02, 0.02, 0.02, 0.02, 0.02).startswith("Good: ")
    one = of(0.02, 0.02, 0.02, 0.02, FAIR + 0.1)
    assert one.startswith("Fair: ") and "Worst is e with 40.0%, 2.0% with all that was found." in one
    assert of(0.9, 0.9, 0.9, 0.9, 0.9).startswith("Keep the description: ")
