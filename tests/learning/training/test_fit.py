"""Training finds known parameters, and survives being killed at any moment.

A killed run that is called again must end with the same bits as one that was not. The trials fork this process, which
has torch loaded, kill the child at a random moment and call the same run again.
"""

import math
import multiprocessing
import os
import pickle
import random
import re
import signal
import time
from pathlib import Path

import helpers
import pytest
import torch
from messages import refused
from torch import nn

import torchdq
import torchdq.learning.training.fit as fitting
from torchdq.base import progress
from torchdq.errors import ArgumentError
from torchdq.learning import CheckpointError, History, Samples, TrainingError, fit
from torchdq.learning.training.loop import Optimiser
from torchdq.nn import DQRNEA

one_thread = helpers.one_thread  # a forked child cannot use the threads of its parent


@pytest.fixture(autouse=True)
def evaluated_every_epoch(monkeypatch):
    monkeypatch.setattr(fitting, "LOOK", 1)


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
    fit(Watched(), train, steps=12, batch=16)
    assert [len(x) for x in seen] == [16, 16, 16, 2] * 3
    epochs = [torch.cat(seen[i : i + 4]) for i in (0, 4, 8)]
    for epoch in epochs:
        torch.testing.assert_close(epoch.sort().values, train.q[:, 0].sort().values, rtol=0, atol=0)
    assert not torch.equal(epochs[0], epochs[1]) and not torch.equal(epochs[1], epochs[2])


def test_evaluations_are_a_hundred_steps_apart_at_least(monkeypatch):
    monkeypatch.undo()
    assert fit(Network(), data(), steps=250, batch=50).step == [100, 200, 250]
    assert fit(Network(), data(), steps=450, batch=1).step == [200, 400, 450]


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
    history = fit(model, train, valid, steps=300, batch=20, rate=0.02)
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
    "options",
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
    ],
)
def test_arguments_are_checked(options):
    arguments = {"model": Network(), "train": data(), "steps": 3, **options}
    with refused(ArgumentError):
        fit(arguments.pop("model"), arguments.pop("train"), **arguments)


@pytest.mark.parametrize("change", [lambda tau: tau[..., :1], lambda tau: tau.detach()])
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


@pytest.mark.parametrize("gradient", [False, True])
def test_numbers_that_are_not_finite_end_the_run_and_spare_the_checkpoint(tmp_path, gradient):
    path = tmp_path / "run.pt"
    model = Breaking(18, gradient)
    with refused(TrainingError):
        fit(model, data(), steps=50, batch=32, checkpoint=path)
    assert torch.load(path)["optimiser"]["step"] == 14  # two epochs of seven batches
    assert weights(model).isfinite().all() and all(p.grad is None for p in model.parameters())


def test_a_validation_error_that_is_not_finite_ends_the_run(tmp_path):
    huge = data()._replace(tau=torch.full((200, 2), 1e30))
    with refused(TrainingError):
        fit(Network(), data(), huge, steps=10, batch=100, checkpoint=tmp_path / "run.pt")
    assert not (tmp_path / "run.pt").exists()


# --- checkpoints -----------------------------------------------------------------------------------------------------

OPTIONS = {"steps": 90, "batch": 32, "rate": 0.01, "seed": 5}


def run(path: Path | None, model: nn.Module | None = None, **options) -> tuple[nn.Module, History]:
    """The run that is killed; 200 rows make 7 batches, and the last epoch is not whole."""
    model = model or Network()
    return model, fit(model, data(), data(50, seed=1), checkpoint=path, **{**OPTIONS, **options})


@pytest.fixture(scope="module")
def undisturbed() -> tuple[torch.Tensor, History]:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(fitting, "LOOK", 1)
        model, history = run(None)
    return weights(model), history


@pytest.mark.parametrize("trials", helpers.thinned((8, 30), (8,)))
def test_a_killed_run_loses_nothing(tmp_path, monkeypatch, undisturbed, trials):
    """Trials that are killed once or twice each at random moments, from before the first step to after the last."""
    monkeypatch.setattr(fitting, "LOOK", 1)  # children write a checkpoint after every epoch
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
        reached.append(torch.load(path)["optimiser"]["step"] if path.exists() else 0)
        other = Network(seed=trial) if reached[-1] else None  # weights to begin with matter no more
        model, history = run(path, other)
        assert torch.equal(weights(model), undisturbed[0]) and history == undisturbed[1], (trial, reached[-1])
        between = sum(0 < step < OPTIONS["steps"] for step in reached)
        if trial + 1 >= trials and between >= trials // 4:
            break
    assert between >= trials // 4, reached


class Interrupted(Network):
    """Takes 20 ms a step; ends as by Ctrl-C after some of them."""

    def __init__(self, steps: int):
        super().__init__()
        self.left = steps

    def forward(self, q, qd, qdd):
        if self.training:
            time.sleep(0.02)
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
        return super().forward(q, qd, qdd)


Interrupted.__name__ = Interrupted.__qualname__ = "Network"


@pytest.mark.parametrize("step", [1, 7, 8, 42])
def test_an_interrupted_run_goes_on_to_the_same_bits(tmp_path, undisturbed, step):
    path, model = tmp_path / "deep" / "run.pt", Interrupted(step)
    with pytest.raises(KeyboardInterrupt):
        run(path, model)
    assert model.training and path.exists() == (step >= 7)
    model, history = run(path)
    assert torch.equal(weights(model), undisturbed[0]) and history == undisturbed[1]


def test_a_finished_run_is_not_done_again(tmp_path, undisturbed, monkeypatch):
    run(tmp_path / "run.pt")
    monkeypatch.setattr(Optimiser, "epoch", None)
    model, history = run(tmp_path / "run.pt", Network(seed=9))
    assert torch.equal(weights(model), undisturbed[0]) and history == undisturbed[1]


# --- checkpoints that are refused ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("written") / "run.pt"
    run(path, steps=6)
    return path


@pytest.mark.parametrize(
    "options",
    [
        *({"model": x} for x in (Network(9), Network(dropout=0.3))),
        *({"train": x} for x in (data(seed=2), data(201))),
        *({"valid": x} for x in (data(50, seed=2), None)),
        *(
            {name: x}
            for name, x in (("steps", 7), ("batch", 33), ("rate", 0.1), ("decay", 0.1), ("prior", 1.0), ("seed", 6))
        ),
    ],
)
def test_a_checkpoint_of_another_run_is_refused_by_name(written, options):
    before = written.read_bytes()
    arguments = {"model": Network(), "train": data(), "valid": data(50, seed=1), **OPTIONS, "steps": 6, **options}
    model = arguments.pop("model")
    start = weights(model).clone()
    with refused(CheckpointError):
        fit(model, arguments.pop("train"), arguments.pop("valid"), checkpoint=written, **arguments)
    assert written.read_bytes() == before and torch.equal(weights(model), start)


@pytest.mark.parametrize("change", [{"gravity": (0.0, 0.0, -1.0)}, {"com": 0.1}, {"damping": 3.0}])
def test_a_checkpoint_of_a_model_of_another_robot_is_refused(tmp_path, change):
    robot, settings = torchdq.robots.load("two_link"), {"steps": 3, "checkpoint": tmp_path / "run.pt"}
    name, value = next(iter(change.items()))
    other = robot.replace(**{name: torch.as_tensor(value, dtype=torch.float64).expand_as(getattr(robot, name)).clone()})
    train = data(dtype=torch.float64)
    fit(DQRNEA(robot, learn="offset"), train, **settings)
    fit(DQRNEA(robot, learn="offset", backend="eager"), train, **settings)  # another backend is no other run
    with refused(CheckpointError):
        fit(DQRNEA(other, learn="offset"), train, **settings)


def test_a_checkpoint_that_does_not_fit_the_model_leaves_it_alone(tmp_path, written):
    state, path, model = torch.load(written), tmp_path / "run.pt", Network(seed=8)
    del state["model"]["layers.3.bias"]
    torch.save(state, path)
    before = weights(model).clone()
    with refused(CheckpointError):
        run(path, model, steps=6)
    assert torch.equal(weights(model), before) and model.training


def test_files_that_are_no_checkpoints_are_refused(tmp_path, written):
    class Trap:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "sprung",))

    path, whole = tmp_path / "run.pt", written.read_bytes()
    contents = [b"", b"hello", whole[:100], whole[: len(whole) // 2], whole[:-1], pickle.dumps({"identity": {}})]
    for state in (Network().state_dict(), [1], {"identity": 5}, {"identity": {}, "step": Trap()}):
        torch.save(state, path)
        contents.append(path.read_bytes())
    for content in contents:
        path.write_bytes(content)
        with refused(CheckpointError):
            run(path)
        assert path.read_bytes() == content
    assert not (tmp_path / "sprung").exists()


# --- what is shown ---------------------------------------------------------------------------------------------------


def test_a_long_run_says_how_far_it_is_and_a_quick_one_is_silent(monkeypatch, capfd):
    monkeypatch.setattr(progress, "FIRST", 60.0)
    run(None, steps=3)
    assert capfd.readouterr().err == ""
    monkeypatch.setattr(progress, "FIRST", 0.05)
    monkeypatch.setattr(progress, "EVERY", 0.05)
    with pytest.raises(KeyboardInterrupt):
        run(None, Interrupted(40))
    assert re.search(r"torchdq: fitting, train \S+, valid \S+, step \d+ of 90, \d+ s", capfd.readouterr().err)
    time.sleep(0.1)
    assert capfd.readouterr().err == ""  # it has ended
