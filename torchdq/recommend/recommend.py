"""Recommendation of precision, integrator and step for a requested error, found by trials on the scene itself.

Trajectories from random states are compared with ones of steps so small that smaller ones change nothing, as far as
these can be held. The steps of every integrator are halved until it meets the error in float64; then it is tried
whether float32 still does. The one with the fewest operations per simulated second is recommended, an operation in
float32 counting half.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchdq.backends.choice import choose
from torchdq.base.checks import require_count, require_number
from torchdq.base.progress import Progress
from torchdq.base.timing import medians
from torchdq.effects import Gravity, RotorInertia
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functional import error_growth, forward_dynamics, inverse_dynamics
from torchdq.functions.compile import compile
from torchdq.program.program import LARGEST_GROWTH
from torchdq.recommend.recommendation import EXACT, MIXED, SINGLE, Candidate, Recommendation, SceneRecommendation
from torchdq.recommend.trajectories import MOST_STEPS, SAFETY, Trial, candidates, random_states, reference
from torchdq.robot import Robot
from torchdq.scene.scene import Scene
from torchdq.scene.state import State

STATES = 256  # states at which accelerations are tried
TYPICAL = 100.0  # errors of accelerations in units of eps times `error_growth`; measured on robots and chains
UNROLLED = 16  # substeps in one program
BATCH = 4096  # samples per timed call
SECONDS = 0.05  # time of measuring [s]


def recommend_settings(
    what: Robot | Scene,
    error: float = 1e-3,
    horizon: float | None = 1.0,
    state: State | None = None,
    most_steps: int = MOST_STEPS,
    **inputs: Tensor,
) -> Recommendation:
    """The cheapest precision, integrator and step that keep an error, found by trials on the robot or scene itself.

    Args:
        what: a robot, which moves under gravity and no torques; or a scene. Its effects and controller stay;
            precision, integrator and step are searched. A scene with controller, actuators or sensors keeps its dt, for
            they act once in it, and gets substeps.
        error: largest error of a joint's position [rad or m] at the end of any of the scene's steps up to the horizon,
            or of eighths of the horizon for a robot; without a horizon, of the accelerations that `forward_dynamics`
            finds, relative to the largest of them.
        horizon: duration of the trajectories [s], rounded to steps of the scene; None: accelerations alone, of a robot.
        state: initial states, float64, shape [samples, n]; None: 64 random ones within the limits, moving at up to
            1 rad/s.
        most_steps: largest number of steps of a trajectory that is tried, the fewest first. Where none of so few meets
            the error, it is refused, and not answered by a setting that does not.
        inputs: inputs of the scene at a step, held over the horizon; None: torques are zero, and a controller's
            reference is to stay.

    Where an arm falls without damping, small errors grow exponentially. A trajectory is not held any longer once they
    have grown a million times: the recommendation is then for a shorter horizon, and a warning says why.

    Returns:
        A `SceneRecommendation` with a scene, integrator and step, and the horizon up to which the error is kept;
        without a horizon, a `Recommendation`.

    Raises:
        ArgumentError: nothing reaches the error, or trajectories cannot be computed over the horizon; it says what can.

    >>> import torchdq
    >>> found = recommend_settings(torchdq.robots.load("two_link"), error=1e-3, horizon=0.2)
    >>> found.scene.step(found.scene.start(torch.zeros(8, 2, dtype=found.dtype))).q.shape
    torch.Size([8, 2])
    """
    require_number("error", error, positive=True)
    require_count("most_steps", most_steps)
    if horizon is not None:
        require_number("horizon", horizon, positive=True)
    if horizon is None and not isinstance(what, Robot):
        raise ArgumentError("a scene needs a horizon; without a horizon, pass scene.robot")
    if horizon is None and (state is not None or inputs):
        raise ArgumentError("state and inputs are those of a trajectory, and without a horizon there is none")
    scene = what
    if isinstance(what, Robot):  # falling, as `forward_dynamics` knows it
        rotors = () if what.armature is None else (RotorInertia(),)
        scene = Scene(what, (Gravity(), *rotors), dt=(horizon or 1.0) / 8)
    if not isinstance(scene, Scene):
        raise ArgumentError(
            f"what must be a torchdq.Robot or a torchdq.Scene, found {type(what).__name__}; load a robot with "
            "Robot.from_urdf(...) or torchdq.robots.load(...)"
        )
    _require_supported(scene, inputs)
    with torch.no_grad(), Progress(f"recommend for {scene.robot.name!r}") as notice:
        if horizon is None:
            return _for_accelerations(scene.robot, error)
        trial = Trial.of(scene, horizon, state, inputs, most_steps, notice.at)
        return _for_trajectories(trial, SAFETY * error, what is not scene)


def _require_supported(scene: Scene, inputs: Mapping[str, Tensor]) -> None:
    """Raise unless a scene is one of a single robot with a fixed base, recorded whole, and has these inputs."""
    if scene.robot.floating:
        raise ArgumentError(
            f"robot {scene.robot.name!r} must have a fixed base, found a floating one: errors of poses have no "
            "measure; scene.check says which steps are stable, and steps half as long how accurate they are"
        )
    for name in inputs:
        if name not in scene.inputs:
            raise UnknownNameError("input of the scene", name, scene.inputs)
    for name, batch in scene.batches.items():
        if batch:
            raise ArgumentError(
                f"recommend_settings tries one robot at a time, found batch axes {batch} of {name}; "
                f"give it the one that is hardest to simulate, with the lightest links or the stiffest joints"
            )
    for effect in scene.effects:
        if effect.IMPLICIT:
            raise ArgumentError(
                f"a scene must be without effects.{type(effect).__name__}, which other integrators than "
                "LinearlyImplicit do not take; halve dt until the motion stays the same, and see scene.check"
            )
    if scene.spec.computed():
        raise ArgumentError(
            "a scene must be without effects.Residual, whose torque is held over dt whatever the integrator; ask about "
            "the scene without it, and halve dt until the motion with it stays the same"
        )


def _for_trajectories(trial: Trial, error: float, divisible: bool) -> SceneRecommendation:
    """Recommendation for a trial; `divisible`: the duration of an interval may be shortened."""
    trial, limit = trial.predictable() if divisible else (trial, "")
    exact = reference(trial, error)
    tried, limit = exact.trial, "; ".join(filter(None, (limit, exact.limit)))
    found = candidates(exact, error, _repeated_share(tried.scene.robot, tried.state.q))
    if limit:
        warnings.warn(f"{limit}; the recommendation is for {tried.horizon:.3g} s", stacklevel=3)
    best = found[0]
    within, dt = (best.times, tried.scene.dt) if tried.sampled else (1, best.step)
    scene = tried.scene.replace(integrator=best.integrator, precision=best.arithmetic.precision)
    scene = scene.replace(dt=dt, substeps=within, unroll=False if within > UNROLLED else None)
    tried.report("time of the recommended step")
    return SceneRecommendation(
        **_common(found, scene.robot, scene, _step(scene, best.arithmetic.dtype, tried), within),
        integrator=scene.integrator,
        step=best.step,
        scene=scene,
        repeats=best.times // within,
        horizon=tried.horizon,
        limit=limit,
        growth=exact.growth,
    )


def _repeated_share(robot: Robot, q: Tensor) -> float:
    """Share of the positions that float32 recomputes in float64."""
    return float((error_growth(robot, q) > LARGEST_GROWTH.single).double().mean())


def _step(scene: Scene, dtype: torch.dtype, trial: Trial) -> Callable[[], State]:
    """Step of a batch, to be timed."""

    def many(x: Tensor) -> Tensor:
        return x.to(dtype).expand(BATCH, -1) if x.ndim < 2 else x.to(dtype).repeat(-(-BATCH // len(x)), 1)[:BATCH]

    state = State(**{name: many(x) for name, x in trial.state.rows().items()})
    inputs = {name: many(x) for name, x in trial.inputs.items()}
    return lambda: scene.step(state, **inputs)


def _for_accelerations(robot: Robot, error: float) -> Recommendation:
    q, qd = random_states(robot, STATES)
    generator = torch.Generator().manual_seed(1)
    wanted = 2 * torch.rand(q.shape, generator=generator, dtype=q.dtype) - 1
    # numbers that float32 can hold, so that only the operations on them make errors
    x = [y.float().double() for y in (q, qd, inverse_dynamics(robot, q, qd, wanted))]
    exact = forward_dynamics(robot, x[0], x[1], x[2])
    rounding = TYPICAL * 2.0**-53 * float(error_growth(robot, q).max())
    operations, repeated = compile(robot, "forward_dynamics").program.count().total, _repeated_share(robot, q)
    found = []
    for arithmetic in (SINGLE, MIXED, EXACT):
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
    best = good[0].arithmetic
    q, qd, tau = (y.to(best.dtype).repeat(BATCH // STATES, 1) for y in x)
    call = partial(forward_dynamics, robot, q, qd, tau, precision=best.precision)
    return Recommendation(**_common(good, robot, None, call))


def _common(
    found: Sequence[Candidate], robot: Robot, scene: Scene | None, call: Callable[[], object], steps: int = 1
) -> dict[str, Any]:
    """Fields that both recommendations have; `call` takes a number of steps."""
    best, program = found[0], compile(robot, "forward_dynamics").program
    return {
        "dtype": best.arithmetic.dtype,
        "precision": best.arithmetic.precision,
        "backend": choose(None if scene is None else scene.backend, torch.device("cpu")).name,
        "method": "articulated bodies" if "articulated" in program.name else "mass matrix",
        "error": best.error / SAFETY,
        "nanoseconds": medians([call], BATCH, SECONDS)[0] / steps,
        "others": tuple(found),
    }
