"""Common style of the figures of all examples."""

import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes

BLUE, ORANGE, GREY, INK = "#0072B2", "#D55E00", "#8A8A8A", "#24292F"  # distinguishable by everyone
DATA, POINTS = "curves", 20  # entry of a PNG file with the data of its lines, and points of a line
STYLE = {
    "font.size": 11,
    "axes.titlesize": 11,
    "axes.titlelocation": "left",
    "axes.xmargin": 0.02,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.6,
    "savefig.dpi": 160,
}


def prepare(changes: dict[str, Any] | None = None) -> None:
    """Draw into files from now on, in the common style with some changes."""
    matplotlib.use("Agg")
    plt.rcParams.update(STYLE | (changes or {}))


def panels(count: int, columns: int, height: float) -> tuple[plt.Figure, list[Axes]]:
    """Figure with a number of panels in columns, each of a height [inches], over one axis of time."""
    rows = -(-count // columns)
    size = (9, height * rows + 0.5)
    figure, grid = plt.subplots(rows, columns, figsize=size, sharex=True, squeeze=False, layout="constrained")
    found = list(grid.ravel())
    for panel in found[count:]:
        panel.set_axis_off()
    for panel in found[:count][-columns:]:
        panel.tick_params(labelbottom=True)  # it has no panel below it
    return figure, found[:count]


def label(figure: plt.Figure, panel: Axes, x: str) -> None:
    """Name the axes of all panels, torques over x, and the lines of one panel, which are those of the others."""
    figure.supylabel("torque [N m]", fontsize=11)
    figure.supxlabel(x, fontsize=11)
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=4)


def curves(figure: plt.Figure) -> str:
    """Some points of every line of a figure, as JSON: the data of a picture, which do not depend on fonts or pixels."""
    rows = [np.asarray(line.get_ydata(), float) for axes in figure.axes for line in axes.get_lines()]
    return json.dumps([[float(f"{y:.4g}") for y in row[:: max(1, len(row) // POINTS)]] for row in rows])


def save(figure: plt.Figure, path: Path) -> None:
    """Write a picture with its data, into a folder that is created if necessary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, metadata={DATA: curves(figure)} if path.suffix == ".png" else None)
    plt.close(figure)
