"""Experiment 1: error of trajectories against time, by scene, integrator, precision and step."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from accuracy import fits, references
from accuracy.clock import Time, clock
from accuracy.methods import (
    DORMAND_PRINCE,
    INTEGRATORS,
    PRECISIONS,
    adaptive,
    compiled,
    dtype_of,
    eager,
    flown,
    initial,
    program_of,
    stepper,
)
from accuracy.rows import LONG
from accuracy.scenes import PERIODS, Case

BATCH = 4096
TOLERANCES = [10.0**-k for k in range(2, 14)]
LONGEST = 30  # joints whose every integrator is worth compiling in a quick run


def settings(case: Case) -> list[tuple[str, str]]:
    """Integrators and precisions that are tried: all precisions with the one of order 4, two with the others."""
    found = [("RungeKutta4", precision) for precision in PRECISIONS]
    return found + [(name, precision) for name in case.suited for precision in ("float32", "float64")]


def measured(case: Case, truth: references.Truth, quick: bool) -> dict[str, Any]:
    """Points, slopes and plateaus of a scene, its agreements and floor, and what was left out."""
    points: list[fits.Point] = []
    slopes, omitted = [], []
    for integrator, precision in settings(case):
        long = quick and case.robot.n > LONGEST and integrator == "RungeKutta4"
        if long:
            omitted.append(f"time of {integrator} in {precision}: its program takes long to compile (--quick)")
        curve = _ladder(case, integrator, precision, truth, quick, timed=not long)
        points += [p for p in curve if np.isfinite(p["error_max"])]
        lost = len(curve) - sum(np.isfinite(p["error_max"]) for p in curve)
        if lost:
            omitted.append(f"{integrator} in {precision} at its {lost} longest steps: not finite")
        order = INTEGRATORS[integrator].order
        slopes.append(_fitted(curve, integrator, precision, order if case.smooth else None, case, truth.floor))
    for precision in ("float32", "float64"):
        curve = _tolerances(case, precision, truth, quick)
        points += curve
        slopes.append(_fitted(curve, DORMAND_PRINCE, precision, 1 if case.smooth else None, case, truth.floor))
    return {
        "scene": case.name,
        "words": case.words,
        "joints": case.robot.n,
        "horizon": case.horizon,
        "limit": case.limit,
        "floor": truth.floor,
        "agreements": truth.agreements,
        "points": points,
        "slopes": slopes,
        "omitted": omitted,
    }


def _point(
    integrator: str,
    precision: str,
    steps: int,
    size: float,
    end: torch.Tensor,
    truth: references.Truth,
    each: Time | None,
) -> fits.Point:
    """Error of a state at the horizon and the time to it, as many times that of each step, if it is known."""
    return {
        "integrator": integrator,
        "precision": precision,
        "steps": steps,
        "size": size,
        **fits.judged(fits.relative(end.numpy().astype(LONG), truth.state), truth.floor),
        "nanoseconds": each and steps * each.nanoseconds,
        "per_step": each and each.nanoseconds,
    }


def _ladder(
    case: Case, integrator: str, precision: str, truth: references.Truth, quick: bool, timed: bool
) -> list[fits.Point]:
    """Points at steps that are halved."""
    once = _step_time(case, integrator, precision) if timed else None
    deepest = 6 if not timed else 10 if quick else 12
    if timed and (integrator, precision) == ("RungeKutta4", "float64"):
        deepest += 2  # where its plateau begins
    curve = []
    for steps in (PERIODS * 2**k for k in range(1, deepest)):
        end = flown(case, integrator, precision, steps, compiled if timed else eager)
        curve.append(_point(integrator, precision, steps, case.horizon / steps, end, truth, once))
    return curve


def _step_time(case: Case, integrator: str, precision: str) -> Time:
    """Time of a step of one robot in a large batch; it does not depend on the step's size."""
    state, torques, others = initial(case, precision, BATCH)
    h = torch.tensor([case.horizon / 1024], dtype=dtype_of(precision))
    step = stepper(program_of(case, integrator, precision), precision, [*others, h])
    return clock(lambda: step(state, torques[0]), BATCH)


def _tolerances(case: Case, precision: str, truth: references.Truth, quick: bool) -> list[fits.Point]:
    """Points of the adaptive integrator at its tolerances."""
    # below a hundred times the rounding of the state a tolerance has no meaning
    tolerances = [t for t in TOLERANCES if t > 100 * torch.finfo(dtype_of(precision)).eps]
    curve = []
    for rtol in tolerances[:: 2 if quick else 1]:
        each = clock(adaptive(case, precision, rtol, BATCH), BATCH, repeats=5 if quick else 20).times(1 / PERIODS)
        curve.append(_point(DORMAND_PRINCE, precision, PERIODS, rtol, adaptive(case, precision, rtol)(), truth, each))
    return [p for p in curve if np.isfinite(p["error_max"])]


def _fitted(
    curve: list[fits.Point], integrator: str, precision: str, order: int | None, case: Case, floor: float
) -> dict[str, Any]:
    """Slope and plateau of a curve beside its nominal order."""
    sizes, errors = [p["size"] for p in curve], [p["error_max"] for p in curve]
    bottom = fits.plateau(sizes, errors, order or 1)
    lowest = max(10 * bottom if bottom else 0.0, floor)
    # far below the limit, if there are points: near it the error is not yet a power of the step
    found = fits.slope(sizes, errors, lowest, case.limit / 10) or fits.slope(sizes, errors, lowest, case.limit)
    return {
        "integrator": integrator,
        "precision": precision,
        "nominal": order,
        "slope": found and found.slope,
        "fitted": found.points if found else 0,
        "plateau": bottom,
    }
