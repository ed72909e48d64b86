"""One look of the pictures of all examples: style, colours, files."""

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib import pyplot as plt

BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#8A8A8A"  # told apart by everyone
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


def save(figure: plt.Figure, path: Path) -> None:
    """Write a picture into a folder, which is made if there is none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
    plt.close(figure)
