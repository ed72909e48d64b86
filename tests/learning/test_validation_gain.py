"""A residual that is fitted: active where it helps on rows it has not seen, silent elsewhere, beside fixed physics."""

import pytest
import torch
from helpers import double, exhaustive, thinned
from messages import refused, warned
from recorded_logs import ROBOT as TWO
from recorded_logs import waves

import torchdq
from torchdq.learning import LogWarning, Samples, fit
from torchdq.learning.fit import HeldOut, validation_gain

F64, BACKEND = torch.float64, "auto"  # one arm, whose programs all tests share
OPTIONS = {"batch": 128, "rate": 1e-2, "decay": 1e-2}


def motion(seed, rest, seconds=20.0, speed=1.0, noise=0.2, correlated=8):
    """A motion of sines at 50 Hz, its torques with those of a function of the state, and correlated noise."""
    (q, qd, qdd), g = waves(seed, 0.2, speed * torch.arange(6) / 2, 0.4 * speed, seconds)
    white = torch.randn(len(q) // correlated + 1, 2, generator=g, dtype=F64).repeat_interleave(correlated, 0)
    tau = torchdq.inverse_dynamics(TWO, q, qd, qdd) + rest(q, qd) + noise * white[: len(q)]
    return Samples(q, qd, qdd, tau)


def stribeck(q, qd):
    """Friction that is higher at low speed and rises with the square of the speed."""
    return (1.0 + 1.5 * torch.exp(-((qd / 0.5) ** 2))) * torch.tanh(qd / 0.05) + 0.2 * qd * qd.abs()


def cable(q, qd):
    """Torques of a cable along the arm: nonlinear, and of both joints together."""
    return 1.5 * torch.stack([(q[:, 0] + q[:, 1]).sin(), (2 * q[:, 0] - q[:, 1]).cos()], 1)


def nothing(q, qd):
    return 0 * qd


def layer(model=None, **options):
    torch.manual_seed(0)
    return torchdq.ResidualDynamics(torchdq.DQRNEA(TWO) if model is None else model, hidden=(16,), **options)


def error(model, part):
    with torch.no_grad():
        return (model(*part[:3]) - part.tau).square().mean(0).sqrt()


@pytest.mark.parametrize("rest", thinned([stribeck, cable], [cable]))
def test_a_residual_that_helps_is_kept_and_brings_the_error_of_unseen_motions_down(rest):
    model = layer(inputs="all" if rest is cable else "joint")
    history = fit(model, [motion(k, rest) for k in range(6)], steps=200, **OPTIONS)
    gain = history.residual
    assert (gain.weight > 0.8).all() and (gain.error < 0.6 * gain.without).all()
    test = motion(99, rest)
    assert (error(model, test) < 2 * 0.2).all() and (error(model.model, test) > 0.9).all()
    text = str(history)
    assert "residual on held-out rows" in text
    assert [line.split()[0] for line in text.splitlines()[-2:]] == ["joint1", "joint2"]


def test_a_joint_that_does_not_gain_by_more_than_chance_has_no_weight():
    parts = [motion(k, lambda q, qd: stribeck(q, qd) * double(1.0, 0.0), 8.0, noise=0.3) for k in range(4)]
    model = layer()
    with warned(LogWarning):
        gain = fit(model, parts, steps=200, **OPTIONS).residual
    assert (gain.gains <= 2 * gain.standard_errors).tolist() == [False, True]
    assert model.weight[0] > 0.8 and model.weight[1] == 0 and model.remaining[1] == 1
    test = motion(99, nothing)
    assert torch.equal(model(*test[:3])[:, 1], model.model(*test[:3])[:, 1])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seconds", thinned([2.0, 20.0], [2.0]))
def test_other_motions_are_never_worse_with_it(seconds):
    """Trained on little and tested slower and faster; a percent is what chance may do."""
    model = layer()
    fit(model, motion(5, stribeck, seconds, noise=0.4), steps=150, **OPTIONS)
    for speed in (0.5, 2.0):
        test = motion(77, stribeck, speed=speed, noise=0.4)
        assert (error(model, test) <= 1.01 * error(model.model, test)).all(), speed


class Linear(torch.nn.Module):
    """Linear layer without `reset_parameters`."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(2, 12))

    def forward(self, x):
        return x @ self.weight.T


@pytest.mark.filterwarnings("ignore")
def test_a_network_of_ones_own_is_measured_if_its_copies_can_have_new_weights():
    network = torch.nn.Sequential(torch.nn.Linear(12, 12), torch.nn.Tanh(), torch.nn.Linear(12, 2))
    found = [fit(layer(network=network), [motion(k, stribeck, 10.0) for k in range(3)], steps=100, **OPTIONS)]
    assert (found[0].residual.weight > 0.5).all()
    model = layer(network=Linear())
    with refused(torchdq.ArgumentError):
        fit(model, motion(0, cable), steps=2)
    assert fit(model, motion(0, cable), motion(1, cable), steps=2).residual is not None


@exhaustive
@pytest.mark.filterwarnings("ignore")
def test_a_motion_that_repeats_itself_does_not_pass_for_others():
    """Its network knows the recorded path, and blocks left out of one pass are in the next; regions are in none."""
    passes = Samples(*(torch.cat(x) for x in zip(*[motion(0, cable, 6.0, noise=0.1)] * 3, strict=True)))
    model = layer()
    gain = fit(model, passes, steps=100, **OPTIONS).residual
    on_blocks, acts = gain.without.square() - gain.error.square(), gain.weight > 0
    assert acts.any() and (gain.gains < 0.5 * on_blocks)[acts].all()  # that of regions counts
    for k in range(3):
        test = motion(90 + k, cable, 15.0, noise=0.1)
        assert (error(model, test) <= 1.05 * error(model.model, test)).all()


def parts(*signs, rows=200, memory=1):
    """Parts of held-out rows whose residual is the network's torque times a sign, and noise."""
    g = torch.Generator().manual_seed(0)
    for sign in signs:
        y, noise = torch.randn(2, rows // memory, 2, generator=g, dtype=F64).repeat_interleave(memory, 1)
        yield HeldOut(y, torch.ones(rows // memory * memory, 2, dtype=F64), sign * y + 0.1 * noise)


def test_regions_are_judged_separately():
    """Torques that explain eight blocks and make two regions worse gain in the mean of all, and are not kept."""
    for sign in (1.0, -1.0):
        model = layer()
        gain = validation_gain(model, list(parts(*[1.0] * 8)), list(parts(sign, sign)), double(1.0, 1.0))
        for kept in (gain.weight > 0, model.remaining < 1, gain.gains > 2 * gain.standard_errors):
            assert (kept == (sign > 0)).all()


def test_a_network_that_gains_by_chance_is_not_kept():
    """Five blocks that it explains, and three that it makes worse."""
    gain = validation_gain(layer(), list(parts(*[1.0] * 5, *[-1.0] * 3)), [], double(1.0, 1.0))
    assert (gain.gains > 0).all() and not gain.weight.any()


def test_rows_that_say_little_keep_no_network():
    """Blocks of 200 rows, all alike where the memory is as long: one independent row for each."""
    for memory in (1, 200):
        gain = validation_gain(layer(), list(parts(*[1.0] * 8, memory=memory)), [], double(1.0, 1.0))
        assert (gain.gains > 2 * gain.standard_errors).all() and ((gain.weight > 0) == (memory == 1)).all()


def test_of_too_few_rows_none_are_held_out_and_the_residual_is_inactive():
    model = layer()
    with warned(LogWarning):
        history = fit(model, motion(0, stribeck, seconds=0.8), steps=20, **OPTIONS)
    assert not history.residual.weight.any() and not model.weight.any()


def test_validation_samples_choose_the_weights():
    train, valid = motion(0, stribeck, 5.0), motion(8, stribeck, 5.0)
    model = layer()
    history = fit(model, train, valid, steps=300, **OPTIONS)
    assert len(history.valid) == 3 and history.best_step == history.step[history.valid.index(min(history.valid))]
    model.weight.fill_(1.0)
    found = model.ungated(model.features(valid.q, valid.qd)) + model.model(*valid[:3])
    expected = ((found - valid.tau).square().detach() / train.tau.var(0, correction=0)).mean()
    assert float(expected) == pytest.approx(min(history.valid), rel=1e-4)


@pytest.mark.filterwarnings("ignore")
def test_the_physics_stay_as_they_are_and_the_same_seed_gives_the_same_bits():
    physics = torchdq.DQRNEA(TWO.replace(mass=1.2 * TWO.mass), learn=("mass", "friction", "offset"))
    before = {name: x.clone() for name, x in physics.state_dict().items()}
    models = [layer(physics) for _ in range(3)]
    for model, seed in zip(models, (1, 1, 2), strict=True):
        fit(model, motion(0, stribeck, 4.0), steps=20, seed=seed, **OPTIONS)
    first, same, other = (model(*motion(1, stribeck, 2.0)[:3]) for model in models)
    assert torch.equal(first, same) and not torch.equal(first, other)
    assert all(torch.equal(x, before[name]) for name, x in physics.state_dict().items())
    assert all(p.requires_grad and p.grad is None for p in physics.parameters())


def test_rows_of_motions_are_one_after_the_other_and_physics_takes_them_too():
    several = [motion(k, nothing, seconds=2.0) for k in range(3)]
    whole = Samples(*(torch.cat(x) for x in zip(*several, strict=True)))
    found = []
    for given in (several, whole):
        model = torchdq.DQRNEA(TWO.replace(mass=1.2 * TWO.mass), learn=("mass",))
        assert fit(model, given, steps=5, batch=64).residual is None
        found.append(model.mass.detach())
    assert torch.equal(*found)
    with refused(torchdq.ArgumentError):
        fit(model, [several[0], Samples(*(x[:, :1] for x in several[1]))], steps=1)
