"""Fitting a model of joint torques to samples by gradients: a plain loop, beside which any trainer of torch will do."""

import copy
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import chain, islice
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchdq.base.checks import require_count, require_number
from torchdq.base.progress import Progress
from torchdq.base.tables import table
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.layers.residual import ResidualDynamics
from torchdq.learning.evaluation.blocks import MotionRows, blocks, regions
from torchdq.learning.evaluation.diagnostics import diagnose
from torchdq.learning.evaluation.statistics import COVERED, correlation_times
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.samples import Samples, of_motions, torque_variance, validated
from torchdq.nn import ComputedTorque, ForwardDynamics, InverseDynamics
from torchdq.robot import Robot
from torchdq.robot.model import batches

LOOK = 100  # steps between two entries of a history
ROWS = 4096  # rows that are evaluated at a time
GROUPS = 5  # groups of blocks, each held out from one copy of a network
CLEAR = 2.0  # standard errors that the squared error must fall by on held-out rows, for a network to be kept
LEAST = 2  # fewest independent rows of a block, on average
Rows = Sequence[Tensor]  # what a function of torques takes, and the torques [rows, n] that it should return


class _Settings(NamedTuple):
    variance: Tensor  # [n] of the torques, in whose units errors count
    steps: int
    batch: int  # rows per step
    rate: float  # learning rate of the first step
    decay: float  # weight decay
    seed: int


class ValidationGain(NamedTuple):
    """Gain of a residual on held-out rows; errors are root mean squares in units of the torque's spread, [n]."""

    joints: tuple[str, ...]
    without: Tensor  # [n] error of the model alone
    error: Tensor  # [n] error with the residual, at its weight
    weight: Tensor  # [n] from 0 to 1
    gains: Tensor  # [n] decrease of the squared error, over blocks or regions, the smaller; in units of the variance
    standard_errors: Tensor  # [n] standard errors of these gains; infinite if there are fewer than two blocks

    def __str__(self) -> str:
        rows = [
            (name, f"{a:.3f}", f"{b:.3f}", f"{g:.2g} +- {e:.1g}", f"{w:.2f}")
            for name, a, b, w, g, e in zip(self.joints, *(x.tolist() for x in self[1:]), strict=True)
        ]
        heads = ("joint", "without", "with", "decrease of squares", "weight")
        return f"residual on held-out rows\n\n{table(heads, rows)}"


class HeldOut(NamedTuple):
    """Rows that a network was not trained on, in float64."""

    torque: Tensor  # [rows, n] of the network, with weight one [N m or N]
    gate: Tensor  # [rows, n]
    residual: Tensor  # [rows, n] measured torque less the model's [N m or N]


class TrainingError(TorchdqError, ArithmeticError):
    """Loss or gradient that is not finite."""


@dataclass
class History:
    """Course of a training, with an entry for every 100 steps."""

    step: list[int] = field(default_factory=list)  # steps done
    # error on the batches since the last entry: mean over joints of squared error / variance of the torque
    train: list[float] = field(default_factory=list)
    valid: list[float] = field(default_factory=list)  # error on the validation data; empty without such data
    residual: ValidationGain | None = None  # what a residual network gains on held-out rows

    @property
    def best_step(self) -> int:
        """Step of the weights that the model has in the end: of the least `valid`, or the last one."""
        return self.step[self.valid.index(min(self.valid)) if self.valid else -1]

    def __str__(self) -> str:
        columns = {"step": self.step, "train": self.train, **({"valid": self.valid} if self.valid else {})}
        rows = [(str(step), *(f"{x:.3g}" for x in errors)) for step, *errors in zip(*columns.values(), strict=True)]
        gain = "" if self.residual is None else f"\n\n{self.residual}"
        return f"{self.step[-1]} steps, weights of step {self.best_step}\n\n{table([*columns], rows)}{gain}"


def fit(
    model: nn.Module,
    train: Samples | Sequence[Samples],
    valid: Samples | None = None,
    *,
    steps: int,
    batch: int = 256,
    rate: float = 1e-3,
    decay: float = 0.0,
    prior: float = 0.0,
    seed: int = 0,
) -> History:
    """History of a fit of a model's parameters, which are changed in place.

    The loss is the mean over joints of squared torque error / variance of the joint's torque in `train`, plus
    `prior` * `model.prior()` if the model has a prior. AdamW, its rate falling to zero along half a cosine; every epoch
    goes through all rows in a new order. With `valid`, the model gets the weights of the least error on it, of those
    after every 100 steps.

    Of a `ResidualDynamics` only the network is trained: fit the physics first. The network is then validated on blocks
    of `valid`; or, by copies that are trained without them, on blocks of `train`, and on regions of the states where
    there are fewer than three motions. A joint keeps it only if its squared error falls there by more than two standard
    errors, on rows as informative as two independent ones for each block. `History.residual` holds the gains.

    Args:
        model: called as model(q, qd, qdd), returns tau [N, n] [N m]; lies on the device to compute on.
        train: samples to fit, [N, n], or one for each motion. Their order matters to a `ResidualDynamics` only: it is
            that of time, and contiguous blocks are held out, or whole motions if there are three.
        valid: samples of another motion to choose by.
        steps: number of batches to train on.
        batch: rows per step.
        rate: first learning rate.
        decay: weight decay of AdamW; it pulls parameters to zero, which suits networks, not masses.
        prior: weight of `model.prior()`.
        seed: seed of the order of the rows, and of torch's generators while the model runs.
    Raises:
        ArgumentError: an argument has the wrong shape or value, or the model has nothing to learn.
        TrainingError: the loss or a gradient is not finite.
    Warns:
        LogWarning: the robot in the model does not explain the samples, or a network does not help at some joints.

    >>> import torchdq
    >>> from torchdq.nn import InverseDynamics
    >>> robot = torchdq.robots.load("two_link")
    >>> q, qd, qdd = torch.randn(
    ...     3, 64, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    ... )
    >>> train = Samples(q, qd, qdd, torchdq.inverse_dynamics(robot, q, qd, qdd))
    >>> model = InverseDynamics(robot.replace(mass=1.2 * robot.mass), learn=("mass",))
    >>> history = fit(model, train, steps=100, batch=32, rate=0.02)
    >>> bool((model.robot.mass / robot.mass - 1).abs().max() < 0.01)
    True
    """
    device = _device_of(model)
    train, lengths = of_motions("train", train)
    valid = None if valid is None else validated("valid", valid)
    if valid is not None and valid.q.shape[1] != train.q.shape[1]:
        raise ArgumentError(f"valid must have the {train.q.shape[1]} joints of train, found {valid.q.shape[1]}")
    for name, count, least in (("steps", steps, 1), ("batch", batch, 1), ("seed", seed, 0)):
        require_count(name, count, least=least)
    require_number("rate", rate, positive=True)
    for name, weight in {"decay": decay, "prior": prior}.items():
        require_number(name, weight, least=0)
    train, valid = train.to(device), None if valid is None else valid.to(device)
    was_training, settings = model.training, _Settings(torque_variance(train.tau), steps, batch, rate, decay, seed)
    try:
        with _seeded(device, seed), Progress("fitting") as progress:
            _warn_of(model, train)
            if isinstance(model, ResidualDynamics):
                return _fit_network(model, train, lengths, valid, settings, progress)
            weigh = getattr(model, "prior", None) if prior else None
            penalty = None if weigh is None else lambda: prior * weigh()
            return _descend(model, model, train, valid, settings, progress.at, penalty)
    finally:
        model.train(was_training)


def _device_of(model: nn.Module) -> torch.device:
    """Device of the parameters to fit; raises unless the model has some, and may return torques."""
    if not isinstance(model, nn.Module):
        cure = '; torchdq.InverseDynamics(robot, learn=("mass",)) is one' if isinstance(model, Robot) else ""
        raise ArgumentError(f"model must be a torch module of torques, found {type(model).__name__}{cure}")
    kind = parametrize.type_before_parametrizations(model).__name__
    if isinstance(model, ForwardDynamics | ComputedTorque):
        raise ArgumentError(
            f"model must return the torques of motions (q, qd, qdd), found a {kind}; fit an InverseDynamics or a "
            f"ResidualDynamics, and make the {kind} of its `robot`"
        )
    trained = model.network if isinstance(model, ResidualDynamics) else model
    if not (parameters := [p for p in trained.parameters() if p.requires_grad]):
        raise ArgumentError("model has no parameters to fit; name tensors of the robot in its learn=(...)")
    return parameters[0].device


@torch.no_grad()
def _warn_of(model: nn.Module, train: Samples) -> None:
    """Warn of samples that the robot in a model, if there is one, does not explain."""
    rigid = next((part for part in model.modules() if isinstance(part, InverseDynamics)), None)
    if rigid is None or any(batches(rigid.robot).values()) or rigid.robot.n != train.q.shape[1]:
        return
    model.eval()
    if findings := diagnose(rigid.robot, rigid, train, rigid.sign_width):
        warnings.warn(LogWarning(*findings), stacklevel=4)  # no_grad is a level, too


@contextmanager
def _seeded(device: torch.device, seed: int) -> Iterator[None]:
    """Torch's own generators with a seed, and gradients; the caller's states come back afterwards."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []), torch.enable_grad():
        torch.manual_seed(seed)
        yield


def _descend(
    model: nn.Module,
    torques: Callable[..., Tensor],
    train: Rows,
    valid: Rows | None,
    settings: _Settings,
    say: Callable[[str], None],
    penalty: Callable[[], Tensor] | None = None,
) -> History:
    """History of the parameters of a model, moved along the gradient of the error of `torques` and the penalty."""
    variance, steps, batch, rate, decay, _ = settings
    parameters = [p for p in model.parameters() if p.requires_grad]
    adamw = torch.optim.AdamW(parameters, lr=rate, weight_decay=decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adamw, steps)
    history, losses, best = History(), list[float](), None
    model.train()
    epochs = (torch.randperm(len(train[-1])).split(batch) for _ in range(steps))
    for step, rows in enumerate(islice(chain.from_iterable(epochs), steps), 1):
        say(f"step {step} of {steps}")
        error = _error(torques, [x[rows.to(x.device)] for x in train], variance)
        if not error.requires_grad:
            raise ArgumentError("the torques of the model do not depend on its parameters; nothing can be fitted")
        (error if penalty is None else error + penalty()).backward()
        losses.append(_finite(error, "the error", step))
        gradients = [p.grad for p in parameters if p.grad is not None]
        _finite(nn.utils.get_total_norm(gradients), "the norm of the gradient", step)
        adamw.step()
        adamw.zero_grad()
        schedule.step()
        if step % LOOK and step < steps:
            continue
        history.step.append(step)
        history.train.append(sum(losses) / len(losses))
        losses = []
        if valid is not None:
            model.eval()
            with torch.no_grad():
                history.valid.append(_finite(_error(torques, valid, variance), "the error on valid", step))
            model.train()
            if history.valid[-1] == min(history.valid):
                best = copy.deepcopy(model.state_dict())
    if best is not None:
        model.load_state_dict(best)
    return history


def _by_parts(function: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
    """Values of a function of rows, so many at a time."""
    return torch.cat([function(*part) for part in zip(*(x.split(ROWS) for x in inputs), strict=True)])


def _error(torques: Callable[..., Tensor], rows: Rows, variance: Tensor) -> Tensor:
    """Mean squared error over the variance of each joint."""
    *inputs, target = rows
    predicted = _by_parts(torques, *inputs)
    if predicted.shape != target.shape:
        raise ArgumentError(f"model must return torques {list(target.shape)}, found {list(predicted.shape)}")
    return ((predicted - target).square() / variance).mean()


def _finite(x: Tensor, what: str, step: int) -> float:
    """Number, after checking that it is finite."""
    value = float(x.detach())
    if not math.isfinite(value):
        raise TrainingError(f"step {step}: {what} is {value:g}; a smaller rate may help, and so may float64")
    return value


# --- residual networks ---


def _fit_network(
    model: ResidualDynamics,
    train: Samples,
    lengths: tuple[int, ...],
    valid: Samples | None,
    settings: _Settings,
    progress: Progress,
) -> History:
    """History of the network of a model on the residuals of its physics, with its gain on held-out rows."""
    model.standardise(*train)
    rows, unseen = _residuals(model, train), None if valid is None else _residuals(model, valid)
    settings = settings._replace(variance=settings.variance.to(rows[1]))
    history = _descend(model.network, model.ungated, rows, unseen, settings, progress.at)
    q, qd, qdd, tau = (x.double().cpu() for x in valid or train)
    motions = MotionRows(q, qd, qdd, (len(q),) if valid else lengths, tau)
    parts = blocks(motions)
    if unseen is not None:
        held_out = _predicted(model, unseen, [part.rows for part in parts])
    else:
        groups = [group for k in range(GROUPS) if (group := parts[k::GROUPS])]
        folds: list[tuple[list[Any], list[Any]]] = [  # rows to predict, and further ones that are not trained on
            ([x.rows for x in group], [margin for x in group for margin in x.margins]) for group in groups
        ]
        if parts and len(lengths) < 3:
            folds += [([half], []) for pair in regions(motions) for half in pair]
        held_out = []
        for k, (some, margins) in enumerate(folds):
            say = progress.within(f"copy {k + 1} of {len(folds)} for held-out rows")
            with _seeded(rows[0].device, settings.seed + k):
                held_out += _predicted(_without(model, rows, [*some, *margins], settings, say), rows, some)
    gain = validation_gain(model, held_out[: len(parts)], held_out[len(parts) :], torque_variance(train.tau).double())
    if poor := [name for name, weight in zip(gain.joints, gain.weight.tolist(), strict=True) if not weight]:
        reason = "on held-out rows the squared error does not fall by more than two standard errors, or the rows are"
        cure = "too few to know; record more and other motions, or go without a network there"
        text = f"the residual network has no weight at {', '.join(poor)}: {reason} {cure}"
        warnings.warn(text, LogWarning, stacklevel=3)
    return replace(history, residual=gain)


def _without(
    model: ResidualDynamics, rows: Rows, parts: Sequence[Any], settings: _Settings, say: Callable[[str], None]
) -> ResidualDynamics:
    """Copy of a model around the same physics, whose network has new weights and is trained without some rows."""
    used = torch.ones(len(rows[0]), dtype=torch.bool, device=rows[0].device)
    for part in parts:
        used[part] = False
    copied = copy.deepcopy(model, {id(model.model): model.model})
    for layer in copied.network.modules():
        if callable(reset := getattr(layer, "reset_parameters", None)):
            reset()
        elif any(True for _ in layer.parameters(recurse=False)):
            expected = "reset_parameters() in every layer, to train copies of it without the held-out rows"
            raise ArgumentError(f"network must have {expected}, found {type(layer).__name__}; or give valid")
    some = [x[used] for x in rows]
    _descend(copied.network, copied.ungated, some, None, settings, say)
    copied.cover(some[0])
    return copied


@torch.no_grad()
def _predicted(model: ResidualDynamics, rows: Rows, parts: Sequence[Any]) -> list[HeldOut]:
    """Torques of a network for parts of the rows."""
    model.network.eval()
    x, residual = rows
    torque, gate = (_by_parts(f, x).double().expand(residual.shape) for f in (model.ungated, model.gate))
    return [HeldOut(gate[k] * torque[k], gate[k], residual[k].double()) for k in parts]


@torch.no_grad()
def _residuals(model: ResidualDynamics, samples: Samples) -> Rows:
    """Features of the network, and torques that the model leaves, in its dtype."""
    q, qd, qdd, tau = samples
    x = model.features(q, qd)
    return x, (tau - _by_parts(model.model, q, qd, qdd)).to(x)


@torch.no_grad()
def validation_gain(
    model: ResidualDynamics, blocks: Sequence[HeldOut], regions: Sequence[HeldOut], variance: Tensor
) -> ValidationGain:
    """Gain of the residual on blocks of the motions and regions of the states, for torques of a variance [n].

    It sets the weights of the joints, from 0 to 1, to those that are best on these rows, or to zero, and the remaining
    errors. Blocks and regions count separately: blocks of a motion that repeats itself say nothing about others. Blocks
    that are short resemble their neighbours: a network that was trained on those shows nothing about other times.
    """
    joints, none = tuple(model.robot.joint_names), torch.zeros_like(variance)
    model.weight.zero_()
    model.remaining.fill_(1.0)
    if len(blocks) < 2:
        return ValidationGain(joints, none + math.nan, none + math.nan, none, none, none + math.inf)
    y, _, r = (torch.cat(x) for x in zip(*blocks, *regions, strict=True))
    weight = ((y * r).sum(0) / y.square().sum(0).clamp_min(1e-300)).clamp(0.0, 1.0)
    means, errors = none.new_empty(2, 1 + bool(regions), len(none))  # of blocks, and of regions
    for k, parts in enumerate(filter(None, (blocks, regions))):
        falls = torch.stack([(weight * x.torque * (2 * x.residual - weight * x.torque)).mean(0) for x in parts])
        means[k], errors[k] = falls.mean(0) / variance, falls.std(0) / len(parts) ** 0.5 / variance

    y, gate, r = (torch.cat(x) for x in zip(*blocks, strict=True))
    independent = len(r) / correlation_times(r - weight * y, [len(x.residual) for x in blocks]).to(r)
    weight = weight * ((means > CLEAR * errors).all(0) & (independent >= LEAST * len(blocks)))
    left, inside = r - weight * y, gate >= 1
    rows = inside | ~inside.any(0)
    width, alone = (x.abs().where(rows, torch.nan).nanquantile(COVERED, 0) for x in (left, r))
    model.weight.copy_(weight)
    model.remaining.copy_((width / alone.clamp_min(1e-300)).clamp(max=1.0))
    without, error = ((x.square().mean(0) / variance).sqrt() for x in (r, left))
    poorest = (means - CLEAR * errors).argmin(0, keepdim=True)
    gains, errors = (x.gather(0, poorest)[0] for x in (means, errors))
    return ValidationGain(joints, without, error, weight, gains, errors)
