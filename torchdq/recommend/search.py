"""Search among integrators and precisions, those that promise most first, within a time.

Answers are kept for this process, `ANSWERS` of them, until `torchdq.clear_caches`: asked again about an equal robot or
scene with equal states, error and horizon, a search takes no time. One that ended early is made again if there is more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from hashlib import sha256
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.base.caches import Bounded
from torchdq.errors import ArgumentError
from torchdq.functional import error_growth
from torchdq.program.program import LARGEST_GROWTH
from torchdq.recommend.recommendation import Stepping
from torchdq.recommend.reference import Reference, held, reference
from torchdq.recommend.time_budget import TimeIsUp
from torchdq.recommend.trials import ARITHMETICS, EXACT, MOST_STEPS, SAFETY, Trial
from torchdq.robot import Robot
from torchdq.scene.integrators import Integrator, SemiImplicitEuler
from torchdq.scene.spec import SceneSpec

ANSWERS = 64  # answers that are kept
PROBE = 512  # steps of a trajectory by which the promise of an integrator is judged
PRUNE = 4.0  # candidates costing more than this times the best are dropped


@dataclass(frozen=True)
class Answer:
    """Candidates that meet an error, and how long they do."""

    trial: Trial  # until the time to which the trajectories can be held
    found: tuple[Stepping, ...]  # the cheapest first
    untried: tuple[str, ...]
    limit: str
    growth: float
    seconds: float  # that the search was given


class _Question(NamedTuple):
    """Everything that an answer depends on, but for the time; the machine is that of the process."""

    spec: SceneSpec
    backend: BackendName | None
    tensors: str
    intervals: int
    error: float


_answers: Bounded[_Question, Answer] = Bounded(ANSWERS)


def search(trial: Trial, error: float, divisible: bool) -> Answer:
    """Candidates for a trial.

    Args:
        divisible: True: the duration of an interval may be shortened.
    """
    question = _question(trial, error)
    known = _answers.get(question)
    cut = known is not None and (known.untried or known.limit)
    if known is not None and not (cut and trial.budget.seconds > known.seconds):
        return known
    trial, limit = held(trial) if divisible else (trial, "")
    exact = reference(trial, SAFETY * error)
    found, untried = _candidates(exact, SAFETY * error)
    limit = "; ".join(filter(None, (limit, exact.limit)))
    answer = Answer(exact.trial, tuple(found), tuple(untried), limit, exact.growth, trial.budget.seconds)
    _answers[question] = answer
    return answer


def _question(trial: Trial, error: float) -> _Question:
    scene = trial.scene.replace(integrator=SemiImplicitEuler(), substeps=1)
    digest = sha256()
    for name, x in {**scene.parameters, **trial.state.rows(), **trial.inputs}.items():
        digest.update(f"{name} {list(x.shape)} {x.dtype}".encode())
        digest.update(x.cpu().contiguous().view(torch.uint8).numpy().tobytes())
    return _Question(scene.spec, scene.backend, digest.hexdigest(), trial.intervals, error)


def _candidates(exact: Reference, error: float) -> tuple[list[Stepping], list[str]]:
    """Candidates that meet the error, the cheapest first, and the names of those that there was no time for."""
    found: list[Stepping] = []
    untried: list[str] = []
    trial = exact.trial
    dt = trial.scene.dt
    repeated = repeated_share(trial.scene.robot, trial.state.q)
    promises = [_promise(exact, integrator, error) for integrator in trial.integrators]
    for promise in sorted(promises, key=lambda promise: promise.operations):
        integrator, per_step = promise.integrator, promise.per_step
        name = type(integrator).__name__
        most = MOST_STEPS / trial.intervals
        if found:
            most = min(most, PRUNE * found[0].operations * dt / per_step)
        try:
            needed = trial.steps_needed(integrator, exact.positions, error, most, promise.known, essential=not found)
        except TimeIsUp:
            untried.append(name)
            continue
        if needed is None:
            continue
        times, in_float64 = needed
        for arithmetic in ARITHMETICS:
            if arithmetic is EXACT:
                made = in_float64
            elif trial.allows(integrator, times, arithmetic):
                made = trial.error(integrator, times, arithmetic, exact.positions)
            else:
                untried.append(f"{name}, {arithmetic}")
                continue
            if made <= error:
                operations = arithmetic.cost(repeated) * per_step * times / dt
                found.append(Stepping(arithmetic, made, operations, integrator, dt / times, times))
        found.sort(key=lambda c: c.operations)
    if not found:
        tried = f"{trial.budget.seconds:g} s; give more seconds" if untried else f"{MOST_STEPS} steps"
        raise ArgumentError(
            f"no candidate was found in {tried}, that keeps {trial.name} over {trial.horizon:.3g} s to "
            f"{error / SAFETY:.1e}; shorten the horizon or raise the error"
        )
    return found, untried


class _Promise(NamedTuple):
    """Integrator with what it is expected to cost."""

    operations: float  # in an interval
    per_step: int  # operations
    integrator: Integrator
    known: dict[int, float]  # errors by the number of steps per interval


def _promise(exact: Reference, integrator: Integrator, error: float) -> _Promise:
    """Promise of an integrator, judged by the error of a short trial."""
    trial = exact.trial
    per_step = trial.scene.replace(integrator=integrator, substeps=1).count().total
    times = 2 ** max(0, int(math.log2(PROBE / trial.intervals)))
    known = exact.known[1] if integrator == exact.known[0] else {}
    if times not in known and trial.allows(integrator, times, EXACT):
        known = {times: trial.error(integrator, times, EXACT, exact.positions)}
    needed = times * (known.get(times, math.inf) / error) ** (1 / integrator.order)
    return _Promise(needed * per_step, per_step, integrator, known)


def repeated_share(robot: Robot, q: Tensor) -> float:
    """Share of the positions that float32 recomputes in float64."""
    return float((error_growth(robot, q) > LARGEST_GROWTH.single).double().mean())
