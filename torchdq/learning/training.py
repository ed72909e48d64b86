"""Fitting a model of joint torques to samples: a training loop that a killed process can resume.

    history = fit(model, train, valid, epochs=200, patience=10, checkpoint="run.pt", progress=True)

A run that is killed at any moment and called again with the same arguments continues from its last checkpoint; on a CPU
the weights come out the same to the last bit. Started by `torchrun`, the same call shares every batch among the
processes.
"""

import copy
import math
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchdq.checks import require_choice, require_count, require_number
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.learning import checkpoint as checkpoints
from torchdq.learning.data import Samples, torque_variance, validated
from torchdq.learning.distributed import Team, team
from torchdq.learning.plausibility import LogWarning, doubts, sampled
from torchdq.learning.progress import Progress
from torchdq.nn import DQRNEA
from torchdq.robot.robot import batches
from torchdq.tables import table

VALIDATION_ROWS = 4096  # rows of the validation data computed at a time
ROWS = 10  # rows of a history that are printed
PROBE_ROWS = 64  # rows of the training data whose torques tell one model from another


class TrainingError(TorchdqError, ArithmeticError):
    """Loss or gradient that is not finite."""


@dataclass
class History:
    """Course of a run, with an entry for every evaluation on the validation data."""

    step: list[int] = field(default_factory=list)  # steps done
    # error on the batches since the last evaluation: mean over joints of squared error / variance of the torque
    train: list[float] = field(default_factory=list)
    valid: list[float] = field(default_factory=list)  # error on the validation data; empty without such data
    best_step: int = 0  # step of the weights that the model has in the end: of the least `valid`, or the last one
    stopped_early: bool = False  # whether patience ended the run

    def __str__(self) -> str:
        if not self.step:
            return "no steps"
        shown = sorted({round(k * (len(self.step) - 1) / (ROWS - 1)) for k in range(ROWS)})
        errors = {"train": self.train, **({"valid": self.valid} if self.valid else {})}
        rows = [(str(self.step[k]), *(f"{error[k]:.3g}" for error in errors.values())) for k in shown]
        end = ", stopped early by patience" if self.stopped_early else ""
        title = f"{self.step[-1]} steps, weights of step {self.best_step}{end}"
        return f"{title}\n\n{table(('step', *errors), rows)}"


def fit(
    model: nn.Module,
    train: Samples,
    valid: Samples | None = None,
    *,
    steps: int | None = None,
    epochs: int | None = None,
    batch: int = 256,
    rate: float = 1e-3,
    decay: float = 0.0,
    prior: float = 0.0,
    seed: int = 0,
    patience: int | None = None,
    every: int | None = None,
    checkpoint: str | Path | None = None,
    tensorboard: str | Path | None = None,
    progress: bool | None = None,
) -> History:
    """History of a fit of a model's parameters, which are changed in place.

    The loss is the mean over joints of squared torque error / variance of the joint's torque in `train`, plus
    `prior` * `model.prior()` if the model has a prior. AdamW, its rate falling to zero along half a cosine; every epoch
    goes through all rows in a new order. Under `torchrun` every process calls this with the same arguments: each takes
    its share of every batch, and all end with the weights that one process would find, but for rounding.

    Args:
        model: called as model(q, qd, qdd), returns tau [N, n] [N m]; lies on the device to compute on, which under
            `torchrun` is another one for every process.
        train: samples to fit, [N, n].
        valid: samples to choose by: the model is left with the weights of the least error on them.
        steps, epochs: length of the run, one of the two.
        batch: rows per step, over all processes.
        rate: first learning rate.
        decay: weight decay of AdamW; it pulls parameters to zero, which suits networks, not masses.
        prior: weight of `model.prior()`.
        seed: seed of the order of the rows, and of torch's generators while the model runs.
        patience: evaluations without a better `valid` after which to stop; None: never.
        every: steps from one evaluation on `valid` and one checkpoint to the next; None: an epoch.
        checkpoint: file to save the run in, and to resume it from if it is there.
        tensorboard: folder to log the losses and the rate to, for TensorBoard.
        progress: show a progress bar; None: lines on stderr once the run takes more than two seconds; False: nothing.
    Raises:
        ArgumentError: an argument has the wrong shape or value, or the model has nothing to learn.
        TrainingError: the loss or a gradient is not finite; the checkpoint is left as it was.
        CheckpointError: the checkpoint is damaged, or of another model, other data or other settings.

    >>> import torchdq
    >>> from torchdq.nn import DQRNEA
    >>> robot = torchdq.robots.load("two_link")
    >>> q, qd, qdd = torch.randn(3, 64, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    >>> train = Samples(q, qd, qdd, torchdq.inverse_dynamics(robot, q, qd, qdd))
    >>> model = DQRNEA(robot.replace(mass=1.2 * robot.mass), learn=("mass",))
    >>> history = fit(model, train, steps=100, batch=32, rate=0.02)
    >>> bool((model.robot.mass / robot.mass - 1).abs().max() < 0.01)
    True
    """
    train, valid = validated("train", train), None if valid is None else validated("valid", valid)
    parameters = {name: p for name, p in model.named_parameters() if p.requires_grad}
    if not parameters:
        raise ArgumentError("model has no parameters to fit; name tensors of the robot in its learn=(...)")
    if valid is not None and valid.q.shape[1] != train.q.shape[1]:
        raise ArgumentError(f"valid must have the {train.q.shape[1]} joints of train, found {valid.q.shape[1]}")
    if valid is None and patience is not None:
        raise ArgumentError("patience needs samples in valid to wait for; found none")
    require_count("batch", batch)
    require_count("seed", seed, least=0)
    for name, count in {"steps": steps, "epochs": epochs, "patience": patience, "every": every}.items():
        if count is not None:
            require_count(name, count)
    require_number("rate", rate, positive=True)
    for name, weight in {"decay": decay, "prior": prior}.items():
        require_number(name, weight, least=0)
    rate, decay, prior = float(rate), float(decay), float(prior)  # checkpoints hold no numbers of numpy
    require_choice("progress", progress, (None, True, False))
    if (steps is None) == (epochs is None):
        raise ArgumentError(f"one of steps and epochs must be given, found steps={steps} and epochs={epochs}")
    per_epoch = -(-len(train.q) // batch)
    last, every = steps or (epochs or 0) * per_epoch, every or per_epoch

    device = next(iter(parameters.values())).device
    train, valid = train.to(device), None if valid is None else valid.to(device)
    path = _checkpoint(checkpoint)
    identity: dict[str, Any] = {}
    if path is not None:
        identity = checkpoints.described(model)
        identity |= {"train": train.fingerprint(), "valid": valid and valid.fingerprint(), "steps": last}
        identity |= {"batch": batch, "rate": rate, "decay": decay, "prior": prior, "seed": seed}
        identity |= {"patience": patience, "every": every}

    was_training = model.training
    try:
        with team(device) as ours, _own_randomness(device, seed), torch.enable_grad():
            run = _Run(model, parameters, train, ours, path, batch, prior, decay, seed)
            if ours.leads and (doubt := _doubts(model, train)):
                warnings.warn(doubt, LogWarning, stacklevel=2)
            run.resume(identity, last)
            bar = progress if ours.leads else False
            with Progress(last, run.step, tensorboard if ours.leads else None, bar) as shown:
                while run.step < last and not run.history.stopped_early:
                    rate_now = rate / 2 * (1 + math.cos(math.pi * run.step / last))
                    run.advance(rate_now)
                    if run.step % every == 0 or run.step == last:
                        run.evaluate(valid, patience)
                        if path is not None and ours.leads:
                            checkpoints.write(path, {"identity": checkpoints.still(identity, model), **run.state()})
                        shown.evaluation(run.history, rate_now)
                    shown.step(run.step)
            if run.best is not None:
                model.load_state_dict(run.best)
    finally:
        model.train(was_training)
    return run.history


class _Run:
    """State of a run; a checkpoint holds all that changes in it."""

    def __init__(
        self,
        model: nn.Module,
        parameters: dict[str, nn.Parameter],
        train: Samples,
        ours: Team,
        path: Path | None,
        batch: int,
        prior: float,
        decay: float,
        seed: int,
    ):
        self.model, self.parameters, self.train, self.team, self.path = model, parameters, train, ours, path
        self.batch, self.prior, self.variance = batch, prior, torque_variance(train.tau)
        self.optimiser = torch.optim.AdamW(parameters.values(), lr=0.0, weight_decay=decay)
        self.generator = torch.Generator().manual_seed(seed)
        self.step = 0
        self.errors: list[float] = []  # errors of the batches since the last evaluation
        self.best: dict[str, Tensor] | None = None
        self.best_error = math.inf
        self.waited = 0
        self.history = History()

    def resume(self, identity: dict[str, Any], last: int) -> None:
        """Load the checkpoint, if there is one, of a run of `last` steps; the same weights in all processes."""
        saved = None
        if self.team.leads and self.path is not None and self.path.exists():
            saved = checkpoints.read(self.path)
            checkpoints.require_same_run(self.path, saved, identity)
        saved = self.team.broadcast(saved)
        if saved is None or self.path is None:
            if self.team.size > 1:
                weights = {name: x.cpu() for name, x in self.model.state_dict().items()}
                self.model.load_state_dict(self.team.broadcast(weights))
            return
        before = copy.deepcopy(self.model.state_dict())
        try:
            self._take_up(self.path, saved, before, last)
        except checkpoints.CheckpointError:
            self.model.load_state_dict(before)
            raise

    def _take_up(self, path: Path, saved: dict[str, Any], now: dict[str, Any], last: int) -> None:
        """Go on from the state in a checkpoint; `now` is the state dict of the model, `last` the last step."""
        checkpoints.require_whole(path, saved, now, list(self.parameters), last)
        with checkpoints.loading(path):
            self.model.load_state_dict(saved["model"])
        if not checkpoints.same_torques(saved["probe"], self._probe().cpu(), now):
            raise checkpoints.CheckpointError(
                f"checkpoint {path} is of another model: given its weights, the model does not return the torques "
                "it did; what is not a parameter, such as the rest of the robot, must be as it was; or name another "
                "file"
            )
        with checkpoints.loading(path):
            # momenta only: rates and decays are those of this call
            settings = self.optimiser.state_dict()["param_groups"]
            self.optimiser.load_state_dict({"state": saved["optimiser"]["state"], "param_groups": settings})
            self.generator.set_state(saved["generator"])
            self._shuffle()
            _set_randomness(saved["random"], self.train.q.device)
        self.step, self.best, self.best_error = saved["step"], saved["best"], saved["best_error"]
        self.waited, self.history = saved["waited"], History(**saved["history"])

    def state(self) -> dict[str, Any]:
        """Content of a checkpoint, for `resume`."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "probe": self._probe(),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.before_shuffle,
            "random": _randomness(self.train.q.device),
            "best": self.best,
            "best_error": self.best_error,
            "waited": self.waited,
            "history": asdict(self.history),
        }

    def advance(self, rate: float) -> None:
        """Do a step, on the next batch."""
        self.model.train()
        at = self.step % -(-len(self.train.q) // self.batch)
        if at == 0:
            self._shuffle()
        rows = self.order[at * self.batch : (at + 1) * self.batch]
        error = loss = self._error(self.train, rows)
        prior: Callable[[], Tensor] | None = getattr(self.model, "prior", None)
        if self.prior and prior is not None:
            loss = loss + self.prior / self.team.size * prior()
        learned = tuple(self.parameters.values())
        if loss.requires_grad:
            found = torch.autograd.grad(loss, learned, allow_unused=True, materialize_grads=True)
        else:  # this process has no share of a small batch
            found = tuple(map(torch.zeros_like, learned))
        error, *gradients = self.team.summed([error.detach(), *found])
        self._require_finite(rows, error, gradients)
        self.update(gradients, rate)
        self.errors.append(float(error))
        self.step += 1

    def update(self, gradients: list[Tensor], rate: float) -> None:
        """Change the parameters by a step of AdamW."""
        for parameter, gradient in zip(self.parameters.values(), gradients, strict=True):
            parameter.grad = gradient
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.step()
        self.optimiser.zero_grad()

    def evaluate(self, valid: Samples | None, patience: int | None) -> None:
        """Note the errors, and the weights if they are the best so far."""
        error = None if valid is None else self._validation_error(valid)
        if error is not None and not math.isfinite(error):
            raise TrainingError(f"step {self.step}: the error on valid is {error}; a smaller rate may help")
        self.history.step.append(self.step)
        self.history.train.append(sum(self.errors) / len(self.errors))
        self.errors.clear()
        if error is None:
            self.history.best_step = self.step
            return
        self.history.valid.append(error)
        if error < self.best_error:
            self.history.best_step, self.best_error, self.waited = self.step, error, 0
            self.best = {name: x.clone() for name, x in self.model.state_dict().items()}
        else:
            self.waited += 1
            self.history.stopped_early = patience is not None and self.waited >= patience

    def _error(self, samples: Samples, rows: Tensor) -> Tensor:
        """Share of this process in the error of a batch of rows."""
        mine = self.team.share(rows).to(samples.q.device)
        q, qd, qdd, tau = (x[mine] for x in samples)
        if not len(tau):
            return tau.sum()  # zero
        predicted = self.model(q, qd, qdd)
        if predicted.shape != tau.shape:
            raise ArgumentError(f"model must return torques {list(tau.shape)}, found {list(predicted.shape)}")
        if torch.is_grad_enabled() and not predicted.requires_grad:
            raise ArgumentError("the torques of the model do not depend on its parameters; nothing can be fitted")
        return ((predicted - tau).square() / self.variance).mean(-1).sum() / len(rows)

    @torch.no_grad()
    def _validation_error(self, valid: Samples) -> float:
        """Error on the validation data, over all processes."""
        self.model.eval()
        total = torch.zeros_like(valid.tau[0, 0])
        for rows in torch.arange(len(valid.q)).split(VALIDATION_ROWS):
            total += self._error(valid, rows) * (len(rows) / len(valid.q))
        return float(self.team.summed([total])[0])

    @torch.no_grad()
    def _probe(self) -> Tensor:
        """Torques of the first samples."""
        self.model.eval()
        return self.model(*(x[:PROBE_ROWS] for x in self.train[:3]))

    def _shuffle(self) -> None:
        """Draw a new order of all rows; the generator's state before it is kept, to draw it again."""
        self.before_shuffle = self.generator.get_state()
        self.order = torch.randperm(len(self.train.q), generator=self.generator)

    def _require_finite(self, rows: Tensor, error: Tensor, gradients: list[Tensor]) -> None:
        if bool(torch.stack([x.isfinite().all() for x in (error, *gradients)]).all()):
            return
        what = f"the error is {float(error):g}"
        if error.isfinite():
            broken = (name for name, x in zip(self.parameters, gradients, strict=True) if not x.isfinite().all())
            what = f"the gradient for {next(broken)!r} is not finite"
        some = ", ".join(map(str, rows[:5].tolist())) + (", ..." if len(rows) > 5 else "")
        path = self.path
        kept = "" if path is None else f"; {path} was left as it is" if path.exists() else f"; {path} was not written"
        raise TrainingError(
            f"step {self.step + 1}: {what}, in the batch of the {len(rows)} rows {some} of train; a smaller rate may "
            f"help, and so may float64{kept}"
        )


@torch.no_grad()
def _doubts(model: nn.Module, train: Samples) -> str:
    """Words for what is wrong with samples that a robot in the model does not explain; "" for nothing, or no robot."""
    rigid = next((part for part in model.modules() if isinstance(part, DQRNEA)), None)
    if rigid is None or any(batches(rigid.robot).values()) or rigid.robot.n != train.q.shape[1]:
        return ""
    model.eval()
    return doubts(rigid, rigid.robot.joint_names, sampled(train), rigid.friction_width)


def _checkpoint(path: Any) -> Path | None:
    """Path of the checkpoint; raises unless it is one, and no folder's."""
    if path is not None and not isinstance(path, str | os.PathLike):
        raise ArgumentError(f"checkpoint must be a path, found {type(path).__name__}")
    if path is not None and Path(path).is_dir():
        raise ArgumentError(f"checkpoint must be a file, found the folder {path}; name a file in it")
    return None if path is None else Path(path)


@contextmanager
def _own_randomness(device: torch.device, seed: int) -> Iterator[None]:
    """Torch's own generators, which dropout uses, seeded; the caller's states come back afterwards."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield


def _randomness(device: torch.device) -> list[Tensor]:
    return [torch.get_rng_state(), *([torch.cuda.get_rng_state(device)] if device.type == "cuda" else [])]


def _set_randomness(states: list[Tensor], device: torch.device) -> None:
    torch.set_rng_state(states[0])
    if device.type == "cuda" and len(states) > 1:
        torch.cuda.set_rng_state(states[1], device)
