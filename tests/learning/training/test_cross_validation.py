"""A residual that is fitted: active where it helps on rows it has not seen, silent elsewhere, with honest errors."""

from itertools import count, pairwise

import pytest
import torch
from helpers import double
from messages import refused, warned
from recorded_logs import ROBOT as TWO
from recorded_logs import waves

import torchdq
import torchdq.learning.training.fit as fitting
from torchdq.learning import LogWarning, Samples, fit
from torchdq.learning.training.loop import Optimiser
from torchdq.learning.training.validation_gain import LEAST, HeldOut, validation_gain

F64 = torch.float64
OPTIONS = {"batch": 128, "rate": 1e-2, "decay": 1e-2}


def motion(seed, friction, seconds=20.0, speed=1.0, noise=0.2, correlated=8):
    """A motion of sines at 50 Hz, its torques with friction that no model has a term for, and correlated noise."""
    (q, qd, qdd), g = waves(seed, 0.2, speed * torch.arange(6) / 2, 0.4 * speed, seconds)
    white = torch.randn(len(q) // correlated + 1, 2, generator=g, dtype=F64).repeat_interleave(correlated, 0)
    tau = torchdq.inverse_dynamics(TWO, q, qd, qdd) + friction(qd) + noise * white[: len(q)]
    return Samples(q, qd, qdd, tau)


def stribeck(qd):
    """Friction that is higher at low speed and rises with the square of the speed."""
    return (1.0 + 1.5 * torch.exp(-((qd / 0.5) ** 2))) * torch.tanh(qd / 0.05) + 0.2 * qd * qd.abs()


def nothing(qd):
    return 0 * qd


def layer(parts, **options):
    torch.manual_seed(0)
    model = torchdq.ResidualDynamics(torchdq.DQRNEA(TWO), hidden=(16,), **options)
    model.standardise(*(torch.cat(x) for x in zip(*parts, strict=True)))
    return model


def error(model, part):
    with torch.no_grad():
        return (model(*part[:3]) - part.tau).square().mean(0).sqrt()


@pytest.fixture(scope="module")
def fitted():
    parts = [motion(k, stribeck) for k in range(6)]
    model = layer(parts)
    return model, fit(model, parts, steps=300, **OPTIONS), parts


# --- kept where it helps ---------------------------------------------------------------------------------------------


def test_a_residual_that_helps_is_kept_and_brings_the_error_down(fitted):
    model, history, _ = fitted
    assert history.residual.active and (history.residual.weight > 0.9).all()
    assert (history.residual.error < 0.5 * history.residual.without).all()
    test = motion(99, stribeck)
    assert (error(model, test) < 2 * 0.2).all() and (error(model.model, test) > 1.0).all()
    text = str(history)
    assert "residual on held-out rows: active" in text
    assert [line.split()[0] for line in text.splitlines()[-2:]] == ["joint1", "joint2"]


def test_a_residual_that_finds_nothing_is_silent():
    parts = [motion(k, nothing, seconds=6.0, noise=0.5) for k in range(4)]
    model = layer(parts)
    with warned(LogWarning):
        history = fit(model, parts, steps=200, **OPTIONS)
    assert not history.residual.active and not model.weight.any()
    test = motion(99, nothing)
    assert torch.equal(model(*test[:3]), model.model(*test[:3]))


def test_a_joint_that_does_not_gain_by_more_than_chance_has_no_weight():
    parts = [motion(k, lambda qd: stribeck(qd) * double(1.0, 0.0), seconds=8.0, noise=0.3) for k in range(20, 24)]
    model = layer(parts)
    with warned(LogWarning):
        gain = fit(model, parts, steps=300, **OPTIONS).residual
    assert (gain.gains <= gain.standard_errors).tolist() == [False, True] and "squares fall by" in str(gain)
    assert model.weight[0] > 0.8 and model.weight[1] == 0


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seconds", [2.0, 5.0, 20.0])
def test_other_motions_are_never_worse_with_it(seconds):
    """Trained on little and tested slower and faster; a percent is what chance may do."""
    parts = [motion(5, stribeck, seconds, noise=0.4)]
    model = layer(parts)
    fit(model, parts, steps=200, **OPTIONS)
    for speed in (0.5, 2.0):
        test = motion(77, stribeck, speed=speed, noise=0.4)
        assert (error(model, test) <= 1.01 * error(model.model, test)).all(), speed


def cable(q, qd):
    """Torques of a cable, which no feature of the network sees."""
    return 0.6 * torch.sin(3 * q) + 0.4 * torch.tanh(4 * qd) * qd.abs()


def of_positions(seed, seconds, passes=1, speed=1.0):
    """A motion and those after it that repeat it, with the torques of a cable."""
    q, qd, qdd, _ = motion(seed, nothing, seconds, speed)
    g = torch.Generator().manual_seed(seed)
    parts = []
    for _ in range(passes):
        noise = 0.1 * torch.randn(q.shape, generator=g, dtype=F64)
        parts.append(Samples(q, qd, qdd, torchdq.inverse_dynamics(TWO, q, qd, qdd) + cable(q, qd) + noise))
    return Samples(*(torch.cat(x) for x in zip(*parts, strict=True)))


@pytest.mark.parametrize("seed", range(2))
def test_three_seconds_are_too_few_independent_samples_for_a_network(seed):
    parts = [of_positions(seed, 3.0)]
    model = layer(parts)
    with warned(LogWarning):
        gain = fit(model, parts, steps=150, **OPTIONS).residual
    few = gain.independent < LEAST * gain.blocks
    assert few.any() and not gain.weight[few].any() and not model.weight[few].any()
    for k in range(3):
        test = of_positions(90 + k, 15.0)
        assert (error(model, test)[few] == error(model.model, test)[few]).all()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seed", range(2))
def test_a_motion_that_repeats_itself_does_not_pass_for_others(seed):
    """Its network knows the recorded path, and blocks left out of one pass are in the next; regions are in none."""
    parts = [of_positions(seed, 6.0, passes=3)]
    model = layer(parts)
    gain = fit(model, parts, steps=150, **OPTIONS).residual
    on_blocks = gain.without.square() - gain.error.square()
    assert (gain.gains < 0.8 * on_blocks).all()  # that of regions counts
    for k in range(3):
        test = of_positions(90 + k, 15.0)
        assert (error(model, test) <= 1.05 * error(model.model, test)).all()


@pytest.mark.parametrize(("sign", "kept"), [(1.0, True), (-1.0, False)])
def test_regions_are_judged_by_themselves(sign, kept):
    """Torques that explain eight blocks and make two regions worse gain in the mean of all, and are not kept."""
    model, random = layer([motion(0, nothing, seconds=4.0)]), torch.Generator().manual_seed(0)

    def part(sign):
        residual = torch.randn(200, 2, generator=random, dtype=torch.float64)
        near = torch.zeros(200, model.domain.reach.shape[0], dtype=torch.float64)
        return HeldOut(sign * residual, residual, near, torch.full_like(residual, -1.0), near)

    gain = validation_gain(model, [part(1.0) for _ in range(8)], [part(sign) for _ in range(2)], double(1.0, 1.0))
    assert (gain.weight > 0).tolist() == [kept, kept]
    assert ((gain.gains > gain.standard_errors) == kept).all()


def test_of_too_few_rows_none_are_held_out_and_the_residual_is_inactive():
    parts = [motion(0, stribeck, seconds=0.8)]
    model = layer(parts)
    with warned(LogWarning):
        history = fit(model, parts, steps=20, **OPTIONS)
    assert not history.residual.active and not model.weight.any()


def test_validation_samples_serve_instead_of_left_out_blocks():
    parts = [motion(k, stribeck) for k in range(2)]
    model = layer(parts)
    history = fit(model, parts, motion(8, stribeck), steps=300, **OPTIONS)
    assert history.valid and (model.weight > 0.8).all() and model.posterior.measured


@pytest.mark.parametrize("inputs", ["joint", "all"])
def test_a_network_of_ones_own_is_measured_too(inputs):
    shape = (6, 1) if inputs == "joint" else (12, 2)
    network = torch.nn.Sequential(torch.nn.Linear(shape[0], 12), torch.nn.Tanh(), torch.nn.Linear(12, shape[1]))
    parts = [motion(k, stribeck, seconds=10.0) for k in range(3)]
    model = layer(parts, network=network, inputs=inputs)
    assert fit(model, parts, steps=300, **OPTIONS).residual.active
    found = model.predict(*parts[0][:3])
    assert found.tau.shape == found.error.shape == (500, 2) and (found.low < found.high).all()


def test_rows_of_motions_are_one_after_the_other_and_physics_takes_them_too():
    parts = [motion(k, nothing, seconds=2.0) for k in range(3)]
    whole = Samples(*(torch.cat(x) for x in zip(*parts, strict=True)))
    found = []
    for given in (parts, whole):
        model = torchdq.DQRNEA(TWO.replace(mass=1.2 * TWO.mass), learn=("mass",))
        history = fit(model, given, steps=20, batch=64)
        assert history.residual is None
        found.append(model.mass.detach())
    assert torch.equal(*found)
    with refused(torchdq.ArgumentError):
        fit(model, [parts[0], Samples(*(x[:, :1] for x in parts[1]))], steps=1)


# --- errors ----------------------------------------------------------------------------------------------------------


def test_intervals_hold_their_share_of_new_torques_of_the_same_kind(fitted):
    model, _, _ = fitted
    inside = []
    for seed in range(50, 70):
        test = motion(seed, stribeck)
        found = model.predict(*test[:3])
        assert torch.equal(found.tau, model(*test[:3]).detach())
        inside.append(((test.tau >= found.low) & (test.tau <= found.high)).double())
    assert 0.93 < float(torch.stack(inside).mean()) < 0.97


def test_intervals_widen_away_from_what_was_trained(fitted):
    model, _, parts = fitted
    q, qd, qdd, _ = parts[0]
    inside = model.predict(q, qd, qdd).error.mean(0)
    faster = [model.predict(q, k * qd, qdd).error.mean(0) for k in (1, 2, 4, 8)]
    assert torch.equal(faster[0], inside)
    assert all((b > a).all() for a, b in pairwise(faster))
    loaded = model.predict(q, qd, 50 * qdd).error.mean(0)
    assert (loaded > 1.5 * inside).all()


def test_the_error_of_the_weights_is_that_of_networks_trained_on_other_noise(fitted):
    """Leverage: more where rows are rare. The spread of the last layer over data sets, to a factor of two."""
    model, _, parts = fitted
    x = model.scaled(model.features(*parts[0][:3], parts[0].tau))
    hidden = model.network.last_hidden(model.scales.within_range(x)).double().detach()
    H = torch.cat([hidden, torch.ones_like(hidden[..., :1])], -1)
    g = torch.Generator().manual_seed(0)
    for j in range(2):
        every = [model.scaled(model.features(*part[:3], model.model(*part[:3]))) for part in parts]
        A = torch.cat([model.network.last_hidden(model.scales.within_range(y)).double().detach()[:, j] for y in every])
        A = torch.cat([A, torch.ones_like(A[:, :1])], -1)
        ridge = 1e-9 * float(A.square().sum())
        noise = torch.randn(len(A), 200, generator=g, dtype=F64)
        w = torch.linalg.solve(A.T @ A + ridge * torch.eye(A.shape[1], dtype=F64), A.T @ noise)
        sampled = (H[:, j] @ w).square().mean(1)
        found = model.posterior.leverage(hidden)[:, j]
        assert 0.3 < float(found.sum() / sampled.sum()) < 1.5


# --- resumed ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("killed", [7, 30, 41])
def test_a_killed_run_ends_with_the_same_bits(tmp_path, monkeypatch, killed):
    """Killed before its first checkpoint, after one, and while the residual is measured."""
    monkeypatch.setattr(fitting, "LOOK", 1)  # six batches of 128 rows make an epoch
    parts = [motion(k, stribeck, seconds=5.0) for k in range(3)]
    model, killed_one, again = (layer(parts) for _ in range(3))
    options, epoch, steps = {**OPTIONS, "steps": 40}, Optimiser.epoch, count()
    fit(model, parts, **options)

    def counted(step):
        if next(steps) == killed:
            raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(
            Optimiser, "epoch", lambda self, rows, error, _, *prior: epoch(self, rows, error, counted, *prior)
        )
        with pytest.raises(KeyboardInterrupt):
            fit(killed_one, parts, checkpoint=tmp_path / "run.pt", **options)
    assert (tmp_path / "run.pt").exists()
    if killed > 7:  # weights to begin with matter no more
        again.network.load_state_dict({name: 0 * x for name, x in again.network.state_dict().items()})
    fit(again, parts, checkpoint=tmp_path / "run.pt", **options)
    for name, x in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], x), name
