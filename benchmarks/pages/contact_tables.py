"""Tables of what was measured of contact, for the page of the effect."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torchdq
from pages.text import table
from torchdq import Scene, effects
from torchdq.objects import Box

STORED = Path(__file__).resolve().parents[1] / "results" / "contact.json"
Rows = Sequence[dict[str, Any]]


def price(rows: Rows) -> str:
    """Operations and times by the number of points."""
    return table(
        ("robot", "points", "operations", "over none", "ns", "MuJoCo", "ratio"),
        [
            (
                row["robot"],
                str(row["points"]),
                str(row["operations"]),
                f"{row['over none']:.2f}",
                f"{row['ns']:.0f}",
                f"{row['MuJoCo ns']:.0f} ns, {row['in contact']} in contact",
                f"{row['ratio']:.0f} x",
            )
            for row in rows
            if row["points"] >= row["in contact"]
        ],
    )


def gradient(rows: Rows) -> str:
    """Gradients of 24 steps."""
    head = ("gradient of 24 steps", "over the rollout", "relative error against differences")
    return table(head, [(row["robot"], f"{row['ratio']:.1f} x", f"{row['error']:.1g}") for row in rows])


def accuracy(rows: Rows) -> str:
    """Results of every measurement at 1, 5 and 10 ms."""
    found = [(row["what"], row["expected"], *map(_number, row["found"])) for row in rows]
    return table(("measured", "expected", "1 ms", "5 ms", "10 ms"), found)


def _number(x: float) -> str:
    return f"{x:.4f}" if abs(x) >= 1e-3 else "0" if abs(x) < 1e-15 else f"{x:.0e}"


def stability(rows: Rows) -> str:
    """Energy gained by the step and the stiffness."""
    return table(
        ("step", "k [N/m]", "largest gain, passive", "with servos", "states lost"),
        [
            (
                f"{1e3 * row['dt']:g} ms",
                f"{row['k']:.2g}",
                _gain(row["passive"]),
                _gain(row["servos"]),
                str(row["lost"]),
            )
            for row in rows
        ],
    )


def _gain(x: float) -> str:
    return f"{100 * x:.2g} %" if x > 1e-9 else "none"


def standing(rows: Rows) -> str:
    """Movement of a standing robot."""
    head = ("moved in a minute [mm]", "at rest", "shaken by 1 N m", "on a slope of 10 degrees")
    return table(head, [(row["who"], *[f"{x:.2g}" for x in row["moved"]]) for row in rows])


def servos(rows: Rows) -> str:
    """Torques of servos over their limit."""
    head = ("step", "largest torque over the limit", "99.9 % are below", "share above the limit")
    return table(
        head,
        [
            (f"{1e3 * x['dt']:g} ms", f"{x['largest']:.2f}", f"{x['99.9 %']:.3f}", f"{100 * x['share above']:.2g} %")
            for x in rows
        ],
    )


TABLES: dict[str, Callable[[Rows], str]] = {
    "price": price,
    "gradient": gradient,
    "accuracy": accuracy,
    "stability": stability,
    "standing": standing,
    "servos": servos,
}


SECTIONS = {  # of the page of an effect: title, text and tables
    "Contact": {
        "Accuracy by step size": (
            "Impacts are first-order accurate, and become plastic in long steps: take 1 to 2 ms for jumps and bounces, "
            "5 ms for walking, 10 ms for standing and wiping. The friction impulse of impacts and the energy of falls "
            "are right at every step size and stiffness. Expected values are analytical, except for the jump height "
            "and the friction impulse of MuJoCo, with steps of 0.2 ms and 2 ms. The jump is that of servos with 120 "
            "N m/rad and no torque limits; its height is that of the base above the ground. [A robot with "
            "feet](../guides/legs.md#which-step) has the height gained in a jump within the limits.",
            ("accuracy", "standing"),
        ),
        "Stability": (
            "Go2 with 20 contact points falls from 64 random states, passive and with servos at random targets; the "
            "table has the largest gain of energy (kinetic, potential and of the servos). The last row of each step "
            "size has the stiffness 4 m / h^2. Any gain is due to the inertial forces of the joints, which are "
            "explicit: at 20 ms an impact at 6 m/s turns a joint by half a radian in a step.",
            ("stability",),
        ),
        "Cost compared with MuJoCo": (
            "Time per sample of a step of 4096 samples in float32, and of a step of MuJoCo on the same file with "
            "spheres as feet: least CPU times of one thread, measured alternately. The cost of MuJoCo depends on the "
            "points in contact, that of the program on all points.",
            ("price", "gradient"),
        ),
    },
    "Servo": {
        "How well the limit holds": (
            "Go2 falls, lands and struggles under targets that jump by 0.5 rad at 50 Hz, with kp 30 and kd 0.7, in "
            "implicit steps: torques at the end of a step over the limits of its file.",
            ("servos",),
        )
    },
}


OBJECTS = (
    "With `on`, points touch the surfaces of [objects](../scenes.md#objects) instead of the ground: those of the "
    "robot, or of other objects, which `points` names. Each body gets the opposite of what the other gets, at the "
    "same point, and both accelerate in the same linear equations, so that a grasp is as implicit as a foot on the "
    "ground. `scene.contacts(state, name)` has the forces of the contacts of a frame or an object, on the body of the "
    "point; `scene.touching` names both bodies of each.",
    "A point touches where its sphere is nearest to the surface, and inside a box in the direction of the nearest "
    "face. Edges between points do not touch: a beam falls through a box that is narrower. Corners of a box without "
    "`rounding`, and rims of a cylinder, touch the ground, balls and capsules; on boxes and cylinders they are "
    "refused, because edges would pass through edges.",
    "By default the stiffness is 1e5 1/s^2 times the mass of the lightest object that takes part, which steps of up "
    "to 6 ms follow; a cube of 0.1 kg then sinks by 0.02 mm on four corners.",
)


def objects() -> str:
    """Operations of contacts with an object."""
    robot, cube = torchdq.robots.load("panda_hand"), Box("cube", 0.1, size=(0.04, 0.04, 0.04))
    ground, fingers = effects.Contact("cube"), effects.Contact("*_finger", on="cube")

    def count(*parts: effects.Effect) -> int:
        return Scene(robot, parts, objects=(cube,)).count().total

    none = count()
    rows = [
        ("a step without contact", f"{none}"),
        ('`effects.Contact("cube")`, 8 points on the ground', f"+ {count(ground) - none}"),
        ('`effects.Contact("*_finger", on="cube")`, 8 points on the cube', f"+ {count(fingers) - none}"),
        ("both", f"+ {count(ground, fingers) - none}"),
    ]
    return table(("`panda_hand` and a cube", "operations"), rows)


def sections(name: str) -> list[str]:
    """Further sections of the page of an effect, of what was measured and stored."""
    if name not in SECTIONS:
        return []
    found = json.loads(STORED.read_text(encoding="utf-8"))
    parts = ["## Objects", *OBJECTS, objects()] if name == "Contact" else []
    for title, (text, names) in SECTIONS[name].items():
        parts += [f"## {title}", text, *[TABLES[part](found[part]) for part in names]]
    machine = ", ".join(f"{key} {value}" for key, value in found["machine"].items())
    return [*parts, f"Measured by `python benchmarks/contact.py`: {machine}."]
