"""State of a training run: its steps, what they cost, and the checkpoint from which another process goes on."""

import copy
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchdq.base.tables import table
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.learning.logs.samples import Samples, torque_variance
from torchdq.learning.training import checkpoint as checkpoints
from torchdq.learning.training.distributed import Team
from torchdq.learning.training.validation_gain import Worth

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
    residual: Worth | None = None  # worth of a residual network on rows that were left out, once the run has ended

    def __str__(self) -> str:
        if not self.step:
            return "no steps"
        shown = sorted({round(k * (len(self.step) - 1) / (ROWS - 1)) for k in range(ROWS)})
        errors = {"train": self.train, **({"valid": self.valid} if self.valid else {})}
        rows = [(str(self.step[k]), *(f"{error[k]:.3g}" for error in errors.values())) for k in shown]
        end = ", stopped early by patience" if self.stopped_early else ""
        title = f"{self.step[-1]} steps, weights of step {self.best_step}{end}"
        worth = "" if self.residual is None else f"\n\n{self.residual}"
        return f"{title}\n\n{table(('step', *errors), rows)}{worth}"


class Run:
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
        # torques of rows of `train`, for a model of which a part was computed once and for all; None: as it is called
        self.known: Callable[[Tensor], Tensor] | None = None

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
            "history": {name: x for name, x in asdict(self.history).items() if name != "residual"},
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
        known = self.known if samples is self.train else None
        predicted = self.model(q, qd, qdd) if known is None else known(mine)
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


def _randomness(device: torch.device) -> list[Tensor]:
    return [torch.get_rng_state(), *([torch.cuda.get_rng_state(device)] if device.type == "cuda" else [])]


def _set_randomness(states: list[Tensor], device: torch.device) -> None:
    torch.set_rng_state(states[0])
    if device.type == "cuda" and len(states) > 1:
        torch.cuda.set_rng_state(states[1], device)
