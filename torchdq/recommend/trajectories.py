"""Trajectories of a scene by candidates of integrator, step and precision, and a reference that is converged.

Steps are halved until two runs agree to a small part of the error. Every trajectory of the reference is computed twice,
the second time from a start that is shifted by so little that the distance of the two grows as every small error does;
where an arm falls without damping, exponentially. Once it has grown a million times, a start that is rounded to float32
ends a tenth of a radian away, no step makes the trajectory meaningful, and the reference ends there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_finite
from torchdq.errors import ArgumentError
from torchdq.recommend.recommendation import EXACT, SINGLE, Arithmetic, Candidate
from torchdq.robot import Robot
from torchdq.scene.integrators import DormandPrince, Integrator, LinearlyImplicit, RungeKutta4, SemiImplicitEuler
from torchdq.scene.scene import Scene
from torchdq.scene.state import State

SAMPLES = 64  # trajectories
SAFETY = 0.3  # share of the requested error that trials may make, since other states are not among the samples
MOST_STEPS = 2**15  # steps of a trajectory, by default
CLOSE = 1.3  # ratio of a number of steps that is enough to one that is not, at which the search ends
PRUNE = 4.0  # candidates costing more than this times the best are dropped
MOST_GROWTH = 1e6  # growth of a small error up to which a trajectory is held
SHIFT = 1e-9  # change of the start, above rounding and below curvature [rad or m]
NEAR = 0.1  # change by halved steps below which a path shows how errors grow [rad or m]
EXACTNESS = 20  # ratio of the error to the change by the last halving, which is more than the reference's own error
FIRST, FACTOR = 1e-3, 1.5  # first time to which growth is followed [s], and ratio of the next ones
TOLERANCE = 1e-6  # tolerated error of a step along which it is followed [rad or m]


@dataclass(frozen=True)
class Trial:
    """A scene with initial states, inputs and a horizon."""

    scene: Scene
    state: State
    inputs: dict[str, Tensor]
    intervals: int  # number of the scene's dt until the horizon
    most_steps: int  # largest number of steps of a trajectory
    report: Callable[[str], object]  # is called with what is being tried

    @classmethod
    def of(
        cls,
        scene: Scene,
        horizon: float,
        state: State | None,
        inputs: Mapping[str, Tensor],
        most_steps: int = MOST_STEPS,
        report: Callable[[str], object] = str,
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
        return cls(scene, state, given, intervals, most_steps, report)

    @property
    def horizon(self) -> float:
        """Duration of the trajectories [s]."""
        return self.intervals * self.scene.dt

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

    def with_shifted(self) -> Trial:
        """Trial with every trajectory twice: as it is, and from a start whose positions are shifted at random."""
        samples, generator = len(self.state.q), torch.Generator().manual_seed(2)
        shift = SHIFT * (2 * torch.randint(0, 2, self.state.q.shape, generator=generator) - 1).double()
        rows = {name: x.expand(samples, -1) for name, x in self.state.rows().items()}
        state = State(**{name: torch.cat([x, x + shift if name == "q" else x]) for name, x in rows.items()})
        inputs = {name: x if x.ndim < 2 else torch.cat([x.expand(samples, -1)] * 2) for name, x in self.inputs.items()}
        return replace(self, state=state, inputs=inputs)

    def path(self, integrator: Integrator, times: int, arithmetic: Arithmetic) -> Tensor:
        """Positions at the ends of all intervals, [intervals, samples, n], with `times` steps in each."""
        self.report(f"{type(integrator).__name__}, {times * self.intervals} steps, {arithmetic}")
        scene, dtype = self.scene.replace(integrator=integrator, substeps=times, unroll=False), arithmetic.dtype
        inputs: dict[str, Any] = {n: x.to(dtype).expand(self.intervals, *x.shape) for n, x in self.inputs.items()}
        return scene.rollout(self.state.to(dtype), steps=self.intervals, nonfinite="ignore", **inputs).q.double()

    def unpredictable(self, until: float) -> str:
        """Reason why trajectories end at a time."""
        what = f"trajectories of {self.scene.robot.name!r} cannot be held beyond {until:.3g} s"
        return f"{what}, for small errors soon grow {MOST_GROWTH:.0e} times"

    def predictable(self) -> tuple[Trial, str]:
        """Trial up to the time until which its trajectories can be held, in as many intervals, and the reason.

        The growth of a small change is followed along coarse trajectories: there is one like them that is exact.
        """
        pair, time, growth = self.with_shifted(), 0.0, 1.0
        scene, state = pair.scene.replace(integrator=DormandPrince(TOLERANCE, TOLERANCE), substeps=1), pair.state
        while time < self.horizon:
            before, grown_before = time, growth
            time = min(max(FIRST, FACTOR * time), self.horizon)
            self.report(f"growth of errors until {time:.2g} s")
            state = scene.replace(dt=time - before).step(state, **pair.inputs)
            at, shifted = state.q.chunk(2)
            growth = float((shifted - at).abs().max()) / SHIFT
            if growth > MOST_GROWTH:
                share = math.log(MOST_GROWTH / grown_before) / math.log(growth / grown_before)
                until = float(f"{0.95 * (before + share * (time - before)):.2g}")
                return replace(self, scene=self.scene.replace(dt=until / self.intervals)), self.unpredictable(until)
        return self, ""


class Reference(NamedTuple):
    """Positions up to the time until which they can be held."""

    trial: Trial  # until that time
    positions: Tensor  # [intervals, samples, n]
    growth: float  # factor by which a small change of the start grows until then
    limit: str  # why it ends before the horizon; "": it does not


def reference(trial: Trial, error: float) -> Reference:
    """Reference that is exact to a small part of the error, extrapolated from steps that are halved.

    Raises:
        ArgumentError: not even the first interval can be held, or no steps are short enough.
    """
    pair, limit, closest, spent = trial.with_shifted(), "", math.inf, False
    for integrator in trial.integrators[:2]:
        row, times, stuck = list[Tensor](), 1, 0
        while stuck < 3 and times * pair.intervals <= trial.most_steps:
            # an error that is a series in the step, from the power of the order on, loses a term with every column
            before, row, times = row, [pair.path(integrator, times, EXACT)], 2 * times
            for j, coarser in enumerate(before[:4]):
                row.append(row[j] + (row[j] - coarser) / (2 ** (integrator.order + j) - 1))
            if not before:
                continue
            at, shifted = row[-1].chunk(2, 1)
            growth = _largest(shifted - at) / SHIFT
            until = _first(growth <= MOST_GROWTH)
            if until < _first(_largest(row[-1] - before[-1]) <= NEAR):
                limit = trial.unpredictable(until * trial.scene.dt)
                if not until:
                    raise ArgumentError(f"{limit}; give the scene damping, a controller or a shorter dt")
                trial, pair = (replace(of, intervals=until) for of in (trial, pair))
                before, row = ([x[:until] for x in of] for of in (before, row))
            # at kinks there is no such series, and the steps themselves have to converge
            changes = [float(_largest(row[k] - before[k])[-1]) for k in (-1, 0)]
            for k, change in zip((-1, 0), changes, strict=True):
                if change <= error / EXACTNESS:
                    return Reference(trial, row[k].chunk(2, 1)[0], float(growth[len(row[0]) - 1]), limit)
            stuck = stuck + 1 if not min(changes) < closest and closest < 1e-6 else 0
            closest = min(closest, *changes)
        spent = spent or stuck < 3
    name = f"trajectories of {trial.scene.robot.name!r} over {trial.horizon:.3g} s"
    steps, cure = (f"in {trial.most_steps} steps", "give more steps, ") if spent else ("however short the steps", "")
    if not closest < 1e3:
        raise ArgumentError(
            f"{name} do not stay finite, {steps}; is the controller stable with dt = {trial.scene.dt:g} s?"
        )
    raise ArgumentError(
        f"{name} can be computed to {closest * EXACTNESS / SAFETY:.1e} at best, not to {error / SAFETY:.1e}"
        f", {steps}; {cure}shorten the horizon or raise the error"
    )


def candidates(exact: Reference, error: float, repeated: float) -> tuple[Candidate, ...]:
    """Candidates that meet the error, the cheapest first: of every integrator, the fewest steps with which it does.

    The steps of all integrators are halved together until they are far dearer than the best that was found.

    Args:
        repeated: share of the samples that float32 recomputes in float64.
    """
    trial, found, few = exact.trial, list[Candidate](), 0
    dt, most = trial.scene.dt, trial.most_steps // trial.intervals
    costs = {i: trial.scene.replace(integrator=i, substeps=1).count().total / dt for i in trial.integrators}

    @cache
    def made(integrator: Integrator, times: int, arithmetic: Arithmetic = EXACT) -> float:
        return distance(trial.path(integrator, times, arithmetic), exact.positions)

    trying = list(costs)
    while trying and few < most:
        times = min(max(1, 2 * few), most)
        cheap = PRUNE * min((c.operations for c in found), default=math.inf)
        trying = [integrator for integrator in trying if times * costs[integrator] <= cheap]
        for integrator in [one for one in trying if made(one, times) <= error]:
            trying.remove(integrator)
            least, enough = few, times
            while enough > max(CLOSE * least, least + 1):
                middle = math.ceil(math.sqrt(least * enough))
                least, enough = (least, middle) if made(integrator, middle) <= error else (middle, enough)
            for arithmetic in (SINGLE, EXACT):
                if (off := made(integrator, enough, arithmetic)) <= error:
                    cost = arithmetic.cost(repeated) * enough * costs[integrator]
                    found.append(Candidate(arithmetic, off, cost, integrator, dt / enough, enough))
        few = times
    if not found:
        raise ArgumentError(
            f"no candidate was found in {trial.most_steps} steps that keeps trajectories of "
            f"{trial.scene.robot.name!r} over {trial.horizon:.3g} s to {error / SAFETY:.1e}; "
            "give more steps, shorten the horizon or raise the error"
        )
    found.sort(key=lambda c: c.operations)
    return tuple([c for c in found if c.operations <= PRUNE * found[0].operations])


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
    return float(_largest(x - y)[-1])


def _largest(differences: Tensor) -> Tensor:
    """Largest differences until the end of every interval; infinite if one is not finite."""
    size = differences.abs().amax((-1, -2))
    return torch.where(size.isfinite(), size, math.inf).cummax(0).values


def _first(good: Tensor) -> int:
    """Number of intervals before the first that is not good."""
    return int(good.long().cumprod(0).sum())
