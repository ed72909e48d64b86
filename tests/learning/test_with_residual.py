"""A network beside an identified robot whose friction remembers: never worse than the robot alone, in scenes too."""

import copy
import math

import pytest
import torch
from messages import refused
from recorded_logs import ROBOT as TWO
from recorded_logs import STEP, waves

import torchdq
from torchdq import effects
from torchdq.envs import Scene
from torchdq.learning import IdentifiedWithResidual, Model, Motion, Samples, evaluate, fit, identify, plot_torques

pytestmark = pytest.mark.filterwarnings("ignore::torchdq.learning.LogWarning")  # of friction that no term has
F64 = torch.float64
BRISTLES = 0.05
REMEMBERS = (effects.Viscous(), effects.LuGre(deflection=BRISTLES))
OPTIONS = {"batch": 128, "rate": 1e-2, "decay": 1e-2}


def bent(q):
    """Deflection of bristles, row by row: towards the direction of motion, along the way."""
    z, found = torch.zeros(q.shape[1], dtype=F64), []
    for step in torch.diff(q, dim=0, prepend=q[:1]):
        z = step.sign() + (z - step.sign()) * (-step.abs() / BRISTLES).exp()
        found.append(z)
    return torch.stack(found)


def motion(seed, rest, seconds=20.0):
    """Positions, velocities, accelerations and torques of sines that turn round often, with bristles and noise."""
    (q, qd, qdd), g = waves(seed, 0.1, torch.arange(1, 5), 1.0, seconds)
    noise = 0.1 * torch.randn(q.shape, generator=g, dtype=F64)
    return Samples(q, qd, qdd, torchdq.inverse_dynamics(TWO, q, qd, qdd) + 0.5 * qd + 2.0 * bent(q) + rest(qd) + noise)


def stribeck(qd):
    """Friction that is higher at low speeds, which no term here has."""
    return 1.5 * torch.exp(-((qd / 0.5) ** 2)) * torch.tanh(qd / 0.05)


def nothing(qd):
    return 0 * qd


def as_motion(part, **changes):
    time = STEP * torch.arange(len(part.q)).numpy()
    return Motion(time, *(x.numpy() for x in part))._replace(**changes)


def trained(found, train, steps=200):
    """The robot that was found with a network, trained on what both leave."""
    torch.manual_seed(0)
    layer = found.layer().requires_grad_(False)
    whole = IdentifiedWithResidual(found, torchdq.ResidualDynamics(layer, hidden=(16,)))
    parts = [whole.samples(*part) for part in train]
    whole.residual.standardise(*(torch.cat(x) for x in zip(*parts, strict=True)))
    fit(whole.residual, parts, steps=steps, **OPTIONS)
    return whole


def made(rest, steps=200):
    parts = [motion(k, rest) for k in range(3)]
    found = identify(TWO, Samples(*map(torch.stack, zip(*parts, strict=True))), Model(REMEMBERS), prior=1.0)
    return found, trained(found, parts, steps), parts


@pytest.fixture(scope="module")
def bumpy():
    return made(stribeck)


def error(tau, test):
    return (tau - test.tau).square().mean(0).sqrt()


def test_the_network_adds_to_friction_that_remembers(bumpy):
    found, whole, parts = bumpy
    test = motion(99, stribeck)
    alone, both = (error(x.predict(*test[:3]).tau, test) for x in (found, whole))
    assert (whole.residual.weight > 0.8).all()
    assert (both < 0.4 * alone).all()
    # a network around the layer alone has to guess what was before
    model = torchdq.ResidualDynamics(found.layer().requires_grad_(False), hidden=(16,))
    model.standardise(*(torch.cat(x) for x in zip(*parts, strict=True)))
    fit(model, parts, steps=200, **OPTIONS)
    assert (error(model(*test[:3]).detach(), test) > 1.7 * both).all()


def test_it_is_never_worse_than_the_robot_alone():
    found, whole, _ = made(nothing, 60)
    for seed in range(90, 93):
        test = motion(seed, nothing)
        alone, both = (error(x.predict(*test[:3]).tau, test) for x in (found, whole))
        assert (both < 1.01 * alone).all()


def test_intervals_hold_their_share(bumpy):
    whole = bumpy[1]
    inside = []
    for seed in range(50, 56):
        test = motion(seed, stribeck)
        predicted = whole.predict(*test[:3])
        inside.append(((predicted.low <= test.tau) & (test.tau <= predicted.high)).double().mean())
    assert 0.92 < float(torch.stack(inside).mean()) < 0.98


def test_without_weight_it_is_what_was_identified_with_its_errors(bumpy):
    found, whole, parts = copy.deepcopy(bumpy)
    whole.residual.weight[1] = 0
    predicted, alone = whole.predict(*parts[0][:3]), found.predict(*parts[0][:3])
    both = whole.residual.predict(*parts[0][:3])
    assert torch.equal(predicted.tau[:, 1], alone.tau[:, 1]) and (predicted.tau != alone.tau)[:, 0].any()
    assert torch.equal(predicted.low[:, 1], alone.low[:, 1]) and torch.equal(predicted.high[:, 1], alone.high[:, 1])
    assert torch.allclose(predicted.error, torch.stack([both.error[:, 0], alone.error.hypot(found.noise)[:, 1]], 1))
    assert torch.allclose((predicted.high - predicted.low)[:, 0], (both.high - both.low)[:, 0])


def test_an_offset_that_was_learned_is_predicted_where_the_network_has_no_weight(bumpy):
    found, whole, parts = bumpy
    model = torchdq.ResidualDynamics(found.layer(learn=("offset",)), hidden=(16,))
    model.load_state_dict(whole.residual.state_dict(), strict=False)
    with torch.no_grad():
        model.weight.zero_()
        model.model.offset.copy_(torch.tensor([0.3, -0.2]))
    predicted, alone = (x.predict(*parts[0][:3]) for x in (IdentifiedWithResidual(found, model), found))
    for name in ("tau", "low", "high"):
        moved = getattr(predicted, name) - getattr(alone, name)
        assert torch.allclose(moved, model.model.offset.expand_as(moved), atol=1e-12)


def test_samples_are_what_the_layer_explains_as_well_as_the_robot_that_remembers(bumpy):
    found, whole, parts = bumpy
    with torch.no_grad():
        steady = found.layer()(*parts[0][:3])
    left = whole.samples(*parts[0])
    assert torch.equal(left.q, parts[0].q)
    assert torch.allclose(left.tau - steady, parts[0].tau - found.predict(*parts[0][:3]).tau, atol=1e-12)
    assert float((left.tau - parts[0].tau).abs().max()) > 1.0  # bristles that are bent back


def test_trials_and_pictures_predict_motion_by_motion(bumpy):
    """Friction that remembers begins anew with each motion, whatever the one before ended with."""
    pytest.importorskip("matplotlib")
    found, tests = bumpy[0], [motion(k, stribeck) for k in (31, 32)]
    several, tau = [as_motion(test) for test in tests], torch.cat([test.tau for test in tests])
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
    several = [as_motion(part) for part in parts[:2]]
    found = whole.samples(several)
    assert torch.equal(found.tau, torch.cat([whole.samples(*part).tau for part in parts[:2]]))
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
        steady = whole.residual(q[1:], qd[1:], qdd)
    assert (off < 0.3).all() and (off < 0.3 * (steady - torque[1:]).square().mean(0).sqrt()).all()


def test_gains_that_were_identified_scale_the_torques():
    parts = [motion(k, nothing, 10.0) for k in range(3)]
    drives = torch.tensor([4.0, 0.5], dtype=F64)
    motions = [as_motion(part, tau=(part.tau / drives).numpy(), known_gains=False) for part in parts]
    found = identify(TWO, motions, Model(REMEMBERS, gains=True), prior=1.0)
    whole = IdentifiedWithResidual(found, torchdq.ResidualDynamics(found.layer()))
    ratio = whole.samples(motions[0]).tau + found.predict(motions[0]).tau - found.layer()(*parts[0][:3]).detach()
    assert torch.allclose(ratio, torch.as_tensor(motions[0].tau) * found.gains.value)
    plain = identify(TWO, parts[0], Model((effects.Viscous(), effects.Coulomb())), prior=1.0)
    other = IdentifiedWithResidual(plain, torchdq.ResidualDynamics(plain.layer()))
    for measured in (motions[0], as_motion(parts[0], tau=None)):
        with refused(torchdq.ArgumentError):
            other.samples(measured)


def test_what_it_does_not_take(bumpy):
    found, whole, parts = bumpy
    fresh = IdentifiedWithResidual(found, torchdq.ResidualDynamics(found.layer()))
    learning = torchdq.ResidualDynamics(found.layer(learn=("mass",)))
    heavier = torchdq.ResidualDynamics(torchdq.DQRNEA(TWO.replace(mass=2 * TWO.mass)))
    for call in (
        lambda: IdentifiedWithResidual(TWO, whole.residual),
        lambda: IdentifiedWithResidual(found, found.layer()),
        lambda: IdentifiedWithResidual(found, learning),
        lambda: IdentifiedWithResidual(found, heavier),
        lambda: fresh.predict(*parts[0][:3]),
        lambda: fresh.samples(*parts[0][:3]),
    ):
        with refused(torchdq.ArgumentError):
            call()
    assert math.isfinite(float(fresh.samples(*parts[0]).tau.sum()))
