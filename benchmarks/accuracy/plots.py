"""The five plots of the study, from its results alone."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from PIL import Image

from accuracy import table

INTEGRATOR_COLOURS = {
    "RungeKutta4": "C0",
    "StoermerVerlet": "C2",
    "SemiImplicitEuler": "C1",
    "LinearlyImplicit": "C4",
    "ExplicitEuler": "C3",
    "DormandPrince": "C5",
}
PRECISION_MARKERS = {"float64": "o", "float32": "s", "mixed": "^", "compensated": "D", "bfloat16": "x"}
PRECISION_LINES = {"float64": "-", "float32": "--", "mixed": "-.", "compensated": ":", "bfloat16": ":"}


def draw(results: dict[str, Any], folder: Path) -> list[Path]:
    """Draw everything that was measured; returns the files."""
    folder.mkdir(parents=True, exist_ok=True)
    plots = {
        "trajectory": (_trajectories, results.get("trajectories")),
        "forward_dynamics": (_forward, results.get("forward_dynamics")),
        "gradients": (_gradients, results.get("gradients")),
        "effects": (_effects, results.get("effects")),
        "energy": (_energy, results.get("energy")),
    }
    files = []
    for name, (plot, found) in plots.items():
        if not found:
            continue
        figure = plot(found)
        drawn = BytesIO()
        figure.savefig(drawn, dpi=80, bbox_inches="tight")
        plt.close(figure)
        files.append(folder / f"{name}.png")
        # a palette is enough for lines
        Image.open(drawn).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(files[-1], optimize=True)
    return files


def _curve(axes: Axes, x: Sequence[float], y: Sequence[float], solid: Sequence[bool], **style: Any) -> None:
    """A line whose points are hollow where they are not measurements."""
    (line,) = axes.plot(x, y, markersize=4, linewidth=1, **{**style, "marker": None})
    marker = style.get("marker", "o")
    for measured in (True, False):
        at = [k for k, s in enumerate(solid) if s == measured]
        face = line.get_color() if measured or marker == "x" else "none"
        axes.plot(
            [x[k] for k in at],
            [y[k] for k in at],
            linestyle="",
            marker=marker,
            markersize=4,
            color=line.get_color(),
            markerfacecolor=face,
        )


def _trajectories(scenes: list[dict[str, Any]]):
    columns = min(3, len(scenes))
    lines = -(-len(scenes) // columns)
    figure, grid = plt.subplots(lines, columns, figsize=(5.2 * columns, 4.2 * lines), squeeze=False, sharey=True)
    labels: dict[str, Any] = {}
    for axes in grid.flat[len(scenes) :]:
        axes.axis("off")
    for axes, scene in zip(grid.flat, scenes, strict=False):
        settings = {(p["integrator"], p["precision"]): None for p in scene["points"] if p["nanoseconds"] is not None}
        for integrator, precision in settings:
            points = [
                p
                for p in scene["points"]
                if (p["integrator"], p["precision"]) == (integrator, precision) and p["error_max"] < 10
            ]
            style = {
                "color": INTEGRATOR_COLOURS[integrator],
                "marker": PRECISION_MARKERS[precision],
                "linestyle": PRECISION_LINES[precision],
            }
            y = [max(p["error_max"], p["floor"]) for p in points]
            _curve(axes, [p["nanoseconds"] / 1e3 for p in points], y, [p["measured"] for p in points], **style)
            labels[f"{integrator}, {precision}"] = plt.Line2D([], [], markersize=4, linewidth=1, **style)
        best = table.front(scene)
        axes.plot(
            [p["nanoseconds"] / 1e3 for p in best], [p["error_max"] for p in best], color="0.8", linewidth=6, zorder=0
        )
        axes.axhline(scene["limit"], color="0.7", linewidth=0.8, linestyle=":")
        axes.set(xscale="log", yscale="log", title=scene["words"], xlabel="time of the whole motion, per robot [us]")
        axes.set_ylim(1e-15, 10)
        axes.grid(True, alpha=0.3)
    for axes in grid[:, 0]:
        axes.set_ylabel("largest relative error at the end")
    figure.legend(labels.values(), labels.keys(), loc="upper center", bbox_to_anchor=(0.5, 0.0), ncol=4, fontsize=9)
    figure.suptitle(
        "What accuracy costs: further down is more accurate, further left is faster; the grey band is the best.\n"
        "A line falls with its order until it meets the rounding of its precision.\n"
        "Hollow: at the floor of the reference. Above the dotted line the motion is lost."
    )
    figure.tight_layout()
    return figure


def _forward(found: dict[str, Any]):
    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 5.2))
    for k, method in enumerate(dict.fromkeys(p["method"] for p in found["points"])):
        points = [p for p in found["points"] if p["method"] == method]
        style = {"color": f"C{k}", "label": method, "linestyle": "--" if method.endswith("float32") else "-"}
        n = [p["n"] for p in points]
        _curve(left, n, [max(p["error_max"], 1e-17) for p in points], [p["measured"] for p in points], **style)
        _curve(right, n, [max(p["residual"], 1e-17) for p in points], [True] * len(n), **style)
    n = [g["n"] for g in found["guides"]]
    for eps, name in ((2.0**-23, "float32"), (2.0**-52, "float64")):
        growth = [100 * eps * g["error_growth"] for g in found["guides"]]
        kappa = [eps * g["kappa_scaled"] for g in found["guides"]]
        left.plot(n, growth, color="0.3", linestyle=":", linewidth=1)
        left.plot(n, kappa, color="0.6", linestyle="-.", linewidth=1)
        left.annotate(f"100 eps growth, {name}", (n[0], growth[0]), fontsize=8, color="0.3", va="bottom")
        left.annotate(f"eps kappa, {name}", (n[-1], kappa[-1]), fontsize=8, color="0.5", ha="right", va="bottom")
    left.set(
        ylabel="largest relative error of accelerations", title="error: grows with the condition of M in any algorithm"
    )
    right.set(
        ylabel="|ID(FD(tau)) - tau| / |tau|", title="residual: none of them misses the torques by more than rounding"
    )
    for axes in (left, right):
        axes.set(xscale="log", yscale="log", xlabel="joints of the chain")
        axes.grid(True, alpha=0.3)
    right.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(
        "Forward dynamics: precision decides, not the algorithm.\n"
        "Further down is better; hollow: at the floor of the reference."
    )
    figure.tight_layout()
    return figure


def _gradients(found: dict[str, Any]):
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.5), sharey=True)
    for k, way in enumerate(dict.fromkeys(p["way"] for p in found["points"])):
        for p in (p for p in found["points"] if p["way"] == way):
            style = {"color": f"C{k}", "marker": PRECISION_MARKERS[p["precision"]], "linestyle": ""}
            style["markerfacecolor"] = f"C{k}" if p["measured"] else "none"
            label = f"{way}, {p['precision']}"
            y = max(p["error_max"], p["floor"])
            left.plot([p["nanoseconds"] / 1e3], [y], label=label, **style)
            if p["bytes"] is not None:
                right.plot([p["bytes"] / 1024], [y], **style)
    left.set(xlabel="time per sample [us]", ylabel="largest relative error of the gradient", title="error against time")
    right.set(xlabel="kept for the backward pass, per sample [KiB]", title="error against memory")
    for axes in (left, right):
        axes.set(xscale="log", yscale="log")
        axes.grid(True, alpha=0.3)
    figure.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncol=4, fontsize=9)
    figure.suptitle(
        f"Gradient of a rollout of {found['steps']} steps: lower left is better. Hollow: at the floor of the reference."
    )
    figure.tight_layout()
    return figure


def _effects(found: dict[str, Any]):
    costs = found["costs"]
    figure, axes = plt.subplots(figsize=(9, 0.4 * len(costs) + 1.5))
    names = [f"{c['effect']} ({c['slot']})" for c in costs]
    bars = axes.barh(names, [c["nanoseconds"] for c in costs], color=["0.6"] + ["C0"] * (len(costs) - 1))
    axes.bar_label(bars, [f" {c['operations']} operations" for c in costs], fontsize=8)
    axes.invert_yaxis()
    axes.set(xlabel=f"nanoseconds per step and robot ({found['measured_on']})")
    axes.set_title("What each effect adds to a step; what is not asked for costs nothing", fontsize=11)
    axes.margins(x=0.2)
    figure.tight_layout()
    return figure


def _energy(found: dict[str, Any]):
    figure, axes = plt.subplots(figsize=(9, 5))
    for row in found["rows"]:
        t = [found["dt"] * found["steps"] * k / len(row["curve"]) for k in range(len(row["curve"]))]
        pairs = [(x, abs(e)) for x, e in zip(t, row["curve"], strict=True) if e is not None and 0 < abs(e) < 1e3]
        if pairs:
            axes.plot(
                *zip(*pairs, strict=True),
                color=INTEGRATOR_COLOURS[row["integrator"]],
                linestyle=PRECISION_LINES[row["precision"]],
                linewidth=1,
                label=f"{row['integrator']}, {row['precision']}",
            )
    axes.set(yscale="log", xlabel="simulated time [s]", ylabel="|error of the energy|, relative")
    axes.grid(True, alpha=0.3)
    axes.legend(fontsize=8, ncol=1, loc="center left", bbox_to_anchor=(1.0, 0.5))
    axes.set_title(
        f"Energy of a double pendulum, step {1e3 * found['dt']:.1f} ms:\n"
        "a level line keeps it for ever, a rising one does not",
        fontsize=11,
    )
    figure.tight_layout()
    return figure
