"""Fitting a model of joint torques to samples: a training loop that goes on where it was interrupted.

    history = fit(model, train, valid, steps=2000, checkpoint="run.pt")

A run that is killed at any moment and called again with the same arguments continues from its last checkpoint; on a CPU
the weights come out the same to the last bit. Several processes, progress bars and curves are a trainer's: a model of
torchdq is a `torch.nn.Module`, which any trainer takes.
"""

import io
import math
import textwrap
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchdq.base.checks import require_count, require_number
from torchdq.base.files import write_atomically
from torchdq.base.progress import Progress
from torchdq.base.tables import table
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.layers.residual import ResidualDynamics
from torchdq.learning.evaluation.diagnostics import diagnose
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.samples import Samples, of_motions, torque_variance, validated
from torchdq.learning.training.cross_validation import cross_validation, with_fixed_physics
from torchdq.learning.training.loop import Optimiser, Training, TrainingError, learned, seeded
from torchdq.learning.training.validation_gain import ValidationGain, warn_of_little_gain
from torchdq.nn import ComputedTorque, ForwardDynamics, InverseDynamics
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.model import batches

VALIDATION_ROWS = 4096  # rows of the validation data computed at a time
LOOK = 100  # least steps between two evaluations
ROWS = 10  # rows of a history that are printed


class CheckpointError(TorchdqError, RuntimeError):
    """Checkpoint that is damaged, or of another model, other data or other settings."""


@dataclass
class History:
    """Course of a run, with an entry for every evaluation: after an epoch, or as many as make 100 steps."""

    step: list[int] = field(default_factory=list)  # steps done
    # error on the batches since the last evaluation: mean over joints of squared error / variance of the torque
    train: list[float] = field(default_factory=list)
    valid: list[float] = field(default_factory=list)  # error on the validation data; empty without such data
    residual: ValidationGain | None = None  # what a residual network gains on held-out rows, once the run has ended

    @property
    def best_step(self) -> int:
        """Step of the weights that the model has in the end: of the least `valid`, or the last one."""
        return self.step[self.valid.index(min(self.valid)) if self.valid else -1]

    def __str__(self) -> str:
        if not self.step:
            return "no steps"
        shown = sorted({round(k * (len(self.step) - 1) / (ROWS - 1)) for k in range(ROWS)})
        errors = {"train": self.train, **({"valid": self.valid} if self.valid else {})}
        rows = [(str(self.step[k]), *(f"{error[k]:.3g}" for error in errors.values())) for k in shown]
        title = f"{self.step[-1]} steps, weights of step {self.best_step}"
        gain = "" if self.residual is None else f"\n\n{self.residual}"
        return f"{title}\n\n{table(('step', *errors), rows)}{gain}"


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
    checkpoint: str | Path | None = None,
) -> History:
    """History of a fit of a model's parameters, which are changed in place.

    The loss is the mean over joints of squared torque error / variance of the joint's torque in `train`, plus
    `prior` * `model.prior()` if the model has a prior. AdamW, its rate falling to zero along half a cosine; every epoch
    goes through all rows in a new order. An evaluation on `valid` and a checkpoint follow every epoch, or as many as
    make 100 steps.

    The network of a `ResidualDynamics` is then measured on rows that it was not trained on: `valid`, or blocks of
    `train` that copies of it are trained without, and regions of the states where there are fewer than three motions.
    There are at most nine copies. Where the network may act, with what weight at each joint, and the errors of
    `predict` follow from that. A joint gets no weight unless its squared error falls by more than one standard error,
    on rows as informative as two independent ones for each block. `History.residual` holds the gains, a `LogWarning`
    names joints where it helps little and those with too few rows.

    Args:
        model: called as model(q, qd, qdd), returns tau [N, n] [N m]; lies on the device to compute on.
        train: samples to fit, [N, n], or one for each motion. Their order means something for a `ResidualDynamics`
            alone: that of time, of which contiguous blocks are held out, or whole motions if there are three.
        valid: samples to choose by: the model has the weights of the least error on them in the end.
        steps: number of batches to train on.
        batch: rows per step.
        rate: first learning rate.
        decay: weight decay of AdamW; it pulls parameters to zero, which suits networks, not masses.
        prior: weight of `model.prior()`.
        seed: seed of the order of the rows, and of torch's generators while the model runs.
        checkpoint: file to save the run in, and to resume it from if it is there.
    Raises:
        ArgumentError: an argument has the wrong shape or value, or the model has nothing to learn.
        TrainingError: the loss or a gradient is not finite; the checkpoint is left as it was.
        CheckpointError: the checkpoint is damaged, or of another model, other data or other settings.
        OSError: the checkpoint cannot be read or written.

    >>> import torchdq
    >>> from torchdq.nn import InverseDynamics
    >>> robot = torchdq.robots.load("two_link")
    >>> q, qd, qdd = torch.randn(3, 64, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    >>> train = Samples(q, qd, qdd, torchdq.inverse_dynamics(robot, q, qd, qdd))
    >>> model = InverseDynamics(robot.replace(mass=1.2 * robot.mass), learn=("mass",))
    >>> history = fit(model, train, steps=100, batch=32, rate=0.02)
    >>> bool((model.robot.mass / robot.mass - 1).abs().max() < 0.01)
    True
    """
    parameters = _parameters(model)
    train, lengths = of_motions("train", train)
    valid = None if valid is None else validated("valid", valid)
    if valid is not None and valid.q.shape[1] != train.q.shape[1]:
        raise ArgumentError(f"valid must have the {train.q.shape[1]} joints of train, found {valid.q.shape[1]}")
    for name, count, least in (("steps", steps, 1), ("batch", batch, 1), ("seed", seed, 0)):
        require_count(name, count, least=least)
    require_number("rate", rate, positive=True)
    for name, weight in {"decay": decay, "prior": prior}.items():
        require_number(name, weight, least=0)
    training = Training(steps, batch, float(rate), float(decay), seed)
    device = next(iter(parameters.values())).device
    train, valid = train.to(device), None if valid is None else valid.to(device)
    residual = model if isinstance(model, ResidualDynamics) else None
    was_training = model.training
    try:
        with seeded(device, seed), torch.enable_grad():
            _warn_of(model, train)
            if residual is not None:
                residual.open()
            run = _Run(model, Optimiser(parameters, training), train, valid, float(prior))
            run.train(None if checkpoint is None else Path(checkpoint))
            if residual is not None:
                run.history.residual = cross_validation(residual, train, lengths, valid, training)
    finally:
        model.train(was_training)
    if run.history.residual is not None:
        warn_of_little_gain(run.history.residual)
    return run.history


class _Run:
    """Model, its data, and what a checkpoint holds: weights, optimiser, best weights and history."""

    def __init__(self, model: nn.Module, optimiser: Optimiser, train: Samples, valid: Samples | None, prior: float):
        self.model, self.optimiser, self.samples, self.valid, self.prior = model, optimiser, train, valid, prior
        self.variance = torque_variance(train.tau)
        self.history = History()
        self.best: dict[str, Any] | None = None  # weights of the least error on the validation data
        self.torques: Callable[[Tensor], Tensor] = lambda rows: model(*(x[rows] for x in train[:3]))
        if isinstance(model, ResidualDynamics) and not learned(model.model):
            self.torques = with_fixed_physics(model, train)

    def train(self, path: Path | None) -> None:
        """Train, from the checkpoint if there is one, and leave the model with the best weights."""
        identity = {} if path is None else self._identity()
        if path is not None and path.exists():
            self._resume(path, identity)
        weigh: Callable[[], Tensor] | None = getattr(self.model, "prior", None) if self.prior else None
        prior = None if weigh is None else lambda: self.prior * weigh()
        optimiser, rows = self.optimiser, torch.arange(len(self.samples.q), device=self.samples.q.device)
        epochs = -(-LOOK // -(-len(rows) // optimiser.training.batch))
        shown = "no evaluation yet"
        with Progress("fitting") as progress:
            while optimiser.step < optimiser.training.steps:
                self.model.train()
                say = progress.within(shown)
                losses = [loss for _ in range(epochs) for loss in optimiser.epoch(rows, self._error, say, prior)]
                self.history.train.append(sum(losses) / len(losses))
                self.history.step.append(optimiser.step)
                self._validate()
                shown = f"train {self.history.train[-1]:.3g}"
                shown += f", valid {self.history.valid[-1]:.3g}" if self.valid else ""
                if path is not None:
                    self._save(path, identity)
        if self.best is not None:
            self.model.load_state_dict(self.best)

    def _error(self, rows: Tensor) -> Tensor:
        """Error of a batch."""
        error = self._weighted(self.torques(rows), self.samples.tau[rows])
        if not error.requires_grad:
            raise ArgumentError("the torques of the model do not depend on its parameters; nothing can be fitted")
        return error

    def _weighted(self, predicted: Tensor, tau: Tensor) -> Tensor:
        """Mean squared error over the variance of each joint."""
        if predicted.shape != tau.shape:
            raise ArgumentError(f"model must return torques {list(tau.shape)}, found {list(predicted.shape)}")
        return ((predicted - tau).square() / self.variance).mean()

    def _validate(self) -> None:
        """Note the error on the validation data, and the weights if they are the best so far."""
        if self.valid is None:
            return
        self.model.eval()
        with torch.no_grad():
            parts = [x.split(VALIDATION_ROWS) for x in self.valid]
            errors = [self._weighted(self.model(*x), tau) * len(tau) for *x, tau in zip(*parts, strict=True)]
        error = float(sum(errors)) / len(self.valid.q)
        if not math.isfinite(error):
            raise TrainingError(f"step {self.optimiser.step}: the error on valid is {error}; a smaller rate may help")
        if error < min(self.history.valid, default=math.inf):
            self.best = {name: x.clone() for name, x in self.model.state_dict().items()}
        self.history.valid.append(error)

    # --- checkpoints ---

    def _identity(self) -> dict[str, Any]:
        """Plain values that must agree for a run to go on: the model, the robots in it, the data and the settings."""
        robots = [robot for part in self.model.modules() if isinstance(robot := getattr(part, "_robot", None), Robot)]
        return {
            "model": repr(self.model),
            **{
                f"{name} of robot {robot.name!r}": None if (x := getattr(robot, name)) is None else x.tolist()
                for robot in robots
                for name in (*SHAPES, "damping", "friction")
            },
            "train": self.samples.fingerprint(),
            "valid": None if self.valid is None else self.valid.fingerprint(),
            "prior": self.prior,
            **self.optimiser.training._asdict(),
        }

    def _save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write a checkpoint, whole or not at all."""
        history = {name: getattr(self.history, name) for name in ("step", "train", "valid")}
        state = {"model": self.model.state_dict(), "optimiser": self.optimiser.state(), "best": self.best}
        content = io.BytesIO()
        torch.save({"identity": identity, "history": history, **state}, content)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically({path: content.getvalue()})

    def _resume(self, path: Path, identity: dict[str, Any]) -> None:
        """Go on from a checkpoint of this run; the model is as it was if it is none."""
        content = io.BytesIO(path.read_bytes())
        try:
            state = torch.load(content, map_location="cpu", weights_only=True)  # a file from elsewhere runs nothing
            found = dict(state["identity"])
        except Exception as fault:  # torch raises errors of many kinds on bytes that it has not written
            raise CheckpointError(f"{path} is damaged, or not a checkpoint of fit; remove it to start again") from fault
        for name, here in identity.items():
            if found.get(name) != here:
                there, here = (textwrap.shorten(str(x), 200) for x in (found.get(name), here))
                raise CheckpointError(
                    f"checkpoint {path} is of another run: {name} is {there} there and {here} here; call fit as that "
                    "run did, or name another file"
                )
        before = {name: x.clone() for name, x in self.model.state_dict().items()}
        try:
            self.model.load_state_dict(state["model"])
            self.optimiser.load(state["optimiser"])
            self.history, self.best = History(**state["history"]), state["best"]
        except (RuntimeError, ValueError, TypeError, LookupError) as fault:
            self.model.load_state_dict(before)
            raise CheckpointError(f"checkpoint {path} does not fit the model: {fault}; name another file") from fault


def _parameters(model: nn.Module) -> dict[str, nn.Parameter]:
    """Parameters to fit; raises unless the model has some, and may return torques."""
    if not isinstance(model, nn.Module):
        cure = '; torchdq.InverseDynamics(robot, learn=("mass",)) is one' if isinstance(model, Robot) else ""
        raise ArgumentError(f"model must be a torch module of torques, found {type(model).__name__}{cure}")
    kind = parametrize.type_before_parametrizations(model).__name__
    if isinstance(model, ForwardDynamics | ComputedTorque):
        raise ArgumentError(
            f"model must return the torques of motions (q, qd, qdd), found a {kind}; fit an InverseDynamics or a "
            f"ResidualDynamics, and make the {kind} of its `robot`"
        )
    if not (parameters := learned(model)):
        raise ArgumentError("model has no parameters to fit; name tensors of the robot in its learn=(...)")
    return parameters


@torch.no_grad()
def _warn_of(model: nn.Module, train: Samples) -> None:
    """Warn of samples that the robot in a model, if there is one, does not explain."""
    rigid = next((part for part in model.modules() if isinstance(part, InverseDynamics)), None)
    if rigid is None or any(batches(rigid.robot).values()) or rigid.robot.n != train.q.shape[1]:
        return
    model.eval()
    if findings := diagnose(rigid.robot, rigid, train, rigid.sign_width):
        warnings.warn(LogWarning(*findings), stacklevel=3)
