"""Static poses: gravity and springs without friction, from a log that comes to each pose from both sides."""

import itertools

import numpy as np
import pytest
import torch
from messages import refused

import torchdq
from torchdq.learning import LogError, Model, Samples, identify, identify_payload, read_log

ARM = torchdq.robots.load("ur10e")
REAL = ARM.replace(mass=1.1 * ARM.mass)
DRY = torch.tensor([8.0, 10.0, 6.0, 3.0, 2.0, 2.0], dtype=torch.float64)


def slow(arm, rest):
    """Log without noise that rests at 20 poses between quintic motions, with friction of the motion before."""
    g, side, dt = np.random.default_rng(0), -1.0, 0.01
    poses = g.uniform(-2, 2, (20, 1, 6)) + np.array([[-0.1], [0.0], [0.1], [0.0]])
    rows, hold, last = [], np.ones((round(rest / dt), 1)), poses[0, 0] + 0.1
    for stop in poses.reshape(-1, 6):
        t = np.arange(0, 1, dt / max(0.4, abs(stop - last).max() / 0.5))[:, None]
        side = np.where(stop == last, side, np.sign(stop - last))
        way, rate = t**3 * (10 - 15 * t + 6 * t**2), 30 * t**2 * (1 - t) ** 2
        rows += [(last + way * (stop - last), np.where(rate > 0, side, rows[-1][1][-1] if rows else side))]
        rows += [(stop * hold, side * hold)]
        last = stop
    q, side = (np.concatenate(x) for x in zip(*rows, strict=True))
    tau = torchdq.inverse_dynamics(arm, *(torch.from_numpy(x) for x in (q, 0 * q, 0 * q))).numpy() + DRY.numpy() * side
    return read_log({"time": dt * np.arange(len(q)), "q": q, "qd": None, "tau": tau})


def log(arm, seed=0, sides=(1, -1), speed=True):
    """Log that rests at 25 poses, each after a step from these sides, with friction that differs from row to row."""
    g = np.random.default_rng(seed)
    lower, upper = (0.8 * x.numpy().clip(-2, 2) for x in ARM.limits[:2])
    poses = [g.uniform(lower, upper) for _ in range(25)]
    stops = [stop for pose in poses for side in sides for stop in (pose - 0.1 * side, pose)]
    w, hold = np.linspace(0, 1, 100)[:, None], np.ones((150, 1))
    w, rate = w * w * (3 - 2 * w), 6 * w * (1 - w)
    moves = list(itertools.pairwise(stops))
    q = np.concatenate([x for a, b in moves for x in (a * hold, a + (b - a) * w)] + [stops[-1] * hold])
    qd = np.concatenate([x for a, b in moves for x in (0 * a * hold, (b - a) * rate)] + [0 * stops[-1] * hold])
    came = np.concatenate([np.sign(np.array([b - a for a, b in moves]))[[0]], np.sign([b - a for a, b in moves])])
    side = np.repeat(came, 250, axis=0)[: len(q)]
    state = [torch.from_numpy(x) for x in (q, 0 * q, 0 * q)]
    tau = torchdq.inverse_dynamics(arm, *state).numpy() + DRY.numpy() * side * g.uniform(0.9, 1.0, size=q.shape)
    tau += 0.05 * g.normal(size=q.shape)
    return read_log({"time": 0.01 * np.arange(len(q)), "q": q, "qd": qd if speed else None, "tau": tau})


@pytest.mark.parametrize("speed", [True, False])
def test_friction_cancels_in_poses_approached_from_both_sides(speed):
    poses = log(REAL, speed=speed).static_poses()
    assert len(poses.q) == 25
    gravity = torchdq.inverse_dynamics(REAL, *poses.samples[:3])
    assert float((poses.tau - gravity).abs().max()) < 0.05
    assert torch.allclose(poses.friction, 0.95 * DRY.expand_as(poses.friction), rtol=0.03)


@pytest.mark.parametrize("rest", [1.1, 4.0])
def test_the_slow_begin_of_the_next_motion_is_no_rest(rest):
    poses = slow(REAL, rest).static_poses()
    gravity = torchdq.inverse_dynamics(REAL, *poses.samples[:3])
    assert len(poses.q) == 20
    assert float((poses.tau - gravity).abs().max()) < 1e-12 * float(gravity.abs().max())
    assert torch.allclose(poses.friction, DRY.expand_as(poses.friction), rtol=1e-11)


def test_rests_that_are_too_short_are_said_to_be():
    with refused(LogError):
        slow(REAL, 0.8).static_poses()
    assert len(slow(REAL, 0.8).static_poses(seconds=0.7).q) == 20


def test_a_tool_is_weighed_at_rest():
    model = Model(friction=None, armature=False)
    empty = identify(ARM, log(REAL).static_poses().samples, model, prior=1.0)
    held = log(REAL.with_payload(2.0, (0.0, 0.02, 0.1)), seed=1).static_poses().samples
    assert isinstance(held, Samples) and not empty.findings
    found = identify_payload(empty, *held)
    assert float(found.mass) == pytest.approx(2.0, abs=0.01)
    assert torch.allclose(found.com, torch.tensor([0.0, 0.02, 0.1], dtype=torch.float64), atol=2e-3)


def test_poses_approached_from_one_side_are_refused():
    with refused(LogError):
        log(REAL, sides=(1, 1)).static_poses()
    with refused(LogError):
        log(REAL)._replace(tau=None).static_poses()
