"""Sampling methods of optimal control: torques are drawn about a plan, which moves to those that cost less."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdq.backends.loop_call import repeat
from torchdq.base.checks import Interval, require, require_count, require_number
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
        shape = (knots, self.samples, 1, n)
        spread = torch.as_tensor(self.spread).to(torque).expand(knots, 1, torque.shape[1], n)
        several = {name: x[:, None] for name, x in passes.stepped.items()}
        begin = {name: x.expand(self.samples, *x.shape) for name, x in start.items()}
        for k in range(iterations):
            at(f"iteration {k + 1} of {iterations}")
            drawn = torch.randn(shape, generator=generator, dtype=torque.dtype, device=torque.device)
            drawn[:, 0] = 0.0  # the plan itself is a sample
            drawn = spread * drawn  # [knots, samples, rows, n]
            stepped = {**several, problem.objective.control: passes.within(torque[:, None] + _between(drawn, steps))}
            given = {**passes.fixed, **passes.shared}
            found = repeat(what, steps, begin, stepped, given, ("cost", "planned"), True, problem.scene.backend)
            cost = found["cost"].nan_to_num(torch.inf, torch.inf)
            change, spread = self.moved(spread, drawn, cost)
            change = torch.where(cost.amin(0).isfinite()[:, None], change, 0.0)
            torque = passes.within(torque + _between(change, steps))
        return torque

    def moved(self, spread: Tensor, drawn: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
        """Change of the plan [knots, rows, n], and spread, of changes drawn [knots, samples, ...] with their costs."""
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

    def __post_init__(self) -> None:
        super().__post_init__()
        require_number("temperature", self.temperature, positive=True)

    def moved(self, spread: Tensor, drawn: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
        """Mean of the samples."""
        weight = torch.softmax((cost.amin(0) - cost) / self.temperature, 0)
        return torch.einsum("sr,ksrn->krn", weight, drawn), spread


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

    def __post_init__(self) -> None:
        super().__post_init__()
        require_count("samples", self.samples, 2)
        require("elite", self.elite, Interval(0.0, open=True, below=1.0))
        require_number("least", self.least, least=0.0)

    def moved(self, spread: Tensor, drawn: Tensor, cost: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and spread of the best samples."""
        best = cost.topk(max(2, round(self.elite * self.samples)), 0, largest=False).indices[None, ..., None]
        chosen = drawn.gather(1, best.expand(len(drawn), -1, -1, drawn.shape[-1]))
        return chosen.mean(1), torch.maximum(chosen.std(1, keepdim=True), self.least * spread)


def _between(x: Tensor, steps: int) -> Tensor:
    """Numbers of knots [knots, ...] at all steps, linear in between."""
    if len(x) == steps:
        return x
    at = torch.linspace(0.0, len(x) - 1.0, steps, dtype=x.dtype, device=x.device)
    share = 1.0 - (at[:, None] - torch.arange(len(x), dtype=x.dtype, device=x.device)).abs()
    return torch.tensordot(share.clamp(min=0.0), x, 1)
