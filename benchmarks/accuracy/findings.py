"""Cheapest choices and limits of accuracy: sentences beside the table of docs/accuracy.md, from the JSON alone."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

from accuracy import fits, peers, table

KINKS = "rough"  # the scene that is not smooth
SCENES = (("arm7", "the seven-joint arm, smooth motion"), ("servo", "the same arm under stiff servos"))


def page(results: dict[str, Any]) -> str:
    """Text of docs/accuracy.md that is made of numbers."""
    found = [
        table.advice(results),
        choices(results),
        "\n".join(f"* {x}" for x in sentences(results)),
        peers.page(results),
    ]
    return "\n\n".join(x for x in found if x)


def choices(results: dict[str, Any]) -> str:
    """Table of the cheapest setting for every error."""
    scenes = {scene["scene"]: scene for scene in results["trajectories"]}
    lines = ["| motion | errors | cheapest |", "|---|---|---|"]
    for name, words in SCENES:
        front = fits.thinned(table.front(scenes[name]))
        turns = [(a, b) for a, b in pairwise(front) if table.method_of(a) != table.method_of(b)]
        last = ""
        for before, _ in turns:
            reached = f"{before['error_max']:.0e}"
            lines.append(f"| {words} | {f'{last} to {reached}' if last else f'down to {reached}'} | {_named(before)} |")
            last = reached
        lines.append(f"| {words} | {f'below {last}' if last else 'all'} | {_named(front[-1])} |")
    return "\n".join(lines)


def sentences(results: dict[str, Any]) -> list[str]:
    """Limits of precision, of long chains and of the references, in words."""
    smooth = [scene for scene in results["trajectories"] if scene["scene"] != KINKS]
    single, double, compensated = (_floors(smooth, x) for x in ("float32", "float64", "compensated"))
    gains = [single[scene] / floor for scene, floor in compensated.items() if scene in single]
    found = [
        f"With shorter steps of `RungeKutta4`, rounding errors dominate: from errors of "
        f"{_span(single.values())} in float32 and of {_span(double.values())} in float64, on smooth motions."
    ]
    if gains:
        found.append(
            f"Compensated states reach errors {min(gains):.1f} to {max(gains):.1f} times smaller than float32 does."
        )
    found += _chains(results["forward_dynamics"]["points"])
    agreed = {scene["scene"]: max(scene["agreements"].values()) for scene in results["trajectories"]}
    found.append(
        f"References agree with independent computations to {max(agreed[s['scene']] for s in smooth):.0e} on smooth "
        f"motions and to {agreed[KINKS]:.0e} where friction and limits make kinks, those of gradients to "
        f"{results['gradients']['agreement']:.0e}."
    )
    return found


def _chains(points: list[dict[str, Any]]) -> list[str]:
    """Sentence on the errors of accelerations of long chains."""
    single, mixed = (
        {p["n"]: p for p in points if p["method"] == method} for method in ("articulated bodies, float32", "mixed")
    )
    longest = max(single.keys() & mixed.keys())
    ratios = [
        mixed[n]["nanoseconds"] / single[n]["nanoseconds"]
        for n in single.keys() & mixed.keys()
        if mixed[n].get("nanoseconds") and single[n].get("nanoseconds")
    ]
    return [
        f"Accelerations of a chain of {longest} joints are off by {single[longest]['error_max']:.0%} in float32, "
        f"although the torques that belong to them are met to {single[longest]['residual']:.0e}. With "
        f'`precision="double"` the error is {mixed[longest]["error_max"]:.0e}.',
        f'`precision="double"` takes {" to ".join(dict.fromkeys(f"{x:.1f}" for x in (min(ratios), max(ratios))))} '
        "times the time of float32.",
    ]


def _floors(scenes: list[dict[str, Any]], precision: str) -> dict[str, float]:
    """Errors at which rounding stops `RungeKutta4`, by scene."""
    return {
        scene["scene"]: slope["plateau"]
        for scene in scenes
        for slope in scene["slopes"]
        if (slope["integrator"], slope["precision"]) == ("RungeKutta4", precision) and slope["plateau"] is not None
    }


def _span(values: Any) -> str:
    low, high = f"{min(values):.0e}", f"{max(values):.0e}"
    return low if low == high else f"{low} to {high}"


def _named(point: fits.Point) -> str:
    return f"{point['precision']}, `{point['integrator']}`"
