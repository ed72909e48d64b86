"""Which precision, integrator and step a scene needs for an error that is asked for, found by trying them on it.

Trajectories from random states are compared with ones of steps so small that smaller ones change nothing. Every way to
integrate is refined until it meets the error in float64; then it is seen whether float32 still does. Of those that meet
it, the one with the fewest operations per simulated second is recommended, an operation in float32 counting half.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.choice import BackendName, choose
from torchdq.effects import Gravity, Limits, RotorInertia
from torchdq.envs.integrators import Integrator, LinearlyImplicit, Repeated, RungeKutta4, SemiImplicitEuler
from torchdq.envs.scene import Scene, State
from torchdq.envs.timing import medians
from torchdq.errors import ArgumentError
from torchdq.functional import Precision, error_growth, forward_dynamics, inverse_dynamics
from torchdq.functions.compile import compile
from torchdq.program.program import LARGEST_GROWTH, Program
from torchdq.robot import Robot

SAMPLES = 64  # trajectories
STATES = 256  # of which accelerations are found
TYPICAL = 100.0  # errors of accelerations in units of eps times `error_growth`; measured on robots and chains
SAFETY = 0.3  # of the asked error, for states that were not among the samples
MOST_STEPS = 2**15  # of a trajectory
AGAIN = 1.5  # of an operation that is done in float64 after it was done in float32, with what gathers and scatters it
CLOSE = 1.3  # between a number of steps that is enough and one that is not
MANY = 8.0  # times the cost of the best, from which nothing is of interest
MOST_SUBSTEPS = 16  # in one program
BATCH = 4096  # at which times are measured
SECONDS = 0.05  # of measuring


class Arithmetic(NamedTuple):
    """A precision of states with one of what happens to them."""

    dtype: torch.dtype
    precision: Precision
    weight: float  # of an operation

    def cost(self, lost: float) -> float:
        """Of an operation, if that part of the samples is lost in float32 and computed again."""
        again = self.dtype == torch.float32 and self.precision == "auto"
        return self.weight + lost * AGAIN if again else self.weight

    def __str__(self) -> str:
        state = str(self.dtype).removeprefix("torch.")
        return f"{state} states, computed in float64" if self.precision == "double" else state


ARITHMETICS = (
    Arithmetic(torch.float32, "auto", 0.5),
    Arithmetic(torch.float32, "double", 1.1),
    Arithmetic(torch.float64, "auto", 1.0),
)


@dataclass(frozen=True)
class Candidate:
    """A way to compute, with what it costs and the error it makes."""

    arithmetic: Arithmetic
    error: float
    operations: float  # weighted; per simulated second, or per call

    def __str__(self) -> str:
        return f"{self.arithmetic}: error {self.error:.1e}, {self.operations:.2e} operations"


@dataclass(frozen=True)
class Stepping(Candidate):
    """A way to let time pass."""

    integrator: Integrator
    step: float  # [s]
    times: int  # in an interval of the scene

    def __str__(self) -> str:
        return f"{type(self.integrator).__name__}, steps of {self.step:.3g} s, {super().__str__()}"


@dataclass(frozen=True)
class Recommendation:
    """What to use; `print` it."""

    dtype: torch.dtype
    """Of states and inputs."""
    precision: Precision
    """What to give `forward_dynamics`, `ForwardDynamics` or `Scene` as `precision`."""
    backend: str
    """Which backend runs it here: "c" or "eager"."""
    method: str
    """How accelerations are found: "mass matrix" or "articulated bodies". The program chooses it by itself."""
    integrator: Integrator | None
    """How time passes; None: no horizon was given."""
    step: float | None
    """Of the integrator [s]."""
    scene: Scene | None
    """The scene with all of this; torques are held for `repeats` of its steps if the scene that was given is longer."""
    repeats: int
    """Steps of `scene` in one of the scene that was given, or in an eighth of the horizon for a robot."""
    error: float
    """Predicted error up to the horizon [rad or m]; without a horizon, of accelerations, relative."""
    nanoseconds: float
    """Measured time of an integrator's step, or of a call, per robot of a batch of 4096, on this machine."""
    others: tuple[Candidate, ...]
    """Everything that was tried and meets the error, the cheapest first."""

    def __str__(self) -> str:
        lines = [f"dtype       {str(self.dtype).removeprefix('torch.')}, precision {self.precision!r}"]
        if self.integrator is not None:
            lines.append(f"integrator  {type(self.integrator).__name__}, steps of {self.step:.3g} s")
        lines += [
            f"backend     {self.backend}, accelerations by {self.method}",
            f"error       {self.error:.1e} predicted",
            f"time        {self.nanoseconds:.0f} ns per robot and {'call' if self.step is None else 'step'}",
            "beside it",
            *[f"- {other}" for other in self.others[1:]],
        ]
        return "\n".join(lines if len(self.others) > 1 else lines[:-1])


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
            precision, integrator and step are what is looked for. A scene with controller, actuators or sensors keeps
            its dt, for they act once in it, and gets substeps.
        error: largest error of a joint's position [rad or m] at the end of any of the scene's steps up to the horizon,
            or of eighths of the horizon for a robot; without a horizon, of the accelerations that `forward_dynamics`
            finds, relative to the largest of them.
        horizon: time over which trajectories count [s], rounded to steps of the scene; None: accelerations alone, of a
            robot.
        state: starting states, float64, shape [samples, n]; None: 64 random ones within the limits, moving at up to
            1 rad/s.
        inputs: what the scene asks for at a step, held over the horizon; None: torques are zero, and a controller's
            reference is to stay.
    Raises:
        ArgumentError: nothing reaches the error, or trajectories cannot be told over the horizon; it says what can.

    >>> import torchdq
    >>> found = recommend(torchdq.robots.load("two_link"), error=1e-3, horizon=0.2)
    >>> found.scene.step(found.scene.start(torch.zeros(8, 2, dtype=found.dtype))).q.shape
    torch.Size([8, 2])
    """
    if isinstance(error, bool) or not (isinstance(error, int | float) and 0 < error < math.inf):
        raise ArgumentError(f"error must be a positive number, found {error!r}")
    if not (horizon is None or (isinstance(horizon, int | float) and 0 < horizon < math.inf)):
        raise ArgumentError(f"horizon must be a positive number of seconds or None, found {horizon!r}")
    if horizon is None:
        if not isinstance(what, Robot):
            raise ArgumentError("a scene needs a horizon; without one, ask for its robot")
        if state is not None or inputs:
            raise ArgumentError("state and inputs are those of a trajectory, and without a horizon there is none")
        _require_one(_falling(what, 1.0))
        return _for_accelerations(what, error)
    scene = _falling(what, horizon) if isinstance(what, Robot) else what
    if not isinstance(scene, Scene):
        raise ArgumentError(f"what must be a torchdq.Robot or a torchdq.envs.Scene, found {type(what).__name__}")
    _require_one(scene)
    with torch.no_grad():
        return _for_trajectories(Trial.of(scene, horizon, state, inputs), error)


def _require_one(scene: Scene) -> None:
    for name, batch in scene.batches.items():
        if batch:
            raise ArgumentError(
                f"recommend tries one robot at a time, found batch axes {batch} of {name}; "
                f"give it the one that is hardest to simulate, with the lightest links or the stiffest joints"
            )


def _falling(robot: Robot, horizon: float) -> Scene:
    """The robot as `forward_dynamics` knows it."""
    rotors = () if robot.armature is None else (RotorInertia(),)
    return Scene(robot, (Gravity(), *rotors), dt=horizon / 8)


# --- trajectories -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Trial:
    """A scene, where it starts, what is done to it and for how long."""

    scene: Scene
    state: State
    inputs: dict[str, Tensor]
    intervals: int  # of the scene's dt, until the horizon

    @classmethod
    def of(cls, scene: Scene, horizon: float, state: State | None, inputs: dict[str, Tensor]) -> Trial:
        """The trial of a scene over a horizon, which is rounded to whole intervals."""
        intervals = max(1, round(horizon / scene.dt))
        if intervals > MOST_STEPS:
            raise ArgumentError(
                f"the horizon holds {intervals} steps of the scene, and {MOST_STEPS} are the most; shorten it"
            )
        noise = torch.full((scene.noises,), 0.5, dtype=torch.float64)
        if state is None:
            limits = next((effect for effect in scene.effects if isinstance(effect, Limits)), None)
            q, qd = random_states(scene.robot, limits=limits)
            state = scene.start(q, qd, noise=noise)
        elif not (isinstance(state, State) and state.q.ndim == 2 and len(state.q)):
            raise ArgumentError(
                "state must be a torchdq.envs.State with q of the shape [samples, n]; `Scene.start` makes one"
            )
        given = {name: x for name, x in inputs.items() if x is not None}
        for name, x in given.items():
            if not (isinstance(x, Tensor) and bool(x.isfinite().all())):
                raise ArgumentError(
                    f"{name} must be a finite tensor, found {x if isinstance(x, Tensor) else type(x).__name__}"
                )
        if not bool(state.q.isfinite().all() and state.qd.isfinite().all()):
            raise ArgumentError("state must be finite")
        if scene.controller is not None and "reference" not in given:
            given["reference"] = torch.cat([state.q, torch.zeros_like(state.q).repeat(1, 2)], -1)
        needed = [name for effect in scene.effects for name in effect.needs(scene.n)]
        for name in needed:
            if name not in given:
                raise ArgumentError(f"{name} must be given, shape [samples, {scene.inputs[name]}]; the scene needs it")
        if scene.noises:
            given["noise"] = noise
        return cls(scene, state, given, intervals)

    @property
    def sampled(self) -> bool:
        """Whether something happens once per dt, so that dt must stay."""
        return self.scene.controller is not None or any(e.SLOT in ("actuator", "sensor") for e in self.scene.effects)

    def path(self, integrator: Integrator, times: int, arithmetic: Arithmetic) -> Tensor:
        """Positions at the ends of all intervals, [intervals, samples, n], after so many steps in each."""
        # a scene rounds its state at the end of its step, which is an interval or, if it may be, a step
        dt, inner, outer = self.scene.dt, times, 1
        if not self.sampled:
            dt, inner, outer = dt / times, 1, times
        scene = self.scene.replace(
            dt=dt, integrator=Repeated(integrator, inner), substeps=1, precision=arithmetic.precision
        )
        state = State._make(None if x is None else x.to(arithmetic.dtype) for x in self.state)
        inputs = {name: x.to(arithmetic.dtype) for name, x in self.inputs.items()}
        found = []
        for _ in range(self.intervals):
            for _ in range(outer):
                state = scene.step(state, **inputs)
            found.append(state.q.double())
        return torch.stack(found)


def random_states(robot: Robot, samples: int = SAMPLES, limits: Limits | None = None) -> tuple[Tensor, Tensor]:
    """Positions within the limits, or within half a turn or half a metre, and velocities up to 1.

    The limits are those of the robot, or of the effect that simulates limits.
    """
    generator = torch.Generator().manual_seed(0)
    unit = torch.rand(2, samples, robot.n, generator=generator, dtype=torch.float64)
    revolute = torch.tensor([kind != "prismatic" for kind in robot.kinds])
    reach = torch.where(revolute, math.pi / 2, 0.25).double()
    of = robot.limits if limits is None else limits
    lower, upper = (torch.as_tensor(x, dtype=torch.float64) for x in (of.lower, of.upper))
    bounded = lower.isfinite() & upper.isfinite()
    lower, upper = torch.where(bounded, lower, -reach), torch.where(bounded, upper, reach)
    # away from the limits, which a trajectory would leave at once
    middle, half = (lower + upper) / 2, 0.8 * (upper - lower) / 2
    return middle + half * (2 * unit[0] - 1), 2 * unit[1] - 1


def _worst(x: Tensor, truth: Tensor) -> float:
    """Largest difference; infinite if something is not finite."""
    difference = (x - truth).abs()
    return float(difference.max()) if bool(difference.isfinite().all()) else math.inf


def _truth(trial: Trial, error: float) -> Tensor:
    """Positions up to the horizon to a fiftieth of the error, extrapolated from steps that are halved till then."""
    closest = math.inf
    for integrator in _ways(trial.scene)[:2]:
        row: list[Tensor] = []
        stuck = 0
        for k in range(int(math.log2(MOST_STEPS / trial.intervals)) + 1):
            before, row = row, [trial.path(integrator, 2**k, ARITHMETICS[-1])]
            # an error that is a series in the step, from the power of the order on, loses a term with every column
            for j, coarser in enumerate(before[:4]):
                row.append(row[j] + (row[j] - coarser) / (2 ** (integrator.order + j) - 1))
            if not before:
                continue
            # at kinks there is no such series, and the steps themselves have to get there
            for found, last in ((row[-1], before[-1]), (row[0], before[0])):
                change = _worst(found, last)
                if change <= error / 50:
                    return found
            stuck = stuck + 1 if change >= closest and closest < 1e-6 else 0
            closest = min(closest, change)
            if stuck > 2:
                break
    if not closest < 1e3:
        raise ArgumentError(
            f"trajectories of {trial.scene.robot.name!r} do not stay finite over "
            f"{trial.intervals * trial.scene.dt:.3g} s, however short the steps; is the controller stable with dt = "
            f"{trial.scene.dt:g} s?"
        )
    raise ArgumentError(
        f"trajectories of {trial.scene.robot.name!r} over {trial.intervals * trial.scene.dt:.3g} s can be told to "
        f"{closest * 50 / SAFETY:.1e} at best, not to {error / SAFETY:.1e}; shorten the horizon, or ask for less"
    )


def _ways(scene: Scene) -> list[Integrator]:
    """Integrators to try, the likeliest first."""
    ways: list[Integrator] = [RungeKutta4(), SemiImplicitEuler()]
    # where joints may be stiff, explicit ones would take long to show that they are
    return [LinearlyImplicit(), *ways] if any(effect.SLOT == "joint" for effect in scene.effects) else ways


def _needed(trial: Trial, integrator: Integrator, truth: Tensor, error: float, most: float) -> tuple[int, float] | None:
    """Steps per interval by which an integrator meets an error in float64, and the error that it then makes."""
    exact = ARITHMETICS[-1]
    times, found = 1, _worst(trial.path(integrator, 1, exact), truth)
    too_few = 0
    while found > error:
        too_few = times
        # as far as the order promises, but never trusting it beyond a factor of eight
        factor = (found / error) ** (1 / integrator.order) if found < 0.1 else 8.0
        if times * (factor if found < 0.01 else 1.0) > most:
            return None
        times = math.ceil(times * min(max(1.1 * factor, 1.25), 8.0))
        found = _worst(trial.path(integrator, times, exact), truth)
    # the last jump may have been far
    while too_few and times > CLOSE * too_few:
        between = math.ceil(math.sqrt(times * too_few))
        if between == times:
            break
        made = _worst(trial.path(integrator, between, exact), truth)
        times, too_few, found = (between, too_few, made) if made <= error else (times, between, found)
    return times, found


def _candidates(trial: Trial, truth: Tensor, error: float) -> list[Stepping]:
    """Ways that meet the error, the cheapest first; of those that cost many times as much, none is tried to the end."""
    found: list[Stepping] = []
    dt = trial.scene.dt
    lost = _lost(trial.scene.robot, trial.state.q)
    for integrator in _ways(trial.scene):
        per_step = trial.scene.replace(integrator=integrator, substeps=1).count().total
        most = MOST_STEPS / trial.intervals
        if found:
            most = min(most, MANY * found[0].operations * dt / per_step)
        needed = _needed(trial, integrator, truth, error, most)
        if needed is None:
            continue
        times, exact = needed
        for arithmetic in ARITHMETICS:
            made = exact if arithmetic is ARITHMETICS[-1] else _worst(trial.path(integrator, times, arithmetic), truth)
            if made <= error:
                operations = arithmetic.cost(lost) * per_step * times / dt
                found.append(Stepping(arithmetic, made, operations, integrator, dt / times, times))
        found.sort(key=lambda c: c.operations)
    return found


def _for_trajectories(trial: Trial, error: float) -> Recommendation:
    asked = SAFETY * error
    truth = _truth(trial, asked)
    found = _candidates(trial, truth, asked)
    if not found:
        raise ArgumentError(
            f"nothing keeps trajectories of {trial.scene.robot.name!r} within {error:.1e} over "
            f"{trial.intervals * trial.scene.dt:.3g} s in {MOST_STEPS} steps; shorten the horizon, or ask for less"
        )
    best = found[0]
    times, precision = best.times, best.arithmetic.precision
    if not trial.sampled:
        scene = trial.scene.replace(integrator=best.integrator, precision=precision, dt=best.step, substeps=1)
    elif times <= MOST_SUBSTEPS:
        scene = trial.scene.replace(integrator=best.integrator, precision=precision, substeps=times)
    else:
        # more than a program should hold
        scene = trial.scene.replace(integrator=Repeated(best.integrator, times), precision=precision, substeps=1)
    (nanoseconds,) = medians([_step(scene, best.arithmetic.dtype, trial)], BATCH, SECONDS)
    return Recommendation(
        **_common(best, scene.robot, scene.backend),
        integrator=best.integrator,
        step=best.step,
        scene=scene,
        repeats=1 if trial.sampled else times,
        nanoseconds=nanoseconds / times if trial.sampled else nanoseconds,
        others=tuple(found),
    )


def _step(scene: Scene, dtype: torch.dtype, trial: Trial) -> Callable[[], State]:
    """A step of a batch, to be timed."""

    def many(x: Tensor) -> Tensor:
        return x.to(dtype).expand(BATCH, -1) if x.ndim < 2 else x.to(dtype).repeat(-(-BATCH // len(x)), 1)[:BATCH]

    state = State._make(None if x is None else many(x) for x in trial.state)
    inputs = {name: many(x) for name, x in trial.inputs.items()}
    return lambda: scene.step(state, **inputs)


# --- accelerations ----------------------------------------------------------------------------------------------------


def _for_accelerations(robot: Robot, error: float) -> Recommendation:
    q, qd = random_states(robot, STATES)
    generator = torch.Generator().manual_seed(1)
    wanted = 2 * torch.rand(q.shape, generator=generator, dtype=q.dtype) - 1
    with torch.no_grad():
        # numbers that float32 can hold, so that only what is done to them is judged
        x = [y.float().double() for y in (q, qd, inverse_dynamics(robot, q, qd, wanted))]
        truth = forward_dynamics(robot, x[0], x[1], x[2])
        rounding = TYPICAL * 2.0**-53 * float(error_growth(robot, q).max())
        operations, lost = _program(robot).count().total, _lost(robot, q)
        found = []
        for arithmetic in ARITHMETICS:
            made = rounding
            if arithmetic.dtype == torch.float32:
                q, qd, tau = (y.float() for y in x)
                y = forward_dynamics(robot, q, qd, tau, precision=arithmetic.precision).double()
                made += float(((y - truth).abs().amax(-1) / truth.abs().amax(-1)).max())
            found.append(Candidate(arithmetic, made, arithmetic.cost(lost) * operations))
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
    return Recommendation(
        **_common(best, robot, None),
        integrator=None,
        step=None,
        scene=None,
        repeats=1,
        nanoseconds=nanoseconds,
        others=tuple(good),
    )


# --- both -------------------------------------------------------------------------------------------------------------


def _lost(robot: Robot, q: Tensor) -> float:
    """Part of the positions in which float32 loses half of its digits."""
    return float((error_growth(robot, q) > LARGEST_GROWTH.single).double().mean())


def _program(robot: Robot) -> Program:
    return compile(robot, "forward_dynamics").program


def _common(best: Candidate, robot: Robot, backend: BackendName | None) -> dict[str, Any]:
    return {
        "dtype": best.arithmetic.dtype,
        "precision": best.arithmetic.precision,
        "backend": choose(backend, torch.device("cpu")).name,
        "method": "articulated bodies" if "articulated" in _program(robot).name else "mass matrix",
        "error": best.error / SAFETY,
    }
