"""Recommendations of `torchdq.recommend_settings` beside the measurements: are they on the front of every scene?"""

from __future__ import annotations

from typing import Any

import torchdq
from accuracy import fits, table
from accuracy.scenes import CASES, PERIODS
from torchdq import Scene
from torchdq.scene import State

ERRORS = (1e-2, 1e-4, 1e-6, 1e-9)
SCENES = ("pendulum", "double_pendulum", "arm7", "servo")
LIKE = 1.3  # times the cost of the best; the measured steps are powers of two
OFFERED = ("float32", "float64", "mixed")


def measured(trajectories: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Recommended setting for every scene and error, and its cost beside that of the best that was measured."""
    rows = []
    for scene in trajectories:
        if scene["scene"] not in SCENES:
            continue
        case = CASES[scene["scene"]]()
        whole = Scene(case.robot, case.effects, dt=case.horizon / PERIODS)
        for error in ERRORS:
            inputs = {"torque": case.torque[0], **case.inputs}
            found = torchdq.recommend_settings(whole, error, case.horizon, State(case.q, case.qd), **inputs)
            precision = "mixed" if found.precision == "double" else str(found.dtype).removeprefix("torch.")
            name = type(found.integrator).__name__
            points = [p for p in table.usable(scene) if p["precision"] in OFFERED and p["error_max"] <= error]
            best = fits.front(points)[:1]
            ours = [p["nanoseconds"] for p in points if (p["integrator"], p["precision"]) == (name, precision)]
            ratio = min(ours) / best[0]["nanoseconds"] if ours and best else None
            rows.append(
                {
                    "scene": scene["scene"],
                    "error": error,
                    "recommended": f"{precision} {name}, {1e3 * found.step:.3g} ms",
                    "predicted": found.error,
                    "best": best and f"{best[0]['precision']} {best[0]['integrator']}",
                    "ratio": ratio,
                    "on_front": ratio is not None and ratio <= LIKE,
                }
            )
    return rows


def words(rows: list[dict[str, Any]]) -> list[str]:
    """Lines of text, one for each row of `measured`."""
    return [
        f"{r['scene']} to {r['error']:.0e}: {r['recommended']}, "
        + ("on the front" if r["on_front"] else f"the best that was measured is {r['best']}")
        + ("" if r["ratio"] is None else f" ({r['ratio']:.2f} times its time)")
        for r in rows
    ]
