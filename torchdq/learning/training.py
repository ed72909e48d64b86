"""Fitting a model of joint torques to samples: a plain loop that can be read, and killed.

    history = fit(model, train, valid, epochs=200, patience=10, checkpoint="run.pt", progress=True)

A run that is killed at any moment and called again with the same arguments goes on where it was; on a CPU the weights
come out the same to the last bit. Started by `torchrun`, the same call shares every batch among the processes.
"""

import hashlib
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchdq.errors import ArgumentError, TorchdqError
from torchdq.learning import checkpoint as checkpoints
from torchdq.learning.distributed import Team, team
from torchdq.learning.progress import Report

EVALUATED = 4096  # rows of the validation data computed at a time
PROBED = 64  # rows of the training data whose torques tell one model from another


class TrainingError(TorchdqError, ArithmeticError):
    """Training has come to numbers that are not finite."""


class Samples(NamedTuple):
    """States of an arm and the torques that go with them, `[N, n]` each; the order of the rows means nothing."""

    q: Tensor  # [rad]
    qd: Tensor  # [rad/s]
    qdd: Tensor  # [rad/s^2]
    tau: Tensor  # [N m]


@dataclass
class History:
    """How a run went; an entry for every look at the validation data."""

    step: list[int] = field(default_factory=list)
    """Steps done."""
    train: list[float] = field(default_factory=list)
    """Error on the batches since the last look: mean over joints of squared error / variance of the torque."""
    valid: list[float] = field(default_factory=list)
    """The same error on the validation data; empty without such data."""
    best_step: int = 0
    """Step whose weights the model was given in the end: of the least `valid`, or the last one."""
    stopped_early: bool = False
    """Whether patience ended the run."""


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
    progress: bool = False,
) -> History:
    """Fit a model's parameters in place, and return how it went.

    The loss is the mean over joints of squared torque error / variance of the joint's torque in `train`, plus
    `prior` * `model.prior()` if the model has a prior. AdamW, its rate falling to zero along half a cosine; every epoch
    goes through all rows in a new order. Under `torchrun` every process calls this with the same arguments: each takes
    its share of every batch, and all end with the weights that one process would find, but for rounding.

    Args:
        model: called as model(q, qd, qdd), returns tau [N, n] [N m]; lies on the device to compute on, which under
            `torchrun` is another one for every process.
        train: samples to fit, [N, n].
        valid: samples to choose by: the weights with the least error on them are the ones the model is left with.
        steps, epochs: length of the run, one of the two.
        batch: rows per step, over all processes.
        rate: first learning rate.
        decay: weight decay of AdamW; it pulls parameters to zero, which suits networks, not masses.
        prior: weight of `model.prior()`.
        seed: of the order of the rows, and of torch's generators while the model runs.
        patience: looks without a better `valid` after which to stop; None: never.
        every: steps from one look at `valid` and one checkpoint to the next; None: an epoch.
        checkpoint: file to save the run in, and to resume it from if it is there.
        tensorboard: folder to log the losses and the rate to, for TensorBoard.
        progress: show a progress bar.
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
    train = _checked("train", train)
    valid = None if valid is None else _checked("valid", valid)
    parameters = {name: p for name, p in model.named_parameters() if p.requires_grad}
    _require_sense(parameters, train, valid, patience)
    _require_positive(batch=batch, rate=rate, steps=steps, epochs=epochs, patience=patience, every=every)
    if (steps is None) == (epochs is None):
        raise ArgumentError(f"one of steps and epochs must be given, found steps={steps} and epochs={epochs}")
    per_epoch = -(-len(train.q) // batch)
    last = steps or (epochs or 0) * per_epoch
    every = every or per_epoch
    path = None if checkpoint is None else Path(checkpoint)

    device = next(iter(parameters.values())).device
    train = Samples(*(x.to(device) for x in train))
    valid = None if valid is None else Samples(*(x.to(device) for x in valid))
    variance = _variance(train.tau)
    identity: dict[str, Any] = {}
    if path is not None:
        identity = checkpoints.described(model) | {"train": _described(train), "valid": valid and _described(valid)}
        identity |= {"steps": last, "batch": batch, "rate": rate, "decay": decay, "prior": prior, "seed": seed}
        identity |= {"patience": patience, "every": every}

    def error(samples: Samples, rows: Tensor) -> Tensor:
        """What this process' share of some rows adds to their error."""
        mine = ours.share(rows).to(device)
        q, qd, qdd, tau = (x[mine] for x in samples)
        if not len(tau):
            return tau.sum()  # zero
        predicted = model(q, qd, qdd)
        if predicted.shape != tau.shape:
            raise ArgumentError(f"model must return torques {list(tau.shape)}, found {list(predicted.shape)}")
        if torch.is_grad_enabled() and not predicted.requires_grad:
            raise ArgumentError("the torques of the model do not depend on its parameters; nothing can be fitted")
        return ((predicted - tau).square() / variance).mean(-1).sum() / len(rows)

    was_training = model.training
    with team(device) as ours, _own_randomness(device, seed), torch.enable_grad():
        run = _Run(model, parameters, decay, seed, train, batch)
        run.start(ours, path, identity)
        report = Report(last, run.step, tensorboard, progress) if ours.leads else None
        try:
            while run.step < last and not run.history.stopped_early:
                model.train()
                rows = run.next_rows()
                part = error(train, rows)
                loss = part + prior / ours.size * _prior(model) if prior else part
                part, *gradients = ours.summed([part.detach(), *_gradients(loss, parameters)])
                _require_finite(run.step, rows, part, dict(zip(parameters, gradients, strict=True)), path)
                run.update(gradients, rate / 2 * (1 + math.cos(math.pi * run.step / last)), float(part))

                if run.step % every == 0 or run.step == last:
                    found = None if valid is None else _evaluated(error, model, valid, ours)
                    if found is not None and not math.isfinite(found):
                        raise TrainingError(f"step {run.step}: the error on valid is {found}; a smaller rate may help")
                    run.look(found, patience)
                    if path is not None and ours.leads:
                        checkpoints.write(path, {"identity": identity, **run.state()})
                    if report:
                        report.look(run.history, run.optimiser.param_groups[0]["lr"])
                if report:
                    report.step(run.step)
        finally:
            if report:
                report.close()
        run.finish()
    model.train(was_training)
    return run.history


class _Run:
    """What changes while a run goes on; a checkpoint holds all of it, and nothing else is needed to go on."""

    def __init__(
        self, model: nn.Module, parameters: dict[str, nn.Parameter], decay: float, seed: int, train: Samples, batch: int
    ):
        self.model, self.train, self.batch = model, train, batch
        self.parameters = list(parameters.values())
        self.optimiser = torch.optim.AdamW(self.parameters, lr=0.0, weight_decay=decay)
        self.generator = torch.Generator().manual_seed(seed)
        self.step = 0
        self.errors: list[float] = []  # of the batches since the last look
        self.best: dict[str, Tensor] | None = None
        self.best_error = math.inf
        self.waited = 0
        self.history = History()

    def start(self, ours: Team, path: Path | None, identity: dict[str, Any]) -> None:
        """Take up what the checkpoint holds, if there is one; begin alike in all processes."""
        saved = None
        if ours.leads and path is not None and path.exists():
            saved = checkpoints.read(path)
            checkpoints.require_same_run(path, saved["identity"], identity)
        saved = ours.leaders(saved)
        if saved is None:
            if ours.size > 1:
                self.model.load_state_dict(ours.leaders({name: x.cpu() for name, x in self.model.state_dict().items()}))
            return
        self.model.load_state_dict(saved["model"])
        then, now = saved["probe"], self._probe().cpu()
        if not torch.allclose(now, then, rtol=1e-3, atol=1e-3 * float(then.abs().max())):
            raise checkpoints.CheckpointError(
                f"checkpoint {path} is of another model: given its weights, the model does not return the torques it "
                "did; what is not a parameter, such as the rest of the robot, must be as it was; or name another file"
            )
        self.optimiser.load_state_dict(saved["optimiser"])
        self.generator.set_state(saved["generator"])
        self._draw()
        _set_randomness(saved["random"], self.parameters[0].device)
        self.step, self.best, self.best_error = saved["step"], saved["best"], saved["best_error"]
        self.waited, self.history = saved["waited"], History(**saved["history"])

    def state(self) -> dict[str, Any]:
        """What `start` takes up."""
        return {
            "step": self.step,
            "model": self.model.state_dict(),
            "probe": self._probe(),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.drawn_from,
            "random": _randomness(self.parameters[0].device),
            "best": self.best,
            "best_error": self.best_error,
            "waited": self.waited,
            "history": asdict(self.history),
        }

    def next_rows(self) -> Tensor:
        """Rows of the next batch, over all processes."""
        batches = -(-len(self.train.q) // self.batch)
        at = self.step % batches
        if at == 0:
            self._draw()
        return self.order[at * self.batch : (at + 1) * self.batch]

    def update(self, gradients: list[Tensor], rate: float, error: float) -> None:
        """Do a step."""
        for parameter, gradient in zip(self.parameters, gradients, strict=True):
            parameter.grad = gradient
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.optimiser.step()
        self.optimiser.zero_grad()
        self.errors.append(error)
        self.step += 1

    def look(self, valid: float | None, patience: int | None) -> None:
        """Note the errors, and the weights if they are the best so far."""
        self.history.step.append(self.step)
        self.history.train.append(sum(self.errors) / len(self.errors))
        self.errors.clear()
        if valid is None:
            self.history.best_step = self.step
            return
        self.history.valid.append(valid)
        if valid < self.best_error:
            self.history.best_step, self.best_error, self.waited = self.step, valid, 0
            self.best = {name: x.clone() for name, x in self.model.state_dict().items()}
        else:
            self.waited += 1
            self.history.stopped_early = patience is not None and self.waited >= patience

    def finish(self) -> None:
        """Leave the model with its best weights."""
        if self.best is not None:
            self.model.load_state_dict(self.best)

    def _draw(self) -> None:
        """A new order of all rows; kept is where the generator stood before, from which it can be drawn again."""
        self.drawn_from = self.generator.get_state()
        self.order = torch.randperm(len(self.train.q), generator=self.generator)

    def _probe(self) -> Tensor:
        """Torques of the first samples."""
        self.model.eval()
        with torch.no_grad():
            return self.model(*(x[:PROBED] for x in self.train[:3]))


def _evaluated(error: Callable[[Samples, Tensor], Tensor], model: nn.Module, samples: Samples, ours: Team) -> float:
    """Error on samples, over all processes."""
    model.eval()
    total = torch.zeros((), dtype=samples.tau.dtype, device=samples.tau.device)
    with torch.no_grad():
        for rows in torch.arange(len(samples.q)).split(EVALUATED):
            total += error(samples, rows) * (len(rows) / len(samples.q))
    (total,) = ours.summed([total])
    return float(total)


def _gradients(loss: Tensor, parameters: dict[str, nn.Parameter]) -> list[Tensor]:
    """Gradient for every parameter, zero for one that has no part in the loss."""
    if not loss.requires_grad:  # this process has no share of a small batch
        return [torch.zeros_like(p) for p in parameters.values()]
    return list(torch.autograd.grad(loss, list(parameters.values()), allow_unused=True, materialize_grads=True))


def _prior(model: nn.Module) -> Tensor:
    """How far the model is from what it was described as; zero for one that does not say."""
    found: Callable[[], Tensor] | None = getattr(model, "prior", None)
    return torch.zeros(()) if found is None else found()


def _require_finite(step: int, rows: Tensor, error: Tensor, gradients: dict[str, Tensor], path: Path | None) -> None:
    if bool(torch.stack([x.isfinite().all() for x in (error, *gradients.values())]).all()):
        return
    broken = [name for name, gradient in gradients.items() if not gradient.isfinite().all()]
    what = f"the error is {float(error):g}" if not error.isfinite() else f"the gradient for {broken[0]!r} is not finite"
    some = ", ".join(map(str, rows[:5].tolist())) + (", ..." if len(rows) > 5 else "")
    kept = "" if path is None else f"; {path} was left as it is" if path.exists() else f"; {path} was not written"
    raise TrainingError(
        f"step {step + 1}: {what}, in the batch of the {len(rows)} rows {some} of train; a smaller rate may help, and "
        f"so may float64{kept}"
    )


def _checked(name: str, samples: Samples) -> Samples:
    """The samples, when they are what they ought to be."""
    if len(samples) != len(Samples._fields):
        raise ArgumentError(f"{name} must be Samples(q, qd, qdd, tau), found {len(samples)} entries")
    samples = Samples(*samples)
    shape, dtype = samples.q.shape, samples.q.dtype
    if len(shape) != 2 or not shape[0] or not dtype.is_floating_point:
        raise ArgumentError(f"{name}.q must be real numbers [N, n] with N > 0, found {dtype} {list(shape)}")
    for field_, x in samples._asdict().items():
        if x.shape != shape or x.dtype != dtype:
            expected = f"{dtype} {list(shape)} as {name}.q"
            raise ArgumentError(f"{name}.{field_} must be {expected}, found {x.dtype} {list(x.shape)}")
        if not bool(x.isfinite().all()):
            row, joint = (~x.isfinite()).nonzero()[0].tolist()
            raise ArgumentError(
                f"{name}.{field_} must be finite, found {float(x[row, joint])} in row {row}, joint {joint + 1}; "
                "leave the row out"
            )
    return Samples(*(x.detach() for x in samples))


def _require_sense(
    parameters: dict[str, nn.Parameter], train: Samples, valid: Samples | None, patience: int | None
) -> None:
    if not parameters:
        raise ArgumentError("model has no parameters to fit; name tensors of the robot in its learn=(...)")
    if valid is not None and valid.q.shape[1] != train.q.shape[1]:
        raise ArgumentError(f"valid must have the {train.q.shape[1]} joints of train, found {valid.q.shape[1]}")
    if valid is None and patience is not None:
        raise ArgumentError("patience needs samples in valid to wait for; found none")


def _require_positive(**values: float | None) -> None:
    for name, value in values.items():
        if value is not None and not value > 0:
            raise ArgumentError(f"{name} must be greater than 0, found {value}")


def _variance(tau: Tensor) -> Tensor:
    """Variance of each joint's torque, [n]; a joint whose torque never changes counts as the others do on average."""
    variance = tau.var(dim=0, correction=0)
    changes = variance > 1e-12 * variance.max()
    if not bool(changes.any()):
        raise ArgumentError(
            "train.tau must change from row to row, found the same torques in all; nothing can be fitted"
        )
    return torch.where(changes, variance, variance[changes].mean())


def _described(samples: Samples) -> str:
    """What tells samples from others."""
    digest = hashlib.sha256()
    for x in samples:
        digest.update(x.cpu().contiguous().view(torch.uint8).numpy().tobytes())
    return f"{list(samples.q.shape)} {samples.q.dtype} samples with SHA-256 {digest.hexdigest()}"


@contextmanager
def _own_randomness(device: torch.device, seed: int) -> Iterator[None]:
    """Torch's own generators, which dropout uses, start from the seed and are the caller's again afterwards."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield


def _randomness(device: torch.device) -> list[Tensor]:
    return [torch.get_rng_state(), *([torch.cuda.get_rng_state(device)] if device.type == "cuda" else [])]


def _set_randomness(states: list[Tensor], device: torch.device) -> None:
    torch.set_rng_state(states[0])
    if device.type == "cuda" and len(states) > 1:
        torch.cuda.set_rng_state(states[1], device)
