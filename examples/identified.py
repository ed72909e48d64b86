"""Table and picture of an identified robot: predicted and measured torques of a test motion."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from pictures import BLUE, ORANGE, label, panels, prepare, save
from rich.table import Table

from torchdq.learning import Motion

COLORS = {"nominal": ORANGE, "identified": BLUE}


def shares(motion: Motion, torques: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Root mean square error over standard deviation of the measured torque, [n], of each model."""
    deviation = motion.tau.std(0)
    return {name: np.sqrt(((x - motion.tau) ** 2).mean(0)) / deviation for name, x in torques.items()}


def errors_table(found: Mapping[str, np.ndarray]) -> Table:
    """Errors of each model by joint."""
    n = len(next(iter(found.values())))
    title = "error / standard deviation of the torque, in a motion that was not learned from"
    rows = Table("model", *(f"joint {j + 1}" for j in range(n)), "mean", title=title)
    for name, x in found.items():
        rows.add_row(name, *(f"{share:.3f}" for share in (*x, x.mean())))
    return rows


def draw(names: tuple[str, ...], motion: Motion, torques: Mapping[str, np.ndarray], path: Path, seconds: float) -> None:
    """Measured torques and those of models over the first seconds of a motion, a panel for each joint."""
    prepare()
    time = motion.time - motion.time[0]
    shown = time <= seconds
    gaps = np.append(False, np.diff(time[shown]) > 0.2)  # no line across rows at rest
    figure, joints = panels(len(names), 2, 1.7)
    for j, panel in enumerate(joints):
        lines = {"measured": motion.tau[shown, j]} | {name: x[shown, j] for name, x in torques.items()}
        for name, line in lines.items():
            width, color = (1.2, COLORS[name]) if name in COLORS else (4.0, "#B8B8B8")
            panel.plot(time[shown], np.where(gaps, np.nan, line), color=color, linewidth=width, label=name)
        panel.set_title(names[j], fontsize=10)
    label(figure, joints[0], "time [s]")
    save(figure, path)
