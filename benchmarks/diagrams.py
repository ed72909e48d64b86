"""Diagrams of the documentation: how a description becomes programs, the step of a scene, frames and signs.

    python benchmarks/diagrams.py [--write]

Each is one function here; `pages/diagram.py` has boxes, arrows and words.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import report
from pages.diagram import Diagram, Point

FOLDER = report.ROOT / "docs" / "pictures"
WIDTH, MARGIN, GAP = 580, 12, 12  # of a diagram, and of its boxes [pixels]
Vector = np.ndarray


def columns(count: int) -> tuple[list[float], float]:
    """Left edges and width of some boxes in a row."""
    width = (WIDTH - 2 * MARGIN - (count - 1) * GAP) / count
    return [MARGIN + k * (width + GAP) for k in range(count)], width


# --- from a description to programs ----------------------------------------------------------------------------------

SOURCES = ("URDF", "xacro", "MJCF", "shipped robots")
DESCRIBED = (
    ("orange", "`Robot`", "joints, links, masses, limits;", "constants, or tensors to learn"),
    ("orange", "Effects, controllers, tasks", "friction, contact, motors, delays,", "sensors, rewards: in scenes only"),
)
PROGRAM = (
    "Recorded program",
    "A formula runs once on symbols; its operations are a list:",
    "constants folded, terms shared, absent effects absent.",
)
TARGETS = (
    ("C", "a sample in each lane", "of the processor"),
    ("CUDA", "a sample", "in each thread"),
    ("torch", "one operation", "after the other"),
)
USES = (
    ("Functions", "`inverse_dynamics`, ...", "of one state or millions"),
    ("Layers", "`DQRNEA`: physics", "in a torch network"),
    ("Scenes", "`Scene`: the effects", "you list, no others"),
    ("Environments", "`torchdq.envs`: tasks", "for many robots"),
    ("Optimal control", "`torchdq.optimal`:", "iLQR, MPC, sampling"),
    ("Export", "C99 for controllers,", "CasADi, ONNX"),
)


STAGES = (  # and their heights [pixels]
    (26, "1  You describe a robot, and what acts on it"),
    (208, "2  You call, for one state or for millions"),
    (428, "3  At the first call: the formula is recorded for this robot"),
    (552, "4  Its program is compiled, cached and run; later calls begin here"),
)


def architecture() -> Diagram:
    """From a description and a call to a recorded program, and its compiled forms."""
    drawn = Diagram(WIDTH, 684)
    for y, words in STAGES:
        drawn.text((MARGIN, y), words, "grey", 12.5, font_weight="bold")
    xs, width = columns(len(SOURCES))
    halves, half = columns(2)
    for x, name in zip(xs, SOURCES, strict=True):
        drawn.shape("rect", stroke="grey", x=x, y=38, width=width, height=32, rx=16, stroke_width=1.2)
        drawn.text((x + width / 2, 59), name, anchor="middle")
        drawn.line([(x + width / 2, 70), (x + width / 2, 80)])
    for x, (colour, *words) in zip(halves, DESCRIBED, strict=True):
        drawn.box((x, 94), (half, 80), *words, colour=colour)
    drawn.line([(x + width / 2, 80) for x in (xs[0], xs[-1])])
    drawn.arrow([(halves[0] + half / 2, 80), (halves[0] + half / 2, 94)])
    xs, width = columns(3)
    for k, use in enumerate(USES):
        drawn.box((xs[k % 3], 220 + 88 * (k // 3)), (width, 80), *use, colour="orange")
    drawn.box((MARGIN, 440), (394, 86), *PROGRAM)
    x, side = WIDTH - MARGIN - 134, 134
    drawn.box((x, 440), (side, 86), "Derivatives", "programs as well")
    drawn.arrow([(x - 28, 471), (x, 471)])
    drawn.arrow([(x, 495), (x - 28, 495)])
    for x, target in zip(xs, TARGETS, strict=True):
        drawn.box((x, 564), (width, 80), *target)
    for top in (174, 388, 526):
        drawn.arrow([(WIDTH - 36, top), (WIDTH - 36, top + 44 if top < 526 else 562)], width=2)
    drawn.text((MARGIN, 668), "Orange: what you write. Blue: what torchdq makes of it.", "grey", 12)
    return drawn


# --- the step of a scene ---------------------------------------------------------------------------------------------


class Stage(NamedTuple):
    """Box of a step, and what enters it, or leaves it, at its right."""

    colour: str  # orange: of what a scene lists
    words: tuple[str, ...]  # title and lines
    given: tuple[str, ...] = ()
    leaves: bool = False

    @property
    def height(self) -> float:
        """Height of the box."""
        return 20 + 19 * len(self.words)


BEFORE = (
    Stage("ink", ("State", "`q`, `qd`, poses and twists of free bodies,", "`memory` of effects, `reading` of sensors")),
    Stage("orange", ("Controller", "torques from the measured `q` and `qd`"), ("`reference`", "`torque`")),
    Stage("orange", ("Actuators", "delay, lag, limits; held over the step")),
)
SUBSTEP = (
    Stage(
        "orange",
        ("Forces", "on joints: friction, springs, limits", "on bodies: contact, pushes, drag"),
        ("`push`, ...",),
    ),
    Stage(
        "blue",
        ("Accelerations", "`M(q) a = forces - c - g`", "implicit: `M + h D + h² K`, forces at the end"),
        ("gravity, payload,", "rotor inertia"),
    ),
    Stage("blue", ("Integrator", "velocities, then positions at `t + h`")),
)
AFTER = (
    Stage("orange", ("Sensors", "bias, noise, resolution, delay"), ("`noise`",)),
    Stage("orange", ("Task", "if an environment has one"), ("observation,", "reward"), True),
)


def step() -> Diagram:
    """The order of computations in a step."""
    x, width, side, gap, inside = 44, 352, 424, 22, 26
    drawn, top, before = Diagram(WIDTH, 762), 12.0, 0.0
    for stage in (*BEFORE, *SUBSTEP, *AFTER):
        if stage in (SUBSTEP[0], AFTER[0]):
            top += inside - 10
        if stage is SUBSTEP[0]:
            size = sum(one.height + gap for one in SUBSTEP) - gap + 2 * inside - 10
            frame = {"x": 30, "y": top - inside, "width": 538, "height": size, "rx": 8}
            drawn.shape("rect", stroke="grey", stroke_dasharray="5 4", **frame)
            drawn.text((556, top - inside + 18), "every substep; `RungeKutta4`: four times", "grey", 12, "end")
        middle, rows, bottom = top + stage.height / 2, len(stage.given), top + stage.height
        if stage is not BEFORE[0]:
            drawn.arrow([(x + width / 2, before), (x + width / 2, top)])
        drawn.box((x, top), (width, stage.height), *stage.words, colour=stage.colour)
        for row, name in enumerate(stage.given):
            drawn.text((side + 12, middle + 5 + 18 * (row - (rows - 1) / 2)), name)
        if rows:
            ends = [(side + 6, middle), (x + width, middle)]
            drawn.arrow(ends[::-1] if stage.leaves else ends)
        before, top = bottom, bottom + gap
    drawn.arrow([(x, middle), (16, middle), (16, 50), (x, 50)])
    drawn.text((x, before + 26), "One compiled program. Orange: only what the scene lists is in it.", "grey", 12)
    return drawn


# --- frames and signs ------------------------------------------------------------------------------------------------

SCALE, ORIGIN = 235, (36, 348)  # [pixels] of a metre, and of the origin of the world
VIEW = np.array([[1.0, 0.5, 0.0], [0.06, -0.42, -1.0]])  # of x, y and z, to the right and down
AXES = ("orange", "green", "blue")


def seen(point: Vector) -> Point:
    """Place of a point in the picture."""
    right, down = SCALE * VIEW @ point + ORIGIN
    return float(right), float(down)


def turn(axis: str, degrees: float) -> Vector:
    """Rotation matrix about an axis."""
    k, angle = "xyz".index(axis), np.radians(degrees)
    found, (i, j) = np.eye(3), ((k + 1) % 3, (k + 2) % 3)
    found[[i, j, i, j], [i, j, j, i]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
    return found


def arc(centre: Vector, R: Vector, radius: float, first: float, last: float) -> list[Point]:
    """Points of an arc about the z axis of a frame, between two angles [degrees]."""
    angles = np.radians(np.linspace(first, last, 24))
    return [seen(centre + radius * R @ (np.cos(a), np.sin(a), 0.0)) for a in angles]


def axes(drawn: Diagram, p: Vector, R: Vector, length: float = 0.24, names: bool = False) -> None:
    """Axes of a frame."""
    for k, colour in enumerate(AXES):
        drawn.arrow([seen(p), seen(p + length * R[:, k])], colour, 2.2)
        if names:
            x, y = seen(p + (length + 0.07) * R[:, k])
            drawn.text((x, y + 4), "xyz"[k], colour, 12.5, "middle")


def solid(drawn: Diagram, p: Vector, R: Vector, size: Vector) -> None:
    """A box about a point, of which three sides are seen."""
    low, high = -0.5 * np.array(size), 0.5 * np.array(size)
    for k in (2, 0, 1):
        face = []
        for s, t in ((0, 0), (1, 0), (1, 1), (0, 1)):
            corner = np.array([high[0], low[1], high[2]])
            corner[(k + 1) % 3], corner[(k + 2) % 3] = (low, high)[s][(k + 1) % 3], (low, high)[t][(k + 2) % 3]
            face.append("{:.1f},{:.1f}".format(*seen(p + R @ corner)))
        drawn.shape("polygon", "panel", "grey", points=" ".join(face), stroke_linejoin="round")


def frames() -> Diagram:
    """Frames of a robot, its twist, the sign of a joint, and of wrenches."""
    drawn = Diagram(WIDTH, 404)
    W, world = np.zeros(3), np.eye(3)
    B, R_B = np.array([0.86, 0.0, 0.42]), turn("z", 8) @ turn("y", -5)
    one, R_1 = B + 0.28 * R_B[:, 2], R_B
    two, R_2 = one + 0.55 * R_1[:, 2], R_1 @ turn("y", 122)
    tip, R_T = two + 0.84 * R_2[:, 2], R_2
    table = np.array([tip[0] + 0.05, tip[1], tip[2] - 0.1])
    solid(drawn, B - 0.06 * R_B[:, 2], R_B, (0.64, 0.44, 0.12))
    solid(drawn, table, world, (0.62, 0.36, 0.2))
    for a, b, width in ((B, one, 26), (one, two, 24), (two, tip, 18)):
        drawn.line([seen(a), seen(b)], "grid", width, stroke_linecap="round")
    for joint in (one, two):
        drawn.shape("circle", "paper", "grey", cx=seen(joint)[0], cy=seen(joint)[1], r=8, stroke_width=1.6)
    for p, R in ((W, world), (B, R_B), (one, R_1), (two, R_2), (tip, R_T)):
        axes(drawn, p, R, names=p is W)
    drawn.arrow([seen(W), seen(B)], "ink", stroke_dasharray="5 4")
    drawn.arrow(arc(one + 0.22 * R_1[:, 2], R_1, 0.15, -150, 130), "ink", 2)
    drawn.arrow(arc(B, R_B, 0.25, -170, 80), "ink", 2)
    drawn.arrow([seen(B), seen(B + R_B @ (0.62, -0.6, 0.0))], "ink", 2.6)
    x, y = seen(two + 0.42 * R_2[:, 2])
    drawn.arrow([(x, y - 74), (x, y - 10)], "ink", 2.6)
    drawn.arrow([seen(tip), seen(tip + 0.32 * R_T[:, 2])], "ink", 2.6)
    for p, shift, anchor, *lines in (
        (seen(W), (-16, 26), "start", "`W`, world"),
        (seen(0.5 * B), (18, 40), "start", "`X_WB`: pose of B in W,", "`X_WT = X_WB X_BT`"),
        (seen(B), (-82, -20), "end", "`B`, base"),
        (seen(B), (112, 52), "start", "`V_WB_B = (ω, v)`: twist of B", "relative to W, in axes of B"),
        (seen(one), (-52, -52), "end", "positive `q` and `tau`:", "right-handed about", "the axis of the joint"),
        (seen(two), (-34, -10), "end", "frame of a link"),
        ((x, y), (12, -60), "start", "`f_ext = (f, n)`: the environment", "on a link; minus sign in `tau`"),
        (seen(tip), (36, -20), "start", "`T`, tip"),
        (seen(tip), (-58, 92), "start", "`f_tip = (f, n)`: the tip on the", "environment; plus sign in `tau`"),
    ):
        for k, words in enumerate(lines):
            drawn.text((p[0] + shift[0], p[1] + shift[1] + 17 * k), words, size=12.5, anchor=anchor)
    return drawn


DIAGRAMS: dict[str, Callable[[], Diagram]] = {"architecture": architecture, "step": step, "frames": frames}


def main() -> None:
    """Names of the diagrams, drawn where the option asks for it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="draw them into docs/pictures")
    arguments = parser.parse_args()
    for name, drawn in DIAGRAMS.items():
        path = FOLDER / f"{name}.svg"
        print(path.relative_to(report.ROOT))
        if arguments.write:
            path.write_text(drawn().svg(), encoding="utf-8")


if __name__ == "__main__":
    main()
