"""Recommendation of precision, integrator and step for a requested error, found by trials on the scene itself.

Trajectories from random states are compared with ones of steps so small that smaller ones change nothing. Every
integrator is refined until it meets the error in float64; then it is tried whether float32 still does. The one with the
fewest operations per simulated second is recommended, an operation in float32 counting half.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchdq.backends.choice import BackendName, choose
from torchdq.effects import Gravity, RotorInertia
from torchdq.envs.integrators import Integrator, Repeated
from torchdq.envs.scene import Scene
from torchdq.envs.state import State
from torchdq.envs.trials import ARITHMETICS, EXACT, MOST_STEPS, SAFETY, Arithmetic, Trial, random_states
from torchdq.errors import ArgumentError
from torchdq.functional import Precision, error_growth, forward_dynamics, inverse_dynamics
from torchdq.functions.compile import compile
from torchdq.program.program import LARGEST_GROWTH, Program
from torchdq.robot import Robot
from torchdq.timing import medians

STATES = 256  # states at which accelerations are tried
TYPICAL = 100.0  # errors of accelerations in units of eps times `error_growth`; measured on robots and chains
PRUNE = 8.0  # candidates costing more than this times the best are dropped
MOST_SUBSTEPS = 16  # substeps in one program
BATCH = 4096  # samples per timed call
SECONDS = 0.05  # time of measuring [s]


@dataclass(frozen=True)
class Candidate:
    """An arithmetic with its cost and its error."""

    arithmetic: Arithmetic
    error: float
    operations: float  # weighted; per simulated second, or per call

    def __str__(self) -> str:
        return f"{self.arithmetic}: error {self.error:.1e}, {self.operations:.2e} operations"


@dataclass(frozen=True)
class Stepping(Candidate):
    """An arithmetic with an integrator and its step."""

    integrator: Integrator
    step: float  # [s]
    times: int  # steps in an interval of the scene

    def __str__(self) -> str:
        return f"{type(self.integrator).__name__}, steps of {self.step:.3g} s, {super().__str__()}"


@dataclass(frozen=True)
class Recommendation:
    """Recommended way to compute accelerations; `print` it."""

    dtype: torch.dtype
    """dtype of states and inputs."""
    precision: Precision
    """`precision` to give to `forward_dynamics`, `ForwardDynamics` or `Scene`."""
    backend: str
    """Backend that runs it here: "c" or "eager"."""
    method: str
    """Algorithm of the accelerations: "mass matrix" or "articulated bodies". The program chooses it by itself."""
    error: float
    """Predicted error up to the horizon [rad or m]; without a horizon, of accelerations, relative."""
    nanoseconds: float
    """Measured time of an integrator's step, or of a call, per robot of a batch of 4096, on this machine."""
    others: tuple[Candidate, ...]
    """Candidates that meet the error, the cheapest first."""

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

    integrator: Integrator
    """Integrator of the scene."""
    step: float
    """Step of the integrator [s]."""
    scene: Scene
    """Scene with all of this; torques are held for `repeats` of its steps if the scene that was given is longer."""
    repeats: int
    """Steps of `scene` in one of the scene that was given, or in an eighth of the horizon for a robot."""

    def __str__(self) -> str:
        return self._text((f"integrator  {type(self.integrator).__name__}, steps of {self.step:.3g} s",), "step")


def recommend(
    what: Robot | Scene,
    error: float = 1e-3,
    horizon: float | None = 1.0,
    state: State | None = None,
    **inputs: Tensor,
) -> Recommendation:
    """The cheapest precision, integrator and step that keep an error, found by trials on the robot or scene itself.

    Args:
        what: a robot, which moves under gravity and no torques; or a scene. Its effects, controller and substance stay;
            precision, integrator and step are searched. A scene with controller, actuators or sensors keeps its dt, for
            they act once in it, and gets substeps.
        error: largest error of a joint's position [rad or m] at the end of any of the scene's steps up to the horizon,
            or of eighths of the horizon for a robot; without a horizon, of the accelerations that `forward_dynamics`
            finds, relative to the largest of them.
        horizon: duration of the trajectories [s], rounded to steps of the scene; None: accelerations alone, of a robot.
        state: initial states, float64, shape [samples, n]; None: 64 random ones within the limits, moving at up to
            1 rad/s.
        inputs: inputs of the scene at a step, held over the horizon; None: torques are zero, and a controller's
            reference is to stay.

    Returns:
        A `SceneRecommendation` with a scene, integrator and step; without a horizon, a `Recommendation`.

    Raises:
        ArgumentError: nothing reaches the error, or trajectories cannot be computed over the horizon; it says what can.

    >>> import torchdq
    >>> found = recommend(torchdq.robots.load("two_link"), error=1e-3, horizon=0.2)
    >>> found.scene.step(found.scene.start(torch.zeros(8, 2, dtype=found.dtype))).q.shape
    torch.Size([8, 2])
    """
    if isinstance(error, bool) or not (isinstance(error, int | float) and 0 < error < math.inf):
        raise ArgumentError(f"error must be a positive number, found {error!r}")
    if not (horizon is None or (isinstance(horizon, int | float) and 0 < horizon < math.inf)):
        raise ArgumentError(f"horizon must be a positive number of seconds or None, found {horizon!r}")
    if horizon is None and not isinstance(what, Robot):
        raise ArgumentError("a scene needs a horizon; without a horizon, pass scene.robot")
    if horizon is None and (state is not None or inputs):
        raise ArgumentError("state and inputs are those of a trajectory, and without a horizon there is none")
    scene = _falling(what, horizon or 1.0) if isinstance(what, Robot) else what
    if not isinstance(scene, Scene):
        raise ArgumentError(f"what must be a torchdq.Robot or a torchdq.envs.Scene, found {type(what).__name__}")
    for name, batch in scene.batches.items():
        if batch:
            raise ArgumentError(
                f"recommend tries one robot at a time, found batch axes {batch} of {name}; "
                f"give it the one that is hardest to simulate, with the lightest links or the stiffest joints"
            )
    with torch.no_grad():
        if horizon is None:
            return _for_accelerations(scene.robot, error)
        return _for_trajectories(Trial.of(scene, horizon, state, inputs), error)


def _falling(robot: Robot, horizon: float) -> Scene:
    """Scene of the robot as `forward_dynamics` knows it."""
    rotors = () if robot.armature is None else (RotorInertia(),)
    return Scene(robot, (Gravity(), *rotors), dt=horizon / 8)


# --- trajectories -----------------------------------------------------------------------------------------------------


def _for_trajectories(trial: Trial, error: float) -> SceneRecommendation:
    accepted = SAFETY * error
    found = _candidates(trial, trial.exact_path(accepted), accepted)
    if not found:
        raise ArgumentError(
            f"no candidate keeps {trial.name} within {error:.1e} in {MOST_STEPS} steps; shorten the horizon or raise "
            f"the error"
        )
    best = found[0]
    times, precision = best.times, best.arithmetic.precision
    scene = trial.scene.replace(integrator=best.integrator, precision=precision, substeps=1)
    if not trial.sampled:
        scene = scene.replace(dt=best.step)
    elif times <= MOST_SUBSTEPS:
        scene = scene.replace(substeps=times)
    else:  # more than a program should hold
        scene = scene.replace(integrator=Repeated(best.integrator, times))
    (nanoseconds,) = medians([_step(scene, best.arithmetic.dtype, trial)], BATCH, SECONDS)
    return SceneRecommendation(
        **_common(best, scene.robot, scene.backend),
        nanoseconds=nanoseconds / times if trial.sampled else nanoseconds,
        others=tuple(found),
        integrator=best.integrator,
        step=best.step,
        scene=scene,
        repeats=1 if trial.sampled else times,
    )


def _candidates(trial: Trial, reference: Tensor, error: float) -> list[Stepping]:
    """Candidates that meet the error, the cheapest first."""
    found: list[Stepping] = []
    dt = trial.scene.dt
    repeated = _repeated(trial.scene.robot, trial.state.q)
    for integrator in trial.integrators:
        per_step = trial.scene.replace(integrator=integrator, substeps=1).count().total
        most = MOST_STEPS / trial.intervals
        if found:
            most = min(most, PRUNE * found[0].operations * dt / per_step)
        needed = trial.steps_needed(integrator, reference, error, most)
        if needed is None:
            continue
        times, exact = needed
        for arithmetic in ARITHMETICS:
            made = exact if arithmetic is EXACT else trial.error(integrator, times, arithmetic, reference)
            if made <= error:
                operations = arithmetic.cost(repeated) * per_step * times / dt
                found.append(Stepping(arithmetic, made, operations, integrator, dt / times, times))
        found.sort(key=lambda c: c.operations)
    return found


def _step(scene: Scene, dtype: torch.dtype, trial: Trial) -> Callable[[], State]:
    """Step of a batch, to be timed."""

    def many(x: Tensor) -> Tensor:
        return x.to(dtype).expand(BATCH, -1) if x.ndim < 2 else x.to(dtype).repeat(-(-BATCH // len(x)), 1)[:BATCH]

    state = State(**{name: many(x) for name, x in trial.state.rows().items()})
    inputs = {name: many(x) for name, x in trial.inputs.items()}
    return lambda: scene.step(state, **inputs)


# --- accelerations ----------------------------------------------------------------------------------------------------


def _for_accelerations(robot: Robot, error: float) -> Recommendation:
    q, qd = random_states(robot, STATES)
    generator = torch.Generator().manual_seed(1)
    wanted = 2 * torch.rand(q.shape, generator=generator, dtype=q.dtype) - 1
    # numbers that float32 can hold, so that only the operations on them make errors
    x = [y.float().double() for y in (q, qd, inverse_dynamics(robot, q, qd, wanted))]
    exact = forward_dynamics(robot, x[0], x[1], x[2])
    rounding = TYPICAL * 2.0**-53 * float(error_growth(robot, q).max())
    operations, repeated = _program(robot).count().total, _repeated(robot, q)
    found = []
    for arithmetic in ARITHMETICS:
        made = rounding
        if arithmetic.dtype == torch.float32:
            q, qd, tau = (y.float() for y in x)
            y = forward_dynamics(robot, q, qd, tau, precision=arithmetic.precision).double()
            made += float(((y - exact).abs().amax(-1) / exact.abs().amax(-1)).max())
        found.append(Candidate(arithmetic, made, arithmetic.cost(repeated) * operations))
    good = sorted((c for c in found if c.error <= SAFETY * error), key=lambda c: c.operations)
    if not good:
        raise ArgumentError(
            f"accelerations of robot {robot.name!r} can be found to {min(c.error for c in found) / SAFETY:.1e} at "
            f"best, not to {error:.1e}"
        )
    best = good[0]
    q, qd, tau = (y.to(best.arithmetic.dtype).repeat(BATCH // STATES, 1) for y in x)
    call = partial(forward_dynamics, robot, q, qd, tau, precision=best.arithmetic.precision)
    (nanoseconds,) = medians([call], BATCH, SECONDS)
    return Recommendation(**_common(best, robot, None), nanoseconds=nanoseconds, others=tuple(good))


# --- both -------------------------------------------------------------------------------------------------------------


def _repeated(robot: Robot, q: Tensor) -> float:
    """Share of the positions that float32 recomputes in float64."""
    return float((error_growth(robot, q) > LARGEST_GROWTH.single).double().mean())


def _program(robot: Robot) -> Program:
    return compile(robot, "forward_dynamics").program


def _common(best: Candidate, robot: Robot, backend: BackendName | None) -> dict[str, Any]:
    """Fields that both recommendations have."""
    return {
        "dtype": best.arithmetic.dtype,
        "precision": best.arithmetic.precision,
        "backend": choose(backend, torch.device("cpu")).name,
        "method": "articulated bodies" if "articulated" in _program(robot).name else "mass matrix",
        "error": best.error / SAFETY,
    }
