"""Training finds known parameters, by the steps and the loss that are written."""

import math
import re
import sys
import time

import helpers
import pytest
import torch
from helpers import all_in_one
from messages import refused
from torch import nn

import torchdq
from torchdq.base import progress
from torchdq.errors import ArgumentError
from torchdq.learning import Samples, TrainingError, fit
from torchdq.nn import DQRNEA

one_thread = helpers.one_thread
OPTIONS = {"steps": 90, "batch": 32, "rate": 0.01}


@pytest.fixture(autouse=True)
def evaluated_often(monkeypatch):
    monkeypatch.setattr(sys.modules["torchdq.learning.fit"], "LOOK", 4)


class Network(nn.Module):
    """Torques of two joints from a small network; dropout makes it depend on torch's own generator."""

    def __init__(self, width: int = 8, dropout: float = 0.2, seed: int = 3):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.layers = nn.Sequential(nn.Linear(6, width), nn.Tanh(), nn.Dropout(dropout), nn.Linear(width, 2))
        for parameter in self.parameters():
            nn.init.normal_(parameter, 0.0, 0.3, generator=generator)

    def forward(self, q, qd, qdd):
        return self.layers(torch.cat([q, qd, qdd], -1))


def data(rows: int = 200, seed: int = 0, dtype: torch.dtype = torch.float32) -> Samples:
    """States and torques of the two-link arm."""
    q, qd, qdd = torch.randn(3, rows, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    tau = torchdq.inverse_dynamics(torchdq.robots.load("two_link"), q, qd, qdd)
    return Samples(*(x.to(dtype) for x in (q, qd, qdd, tau)))


def weights(model: nn.Module) -> torch.Tensor:
    return nn.utils.parameters_to_vector(model.parameters()).detach()


def test_known_masses_are_found():
    robot = torchdq.robots.load("two_link")
    model = DQRNEA(robot.replace(mass=robot.mass * torch.tensor([1.5, 0.6])), learn=("mass",))
    history = fit(model, data(dtype=torch.float64), steps=400, batch=50, rate=0.05)
    torch.testing.assert_close(model.robot.mass, robot.mass, rtol=1e-6, atol=0)
    assert history.train[-1] < 1e-10 < history.train[0]
    assert history.step == list(range(4, 401, 4)) and history.best_step == 400 and not history.valid


def test_the_loss_is_error_over_variance_of_each_joint():
    class Constant(nn.Module):
        def __init__(self):
            super().__init__()
            self.tau = nn.Parameter(torch.zeros(2))

        def forward(self, q, qd, qdd):
            return self.tau.expand_as(q)

    train, valid = data(), data(77, seed=1)
    history = fit(Constant(), train, valid, steps=1, batch=200, rate=1e-12)
    for x, found in ((train, history.train), (valid, history.valid)):
        expected = (x.tau.square().mean(0) / train.tau.var(0, correction=0)).mean()
        assert found == pytest.approx([float(expected)], rel=1e-5)


def test_the_course_has_an_entry_every_hundred_steps_whatever_torque_a_joint_has(monkeypatch):
    """A joint whose torque never changes counts in the variance of the other."""
    monkeypatch.undo()
    train = data(8)
    train.tau[:, 1] = 0.0
    model = Network(1, dropout=0.0)
    with torch.no_grad():
        wrong = model(train.q, train.qd, train.qdd) - train.tau
    history = fit(model, train, steps=250, batch=8, rate=1e-9)
    assert history.step == [100, 200, 250]
    expected = (wrong.square() / train.tau[:, 0].var(correction=0)).mean()
    assert history.train == pytest.approx(3 * [float(expected)], rel=1e-4)


def test_the_steps_are_those_of_adamw_with_a_cosine():
    """Written out again with torch's own schedule, on whole batches."""
    train, model, again = data(), Network(dropout=0.0), Network(dropout=0.0)
    fit(model, train, steps=30, batch=200, rate=0.01, decay=0.1)
    optimiser = torch.optim.AdamW(again.parameters(), lr=0.01, weight_decay=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 30)
    for _ in range(30):
        optimiser.zero_grad()
        (((again(*train[:3]) - train.tau) ** 2 / train.tau.var(0, correction=0)).mean()).backward()
        optimiser.step()
        schedule.step()
    torch.testing.assert_close(weights(model), weights(again), rtol=1e-4, atol=1e-5)


def test_every_epoch_takes_every_row_once_in_a_new_order():
    seen = []

    class Watched(Network):
        def forward(self, q, qd, qdd):
            seen.append(q[:, 0].clone())
            return super().forward(q, qd, qdd)

    train = data(50)
    fit(Watched(), train, steps=12, batch=16)
    assert [len(x) for x in seen] == [16, 16, 16, 2] * 3
    epochs = [torch.cat(seen[i : i + 4]) for i in (0, 4, 8)]
    for epoch in epochs:
        torch.testing.assert_close(epoch.sort().values, train.q[:, 0].sort().values, rtol=0, atol=0)
    assert not torch.equal(epochs[0], epochs[1]) and not torch.equal(epochs[1], epochs[2])


def test_the_prior_holds_a_model_back():
    class Held(Network):
        def prior(self):
            return nn.utils.parameters_to_vector(self.parameters()).square().sum()

    free, held = Held(), Held()
    fit(free, data(), steps=100, rate=0.01)
    fit(held, data(), steps=100, rate=0.01, prior=10.0)
    assert weights(held).norm() < 0.5 * weights(free).norm()
    without = Network()
    fit(without, data(), steps=100, rate=0.01, prior=10.0)  # has no prior
    assert torch.equal(weights(without), weights(free))


def test_the_weights_with_the_least_error_on_the_validation_data_are_kept():
    train, valid = data(20), data(200, seed=1)
    model = Network(width=64, dropout=0.0)
    history = fit(model, train, valid, steps=300, batch=20, rate=0.1)
    best = min(history.valid)
    assert history.best_step == history.step[history.valid.index(best)] < 300
    error = ((model(*valid[:3]) - valid.tau).square() / train.tau.var(0, correction=0)).mean()
    assert float(error.detach()) == pytest.approx(best, rel=1e-5)


def test_the_same_seed_gives_the_same_bits_and_leaves_the_callers_generator_alone():
    found = []
    for seed, stir in ((1, 0), (1, 7), (2, 0)):
        torch.manual_seed(stir)
        model = Network()
        before = torch.get_rng_state()
        fit(model, data(), steps=20, batch=32, seed=seed)
        assert torch.equal(torch.get_rng_state(), before)
        found.append(weights(model))
    assert torch.equal(found[0], found[1]) and not torch.equal(found[0], found[2])


def test_frozen_parameters_stay_and_unused_ones_do_no_harm():
    model = Network()
    model.unused = nn.Parameter(torch.ones(3))
    model.layers[0].weight.requires_grad_(False)
    before = model.layers[0].weight.clone()
    fit(model, data(), steps=5)
    assert torch.equal(model.layers[0].weight, before) and torch.equal(model.unused, torch.ones(3))
    assert model.training and all(p.grad is None for p in model.parameters())


def test_a_history_prints_as_a_table():
    history = fit(Network(), data(), data(50, seed=1), **OPTIONS)
    lines = str(history).splitlines()
    assert lines[0] == f"90 steps, weights of step {history.best_step}" and lines[2].split() == [
        "step",
        "train",
        "valid",
    ]
    assert lines[-1].split() == ["90", f"{history.train[-1]:.3g}", f"{history.valid[-1]:.3g}"]
    assert str(fit(Network(), data(), steps=4, batch=200)).splitlines()[2].split() == ["step", "train"]


def spoilt(value: float) -> Samples:
    samples = data(dtype=torch.float64)
    samples.qd[7, 1] = value
    return samples


@all_in_one(
    [
        {"steps": 0},
        *({name: x} for name, x in (("batch", 0), ("rate", math.nan), ("prior", -1), ("decay", -0.1), ("seed", 0.5))),
        {"model": nn.Identity()},
        *({"train": x} for x in (None, spoilt(math.nan), data()[:3], data(0), Samples(*(x.numpy() for x in data())))),
        {"train": data()._replace(qd=torch.zeros(200, 3))},
        {"train": data()._replace(tau=torch.ones(200, 2))},
        {"train": Samples(*(x.new_ones(9, 6) for x in data()))},
        *({"valid": x} for x in (spoilt(math.inf), data()._replace(tau=data().tau.tolist()), data()._asdict())),
        {"valid": Samples(*(x[:, :1] for x in data()))},
    ]
)
def test_arguments_are_checked(options):
    arguments = {"model": Network(), "train": data(), "steps": 3, **options}
    with refused(ArgumentError):
        fit(arguments.pop("model"), arguments.pop("train"), **arguments)


@all_in_one([lambda tau: tau[..., :1], lambda tau: tau.detach()])
def test_a_model_of_other_torques_is_refused(change):
    class Wrong(Network):
        def forward(self, q, qd, qdd):
            return change(super().forward(q, qd, qdd))

    with refused(ArgumentError):
        fit(Wrong(), data(), steps=1)


class Breaking(Network):
    """Is not finite for one row, from a step on: in its torques, or only in a gradient."""

    def __init__(self, step: int, gradient: bool):
        super().__init__()
        self.calls, self.step, self.gradient = 0, step, gradient

    def forward(self, q, qd, qdd):
        tau = super().forward(q, qd, qdd)
        self.calls += self.training
        if self.calls < self.step:
            return tau
        bias = self.layers[0].bias
        return tau + (torch.sqrt(0 * bias).sum() if self.gradient else torch.nan * bias.sum())


@all_in_one([False, True])
def test_numbers_that_are_not_finite_end_the_run_before_they_reach_the_weights(gradient):
    model = Breaking(18, gradient)
    with refused(TrainingError):
        fit(model, data(), steps=50, batch=32)
    assert weights(model).isfinite().all() and model.training


def test_a_validation_error_that_is_not_finite_ends_the_run():
    huge = data()._replace(tau=torch.full((200, 2), 1e30))
    with refused(TrainingError):
        fit(Network(), data(), huge, steps=10, batch=100)


class Interrupted(Network):
    """Stops its own training by a signal from the keyboard after some steps."""

    def __init__(self, steps: int):
        super().__init__()
        self.left = steps

    def forward(self, q, qd, qdd):
        self.left -= self.training
        if self.left < 0:
            time.sleep(0.2)
            raise KeyboardInterrupt
        return super().forward(q, qd, qdd)


def test_a_long_run_says_how_far_it_is_and_a_quick_one_is_silent(monkeypatch, capfd):
    monkeypatch.setattr(progress, "FIRST", 60.0)
    fit(Network(), data(), steps=3)
    assert capfd.readouterr().err == ""
    monkeypatch.setattr(progress, "FIRST", 0.05)
    monkeypatch.setattr(progress, "EVERY", 0.05)
    with pytest.raises(KeyboardInterrupt):
        fit(Interrupted(40), data(), **OPTIONS)
    assert re.search(r"torchdq: fitting, step \d+ of 90, \d+ s", capfd.readouterr().err)
    time.sleep(0.1)
    assert capfd.readouterr().err == ""  # it has ended
