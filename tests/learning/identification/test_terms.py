"""Friction found from filtered logs is that of the robot, within the stated errors, at any rate of the log."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("scipy", reason="smoothing needs scipy")

import torchdq
from torchdq.errors import ArgumentError
from torchdq.learning import Layout, Log, LogWarning, cut, directions, identify, samples, smooth


def fitted(robot, *signals, **options):
    """Robot identified without a choice of models."""
    return identify(robot, *signals, friction=True, prior=1.0, **options)


def log_of(robot, rate, seed, width=1e-3):
    """Log of a robot with masses off by 30 % and dry friction, noisy; and its viscous and Coulomb friction."""
    g = torch.Generator().manual_seed(seed)
    n, t = robot.n, torch.arange(0, 40, 1 / rate, dtype=torch.float64)[:, None, None]

    def uniform(*shape):
        return torch.rand(shape, generator=g, dtype=torch.float64)

    def noise(x):
        return torch.randn(x.shape, generator=g, dtype=torch.float64)

    w = 2 * math.pi * 0.1 * torch.arange(1, 6).double()
    size, phase = (0.2 + 0.5 * uniform(n, 5)) / w.sqrt(), w * t + 6.3 * uniform(n, 5)
    q, qd, qdd = (size * phase.sin()).sum(-1), (size * w * phase.cos()).sum(-1), -(size * w**2 * phase.sin()).sum(-1)
    factor = 0.7 + 0.6 * uniform(n)
    real = robot.replace(mass=factor * robot.mass, inertia=factor[:, None] * robot.inertia)
    tau = torchdq.inverse_dynamics(real, q, qd, qdd)
    coulomb = 0.3 * tau.std(0).clamp_min(0.02 * tau.std(0).max())
    viscous = 0.3 * coulomb
    tau = tau + viscous * qd + coulomb * qd / (qd**2 + width**2).sqrt()
    signals = (q + 1e-5 * noise(q), qd + 1e-3 * noise(q), tau + 0.05 * tau.std(0) * noise(q))
    return Log(Path("log"), Layout(), t[:, 0, 0].numpy(), *(x.numpy() for x in signals), 0), viscous, coulomb


@pytest.mark.parametrize("rate", [100, 500, 1000])
@pytest.mark.parametrize("name", ["two_link", "ur10e", "panda"])
def test_friction_is_found_within_the_stated_errors(name, rate):
    robot = torchdq.robots.load(name)
    log, viscous, coulomb = log_of(robot, rate, seed=rate)
    motion = smooth(log, rate=16)
    found = fitted(robot, *samples(motion), direction=directions(motion))
    for k, truth in ((-2, viscous), (-1, coulomb)):
        part = slice(k * robot.n, (k + 1) * robot.n or None)
        off = (found.parameters[part] - truth) / found.errors[part]
        assert float(off.abs().max()) < 3
    assert float((found.coulomb / coulomb - 1).abs().max()) < 0.03
    sharp = fitted(robot, *samples(motion))
    assert float((sharp.coulomb / coulomb).mean()) < 0.98  # what the rounded steps cost otherwise


def errors(found, robot, *truths):
    """Distances of viscous and Coulomb friction from the true ones, in standard errors, [2, n]."""
    n = robot.n
    return ((found.parameters - torch.cat([found.parameters[: -2 * n], *truths])) / found.errors)[-2 * n :].reshape(
        2, n
    )


@pytest.mark.parametrize("width", [0.03, 0.1])
def test_friction_of_another_shape_is_told_and_its_width_is_the_cure(width):
    """Friction as simulated, which is viscous below a width, beside that of a sharp step, and the other way round."""
    robot = torchdq.robots.load("two_link")
    log, *truths = log_of(robot, 100, 3, width)
    sharp, motion = smooth(log, rate=16), smooth(log, rate=16, width=width)
    with pytest.warns(LogWarning, match=r"dry friction of joint. .* another shape .* give smooth\(log\) its width"):
        biased = fitted(robot, *samples(sharp), direction=directions(sharp))
    assert errors(biased, robot, *truths).abs().max() > 3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = fitted(robot, *samples(motion), direction=directions(motion), width=width)
    assert errors(found, robot, *truths).abs().max() < 3


def test_dry_friction_of_filtered_torques_is_told_without_directions():
    robot = torchdq.robots.load("two_link")
    data = samples(smooth(log_of(robot, 100, 3)[0], rate=16))
    with pytest.warns(LogWarning, match=r"dry friction of joint1 .* give direction=directions\(motion\)"):
        fitted(robot, *data)


@pytest.mark.parametrize("name", ["two_link", "ur10e", "panda"])
def test_dry_friction_of_the_right_shape_is_not_doubted(name):
    robot = torchdq.robots.load(name)
    motion = smooth(log_of(robot, 100, 5)[0], rate=16)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fitted(robot, *samples(motion), direction=directions(motion))


def test_directions_are_those_of_the_rows():
    log, *_ = log_of(torchdq.robots.load("two_link"), 100, seed=0)
    motion = smooth(log)
    found = directions([motion, motion])
    assert found.shape == (2 * len(motion.time), 2) and found.dtype == torch.float64
    fast = abs(motion.qd) > 0.5
    assert np.abs(motion.direction - np.sign(motion.qd))[fast].max() < 0.2
    assert float(found.abs().min()) < 0.1  # rounded, where a sharp sign would hardly ever be
    parts = cut(motion, 0.5)
    assert [len(part.direction) for part in parts] == [len(part.time) for part in parts]
    few = smooth(log, rate=20)
    assert np.allclose(np.diff(few.time), 0.05) and len(few.direction) == len(few.time)
    with pytest.raises(ArgumentError, match="motions must have the field direction"):
        directions(motion._replace(direction=None))
    with pytest.raises(ArgumentError, match="rate must be a positive number, found 0"):
        smooth(log, rate=0)
