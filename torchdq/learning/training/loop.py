"""Training loop: AdamW on batches of rows, in a new order every epoch, its rate falling to zero along half a cosine."""

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain, islice
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchdq.base.tables import table
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.learning.training.validation_gain import ValidationGain

LOOK = 100  # steps between two evaluations
ROWS = 4096  # rows that are evaluated at a time
SHOWN = 10  # rows of a history that are printed


class TrainingError(TorchdqError, ArithmeticError):
    """Loss or gradient that is not finite."""


class Training(NamedTuple):
    """Settings of a training."""

    steps: int
    batch: int  # rows per step
    rate: float  # learning rate of the first step
    decay: float  # weight decay
    seed: int  # for the order of the rows, and dropout


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
        shown = sorted({round(k * (len(self.step) - 1) / (SHOWN - 1)) for k in range(SHOWN)})
        errors = {"train": self.train, **({"valid": self.valid} if self.valid else {})}
        rows = [(str(self.step[k]), *(f"{error[k]:.3g}" for error in errors.values())) for k in shown]
        gain = "" if self.residual is None else f"\n\n{self.residual}"
        return f"{self.step[-1]} steps, weights of step {self.best_step}\n\n{table(('step', *errors), rows)}{gain}"


@contextmanager
def seeded(device: torch.device, seed: int) -> Iterator[None]:
    """Torch's own generators with a seed, and gradients; the caller's states come back afterwards."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []), torch.enable_grad():
        torch.manual_seed(seed)
        yield


def descend(
    model: nn.Module,
    torques: Callable[..., Tensor],
    train: Sequence[Tensor],
    valid: Sequence[Tensor] | None,
    variance: Tensor,
    training: Training,
    say: Callable[[str], None],
    penalty: Callable[[], Tensor] | None = None,
) -> History:
    """History of the parameters of a model, moved along the gradient of the error of `torques` and the penalty.

    Data are what `torques` takes, and the torques [rows, n] that it should return. The model has the weights of the
    least error on `valid` in the end, if there are such rows.
    """
    parameters = [p for p in model.parameters() if p.requires_grad]
    adamw = torch.optim.AdamW(parameters, lr=training.rate, weight_decay=training.decay)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adamw, training.steps)
    history, losses, best = History(), list[float](), None
    model.train()
    epochs = (torch.randperm(len(train[-1])).split(training.batch) for _ in range(training.steps))
    for step, rows in enumerate(islice(chain.from_iterable(epochs), training.steps), 1):
        say(f"step {step} of {training.steps}")
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
        if step % LOOK and step < training.steps:
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


def by_parts(function: Callable[..., Tensor], *inputs: Tensor) -> Tensor:
    """Values of a function of rows, so many at a time."""
    return torch.cat([function(*part) for part in zip(*(x.split(ROWS) for x in inputs), strict=True)])


def _error(torques: Callable[..., Tensor], rows: Sequence[Tensor], variance: Tensor) -> Tensor:
    """Mean squared error over the variance of each joint."""
    *inputs, target = rows
    predicted = by_parts(torques, *inputs)
    if predicted.shape != target.shape:
        raise ArgumentError(f"model must return torques {list(target.shape)}, found {list(predicted.shape)}")
    return ((predicted - target).square() / variance).mean()


def _finite(x: Tensor, what: str, step: int) -> float:
    """Number, after checking that it is finite."""
    value = float(x.detach())
    if not math.isfinite(value):
        raise TrainingError(f"step {step}: {what} is {value:g}; a smaller rate may help, and so may float64")
    return value
