"""A network beside an identified robot whose friction remembers: never worse than the robot alone, in scenes too."""

import copy

import numpy as np
import pytest
import torch
from helpers import EVERYTHING, thinned
from recorded_logs import ROBOT as TWO
from recorded_logs import motion_of, waves
from recordings import predicted, residual_samples

import torchdq
from torchdq import Scene, effects
from torchdq.learning import Model, Samples, evaluate, fit, identify, plot_torques

pytestmark = pytest.mark.filterwarnings("ignore::torchdq.learning.LogWarning")  # of friction that no term has
F64, BACKEND = torch.float64, "auto"  # one arm, whose programs all tests share
BRISTLES = 0.05
REMEMBERS = (effects.Viscous(), effects.LuGre(deflection=BRISTLES))
STEPS, OPTIONS = 150, {"batch": 128, "rate": 1e-2, "decay": 1e-2}


def bent(q):
    """Deflection of bristles, row by row: towards the direction of motion, along the way."""
    z, found = torch.zeros(q.shape[1], dtype=F64), []
    for step in torch.diff(q, dim=0, prepend=q[:1]):
        z = step.sign() + (z - step.sign()) * (-step.abs() / BRISTLES).exp()
        found.append(z)
    return torch.stack(found)


def motion(seed, rest, seconds=15.0):
    """Positions, velocities, accelerations and torques of sines that turn round often, with bristles and noise."""
    (q, qd, qdd), g = waves(seed, 0.1, torch.arange(1, 5), 1.0, seconds)
    noise = 0.1 * torch.randn(q.shape, generator=g, dtype=F64)
    return Samples(
        q, qd, qdd, torchdq.inverse_dynamics(TWO, q, qd, qdd) + 0.5 * qd + 2.0 * bent(q) + rest(q, qd) + noise
    )


def stribeck(q, qd):
    """Friction that is higher at low speeds, which no term here has."""
    return 1.5 * torch.exp(-((qd / 0.5) ** 2)) * torch.tanh(qd / 0.05)


def nothing(q, qd):
    return 0 * qd


def trained(found, train, inputs="joint"):
    """A network around the layer of a robot that was found, trained on what its predictions leave."""
    torch.manual_seed(0)
    network = torchdq.ResidualDynamics(found.layer(), inputs=inputs, hidden=(16,))
    fit(network, [residual_samples(found, network, motion_of(*part)) for part in train], steps=STEPS, **OPTIONS)
    return network


@pytest.fixture(scope="module")
def bumpy():
    """An identified robot, a network for what it leaves, and the motions both were made from."""
    parts = [motion(k, stribeck) for k in range(3)]
    found = identify(TWO, Samples(*map(torch.stack, zip(*parts, strict=True))), Model(REMEMBERS), prior=1.0)
    return found, trained(found, parts), parts


def error(found, test, network=None):
    """Root mean square of what predictions of a motion are off by, at each joint."""
    motion = motion_of(*test)
    known = found.predict(motion) if network is None else predicted(found, network, motion)
    return (known.tau - test.tau).square().mean(0).sqrt()


def test_the_network_adds_to_friction_that_remembers(bumpy):
    found, network, parts = bumpy
    test = motion(99, stribeck)
    both = error(found, test, network)
    assert (network.weight > 0.8).all()
    assert (both < 0.4 * error(found, test)).all()
    if not EVERYTHING:
        return
    # a network around the layer alone has to guess what was before
    model = torchdq.ResidualDynamics(found.layer(), hidden=(16,))
    fit(model, parts, steps=STEPS, **OPTIONS)
    assert ((model(*test[:3]) - test.tau).detach().square().mean(0).sqrt() > 1.7 * both).all()


def cable(q, qd):
    """Torques of a cable along the arm: nonlinear, and of both joints together, so that no friction has their shape."""
    return 2.0 * torch.stack([(q[:, 0] + q[:, 1]).sin(), (2 * q[:, 0] - q[:, 1]).cos()], 1)


@pytest.mark.parametrize(("rest", "most"), thinned([(cable, 0.5), (nothing, 1.01)], [(cable, 0.5)]))
def test_unseen_motions_gain_by_what_no_friction_explains_and_never_lose(rest, most):
    """Beside the model that `identify` chose: half the error at least where there is a cable, a percent at most where
    its friction says all."""
    parts = [plain_motion(k, rest) for k in range(4)]
    found = identify(TWO, parts, Model((effects.Viscous(), effects.Coulomb()), offset=False))
    network = trained(found, parts, "all")
    for seed, (speed, bar) in enumerate(((0.5, most), (1.0, most), (2.0, min(1.01, 1.5 * most))), start=90):
        test = plain_motion(seed, rest, speed)
        assert (error(found, test, network) < bar * error(found, test)).all(), speed


def plain_motion(seed, rest, speed=1.0):
    """A motion of an arm with viscous and Coulomb friction, further torques, and noise."""
    (q, qd, qdd), g = waves(seed, 0.3, speed * torch.arange(6) / 2, 0.4 * speed, 15.0)
    noise = 0.1 * torch.randn(q.shape, generator=g, dtype=F64)
    friction = 0.5 * qd + 0.8 * qd / (qd**2 + 1e-4).sqrt()
    return Samples(q, qd, qdd, torchdq.inverse_dynamics(TWO, q, qd, qdd) + friction + rest(q, qd) + noise)


def test_intervals_hold_their_share(bumpy):
    inside = []
    for seed in range(50, 56):
        test = motion(seed, stribeck)
        told = predicted(*bumpy[:2], motion_of(*test))
        inside.append(((told.low <= test.tau) & (test.tau <= told.high)).double().mean())
    assert 0.92 < float(torch.stack(inside).mean()) < 0.98


def test_errors_and_intervals_are_those_identified_narrowed_where_the_network_was_trained(bumpy):
    found, network, parts = copy.deepcopy(bumpy)
    network.weight[1], network.remaining[1] = 0, 1
    part = motion_of(*parts[0])
    told, alone = predicted(found, network, part), found.predict(part)
    assert torch.equal(told.tau[:, 1], alone.tau[:, 1]) and (told.tau != alone.tau)[:, 0].any()
    assert torch.allclose(told.low[:, 1], alone.low[:, 1]) and torch.allclose(told.high[:, 1], alone.high[:, 1])
    factor = network.remaining
    assert 0.1 < float(factor[0]) < 0.6
    assert torch.allclose(told.error, factor * alone.error)
    assert torch.allclose(told.high - told.low, factor * (alone.high - alone.low))
    far = part._replace(qd=100 * np.sign(part.qd))
    told, alone = predicted(found, network, far), found.predict(far)
    assert torch.equal(told.tau, alone.tau) and torch.allclose(told.high, alone.high)


def test_trials_and_pictures_predict_motion_by_motion(bumpy):
    """Friction that remembers begins anew with each motion, whatever the one before ended with."""
    pytest.importorskip("matplotlib")
    found, tests = bumpy[0], [motion(k, stribeck) for k in (31, 32)]
    several, tau = [motion_of(*test) for test in tests], torch.cat([test.tau for test in tests])
    apart = torch.cat([found.predict(*test[:3]).tau for test in tests])
    on = found.predict(*(torch.cat(x) for x in list(zip(*tests, strict=True))[:3])).tau
    assert float((apart - on).abs().max()) > 0.1
    left = (tau - apart).square().mean(0).sqrt() / tau.std(0)
    assert torch.allclose(evaluate(TWO, found, several).found, left, rtol=1e-12)
    for j, axes in enumerate(plot_torques(found, several).axes):
        drawn = torch.as_tensor(axes.lines[1].get_ydata())
        assert torch.equal(drawn[drawn.isfinite()], apart[:, j])


def test_a_scene_moves_as_it_predicts(bumpy):
    """Torques that were applied are those predicted of the motion that followed, to first order in the step."""
    (found, network, _), dt = bumpy, 2e-3
    scene = Scene(found.robot, (*found.effects(), effects.Residual(network)), dt=dt)
    t = dt * torch.arange(200, dtype=F64)[:, None]
    held = torchdq.inverse_dynamics(found.robot, torch.zeros(2, dtype=F64))
    torque = held + torch.cat([12 * (12 * t).sin(), 6 * (15 * t).cos()], 1)
    states = scene.rollout(scene.start(torch.zeros(2, dtype=F64)), torque)
    q, qd = states.q.detach(), states.qd.detach()
    qdd = torch.diff(qd, dim=0) / dt
    told = predicted(found, network, motion_of(q[1:], qd[1:], qdd, torque[1:]))
    assert (qd.amax(0) > 0.2).all() and (qd.amin(0) < -0.2).all()  # both joints turn round
    off = (told.tau - torque[1:]).square().mean(0).sqrt()
    with torch.no_grad():
        steady = network(q[1:], qd[1:], qdd)
    assert (off < 0.3).all() and (off < 0.3 * (steady - torque[1:]).square().mean(0).sqrt()).all()
