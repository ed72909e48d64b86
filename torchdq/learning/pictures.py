"""Pictures of motions and of predicted torques, one panel per joint; matplotlib is imported when one is drawn."""

from typing import Any

from torch import Tensor

from torchdq.learning.motion_limits import Bounds
from torchdq.optional import imported
from torchdq.robot import Robot

BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#8A8A8A"  # told apart by everyone
STYLE = {
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "axes.axisbelow": True,
    "legend.frameon": False,
}


def _panels(rows: int, columns: int, purpose: str) -> tuple[Any, Any]:
    """Figure and panels [rows, columns] over one axis of time, without a window: `savefig` writes it."""
    matplotlib = imported("matplotlib", "matplotlib", purpose, "torchdq[viz]")
    figures = imported("matplotlib.figure", "matplotlib", purpose, "torchdq[viz]")
    with matplotlib.rc_context(STYLE):
        figure = figures.Figure(figsize=(4.5 * columns, 1.6 * rows + 0.6), layout="constrained")
        return figure, figure.subplots(rows, columns, sharex=True, squeeze=False)


def picture_of_motion(robot: Robot, time: Tensor, q: Tensor, qd: Tensor, tau: Tensor, bounds: Bounds) -> Any:
    """Figure of positions, velocities and torques [rows, n] beside the limits that they keep, a row per joint."""
    figure, panels = _panels(robot.n, 3, "plot")
    most = (bounds.upper, bounds.velocity, bounds.effort)
    least = (bounds.lower, -bounds.velocity, -bounds.effort)
    for j, (name, kind) in enumerate(zip(robot.joint_names, robot.joint_types, strict=True)):
        units = ("rad", "rad/s", "N m") if kind.turns else ("m", "m/s", "N")
        for k, x in enumerate((q, qd, tau)):
            panel = panels[j, k]
            panel.plot(time, x[:, j], color=BLUE)
            for limit in (least[k][j], most[k][j]):
                panel.axhline(float(limit), color=GREY, linestyle="--")
            panel.set_ylabel(f"[{units[k]}]")
        panels[j, 0].set_title(name)
    for panel, title in zip(panels[-1], ("position", "velocity", "torque"), strict=True):
        panel.set_xlabel(f"time [s]: {title}")
    return figure
