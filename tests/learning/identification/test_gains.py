"""Gains of drives are found within their errors, and their errors are part of those of all parameters."""

import numpy as np
import pytest
import torch
from helpers import PAIR, thinned
from recorded_logs import COULOMB, ROBOT, VISCOUS, dry, fitted, motion_of, noise, sign, states, with_findings

import torchdq
from torchdq.learning import Layout, Model, identify, posterior_samples, read_log, smooth
from torchdq.learning.evaluation.blocks import of_motions
from torchdq.robot.pseudo_inertia import BASIS, bodies_of, pseudo_inertia


def motions_of(*signals, **options):
    """Motions of signals [motions, rows, n]: positions, velocities, accelerations and efforts."""
    return [motion_of(*one, **options) for one in zip(*signals, strict=True)]


def rubbed(robot, q, qd, qdd):
    """Torques with friction of a tenth of those of the bodies, and with noise."""
    clean = torchdq.inverse_dynamics(robot, q, qd, qdd)
    clean = clean + (0.1 * clean.std((0, 1))).clamp_min(0.2) * (qd + sign(qd))
    return clean, clean + 0.02 * clean.std((0, 1)) * noise(q.shape, 0.5, seed=1)


@pytest.mark.parametrize("known", thinned([True, False], [False]))
def test_gains_of_drives_are_found_within_their_errors(known):
    """Efforts by gains that are off by tens of percent, or in other units; the description has the right masses."""
    robot = torchdq.robots.load("ur10e")
    q, qd, qdd = states(4, 300, joints=6)
    clean, tau = rubbed(robot, q, qd, qdd)
    tau = tau + 0.01 * clean * noise(q.shape, 0.0)
    gains = 0.8 + 0.4 * torch.rand(6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    gains = gains if known else 10 * gains
    motions = motions_of(q, qd, qdd, tau / gains, sign(qd), known_gains=known)
    found = fitted(robot, motions, gains=True)
    assert found.gains is not None
    off = (found.gains.value / gains)[:5]  # the last joint's torque is nearly all friction, which any gain explains
    assert float((off / off.mean() - 1).abs().max()) < 0.03  # between joints that share a load
    assert float((off.mean() - 1).abs()) < 0.2  # all together: masses would have to be known
    assert float(((found.gains.value - gains) / found.gains.error).abs().max()) < 3
    assert found.gains.identifiable.tolist() == [True] * 5 + [False]
    assert "torque per unit of effort" in str(found) and "rests on the described masses" in str(found)
    predicted = found.predict(motions).tau.reshape(q.shape) / found.gains.value
    assert float(((predicted - clean / gains).std((0, 1)) / (clean / gains).std((0, 1))).max()) < 0.02


def test_negative_gains_are_found_and_named():
    q, qd, qdd = states(3, 300)
    gains = torch.tensor([8, -8.7], dtype=torch.float64)
    motions = motions_of(q, qd, qdd, rubbed(ROBOT, q, qd, qdd)[1] / gains, known_gains=False)
    found, findings = with_findings(fitted, ROBOT, motions, gains=True)
    assert float((found.gains.value / gains - 1).abs().max()) < 0.1
    assert [(x.code, x.subject) for x in findings] == [("gain.negative", "joint2")]


def test_a_given_gain_of_the_wrong_sign_is_found_and_named():
    q, qd, qdd = states(3, 300)
    tau = rubbed(ROBOT, q, qd, qdd)[1] * torch.tensor([1.0, -1.0])
    found, findings = with_findings(fitted, ROBOT, q, qd, qdd, tau, gains=True)
    assert abs(float(found.gains.value[1]) + 1) < 0.1 and float(found.gains.value[0]) > 0.9
    assert [(x.code, x.subject) for x in findings] == [("gain.negative", "joint2")]


def test_gains_are_found_beside_rotors_that_the_description_lacks():
    """Currents drive the rotors, too: without them, gains would be those of a part of the torque."""
    q, qd, qdd = states(3, 300)
    rotors = ROBOT.replace(armature=torch.ones(2).double())
    tau = rubbed(rotors, q, qd, qdd)[1]
    found = identify(ROBOT, motions_of(q, qd, qdd, tau / 5, known_gains=False), Model(gains=True))
    assert float((found.gains.value / 5 - 1).abs().max()) < 0.1
    assert float(((found.gains.value - 5) / found.gains.error).abs().max()) < 3


def real_arm(described, seed, size=0.1):
    """Arm whose bodies differ from those described as much as gains expect: by a common factor, and each by itself."""
    g = np.random.default_rng(seed)
    C = torch.linalg.cholesky(pseudo_inertia(described.inertial_parameters.reshape(-1, 10)))
    change = size * torch.einsum("li,ijk->ljk", torch.from_numpy(g.normal(size=(len(C), 10))), BASIS)
    J = (1 + size * g.normal()) * C @ (torch.eye(4).double() + change) @ C.mT
    mass, com, inertia = bodies_of(torch.linalg.cholesky(J))
    return described.replace(mass=mass, com=com, inertia=inertia)


@pytest.mark.parametrize("runs", thinned([3, 200], [3]))
@pytest.mark.parametrize("known", thinned([True, False, (True, False)], [(True, False)]))
def test_errors_hold_those_of_the_gains(known, runs):
    """Over arms, gains and noise: squares of what parameters are off by over the stated errors are about one."""
    far: dict[str, list[float]] = {}
    described = torchdq.Robot.from_urdf(PAIR)
    for seed in range(runs):
        g = np.random.default_rng(1000 + seed)
        real, (q, qd, qdd) = real_arm(described, seed), states(3, 200, seed=seed)
        clean = torchdq.inverse_dynamics(real, q, qd, qdd) + dry(qd)
        tau = clean + 0.02 * clean.std((0, 1)) * torch.from_numpy(g.normal(size=q.shape))
        gains = (1 + 0.3 * torch.from_numpy(g.normal(size=2)).clamp(-2, 2)) / torch.where(torch.tensor(known), 1.0, 10)
        found = fitted(described, motions_of(q, qd, qdd, tau / gains, known_gains=known), gains=True)
        alone = found.by_these_gains()
        off = found.parameters - torch.cat([real.inertial_parameters.flatten(), VISCOUS, COULOMB])
        predicted = found.predict(q, qd, qdd)
        parts = {
            "viscous": off[-4:-2] / found.errors[-4:-2],
            "coulomb": off[-2:] / found.errors[-2:],
            "base": found.base @ off / found.base_errors,
            "gains": (found.gains.value - gains) / found.gains.error,
            "without": off[-4:] / alone.errors[-4:],
            "torques": (predicted.tau - clean) / predicted.error,
        }
        for name, x in parts.items():
            far.setdefault(name, []).append(float(x.square().mean()))
        inside = (tau / gains * found.gains.value - predicted.tau).abs() < 2 * alone.noise
        far.setdefault("inside", []).append(float(inside.double().mean()))
        if not seed:
            drawn = posterior_samples(found, 100).coefficients("viscous").std(0)
            assert torch.allclose(drawn, found.errors[-4:-2], rtol=0.4)
    mean = {name: float(np.mean(x)) for name, x in far.items()}
    least, most = (0.8, 1.25) if runs > 100 else (0.3, 3.0)
    for name in ("viscous", "coulomb", "base", "gains", "torques"):
        assert least < mean[name] < most, mean
    assert mean["without"] > 10 and mean["inside"] > 0.9, mean


def test_some_gains_may_be_unknown():
    time = np.arange(0, 10, 0.01)
    x = np.stack([np.sin(time), np.cos(2 * time)], 1)
    signals = {"time": time, "q": x, "qd": x, "tau": np.ones_like(x)}
    log = read_log(signals, Layout(gain=(3, None)))
    motion = smooth(log)
    assert (log.tau == [3, 1]).all() and motion.known_gains == (True, False)
    assert of_motions(ROBOT, [motion, motion._replace(known_gains=True)]).known_gains == (True, False)
