"""Training loop: AdamW on batches of rows, in a new order every epoch, its rate falling to zero along half a cosine."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torchdq.errors import TorchdqError


class TrainingError(TorchdqError, ArithmeticError):
    """Loss or gradient that is not finite."""


class Training(NamedTuple):
    """Settings of a training."""

    steps: int
    batch: int  # rows per step
    rate: float  # learning rate of the first step
    decay: float  # weight decay
    seed: int  # for the order of the rows, and dropout


@contextmanager
def seeded(device: torch.device, seed: int) -> Iterator[None]:
    """Torch's own generators with a seed; the caller's states come back afterwards."""
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        torch.manual_seed(seed)
        yield


class Optimiser:
    """Parameters, by name, in training; all that changes in it is in `state`."""

    def __init__(self, parameters: Mapping[str, Tensor], training: Training):
        self.parameters, self.training, self.step = parameters, training, 0
        self.device = next(iter(parameters.values())).device
        self.adamw = torch.optim.AdamW(parameters.values(), lr=training.rate, weight_decay=training.decay)

    def state(self) -> dict[str, Any]:
        """Steps done, the optimiser's state, and those of torch's generators."""
        generators = [torch.get_rng_state()]
        if self.device.type == "cuda":
            generators.append(torch.cuda.get_rng_state(self.device))
        return {"step": self.step, "adamw": self.adamw.state_dict(), "generators": generators}

    def load(self, state: Mapping[str, Any]) -> None:
        """Go on from a state."""
        self.step = state["step"]
        self.adamw.load_state_dict(state["adamw"])
        torch.set_rng_state(state["generators"][0])
        if self.device.type == "cuda":
            torch.cuda.set_rng_state(state["generators"][1], self.device)

    def epoch(
        self,
        rows: Tensor,
        error: Callable[[Tensor], Tensor],
        say: Callable[[str], None],
        prior: Callable[[], Tensor] | None = None,
    ) -> list[float]:
        """Errors of the batches of an epoch of these rows, or of the steps that are left; minimised with the prior."""
        steps, errors = self.training.steps, list[float]()
        batches = rows[torch.randperm(len(rows)).to(rows.device)].split(self.training.batch)
        for batch in batches[: steps - self.step]:
            say(f"step {self.step + 1} of {steps}")
            for group in self.adamw.param_groups:
                group["lr"] = self.training.rate / 2 * (1 + math.cos(math.pi * self.step / steps))
            found = error(batch)
            (found if prior is None else found + prior()).backward()
            self._require_finite(found, batch)
            self.adamw.step()
            self.adamw.zero_grad()
            errors.append(float(found.detach()))
            self.step += 1
        return errors

    def _require_finite(self, error: Tensor, rows: Tensor) -> None:
        """Raise unless an error and its gradients are finite."""
        gradients = {name: p.grad for name, p in self.parameters.items() if p.grad is not None}
        finite = torch.stack([x.isfinite().all() for x in (error, *gradients.values())])
        if bool(finite.all()):
            return
        what = f"the error is {float(error.detach()):g}"
        if finite[0]:
            what = f"the gradient for {list(gradients)[int(finite[1:].int().argmin())]!r} is not finite"
        self.adamw.zero_grad()
        some = ", ".join(map(str, rows[:5].tolist())) + (", ..." if len(rows) > 5 else "")
        raise TrainingError(
            f"step {self.step + 1}: {what}, in the batch of the {len(rows)} rows {some} of train; a smaller rate may "
            "help, and so may float64"
        )


def learned(model: nn.Module) -> dict[str, nn.Parameter]:
    """Parameters of a model that require gradients, by name."""
    return {name: p for name, p in model.named_parameters() if p.requires_grad}
