"""Recommendations and the candidates they were chosen from; all of them can be printed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch

from torchdq.functions.call import Precision
from torchdq.scene.integrators import Integrator
from torchdq.scene.scene import Scene

REPEATED = 1.5  # cost of an operation that is repeated in float64, with gathering and scattering, relative to float64


class Arithmetic(NamedTuple):
    """Precision of the states, and of the operations on them."""

    dtype: torch.dtype
    precision: Precision
    weight: float  # cost of an operation, relative to float64

    def cost(self, repeated: float) -> float:
        """Cost of an operation if that share of the samples is recomputed in float64."""
        again = self.dtype == torch.float32 and self.precision == "auto"
        return self.weight + repeated * REPEATED if again else self.weight

    def __str__(self) -> str:
        state = str(self.dtype).removeprefix("torch.")
        return f"{state} states, computed in float64" if self.precision == "double" else state


SINGLE, MIXED = Arithmetic(torch.float32, "auto", 0.5), Arithmetic(torch.float32, "double", 1.1)
EXACT = Arithmetic(torch.float64, "auto", 1.0)


@dataclass(frozen=True)
class Candidate:
    """An arithmetic and, for trajectories, an integrator and its step, with cost and error."""

    arithmetic: Arithmetic
    error: float
    operations: float  # weighted; per simulated second, or per call
    integrator: Integrator | None = None
    step: float = 0.0  # [s]
    times: int = 1  # steps in an interval of the scene

    def __str__(self) -> str:
        stepping = f"{type(self.integrator).__name__}, steps of {self.step:.3g} s, " if self.integrator else ""
        return f"{stepping}{self.arithmetic}: error {self.error:.1e}, {self.operations:.2e} operations"


@dataclass(frozen=True)
class Recommendation:
    """Recommended way to compute accelerations; `print` it."""

    dtype: torch.dtype  # dtype of states and inputs
    precision: Precision  # to give to `forward_dynamics`, `ForwardDynamics` or `Scene`
    backend: str  # that runs it here: "c" or "eager"
    method: str  # algorithm, which the program chooses by itself: "mass matrix" or "articulated bodies"
    error: float  # predicted, up to the horizon [rad or m]; without a horizon, of accelerations, relative
    nanoseconds: float  # measured time of an integrator's step, or of a call, per robot of a batch of 4096
    others: tuple[Candidate, ...]  # candidates that meet the error, the cheapest first

    def __str__(self) -> str:
        return self._text((), "call")

    def _text(self, stepping: tuple[str, ...], unit: str) -> str:
        lines = [
            f"dtype       {str(self.dtype).removeprefix('torch.')}, precision {self.precision!r}",
            *stepping,
            f"backend     {self.backend}, accelerations by {self.method}",
            f"error       {self.error:.1e} predicted",
            f"time        {self.nanoseconds:.0f} ns per robot and {unit}",
        ]
        others = [f"- {other}" for other in self.others[1:]]
        return "\n".join([*lines, "alternatives", *others] if others else lines)


@dataclass(frozen=True)
class SceneRecommendation(Recommendation):
    """Recommended way to compute trajectories; `print` it."""

    integrator: Integrator  # integrator of the scene
    step: float  # step of the integrator [s]
    scene: Scene  # with all of this; torques are held for `repeats` of its steps if the scene that was given is longer
    repeats: int  # steps of `scene` in one of the scene that was given, or in an eighth of the horizon for a robot
    horizon: float  # time up to which the error is kept [s]
    limit: str  # why that is shorter than the horizon that was asked for; "": it is not
    growth: float  # factor by which a small change of the start grows until then; a large one asks for small steps

    def __str__(self) -> str:
        lines = [f"integrator  {type(self.integrator).__name__}, steps of {self.step:.3g} s"]
        if self.limit:
            lines.append(f"horizon     {self.horizon:.3g} s only: {self.limit}")
        return self._text(tuple(lines), "step")
