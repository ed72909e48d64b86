"""Pictures of motions and of predicted torques, one panel per joint; matplotlib is imported when one is drawn."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from torchdq.base.checks import require_object
from torchdq.base.optional import imported
from torchdq.learning.evaluate import torques_by
from torchdq.learning.excitation.limits import Bounds
from torchdq.learning.identification.identified import Identified
from torchdq.learning.logs.motions import Motion, stack_samples
from torchdq.robot import Robot

BLUE, GREY, PALE = "#0072B2", "#8A8A8A", "#E4E4E4"
TURNS, SLIDES = ("q [rad]", "qd [rad/s]", "tau [N m]"), ("q [m]", "qd [m/s]", "tau [N]")
BREAK = 0.1  # [s] between rows, from which a line is broken: rows at rest are not in a motion
PAUSE = 1.0  # [s] between motions in a picture


def _panels(rows: int, columns: int, purpose: str, width: float = 4.5) -> tuple[Any, Any]:
    """Figure and panels [rows, columns] over one axis of time, without a window: `savefig` writes it."""
    matplotlib = imported("matplotlib", "matplotlib", purpose, "torchdq[viz]")
    imported("matplotlib.figure", "matplotlib", purpose, "torchdq[viz]")
    figure = matplotlib.figure.Figure(figsize=(width * columns, 1.6 * rows + 0.6), layout="constrained")
    panels = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for panel in panels.flat:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(color=PALE)
        panel.set_axisbelow(True)
    for panel in panels[-1]:
        panel.set_xlabel("time [s]")
    return figure, panels


def picture_of_motion(robot: Robot, time: Tensor, q: Tensor, qd: Tensor, tau: Tensor, bounds: Bounds) -> Any:
    """Figure of positions, velocities and torques [rows, n] with the limits that they keep, a row per joint."""
    figure, panels = _panels(robot.n, 3, "plot")
    limits = (bounds.lower, bounds.upper), (-bounds.velocity, bounds.velocity), (-bounds.effort, bounds.effort)
    for j, kind in enumerate(robot.joint_types):
        for panel, label, x, ends in zip(panels[j], TURNS if kind.turns else SLIDES, (q, qd, tau), limits, strict=True):
            panel.plot(time, x[:, j], color=BLUE)
            for limit in ends:
                panel.axhline(float(limit[j]), color=GREY, linestyle="--")
            panel.set_ylabel(label)
        panels[j, 0].set_title(robot.joint_names[j])
    return figure


def plot_torques(identified: Identified, motions: Motion | Sequence[Motion]) -> Any:
    """Figure of measured and predicted torques over time, one panel per joint, by matplotlib.

    The band holds 95 % of the measurements in motions of the kinds that were identified, see `Identified.predict`. A
    title says how large the residual is, as a part of the torque's standard deviation.

    Args:
        identified: from `identify`.
        motions: motions from `smooth`, drawn one after the other; best such that were not identified from.
    Raises:
        ArgumentError: the motions are of another arm.
        MissingLibraryError: matplotlib is not installed.

    >>> figure = plot_torques(identify(robot, before), after)  # doctest: +SKIP
    >>> figure.savefig("torques.png")  # doctest: +SKIP
    """
    require_object("identified", identified, Identified, "torchdq.learning", "identify(robot, motions)")
    several, robot = torques_by(identified, motions), identified.robot
    tau, predicted = stack_samples(several).tau, identified.predict(several)
    left = (tau - predicted.tau).square().mean(0).sqrt() / tau.std(0)
    step = np.concatenate([np.diff(motion.time, prepend=motion.time[0] - PAUSE) for motion in several])
    breaks = 1 + np.flatnonzero(step[1:] > BREAK)  # a NaN before these rows breaks the lines
    time = np.insert(np.cumsum(step) - PAUSE, breaks, np.nan)
    rows = tau, predicted.tau, predicted.low, predicted.high
    measured, mean, lower, upper = (np.insert(x.numpy(), breaks, np.nan, axis=0) for x in rows)
    figure, panels = _panels(robot.n, 1, "plot_torques", width=9.0)
    for j, panel in enumerate(panels[:, 0]):
        panel.fill_between(time, lower[:, j], upper[:, j], color=BLUE, alpha=0.25, linewidth=0, label="95 %")
        panel.plot(time, measured[:, j], color="black", linewidth=0.8, label="measured")
        panel.plot(time, mean[:, j], color=BLUE, linewidth=1.2, label="identified")
        panel.set_title(f"{robot.joint_names[j]}: {float(left[j]):.3f} of a standard deviation unexplained")
        panel.set_ylabel("[N m]" if robot.joint_types[j].turns else "[N]")
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper right", ncols=3)
    return figure
