"""Errors, and what they say: orders, plateaus, fronts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

Point = dict[str, Any]  # with "error_max", "nanoseconds" and whatever else
FITTED = 5  # points of a straight line, at most
BETTER = 0.9  # ratio of errors, and of times, from which one point beats another


def relative(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Relative errors of rows [..., k]."""
    return (np.sqrt(((found - truth) ** 2).sum(-1)) / np.sqrt((truth**2).sum(-1))).astype(float)


def judged(errors: np.ndarray, floor: float) -> Point:
    """Largest and median error; one below the floor of its reference is not a measurement."""
    worst = float(errors.max())
    return {"error_max": worst, "error_median": float(np.median(errors)), "floor": floor, "measured": worst > floor}


def plateau(sizes: Sequence[float], errors: Sequence[float], order: float) -> float | None:
    """Error below which smaller steps do not lead: the smallest one, if the errors no longer fall by half the order."""
    pairs = sorted((h, e) for h, e in zip(sizes, errors, strict=True) if np.isfinite(e) and e > 0)
    if len(pairs) < 2:
        return None
    (h0, e0), (h1, e1) = pairs[:2]
    falling = np.log(e1 / e0) / np.log(h1 / h0)
    return None if falling > order / 2 else float(min(e for _, e in pairs))


class Line(NamedTuple):
    """A straight line through points of a curve, both axes logarithmic."""

    slope: float
    points: int


def slope(sizes: Sequence[float], errors: Sequence[float], lowest: float, highest: float) -> Line | None:
    """Order of convergence: of the straight line through the finest points between two errors.

    Points finer than the most accurate one are not among them: their errors are of rounding. None: fewer than two are.
    """
    pairs = sorted((h, e) for h, e in zip(sizes, errors, strict=True) if np.isfinite(e))
    best = min(range(len(pairs)), key=lambda k: pairs[k][1], default=0)
    pairs = [(h, e) for h, e in pairs[best:] if lowest < e < highest][:FITTED]
    if len(pairs) < 2:
        return None
    h, e = np.log(np.array(pairs)).T
    return Line(float(np.polyfit(h, e, 1)[0]), len(pairs))


def front(points: Sequence[Point]) -> list[Point]:
    """Points that no other beats in both error and time, from the fastest to the most accurate."""
    found: list[Point] = []
    for point in sorted(points, key=lambda p: (p["nanoseconds"], p["error_max"])):
        if not found or point["error_max"] < found[-1]["error_max"]:
            found.append(point)
    return found


def thinned(best: Sequence[Point], factor: float = 2.0) -> list[Point]:
    """Points of a front that each bring the error down by a factor, from the fastest to the most accurate."""
    found: list[Point] = []
    for point in best:
        if not found or point["error_max"] * factor < found[-1]["error_max"]:
            found.append(point)
    return found


def dominated(points: Sequence[Point]) -> list[tuple[Point, Point]]:
    """Points with one that beats them in both error and time, the most accurate such one."""
    found = []
    for point in points:
        better = [
            other
            for other in points
            if other["error_max"] <= BETTER * point["error_max"]
            and other["nanoseconds"] <= BETTER * point["nanoseconds"]
        ]
        if better:
            found.append((point, min(better, key=lambda p: p["error_max"])))
    return found
