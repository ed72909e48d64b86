"""Sampling methods of optimal control: torques are drawn about a plan, which moves to those that cost less."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdq.backends.loop_call import repeat
from torchdq.base.checks import require_count, require_number
from torchdq.optimal.problem import Passes
from torchdq.scene.recording import Stage


@dataclass(frozen=True)
class Sampling:
    """Method that draws torques about a plan; the same numbers for every row."""

    samples: int = 1024
    spread: Tensor | float = 1.0
    knots: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        require_count("samples", self.samples)
        if not isinstance(self.spread, Tensor):
            require_number("spread", self.spread, positive=True)
        if self.knots is not None:
            require_count("knots", self.knots)

    def improved(
        self, passes: Passes, start: Mapping[str, Tensor], torque: Tensor, iterations: int, at: Callable[[str], None]
    ) -> Tensor:
        """Torques [steps, rows, n] after some iterations."""
        problem, (steps, _, n) = passes.problem, torque.shape
        what = Stage(problem.scene.spec, "step", problem.objective, unguarded=True)
        generator = torch.Generator(torque.device).manual_seed(self.seed)
        knots = min(self.knots or steps, steps)
        noise = torch.randn(
            iterations, knots, self.samples, 1, n, generator=generator, dtype=torque.dtype, device=torque.device
        )
        noise[:, :, 0] = 0.0  # the plan itself is a sample
        spread = torch.as_tensor(self.spread).to(torque).expand(knots, 1, torque.shape[1], n)
        several = {name: x[:, None] for name, x in passes.stepped.items()}
        for k in range(iterations):
            at(f"iteration {k + 1} of {iterations}")
            drawn = spread * noise[k]  # [knots, samples, rows, n]
            change = drawn if knots == steps else _between(drawn, steps)
            tried = torque[:, None] + change
            if passes.limits is not None:
                tried = tried.clamp(*passes.limits)
            begin = {name: x.expand(self.samples, *x.shape) for name, x in start.items()}
            stepped = {**several, problem.objective.control: tried}
            given = {**passes.fixed, **passes.shared}
            found = repeat(what, steps, begin, stepped, given, ("cost",), True, problem.scene.backend)
            torque, spread = self.moved(torque, spread, drawn, tried, found["cost"].nan_to_num(torch.inf, torch.inf))
        return torque

    def moved(
        self, torque: Tensor, spread: Tensor, drawn: Tensor, tried: Tensor, cost: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Torques and spread after samples [steps, samples, rows, n] have these costs [samples, rows]."""
        raise NotImplementedError


@dataclass(frozen=True)
class MPPI(Sampling):
    """Model predictive path integral control: the mean of samples, with weights exp(-cost / temperature).

    Args:
        samples: number of samples.
        spread: standard deviation of the torques [N m or N], a number or [..., n].
        knots: torques are drawn at so many of the steps, and linear in between; None: at every step.
        seed: of the random numbers.
        temperature: difference of costs by which a weight falls to 1/e.

    Source: G. Williams, A. Aldrich, E. Theodorou, "Model predictive path integral control: from theory to parallel
    computation", Journal of Guidance, Control, and Dynamics 40 (2017).

    >>> from torchdq import optimal
    >>> optimal.MPPI(samples=512, spread=0.5, temperature=0.1)
    MPPI(samples=512, spread=0.5, knots=None, seed=0, temperature=0.1)
    """

    temperature: float = 1.0

    def moved(
        self, torque: Tensor, spread: Tensor, drawn: Tensor, tried: Tensor, cost: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean of the samples."""
        weight = torch.softmax((cost.amin(0) - cost) / self.temperature, 0)
        found = torch.einsum("sr,tsrn->trn", weight, tried)
        return torch.where(cost.amin(0).isfinite()[:, None], found, torque), spread


@dataclass(frozen=True)
class CEM(Sampling):
    """Cross-entropy method: mean and spread of the samples of least cost.

    Args:
        samples, spread, knots, seed: as in `MPPI`; the spread is that of the first iteration.
        elite: share of the samples that count.
        least: share of the spread that is left at least, so that later iterations find something new.

    >>> from torchdq import optimal
    >>> optimal.CEM(samples=512, spread=0.5)
    CEM(samples=512, spread=0.5, knots=None, seed=0, elite=0.05, least=0.01)
    """

    elite: float = 0.05
    least: float = 0.01

    def moved(
        self, torque: Tensor, spread: Tensor, drawn: Tensor, tried: Tensor, cost: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean and spread of the best samples."""
        best = cost.topk(max(2, round(self.elite * self.samples)), 0, largest=False).indices[None, ..., None]
        pick: Callable[[Tensor], Tensor] = lambda x: x.gather(1, best.expand(len(x), -1, -1, x.shape[-1]))  # noqa: E731
        found, width = pick(tried).mean(1), pick(drawn).std(1, keepdim=True)
        spread = torch.maximum(width, self.least * spread)
        return torch.where(cost.amin(0).isfinite()[:, None], found, torque), spread


def _between(x: Tensor, steps: int) -> Tensor:
    """Numbers of knots [knots, ...] at all steps, linear in between."""
    at = torch.linspace(0.0, len(x) - 1.0, steps, dtype=x.dtype, device=x.device)
    low = at.floor().clamp(max=len(x) - 2.0 if len(x) > 1 else 0.0)
    hat = (1.0 - (at[:, None] - torch.arange(len(x), dtype=x.dtype, device=x.device)).abs()).clamp(min=0.0)
    return torch.tensordot(hat, x, 1) if low.numel() else x
