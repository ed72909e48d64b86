"""Trials of integrators and precisions on a scene, against a reference."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_finite
from torchdq.errors import ArgumentError
from torchdq.functions.call import Precision
from torchdq.robot import Robot
from torchdq.scene.integrators import Integrator, LinearlyImplicit, Repeated, RungeKutta4, SemiImplicitEuler
from torchdq.scene.scene import Scene
from torchdq.scene.state import State

SAMPLES = 64  # trajectories
SAFETY = 0.3  # share of the requested error that trials may make, since other states are not among the samples
MOST_STEPS = 2**15  # steps of a trajectory, by default
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
    most_steps: int = MOST_STEPS  # largest number of steps of a trajectory
    report: Callable[[str], object] = field(default=str, compare=False)  # is called with what is being tried

    @classmethod
    def of(
        cls,
        scene: Scene,
        horizon: float,
        state: State | None,
        inputs: Mapping[str, Tensor],
        most_steps: int = MOST_STEPS,
    ) -> Trial:
        """Trial over a horizon, which is rounded to whole intervals."""
        intervals = max(1, round(horizon / scene.dt))
        if intervals > most_steps:
            raise ArgumentError(
                f"the horizon holds {intervals} steps of the scene, and {most_steps} are the most; shorten it"
            )
        noise = torch.full((scene.noises,), 0.5, dtype=torch.float64)
        if state is None:
            limits = next((e for e in scene.effects if "limits.lower" in e.DESCRIBED.values()), None)
            q, qd = random_states(scene.robot, limits=limits)
            state = scene.start(q, qd, noise=noise)
        elif not (isinstance(state, State) and state.q.ndim == 2 and len(state.q)):
            raise ArgumentError(
                "state must be a torchdq.scene.State with q of the shape [samples, n]; `Scene.start` makes one"
            )
        given = {name: x for name, x in inputs.items() if x is not None}
        require_finite(**{"q": state.q, "qd": state.qd, **given})
        if scene.controller is not None and "reference" not in given:
            given["reference"] = torch.cat([state.q, torch.zeros_like(state.q).repeat(1, 2)], -1)
        if scene.noises:
            given["noise"] = noise
        return cls(scene, state, given, intervals, most_steps)

    @property
    def horizon(self) -> float:
        """Duration of the trajectories [s]."""
        return self.intervals * self.scene.dt

    @property
    def name(self) -> str:
        """Name of the trajectories in messages."""
        return f"trajectories of {self.scene.robot.name!r}"

    def with_shifted(self, shift: Tensor) -> Trial:
        """Trial with every trajectory twice: as it is, and from a start whose positions are shifted."""
        samples = len(self.state.q)
        rows = {name: x.expand(samples, -1) for name, x in self.state.rows().items()}
        state = State(**{name: torch.cat([x, x + shift if name == "q" else x]) for name, x in rows.items()})
        inputs = {name: x if x.ndim < 2 else torch.cat([x.expand(samples, -1)] * 2) for name, x in self.inputs.items()}
        return replace(self, state=state, inputs=inputs)

    @property
    def sampled(self) -> bool:
        """True if something acts once per dt, so that dt must stay."""
        return self.scene.controller is not None or any(e.SLOT in ("actuator", "sensor") for e in self.scene.effects)

    @property
    def integrators(self) -> list[Integrator]:
        """Integrators to try, those first that most surely stay finite."""
        found: list[Integrator] = [RungeKutta4(), SemiImplicitEuler()]
        # where joints may be stiff, explicit integrators would take long to show that they are
        stiff = any(effect.SLOT == "joint" for effect in self.scene.effects)
        return [LinearlyImplicit(), *found] if stiff else found

    def path(self, integrator: Integrator, times: int, arithmetic: Arithmetic) -> Tensor:
        """Positions at the ends of all intervals, [intervals, samples, n], with `times` steps in each."""
        # a scene rounds its state at the end of its step, which is an interval if something acts once per dt
        rounds = arithmetic.precision == "double" and arithmetic.dtype != torch.float64 and not self.sampled
        inner, outer = (1, times) if rounds else (times, 1)
        how = {"dt": self.scene.dt / outer, "integrator": Repeated(integrator, inner), "substeps": 1}
        scene = self.scene.replace(**how, precision=arithmetic.precision)
        steps = self.intervals * outer
        self.report(f"{type(integrator).__name__}, {times * self.intervals} steps, {arithmetic}")
        inputs: dict[str, Any] = {
            name: x.to(arithmetic.dtype).expand(steps, *x.shape) for name, x in self.inputs.items()
        }
        states = scene.rollout(self.state.to(arithmetic.dtype), steps=steps, nonfinite="ignore", **inputs)
        return states.q[outer - 1 :: outer].double()

    def error(self, integrator: Integrator, times: int, arithmetic: Arithmetic, reference: Tensor) -> float:
        """Largest error of the positions; infinite if one is not finite."""
        return distance(self.path(integrator, times, arithmetic), reference)


class Attempt(NamedTuple):
    """Numbers of steps per interval."""

    times: int  # to be tried, or fewer of them
    too_few: float  # that are not worth trying


Search = Generator[Attempt, tuple[int, float], tuple[int, float]]


def steps_needed(order: int, error: float, known: Mapping[int, float]) -> Search:
    """Search for the number of steps per interval by which an integrator meets an error, and the error it then makes.

    It asks for attempts, and is sent the number of steps that was tried, and the error that they made.

    Args:
        order: order of the integrator.
        error: error to be met.
        known: errors that numbers of steps are known to make.
    """
    too_few = max((times for times, made in known.items() if made > error), default=0)
    enough = min((times for times in known if times > too_few), default=math.inf)
    times, found = yield Attempt(too_few or 1, 0)
    while found > error:
        too_few = times
        # as far as the order promises, but never trusting it beyond a factor of eight
        factor = (found / error) ** (1 / order) if found < 0.1 else 8.0
        times = int(min(math.ceil(times * min(max(1.1 * factor, 1.25), 8.0)), enough))
        expected = too_few * factor if found < 0.01 else too_few
        times, found = yield Attempt(times, expected if times < enough else too_few)
    # the last jump may have been far: first to where the order promises to end, then to the middle
    between = max(math.ceil(1.05 * times * (found / error) ** (1 / order)), too_few + 1)
    while too_few and times > CLOSE * too_few and between < times:
        between, made = yield Attempt(between, too_few)
        times, too_few, found = (between, too_few, made) if made <= error else (times, between, found)
        between = math.ceil(math.sqrt(times * too_few))
    return times, found


def random_states(robot: Robot, samples: int = SAMPLES, limits: object | None = None) -> tuple[Tensor, Tensor]:
    """Positions within the limits, or within half a turn or half a metre, and velocities up to 1.

    The limits are those of the robot, or of the effect that simulates limits.
    """
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(2, samples, robot.n, generator=generator, dtype=torch.float64)
    revolute = torch.tensor([joint.turns for joint in robot.joint_types], dtype=torch.bool)
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
