"""A network beside an identified robot whose friction remembers: never worse than the robot alone, in scenes too."""

import copy

import pytest
import torch
from helpers import EVERYTHING, exhaustive, thinned
from messages import refused
from recorded_logs import ROBOT as TWO
from recorded_logs import motion_of, waves

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
    """The robot that was found with a network, trained on what both leave."""
    torch.manual_seed(0)
    network = torchdq.ResidualDynamics(found.layer(), inputs=inputs, hidden=(16,))
    fit(network, [found.residual_samples(*part) for part in train], steps=STEPS, **OPTIONS)
    return found.with_residual(network)


@pytest.fixture(scope="module")
def bumpy():
    """An identified robot, the same with a network, and the motions both were made from."""
    parts = [motion(k, stribeck) for k in range(3)]
    found = identify(TWO, Samples(*map(torch.stack, zip(*parts, strict=True))), Model(REMEMBERS), prior=1.0)
    return found, trained(found, parts), parts


def error(found, test):
    """Root mean square of what predictions of a motion are off by, at each joint."""
    return (found.predict(*test[:3]).tau - test.tau).square().mean(0).sqrt()


def test_the_network_adds_to_friction_that_remembers(bumpy):
    found, whole, parts = bumpy
    test = motion(99, stribeck)
    both = error(whole, test)
    assert (whole.network.weight > 0.8).all()
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
    whole = trained(found, parts, "all")
    for seed, (speed, bar) in enumerate(((0.5, most), (1.0, most), (2.0, min(1.01, 1.5 * most))), start=90):
        test = plain_motion(seed, rest, speed)
        assert (error(whole, test) < bar * error(found, test)).all(), speed


def plain_motion(seed, rest, speed=1.0):
    """A motion of an arm with viscous and Coulomb friction, further torques, and noise."""
    (q, qd, qdd), g = waves(seed, 0.3, speed * torch.arange(6) / 2, 0.4 * speed, 15.0)
    noise = 0.1 * torch.randn(q.shape, generator=g, dtype=F64)
    friction = 0.5 * qd + 0.8 * qd / (qd**2 + 1e-4).sqrt()
    return Samples(q, qd, qdd, torchdq.inverse_dynamics(TWO, q, qd, qdd) + friction + rest(q, qd) + noise)


def test_intervals_hold_their_share(bumpy):
    whole = bumpy[1]
    inside = []
    for seed in range(50, 56):
        test = motion(seed, stribeck)
        predicted = whole.predict(*test[:3])
        inside.append(((predicted.low <= test.tau) & (test.tau <= predicted.high)).double().mean())
    assert 0.92 < float(torch.stack(inside).mean()) < 0.98


def test_errors_and_intervals_are_those_identified_narrowed_where_the_network_was_trained(bumpy):
    found, whole, parts = copy.deepcopy(bumpy)
    whole.network.weight[1], whole.network.remaining[1] = 0, 1
    predicted, alone = whole.predict(*parts[0][:3]), found.predict(*parts[0][:3])
    assert torch.equal(predicted.tau[:, 1], alone.tau[:, 1]) and (predicted.tau != alone.tau)[:, 0].any()
    assert torch.equal(predicted.low[:, 1], alone.low[:, 1]) and torch.equal(predicted.high[:, 1], alone.high[:, 1])
    factor = whole.network.remaining
    assert 0.1 < float(factor[0]) < 0.6
    assert torch.allclose(predicted.error, factor * alone.error)
    assert torch.allclose(predicted.high - predicted.low, factor * (alone.high - alone.low))
    q, qd, qdd, _ = parts[0]
    wide, far = whole.predict(q, 100 * qd.sign(), qdd), found.predict(q, 100 * qd.sign(), qdd)
    assert torch.equal(wide.tau, far.tau) and torch.allclose(wide.high, far.high)


def test_samples_are_what_the_layer_explains_as_well_as_the_robot_that_remembers(bumpy):
    found, whole, parts = bumpy
    with torch.no_grad():
        steady = found.layer()(*parts[0][:3])
    left = whole.residual_samples(*parts[0])
    assert torch.equal(left.q, parts[0].q)
    assert torch.allclose(left.tau - steady, parts[0].tau - found.predict(*parts[0][:3]).tau, atol=1e-12)
    assert float((left.tau - parts[0].tau).abs().max()) > 1.0  # bristles that are bent back


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


def test_motions_and_tensors_are_alike_and_rows_of_motions_follow_each_other(bumpy):
    whole, parts = bumpy[1:]
    several = [motion_of(*part) for part in parts[:2]]
    found = whole.residual_samples(several)
    assert torch.equal(found.tau, torch.cat([whole.residual_samples(*part).tau for part in parts[:2]]))
    predicted = whole.predict(several)
    assert torch.equal(predicted.low, torch.cat([whole.predict(*part[:3]).low for part in parts[:2]]))
    stacked = whole.predict(*(torch.stack(x) for x in zip(*(part[:3] for part in parts[:2]), strict=True)))
    assert stacked.tau.shape == (2, len(parts[0].q), 2) and torch.equal(stacked.tau.reshape(-1, 2), predicted.tau)


def test_a_scene_moves_as_it_predicts(bumpy):
    """Torques that were applied are those predicted of the motion that followed, to first order in the step."""
    whole, dt = bumpy[1], 2e-3
    scene = Scene(whole.robot, whole.effects(), dt=dt)
    assert [type(effect).__name__ for effect in scene.effects].count("Residual") == 1
    t = dt * torch.arange(200, dtype=F64)[:, None]
    held = torchdq.inverse_dynamics(whole.robot, torch.zeros(2, dtype=F64))
    torque = held + torch.cat([12 * (12 * t).sin(), 6 * (15 * t).cos()], 1)
    states = scene.rollout(scene.start(torch.zeros(2, dtype=F64)), torque)
    q, qd = states.q.detach(), states.qd.detach()
    qdd = torch.diff(qd, dim=0) / dt
    predicted = whole.predict(q[1:], qd[1:], qdd)
    assert (qd.amax(0) > 0.2).all() and (qd.amin(0) < -0.2).all()  # both joints turn round
    off = (predicted.tau - torque[1:]).square().mean(0).sqrt()
    with torch.no_grad():
        steady = whole.network(q[1:], qd[1:], qdd)
    assert (off < 0.3).all() and (off < 0.3 * (steady - torque[1:]).square().mean(0).sqrt()).all()


@exhaustive
def test_gains_that_were_identified_scale_the_torques():
    parts = [motion(k, nothing, 10.0) for k in range(3)]
    drives = torch.tensor([4.0, 0.5], dtype=F64)
    motions = [motion_of(*part[:3], part.tau / drives, known_gains=False) for part in parts]
    found = identify(TWO, motions, Model(REMEMBERS, gains=True), prior=1.0)
    steady = found.layer()(*parts[0][:3]).detach()
    ratio = found.residual_samples(motions[0]).tau + found.predict(motions[0]).tau - steady
    assert torch.allclose(ratio, torch.as_tensor(motions[0].tau) * found.gains.value)
    plain = identify(TWO, parts[0], Model((effects.Viscous(), effects.Coulomb())), prior=1.0)
    for measured in (motions[0], motion_of(*parts[0])._replace(tau=None)):
        with refused(torchdq.ArgumentError):
            plain.residual_samples(measured)


def test_what_it_does_not_take(bumpy):
    found, whole, parts = bumpy
    heavier = torchdq.ResidualDynamics(torchdq.DQRNEA(TWO.replace(mass=2 * TWO.mass)))
    for call in (
        lambda: found.with_residual(found.layer()),
        lambda: found.with_residual(heavier),
        lambda: found.residual_samples(*parts[0][:3]),
    ):
        with refused(torchdq.ArgumentError):
            call()
    assert torch.equal(whole.residual_samples(*parts[0]).tau, found.residual_samples(*parts[0]).tau)
