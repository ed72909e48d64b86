"""Advice from the results, from the JSON alone: the table of docs/accuracy.md, dominated settings, crossovers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from accuracy import fits

Results = dict[str, Any]
NEEDS = (("rollouts for reinforcement learning", 1e-3), ("learning and MPC", 1e-6), ("verification", 1e-10))
STIFF = 1e-2  # error asked of the scene with stiff servos
UNTRIED = ("nothing that was tried", "", "", "")  # cells of a need that no setting meets


def usable(scene: dict[str, Any]) -> list[fits.Point]:
    """Points of a scene that were timed and did not lose the motion."""
    return [p for p in scene["points"] if p["nanoseconds"] is not None and p["error_max"] < scene["limit"]]


def front(scene: dict[str, Any]) -> list[fits.Point]:
    """Best settings of a scene, from the fastest to the most accurate."""
    return fits.front(usable(scene))


def cheapest(scene: dict[str, Any], error: float) -> fits.Point | None:
    """Fastest setting of a scene that reaches an error."""
    return next((p for p in front(scene) if p["error_max"] <= error), None)


def advice(results: Results) -> str:
    """Table of docs/accuracy.md: precision, integrator and step for every need."""
    scenes = {scene["scene"]: scene for scene in results.get("trajectories", ())}
    rows = []
    arm = scenes.get("arm7")
    for need, error in NEEDS:
        rows.append(_trajectory(f"{need}: seven-joint arm to {error:.0e}", arm, error, results))
    rows.append(_energy(results))
    rows.append(_trajectory(f"stiff servos: the same arm to {STIFF:.0e}", scenes.get("servo"), STIFF, results))
    rows.append(_forward(results))
    lines = [
        "| I need | use | error reached | time per robot step | gradient error |",
        "|---|---|---|---|---|",
        *(f"| {' | '.join(row)} |" for row in rows),
    ]
    return "\n".join(lines)


def time(nanoseconds: float | None) -> str:
    """A time in words."""
    if nanoseconds is None:
        return "not taken"
    return f"{nanoseconds:.0f} ns" if nanoseconds < 1e4 else f"{nanoseconds / 1e3:.0f} us"


def called(point: fits.Point, horizon: float) -> str:
    """A setting in words."""
    if point["integrator"] == "DormandPrince":
        return f"{point['precision']} DormandPrince at rtol {point['size']:.0e}"
    return f"{point['precision']} {point['integrator']}, {1e3 * horizon / point['steps']:.3g} ms"


def _gradient(results: Results, precision: str) -> str:
    """Error of gradients by the compiled reverse mode in a precision."""
    for p in results.get("gradients", {}).get("points", ()):
        if p["way"] == "compiled reverse" and p["precision"] == ("float64" if precision == "float64" else "float32"):
            return f"{p['error_max']:.0e}" if p["measured"] else f"below {p['floor']:.0e}"
    return "not taken"


def _trajectory(need: str, scene: dict[str, Any] | None, error: float, results: Results) -> tuple[str, ...]:
    best = cheapest(scene, error) if scene else None
    if scene is None or best is None:
        return need, *UNTRIED
    return (
        need,
        called(best, scene["horizon"]),
        f"{best['error_max']:.0e}",
        time(best["per_step"]),
        _gradient(results, best["precision"]),
    )


def _energy(results: Results) -> tuple[str, ...]:
    need, found = "energy over long times: double pendulum", results.get("energy")
    rows = [r for r in found["rows"] if r["drift"] is not None and r["precision"] == "float64"] if found else []
    # a drift grows with time, so the one that keeps a band is worth more than a smaller error that grows; a band's own
    # width must not be mistaken for a drift, which is why the drift is compared with it
    banded = [r for r in rows if abs(r["drift"]) < 0.01 * r["largest"]]
    if not banded:
        return need, *UNTRIED
    best = min(banded, key=lambda r: r["largest"])
    return (
        need,
        f"{best['precision']} {best['integrator']}, {1e3 * found['dt']:.3g} ms",
        f"{best['largest']:.0e}, drift {abs(best['drift']):.0e} over {found['steps']} steps",
        time(best["nanoseconds"]),
        _gradient(results, best["precision"]),
    )


def _forward(results: Results) -> tuple[str, ...]:
    need, points = "accelerations of more than 40 joints: chains", results.get("forward_dynamics", {}).get("points", ())
    # float32 in and out: how it is computed inside is the choice
    tried = [p for p in points if p["method"] in ("mixed", "float32, auto") and p["n"] == 42 and p.get("nanoseconds")]
    if not tried:
        return need, *UNTRIED
    best = min(tried, key=lambda p: p["nanoseconds"])
    use = 'float32, `precision="double"`' if best["method"] == "mixed" else 'float32, `precision="auto"`'
    worst = max(p["error_max"] for p in points if p["method"] == best["method"])
    largest = max(p["n"] for p in points if p["method"] == best["method"])
    return (
        need,
        use,
        f"{best['error_max']:.0e} at 42 joints, {worst:.0e} at most up to {largest}",
        f"{time(best['nanoseconds'])} at 42 joints",
        "",
    )


def dominated(results: Results) -> list[str]:
    """Settings most of whose points lose to another one of the same scene in both error and time, in words.

    A setting is an integrator in a precision; by ten per cent in both, among the points that did not lose the motion.
    """
    counts: dict[str, list[str]] = {}
    for scene in results.get("trajectories", ()):
        points = usable(scene)
        losers = Counter(method_of(p) for p, _ in fits.dominated(points))
        for setting, number in Counter(map(method_of, points)).items():
            if 2 * losers[setting] > number:
                counts.setdefault(setting, []).append(f"{scene['scene']} ({losers[setting]} of {number} points)")
    return [f"{setting}: {', '.join(scenes)}" for setting, scenes in sorted(counts.items())]


def crossovers(results: Results) -> list[str]:
    """Errors on the front of a scene below which another setting takes over, in words."""
    found = []
    for scene in results.get("trajectories", ()):
        for before, after in pairwise(fits.thinned(front(scene))):
            a, b = method_of(before), method_of(after)
            if a == b:
                continue
            # true if the one before would get as far, but slower
            reaches = any(method_of(p) == a and p["error_max"] <= after["error_max"] for p in usable(scene))
            why = f"is cheaper than {a}" if reaches else f"takes over from {a}, which does not get there"
            found.append(f"{scene['scene']}: below {before['error_max']:.0e}, {b} {why}")
    return found


def method_of(point: fits.Point) -> str:
    """Integrator and precision of a point."""
    return f"{point['precision']} {point['integrator']}"


def slopes(results: Results) -> str:
    """Measured orders and plateaus as a table."""
    lines = ["scene            integrator         precision    nominal  slope            plateau"]
    for scene in results.get("trajectories", ()):
        for s in scene["slopes"]:
            order = "-" if s["nominal"] is None else str(s["nominal"])
            slope = "-" if s["slope"] is None else f"{s['slope']:.2f} ({s['fitted']} points)"
            plateau = "-" if s["plateau"] is None else f"{s['plateau']:.1e}"
            lines.append(
                f"{scene['scene']:<16} {s['integrator']:<18} {s['precision']:<12} {order:<8} {slope:<16} {plateau}"
            )
    return "\n".join(lines)


def lines(title: str, items: Sequence[str]) -> str:
    """A titled list."""
    return f"{title}\n" + "\n".join(f"- {item}" for item in items or ["none"])
