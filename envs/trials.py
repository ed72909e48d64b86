"""Trials of integrators and precisions on a scene, against trajectories whose steps are short enough."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.envs.integrators import Integrator, LinearlyImplicit, Repeated, RungeKutta4, SemiImplicitEuler
from torchdq.envs.scene import Scene
from torchdq.envs.state import State
from torchdq.errors import ArgumentError
from torchdq.functional import Precision, require_finite
from torchdq.robot import Robot

SAMPLES = 64  # trajectories
SAFETY = 0.3  # share of the requested error that trials may make, since other states are not among the samples
MOST_STEPS = 2**15  # steps of a trajectory
CLOSE = 1.3  # ratio of a number of steps that is enough to one that is not, at which the search ends
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


ARITHMETICS = (
    Arithmetic(torch.float32, "auto", 0.5),
    Arithmetic(torch.float32, "double", 1.1),
    Arithmetic(torch.float64, "auto", 1.0),
)
EXACT = ARITHMETICS[-1]


@dataclass(frozen=True)
class Trial:
    """A scene with initial states, inputs and a horizon."""

    scene: Scene
    state: State
    inputs: dict[str, Tensor]
    intervals: int  # number of the scene's dt until the horizon

    @classmethod
    def of(cls, scene: Scene, horizon: float, state: State | None, inputs: dict[str, Tensor]) -> Trial:
        """Trial over a horizon, which is rounded to whole intervals."""
        intervals = max(1, round(horizon / scene.dt))
        if intervals > MOST_STEPS:
            raise ArgumentError(
                f"the horizon holds {intervals} steps of the scene, and {MOST_STEPS} are the most; shorten it"
            )
        noise = torch.full((scene.noises,), 0.5, dtype=torch.float64)
        if state is None:
            limits = next((e for e in scene.effects if "limits.lower" in e.DESCRIBED.values()), None)
            q, qd = random_states(scene.robot, limits=limits)
            state = scene.start(q, qd, noise=noise)
        elif not (isinstance(state, State) and state.q.ndim == 2 and len(state.q)):
            raise ArgumentError(
                "state must be a torchdq.envs.State with q of the shape [samples, n]; `Scene.start` makes one"
            )
        given = {name: x for name, x in inputs.items() if x is not None}
        require_finite(**{"q": state.q, "qd": state.qd, **given})
        if scene.controller is not None and "reference" not in given:
            given["reference"] = torch.cat([state.q, torch.zeros_like(state.q).repeat(1, 2)], -1)
        if scene.noises:
            given["noise"] = noise
        return cls(scene, state, given, intervals)

    @property
    def name(self) -> str:
        """Words for the trial in error messages."""
        return f"trajectories of {self.scene.robot.name!r} over {self.intervals * self.scene.dt:.3g} s"

    @property
    def sampled(self) -> bool:
        """True if something acts once per dt, so that dt must stay."""
        return self.scene.controller is not None or any(e.SLOT in ("actuator", "sensor") for e in self.scene.effects)

    @property
    def integrators(self) -> list[Integrator]:
        """Integrators to try, the most promising first."""
        found: list[Integrator] = [RungeKutta4(), SemiImplicitEuler()]
        # where joints may be stiff, explicit integrators would take long to show that they are
        stiff = any(effect.SLOT == "joint" for effect in self.scene.effects)
        return [LinearlyImplicit(), *found] if stiff else found

    def path(self, integrator: Integrator, times: int, arithmetic: Arithmetic) -> Tensor:
        """Positions at the ends of all intervals, [intervals, samples, n], with `times` steps in each."""
        # a scene rounds its state at the end of its step, which is an interval if something acts once per dt
        dt, inner, outer = self.scene.dt, times, 1
        if not self.sampled:
            dt, inner, outer = dt / times, 1, times
        scene = self.scene.replace(
            dt=dt, integrator=Repeated(integrator, inner), substeps=1, precision=arithmetic.precision
        )
        state = self.state.to(arithmetic.dtype)
        inputs = {name: x.to(arithmetic.dtype) for name, x in self.inputs.items()}
        found = []
        for _ in range(self.intervals):
            for _ in range(outer):
                state = scene.step(state, **inputs)
            found.append(state.q.double())
        return torch.stack(found)

    def error(self, integrator: Integrator, times: int, arithmetic: Arithmetic, reference: Tensor) -> float:
        """Largest error of the positions; infinite if one is not finite."""
        return distance(self.path(integrator, times, arithmetic), reference)

    def exact_path(self, error: float) -> Tensor:
        """Positions up to the horizon, exact to a fiftieth of the error; extrapolated from steps that are halved."""
        closest = math.inf
        for integrator in self.integrators[:2]:
            row: list[Tensor] = []
            stuck = 0
            for k in range(int(math.log2(MOST_STEPS / self.intervals)) + 1):
                before, row = row, [self.path(integrator, 2**k, EXACT)]
                # an error that is a series in the step, from the power of the order on, loses a term with every column
                for j, coarser in enumerate(before[:4]):
                    row.append(row[j] + (row[j] - coarser) / (2 ** (integrator.order + j) - 1))
                if not before:
                    continue
                # at kinks there is no such series, and the steps themselves have to converge
                for found, last in ((row[-1], before[-1]), (row[0], before[0])):
                    change = distance(found, last)
                    if change <= error / 50:
                        return found
                stuck = stuck + 1 if change >= closest and closest < 1e-6 else 0
                closest = min(closest, change)
                if stuck > 2:
                    break
        if not closest < 1e3:
            raise ArgumentError(
                f"{self.name} do not stay finite, however short the steps; is the controller stable with dt = "
                f"{self.scene.dt:g} s?"
            )
        raise ArgumentError(
            f"{self.name} can be computed to {closest * 50 / SAFETY:.1e} at best, not to {error / SAFETY:.1e}; shorten "
            f"the horizon or raise the error"
        )

    def steps_needed(
        self, integrator: Integrator, reference: Tensor, error: float, most: float
    ) -> tuple[int, float] | None:
        """Steps per interval by which an integrator meets an error in float64, and the error it then makes."""
        times, found = 1, self.error(integrator, 1, EXACT, reference)
        too_few = 0
        while found > error:
            too_few = times
            # as far as the order promises, but never trusting it beyond a factor of eight
            factor = (found / error) ** (1 / integrator.order) if found < 0.1 else 8.0
            if times * (factor if found < 0.01 else 1.0) > most:
                return None
            times = math.ceil(times * min(max(1.1 * factor, 1.25), 8.0))
            found = self.error(integrator, times, EXACT, reference)
        # the last jump may have been far
        while too_few and times > CLOSE * too_few:
            between = math.ceil(math.sqrt(times * too_few))
            if between == times:
                break
            made = self.error(integrator, between, EXACT, reference)
            times, too_few, found = (between, too_few, made) if made <= error else (times, between, found)
        return times, found


def random_states(robot: Robot, samples: int = SAMPLES, limits: object | None = None) -> tuple[Tensor, Tensor]:
    """Positions within the limits, or within half a turn or half a metre, and velocities up to 1.

    The limits are those of the robot, or of the effect that simulates limits.
    """
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(2, samples, robot.n, generator=generator, dtype=torch.float64)
    revolute = torch.tensor([joint.turns for joint in robot.joint_types])
    reach = torch.where(revolute, math.pi / 2, 0.25).double()
    of: object = robot.limits if limits is None else limits
    lower, upper = (torch.as_tensor(getattr(of, name), dtype=torch.float64) for name in ("lower", "upper"))
    bounded = lower.isfinite() & upper.isfinite()
    lower, upper = torch.where(bounded, lower, -reach), torch.where(bounded, upper, reach)
    # away from the limits, which a trajectory would leave at once
    middle, half = (lower + upper) / 2, 0.8 * (upper - lower) / 2
    return middle + half * (2 * unit[0] - 1), 2 * unit[1] - 1


def distance(x: Tensor, y: Tensor) -> float:
    """Largest difference; infinite if one is not finite."""
    difference = (x - y).abs()
    return float(difference.max()) if bool(difference.isfinite().all()) else math.inf
