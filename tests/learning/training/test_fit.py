"""Training finds known parameters, survives being killed at any moment, and is shared by processes without a change.

A killed run that is called again must end with the same bits as one that was not. The trials fork this process, which
has torch loaded, kill the child at a random moment and call the same run again.
"""

import contextlib
import copy
import io
import math
import multiprocessing
import os
import pickle
import random
import re
import signal
import subprocess
import sys
import time
import types
from argparse import Namespace
from collections.abc import Callable
from functools import partial
from pathlib import Path

import helpers
import numpy as np
import pytest
import torch
from places import ROOT
from torch import nn

import torchdq
from torchdq.base import progress as notice
from torchdq.errors import ArgumentError, MissingLibraryError
from torchdq.learning import CheckpointError, History, Samples, TrainingError, fit
from torchdq.learning.training import checkpoint as checkpoints
from torchdq.learning.training.attributes import attributes
from torchdq.learning.training.run import Run
from torchdq.nn import DQRNEA

one_thread = helpers.one_thread  # a forked child cannot use the threads of its parent


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


# --- what is learned -------------------------------------------------------------------------------------------------


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
    expected = [(x.tau.square().mean(0) / train.tau.var(0, correction=0)).mean() for x in (train, valid)]
    assert history.train == pytest.approx([float(expected[0])], rel=1e-5)
    assert history.valid == pytest.approx([float(expected[1])], rel=1e-5)


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
    fit(Watched(), train, epochs=3, batch=16, every=1000)
    assert [len(x) for x in seen] == [16, 16, 16, 2] * 3
    epochs = [torch.cat(seen[i : i + 4]) for i in (0, 4, 8)]
    for epoch in epochs:
        torch.testing.assert_close(epoch.sort().values, train.q[:, 0].sort().values, rtol=0, atol=0)
    assert not torch.equal(epochs[0], epochs[1]) and not torch.equal(epochs[1], epochs[2])


def test_the_prior_holds_a_model_back():
    class Held(Network):
        def prior(self):
            return weights_of(self).square().sum()

    def weights_of(model):
        return nn.utils.parameters_to_vector(model.parameters())

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
    history = fit(model, train, valid, steps=1000, batch=20, rate=0.02, patience=8, every=5)
    assert history.stopped_early and history.step[-1] < 1000
    best = min(history.valid)
    assert history.best_step == history.step[history.valid.index(best)] == history.step[-1] - 8 * 5
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


def test_a_joint_without_torque_counts_as_the_others():
    still = data()._replace(tau=data().tau * torch.tensor([1.0, 0.0]))
    history = fit(Network(), still, steps=50, rate=0.01)
    assert all(math.isfinite(error) and error < 20 for error in history.train)


def test_a_history_prints_as_a_table():
    _, history = run(None)
    lines = str(history).splitlines()
    assert lines[0] == f"90 steps, weights of step {history.best_step}"
    assert lines[2].split() == ["step", "train", "valid"] and 8 <= len(lines) <= 14
    assert lines[-1].split() == ["90", f"{history.train[-1]:.3g}", f"{history.valid[-1]:.3g}"]
    alone = fit(Network(), data(), steps=4, batch=200)
    assert str(alone).splitlines()[2].split() == ["step", "train"] and len(str(alone).splitlines()) == 3 + 4
    assert str(History()) == "no steps"


# --- arguments -------------------------------------------------------------------------------------------------------


def spoilt(value: float) -> Samples:
    samples = data(dtype=torch.float64)
    samples.qd[7, 1] = value
    return samples


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "one of steps and epochs must be given, found steps=None and epochs=None"),
        ({"steps": 3, "epochs": 3}, "one of steps and epochs"),
        ({"steps": 0}, "steps must be a whole number from 1, found 0"),
        ({"steps": 2.5}, "steps must be a whole number from 1, found 2.5"),
        ({"steps": True}, "steps must be a whole number from 1, found True"),
        ({"epochs": -1}, "epochs must be a whole number from 1, found -1"),
        ({"steps": 3, "batch": 0}, "batch must be a whole number from 1"),
        ({"steps": 3, "batch": "8"}, "batch must be a whole number from 1, found '8'"),
        ({"steps": 3, "rate": math.nan}, "rate must be a positive number, found nan"),
        ({"steps": 3, "rate": "fast"}, "rate must be a positive number, found 'fast'"),
        ({"steps": 3, "prior": -1}, "prior must be a finite number from 0, found -1"),
        ({"steps": 3, "decay": -0.1}, "decay must be a finite number from 0, found -0.1"),
        ({"steps": 3, "seed": 0.5}, "seed must be a whole number from 0, found 0.5"),
        ({"steps": 3, "every": 0}, "every must be a whole number from 1"),
        ({"steps": 3, "patience": 3}, "patience needs samples in valid"),
        (
            {"steps": 3, "model": nn.Identity()},
            r"model has no parameters to fit; name tensors of the robot in its learn",
        ),
        ({"steps": 3, "train": spoilt(math.nan)}, r"train\.qd must be finite, found nan in row 7, joint 2; leave"),
        ({"steps": 3, "valid": spoilt(math.inf)}, r"valid\.qd must be finite, found inf in row 7, joint 2; leave"),
        ({"steps": 3, "train": data()[:3]}, r"train must be Samples\(q, qd, qdd, tau\), found 3 entries"),
        (
            {"steps": 3, "train": Samples(*(x.numpy() for x in data()))},
            r"train\.q must be a tensor, found ndarray; use torch\.as_tensor",
        ),
        ({"steps": 3, "valid": data()._replace(tau=data().tau.tolist())}, r"valid\.tau must be a tensor, found list"),
        ({"steps": 3, "train": None}, r"train must be Samples\(q, qd, qdd, tau\), found NoneType"),
        ({"steps": 3, "valid": data()._asdict()}, r"valid must be Samples\(q, qd, qdd, tau\), found dict"),
        ({"steps": 3, "train": data()._replace(qd=torch.zeros(200, 3))}, r"train\.qd must be .*\[200, 2\] as train\.q"),
        ({"steps": 3, "train": data(0)}, r"train\.q must be real numbers \[N, n\] with N > 0, found .*\[0, 2\]"),
        ({"steps": 3, "valid": Samples(*(x[:, :1] for x in data()))}, "valid must have the 2 joints of train, found 1"),
        ({"steps": 3, "train": data()._replace(tau=torch.ones(200, 2))}, r"train\.tau must change from row to row"),
        ({"steps": 3, "train": Samples(*(x.new_ones(9, 6) for x in data()))}, r"train\.tau must change"),
    ],
)
def test_arguments_are_checked(options, message):
    arguments = {"model": Network(), "train": data(), **options}
    with pytest.raises(ArgumentError, match=message):
        fit(arguments.pop("model"), arguments.pop("train"), **arguments)


def test_a_model_of_other_torques_is_refused():
    class Wrong(Network):
        def forward(self, q, qd, qdd):
            return super().forward(q, qd, qdd)[..., :1]

    with pytest.raises(ArgumentError, match=r"model must return torques \[200, 2\], found \[200, 1\]"):
        fit(Wrong(), data(), steps=1)

    class Constant(Network):
        def forward(self, q, qd, qdd):
            return super().forward(q, qd, qdd).detach()

    with pytest.raises(ArgumentError, match="the torques of the model do not depend on its parameters"):
        fit(Constant(), data(), steps=1)


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


@pytest.mark.parametrize("gradient", [False, True])
def test_numbers_that_are_not_finite_end_the_run_and_spare_the_checkpoint(tmp_path, gradient):
    path = tmp_path / "run.pt"
    what = r"the gradient for 'layers\.0\.bias' is not finite" if gradient else "the error is nan"
    expected = (
        rf"step 8: {what}, in the batch of the 32 rows \d+, \d+, \d+, \d+, \d+, \.\.\. of train; .*was not written"
    )
    with pytest.raises(TrainingError, match=expected):
        fit(Breaking(8, gradient), data(), steps=50, batch=32, every=10, checkpoint=path)
    assert not path.exists()
    model = Breaking(18, gradient)
    with pytest.raises(TrainingError, match=rf"step 18: {what}.*run\.pt was left as it is"):
        fit(model, data(), steps=50, batch=32, every=10, checkpoint=path)
    assert checkpoints.read(path)["step"] == 10
    assert weights(model).isfinite().all()


def test_a_validation_error_that_is_not_finite_ends_the_run(tmp_path):
    huge = data()._replace(tau=torch.full((200, 2), 1e30))
    with pytest.raises(TrainingError, match="step 2: the error on valid is inf"):
        fit(Network(), data(), huge, steps=10, every=2, checkpoint=tmp_path / "run.pt")
    assert not (tmp_path / "run.pt").exists()


# --- checkpoints -----------------------------------------------------------------------------------------------------

OPTIONS = {"steps": 90, "batch": 32, "rate": 0.01, "every": 3, "seed": 5, "patience": 25}


def run(path: Path | None, model: nn.Module | None = None, **options) -> tuple[nn.Module, History]:
    """The run that is killed; 200 rows make 7 batches, so that looks fall within epochs and on their ends."""
    model = model or Network()
    return model, fit(model, data(), data(50, seed=1), checkpoint=path, **{**OPTIONS, **options})


@pytest.fixture(scope="module")
def undisturbed() -> tuple[torch.Tensor, History]:
    model, history = run(None)
    return weights(model), history


@pytest.mark.parametrize("trials", helpers.thinned((8, 30), (8,)))
def test_a_killed_run_loses_nothing(tmp_path, undisturbed, trials):
    """Trials that are killed once or twice each at random moments, from before the first step to after the last."""
    fork = multiprocessing.get_context("fork")
    rng, reached = random.Random(0), []
    whole = math.inf  # moments are parts of what a whole run takes on this machine, at best
    for k in range(3):
        start = time.monotonic()
        child = fork.Process(target=run, args=(tmp_path / f"whole{k}.pt",))
        child.start()
        child.join()
        whole = min(whole, time.monotonic() - start)
    for trial in range(20 * trials):  # on a machine with other work, moments are often too early or too late
        path = tmp_path / f"run{trial}.pt"
        for _ in range(1 + trial % 2):
            child = fork.Process(target=run, args=(path,))
            child.start()
            time.sleep(rng.uniform(0.0, whole))
            os.kill(child.pid, signal.SIGKILL)
            child.join()
        reached.append(checkpoints.read(path)["step"] if path.exists() else 0)
        other = Network(seed=trial) if reached[-1] else None  # weights to begin with matter no more
        model, history = run(path, other)
        assert torch.equal(weights(model), undisturbed[0]) and history == undisturbed[1], (trial, reached[-1])
        between = sum(0 < step < OPTIONS["steps"] for step in reached)
        if trial + 1 >= trials and between >= trials // 4:
            break
    assert between >= trials // 4, reached


class Killed(BaseException):
    """Ends a run as a signal does, but at a step of one's choice."""


def stopped_at(step: int, path: Path, **options) -> None:
    class Ending(Network):
        def forward(self, q, qd, qdd):
            if self.training:
                self.calls = getattr(self, "calls", 0) + 1
                if self.calls > step:
                    raise Killed
            return super().forward(q, qd, qdd)

    Ending.__name__ = Ending.__qualname__ = "Network"
    with pytest.raises(Killed):
        run(path, Ending(), **options)


@pytest.mark.parametrize("step", [1, 3, 20, 21, 22, 23, 24, 42, 89])
def test_a_run_goes_on_from_any_step(tmp_path, undisturbed, step):
    """Also from the ends of epochs, every seven steps, where the order of the rows is drawn anew."""
    path = tmp_path / "run.pt"
    stopped_at(step, path)
    assert path.exists() == (step >= 3)
    model, history = run(path)
    assert torch.equal(weights(model), undisturbed[0]) and history == undisturbed[1]


def test_a_finished_run_is_not_done_again(tmp_path, undisturbed, monkeypatch):
    path = tmp_path / "deep" / "run.pt"
    run(path)
    monkeypatch.setattr(Run, "update", None)
    model, history = run(path, Network(seed=9))
    assert torch.equal(weights(model), undisturbed[0]) and history == undisturbed[1]


def test_patience_goes_on_where_it_was(tmp_path):
    path = tmp_path / "run.pt"
    options = {"rate": 0.3, "patience": 4, "every": 3}
    straight, expected = run(None, **options)
    assert expected.stopped_early and expected.best_step <= expected.step[-1] - 4 * 3
    stopped_at(expected.step[-1] - 4, path, **options)  # it has waited for two looks and begins to wait for the third
    model, found = run(path, **options)
    assert found == expected and torch.equal(weights(model), weights(straight))


def test_a_write_that_fails_leaves_the_old_checkpoint(tmp_path, monkeypatch):
    path = tmp_path / "run.pt"
    checkpoints.write(path, {"step": 1})

    def full(part, path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        checkpoints.write(path, {"step": 2})
    assert checkpoints.read(path)["step"] == 1 and list(tmp_path.iterdir()) == [path]


# --- checkpoints that are refused ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("written") / "run.pt"
    run(path, steps=6)
    return path


def test_damage_anywhere_is_found(tmp_path, written):
    whole, path = written.read_bytes(), tmp_path / "run.pt"
    rng = random.Random(1)
    for size in (0, 1, 100, *(rng.randrange(len(whole)) for _ in range(20)), len(whole) - 1):
        path.write_bytes(whole[:size])
        with pytest.raises(
            CheckpointError, match=r"run\.pt is damaged, or not a checkpoint of fit; remove it to start"
        ):
            run(path, steps=6)
        assert path.read_bytes() == whole[:size]
    for at in (rng.randrange(len(whole)) for _ in range(60)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        with pytest.raises(CheckpointError, match="damaged"):
            checkpoints.read(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"model": Network(9)},
            r"tensor 'layers\.0\.weight' of the model is float32 \[8, 6\] there and .* \[9, 6\]",
        ),
        ({"model": Network(dropout=0.3)}, r"the model is Network\(.*p=0\.2.* there and Network\(.*p=0\.3.* here"),
        ({"train": data(seed=2)}, r"train is \[200, 2\] torch\.float32 samples with SHA-256 \w+ there and .* here"),
        ({"train": data(201)}, r"train is \[200, 2\] .* there and \[201, 2\]"),
        ({"valid": data(50, seed=2)}, r"valid is \[50, 2\] torch\.float32 samples with SHA-256 \w+ there and"),
        ({"valid": None, "patience": None}, r"valid is \[50, 2\] .* there and None here"),
        ({"steps": 7}, "steps is 6 there and 7 here; call fit as that run did, or name another file"),
        ({"batch": 33}, "batch is 32 there and 33 here"),
        ({"rate": 0.1}, "rate is 0.01 there and 0.1 here"),
        ({"decay": 0.1}, "decay is 0.0 there and 0.1 here"),
        ({"prior": 1.0}, "prior is 0.0 there and 1.0 here"),
        ({"seed": 6}, "seed is 5 there and 6 here"),
        ({"patience": 5}, "patience is 25 there and 5 here"),
        ({"every": 4}, "every is 3 there and 4 here"),
    ],
)
def test_a_checkpoint_of_another_run_is_refused_by_name(written, options, message):
    before = written.read_bytes()
    arguments = {"model": Network(), "train": data(), "valid": data(50, seed=1), **OPTIONS, "steps": 6, **options}
    model = arguments.pop("model")
    start = weights(model).clone()
    with pytest.raises(CheckpointError, match=r"checkpoint .*run\.pt is of another run: " + message):
        fit(model, arguments.pop("train"), arguments.pop("valid"), checkpoint=written, **arguments)
    assert written.read_bytes() == before and torch.equal(weights(model), start)


ROBOT = torchdq.robots.load("two_link")


class Held(nn.Module):
    """Model that keeps what its torques depend on as attributes, and counts its calls."""

    def __init__(self, scale, learned: nn.Module | None = None):
        super().__init__()
        self.network, self.scale, self.calls = learned or Network(), scale, 0
        self.register_buffer("shift", torch.zeros(2), persistent=False)

    def forward(self, q, qd, qdd):
        self.calls += 1
        if self.calls == 3:
            self.found_late = self.calls
        return self.network(q, qd, qdd) + self.shift


def layer(robot: torchdq.Robot, **settings: float) -> nn.Module:
    return DQRNEA(robot, learn="offset", **settings)


def shifted(by: float) -> nn.Module:
    model = Held(1.0)
    model.shift += by
    return model


@pytest.mark.parametrize(
    ("there", "here", "message"),
    [
        (layer(ROBOT), layer(ROBOT, friction_width=0.5), "'friction_width' of the model is 0.01 there and 0.5 here"),
        (layer(ROBOT), layer(ROBOT.replace(gravity=1.1 * ROBOT.gravity)), "'_robot.gravity' of the model is"),
        (layer(ROBOT), layer(ROBOT.replace(com=ROBOT.com + 1e-4)), "'_robot.com' of the model is"),
        (layer(ROBOT), layer(ROBOT.replace(gravity=None)), "'_robot.gravity' of the model is"),
        (Held(1.0), Held(2.0), "'scale' of the model is 1 there and 2 here"),
        (
            Held({"a": [1, (2, "x")]}),
            Held({"a": [1, (2, "y")]}),
            r"'scale.a.1.1' of the model is 'x' there and 'y'",
        ),
        (Held(torch.ones(2)), Held(torch.tensor([1.0, 1.1])), r"'scale' of the model is \[2\] numbers"),
        (Held(np.arange(3)), Held(np.arange(4)), r"'scale' of the model is \[3\] numbers .* and \[4\] numbers"),
        (Held(math.sin), Held(math.cos), "'scale' of the model is sin there and cos here"),
        (Held(partial(torch.add, alpha=2)), Held(partial(torch.add, alpha=3)), "'scale.alpha' of the model is 2 there"),
        (Held(Namespace(a=1)), Held(Namespace(a=2)), r"'scale\.a' of the model is 1 there and 2 here"),
        (Held([Network(seed=1)]), Held([Network(seed=2)]), r"'scale.0.layers.0.weight' of the model is"),
        (Held(1.0), shifted(0.5), r"'shift' of the model is \[2\] numbers"),
    ],
    ids=lambda x: None if isinstance(x, nn.Module) else re.sub(r"\W+", "-", x),
)
def test_a_checkpoint_of_a_model_with_other_attributes_is_refused(tmp_path, there, here, message):
    """The same weights and the same name, but other constants."""
    dtype = torch.float64 if isinstance(there, DQRNEA) else torch.float32
    settings = {"train": data(dtype=dtype), "steps": 3, "checkpoint": tmp_path / "run.pt"}
    fit(copy.deepcopy(there), **settings)
    with pytest.raises(CheckpointError, match=r"run\.pt is of another run: attribute " + message):
        fit(copy.deepcopy(here), **settings)


def test_a_checkpoint_of_a_model_that_computes_otherwise_is_refused(tmp_path):
    """Attributes do not tell, but the torques do; those of the second joint are a thousand times as small."""

    class Other(Network):
        def forward(self, q, qd, qdd):
            return super().forward(q, qd, qdd) * torch.tensor([1.0, 1e-2]) * factor

    Other.__qualname__ = "Other"
    for factor in (torch.ones(2), torch.ones(2), torch.tensor([1.0, 1.01])):
        expected = contextlib.nullcontext()
        if factor[1] != 1:
            expected = pytest.raises(CheckpointError, match=r"run\.pt is of another model: .* such as the rest")
        with expected:
            fit(Other(dropout=0.0), data(), steps=3, checkpoint=tmp_path / "run.pt")


def test_attributes_that_a_run_changes_and_backends_do_not_stop_it_from_going_on(tmp_path):
    model, path = Held(1.0), tmp_path / "run.pt"
    fit(model, data(), steps=6, every=2, checkpoint=path)
    calls = model.calls
    fit(model, data(), steps=6, every=2, checkpoint=path)  # the same object, whose counter went on
    fit(Held(1.0), data(), steps=6, every=2, checkpoint=path)
    assert model.calls < 2 * calls
    fit(Held(1.0, DQRNEA(ROBOT, learn=("mass",))), data(dtype=torch.float64), steps=3, checkpoint=tmp_path / "a.pt")
    other = Held(1.0, DQRNEA(ROBOT, learn=("mass",), backend="eager"))
    fit(other, data(dtype=torch.float64), steps=3, checkpoint=tmp_path / "a.pt")


def test_text_of_attributes_is_the_same_on_other_processors():
    class Module(nn.Module):
        def __init__(self, x):
            super().__init__()
            self.x = x

    def text(x):
        return attributes(Module(x))["x"]

    a = torch.tensor([1.0, -0.0, 300.0, math.inf], dtype=torch.float64)
    assert text(a) == text(a * (1 + 1e-15) + torch.tensor([0.0, 1e-17, 0.0, 0.0], dtype=torch.float64))
    assert text(a) != text(a * (1 + 1e-6))
    assert text(0.1 + 0.2) == text(0.3) and text({"b", "a"}) == "[\"'a'\", \"'b'\"]"
    assert text(object()) == "object" and text(torch.ones(2, device="meta")) == "torch.float32 [2] without values"
    assert text(torch.ones(2, 2).to_sparse()) == text(torch.ones(2, 2))
    assert text(torch.ones(2, dtype=torch.bfloat16)) == text(torch.ones(2)) and text(np.float64(2.0)) == "2"


def test_other_files_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "run.pt"
    torch.save(Network().state_dict(), path)
    with pytest.raises(CheckpointError, match=r"run\.pt is damaged, or not a checkpoint of fit"):
        run(path)
    with monkeypatch.context() as later:
        later.setattr(checkpoints, "VERSION", 99)
        checkpoints.write(path, {})
    with pytest.raises(CheckpointError, match="has format 99, this version of torchdq reads format 2"):
        run(path)


def test_a_checkpoint_cannot_run_anything(tmp_path):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    checkpoints.write(tmp_path / "run.pt", {"step": Trap()})
    with pytest.raises(CheckpointError, match="holds more than tensors and plain values; do not use it"):
        run(tmp_path / "run.pt")
    assert not (tmp_path / "sprung").exists()


def put(path: Path, state: object) -> None:
    """Write anything as a checkpoint whose hash is right: the hash tells damage, not trust."""
    content = io.BytesIO()
    torch.save(state, content)
    put_bytes(path, content.getvalue())


def put_bytes(path: Path, content: bytes) -> None:
    path.write_bytes(content + checkpoints._digest(content))


def changed(x: object, change: Callable[[torch.Tensor], torch.Tensor]) -> object:
    """A copy in which all tensors of real numbers are changed, and all floats are NaN."""
    if isinstance(x, torch.Tensor):
        return change(x) if x.is_floating_point() else x
    if isinstance(x, dict):
        return {name: changed(value, change) for name, value in x.items()}
    if isinstance(x, list | tuple):
        return [changed(value, change) for value in x]
    return math.nan if isinstance(x, float) else x


ENTRIES = ("identity", "step", "model", "probe", "optimiser", "generator", "random", "best", "best_error", "waited")
ENTRIES += ("history",)
HISTORY = {"step": [3, 6], "train": [1.0, 1.0], "valid": [1.0, 1.0], "best_step": 6, "stopped_early": False}
UNTRUSTED = {
    **{f"{name} missing": (name, lambda state, name=name: state.pop(name)) for name in ENTRIES},
    **{f"{name} a word": (name, lambda state, name=name: state.update({name: "a"})) for name in ENTRIES},
    **{f"{name} None": (name, lambda state, name=name: state.update({name: None})) for name in ENTRIES},
    **{f"{name} a list": (name, lambda state, name=name: state.update({name: [1, 2]})) for name in ENTRIES},
    **{
        f"{name} not a number": (name, lambda state, name=name: state.update({name: changed(state[name], nans)}))
        for name in ("model", "probe", "optimiser", "best", "best_error", "history")
    },
    **{
        f"{name} of other shapes": (name, lambda state, name=name: state.update({name: changed(state[name], longer)}))
        for name in ("model", "optimiser", "best")
    },
    "a probe of other shapes": ("torques", lambda state: state.update(probe=longer(state["probe"]))),
    **{
        f"{name} of another dtype": (name, lambda state, name=name: state.update({name: changed(state[name], doubled)}))
        for name in ("model", "best")
    },
    "a weight missing": ("model", lambda state: state["model"].pop("layers.0.bias")),
    "a weight too many": ("best", lambda state: state["best"].update(more=torch.ones(2))),
    "a step below zero": ("step", lambda state: state.update(step=-1)),
    "a step after the last": ("step", lambda state: state.update(step=10**9)),
    "a step that is true": ("step", lambda state: state.update(step=True)),
    "a momentum missing": ("optimiser", lambda state: state["optimiser"]["state"].pop(0)),
    "a momentum's name": ("optimiser", lambda state: state["optimiser"]["state"][0].pop("exp_avg")),
    "a square below zero": ("optimiser", lambda state: state["optimiser"]["state"][0]["exp_avg_sq"].neg_().sub_(1)),
    "a generator of zeros": ("", lambda state: state.update(generator=torch.zeros_like(state["generator"]))),
    "a short generator": ("", lambda state: state.update(generator=state["generator"][:9])),
    "randomness of zeros": ("", lambda state: state.update(random=[torch.zeros_like(x) for x in state["random"]])),
    "no randomness": ("random", lambda state: state.update(random=[])),
    "a history of words": ("history", lambda state: state.update(history={**HISTORY, "train": ["a", "b"]})),
    "a history too short": ("history", lambda state: state.update(history={**HISTORY, "train": [1.0]})),
    "a history that runs back": ("history", lambda state: state.update(history={**HISTORY, "step": [6, 3]})),
    "a history with more": ("history", lambda state: state.update(history={**HISTORY, "more": []})),
    "waited for less than nothing": ("waited", lambda state: state.update(waited=-1)),
    "an identity of tensors": ("identity", lambda state: state["identity"].update(batch=torch.ones(2))),
    "an error below zero": ("best_error", lambda state: state.update(best_error=-1.0)),
}


def nans(x: torch.Tensor) -> torch.Tensor:
    return torch.full_like(x, math.nan)


def longer(x: torch.Tensor) -> torch.Tensor:
    return torch.cat([x.reshape(-1), x.new_ones(1)])


def doubled(x: torch.Tensor) -> torch.Tensor:
    return x.double()


@pytest.mark.parametrize("way", UNTRUSTED)
def test_a_checkpoint_that_is_not_to_be_trusted_is_refused(tmp_path, written, way):
    """Its hash is right, but it holds what `fit` never writes."""
    entry, spoil = UNTRUSTED[way]
    path, model = tmp_path / "run.pt", Network(seed=8)
    state = checkpoints.read(written)
    spoil(state)
    put(path, state)
    before, content = weights(model).clone(), path.read_bytes()
    with pytest.raises(CheckpointError, match=rf"checkpoint .*run\.pt.*{entry}.*(remove it|another)"):
        run(path, model, steps=6)
    assert torch.equal(weights(model), before) and path.read_bytes() == content and model.training


@pytest.mark.parametrize(
    "content", [b"", b"hello", b"PK\x03\x04", bytes(range(256)), pickle.dumps({"a": 1}), pickle.dumps(os.system)]
)
def test_bytes_with_the_right_hash_are_refused(tmp_path, content):
    put_bytes(tmp_path / "run.pt", content)
    with pytest.raises(CheckpointError, match=r"run\.pt (holds more than tensors|is not a checkpoint)"):
        run(tmp_path / "run.pt")


@pytest.mark.parametrize("state", [None, [1], 5, "a", {}, {"version": "1"}, {"version": torch.ones(2)}])
def test_states_without_a_version_are_refused(tmp_path, state):
    put(tmp_path / "run.pt", state)
    with pytest.raises(CheckpointError, match=r"run\.pt is not a checkpoint of fit; remove it"):
        run(tmp_path / "run.pt")


def test_settings_of_the_optimiser_are_those_of_the_call(tmp_path, undisturbed):
    """A checkpoint gives the optimiser's momenta, not its rates of decay or anything else that steers it."""
    path = tmp_path / "run.pt"
    stopped_at(20, path)
    state = checkpoints.read(path)
    state["optimiser"]["param_groups"][0].update(betas=(0.0, 0.0), weight_decay=5.0, maximize=True)
    put(path, state)
    model, history = run(path)
    assert torch.equal(weights(model), undisturbed[0]) and history == undisturbed[1]


def test_a_folder_is_no_checkpoint(tmp_path):
    with pytest.raises(ArgumentError, match="checkpoint must be a file, found the folder"):
        run(tmp_path)
    with pytest.raises(ArgumentError, match="checkpoint must be a path, found int"):
        run(5)


# --- several processes -----------------------------------------------------------------------------------------------

SHARED = """
import os
import sys
from pathlib import Path
import torch
sys.path.insert(0, {tests!r})
import torchdq
from learning.training.test_fit import Network, data, weights
from torchdq.learning import fit

out, path = Path(sys.argv[1]), Path(sys.argv[2])
class Held(Network):
    def prior(self):
        return sum(p.square().sum() for p in self.parameters())
dist_rank = int(os.environ["RANK"])
model = Held(dropout=0.0, seed=3 + dist_rank)  # the other process begins elsewhere; the leader's weights count
with torchdq.backend("eager"):
    train, valid = data(41, dtype=torch.float64), data(21, seed=1, dtype=torch.float64)
options = dict(batch=10, rate=0.01, every=5, prior=0.01, epochs=6, checkpoint=path)
history = fit(model.double(), train, valid, **options)
torch.save((weights(model), history.train, history.valid), out / f"rank{{dist_rank}}.pt")
"""


def test_two_processes_do_what_one_does(tmp_path):
    """41 rows in batches of 10 leave a last batch of one row, of which one process has no share."""

    class Held(Network):
        def prior(self):
            return sum(p.square().sum() for p in self.parameters())

    Held.__qualname__ = "Held"
    alone = Held(dropout=0.0).double()
    train, valid = data(41, dtype=torch.float64), data(21, seed=1, dtype=torch.float64)
    expected = fit(alone, train, valid, batch=10, rate=0.01, every=5, prior=0.01, epochs=6)

    script = tmp_path / "shared.py"
    script.write_text(SHARED.format(tests=str(ROOT / "tests")))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", str(script)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    call = [*command, str(tmp_path), str(tmp_path / "run.pt")]
    started = subprocess.run(call, env=environment, capture_output=True, text=True, timeout=300)
    assert started.returncode == 0, started.stderr
    ranks = [torch.load(tmp_path / f"rank{rank}.pt") for rank in (0, 1)]
    assert torch.equal(ranks[0][0], ranks[1][0])
    torch.testing.assert_close(ranks[0][0], weights(alone), rtol=1e-10, atol=1e-12)
    for found in ranks:
        assert found[1] == pytest.approx(expected.train, rel=1e-10)
        assert found[2] == pytest.approx(expected.valid, rel=1e-10)
    # a single process takes up what the two have written
    again = Held(dropout=0.0, seed=8).double()
    options = {"batch": 10, "rate": 0.01, "every": 5, "prior": 0.01, "epochs": 6}
    assert fit(again, train, valid, checkpoint=tmp_path / "run.pt", **options).valid == ranks[0][2]
    assert torch.equal(weights(again), ranks[0][0])


# --- what is shown ---------------------------------------------------------------------------------------------------


def test_the_bar_shows_steps_and_errors(capsys):
    pytest.importorskip("rich")
    quiet, history = run(None)
    assert capsys.readouterr().out == ""
    shown, _ = run(None, progress=True)
    printed = capsys.readouterr().out
    assert "100%" in printed and f"train {history.train[-1]:.3g}  valid {history.valid[-1]:.3g}" in printed
    assert torch.equal(weights(quiet), weights(shown))


def test_curves_go_to_tensorboard_and_a_resumed_run_does_not_double_them(tmp_path, monkeypatch):
    calls = []

    class SummaryWriter:
        def __init__(self, folder, purge_step):
            calls.append((folder, purge_step))

        def add_scalar(self, name, value, step):
            calls.append((name, value, step))

        def flush(self):
            pass

        def close(self):
            calls.append("closed")

    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", types.SimpleNamespace(SummaryWriter=SummaryWriter))
    stopped_at(4, tmp_path / "run.pt")
    _, history = run(tmp_path / "run.pt", tensorboard=tmp_path / "curves")
    assert calls[0] == (str(tmp_path / "curves"), 4) and calls[-1] == "closed"
    for name, values in (("error/train", history.train), ("error/valid", history.valid)):
        assert [call[1:] for call in calls[1:-1] if call[0] == name] == list(zip(values, history.step, strict=True))[1:]
    rates = [call[1] for call in calls[1:-1] if call[0] == "rate"]
    assert rates == [0.01 / 2 * (1 + math.cos(math.pi * (step - 1) / 90)) for step in range(6, 91, 3)]


class Slow(Network):
    """Takes 20 ms a step; ends as by Ctrl-C before a step of one's choice."""

    def __init__(self, last: int):
        super().__init__()
        self.left = last

    def forward(self, q, qd, qdd):
        if self.training:
            time.sleep(0.02)
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt  # as Ctrl-C does
        return super().forward(q, qd, qdd)


Slow.__name__ = Slow.__qualname__ = "Network"


def test_a_long_run_says_how_far_it_is_and_an_interrupted_one_goes_on(tmp_path, undisturbed, monkeypatch, capfd):
    monkeypatch.setattr(notice, "FIRST", 0.05)
    monkeypatch.setattr(notice, "EVERY", 0.05)
    model, path = Slow(40), tmp_path / "run.pt"
    with pytest.raises(KeyboardInterrupt):
        run(path, model)
    told = capfd.readouterr().err
    assert re.search(r"torchdq: fitting, step \d+ of 90, train \S+  valid \S+, \d+ s", told)
    assert model.training and checkpoints.read(path)["step"] == 39
    time.sleep(0.1)
    assert capfd.readouterr().err == ""  # it has ended
    model, history = run(path)
    assert torch.equal(weights(model), undisturbed[0]) and history == undisturbed[1]


def test_a_run_can_be_silent_and_a_quick_one_is(monkeypatch, capfd):
    monkeypatch.setattr(notice, "FIRST", 60.0)
    run(None, steps=3)
    monkeypatch.setattr(notice, "FIRST", 0.0)
    fit(Slow(9), data(), steps=3, batch=200, progress=False)
    assert capfd.readouterr().err == ""
    with pytest.raises(ArgumentError, match="progress must be one of None, True, False, found 'bar'"):
        run(None, progress="bar")


@pytest.mark.parametrize(
    ("module", "options", "message"),
    [
        ("torch.utils.tensorboard", {"tensorboard": "curves"}, "needs tensorboard, .*; pip install tensorboard"),
        ("rich.progress", {"progress": True}, "needs rich, .*; pip install rich"),
    ],
)
def test_missing_packages_are_named(monkeypatch, module, options, message):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingLibraryError, match=message):
        run(None, **options)
