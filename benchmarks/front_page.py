"""Five rows of speed for the README, from the tables of docs/prices.md.

    python benchmarks/front_page.py [--page]

It measures nothing, so the numbers of the two pages are the same. `peers.py --page` and `envs.py --page` end with it.
"""

from __future__ import annotations

import argparse
import re

import report

# what the README calls it, what the table of a script calls it, the script, the name of the other package
ROWS = (
    ("joint torques of a motion", "inverse dynamics, against pinocchio", "peers.py", "Pinocchio"),
    ("torques and their gradients", "inverse dynamics, forward + backward", "peers.py", "Pinocchio, called in a loop"),
    ("joint accelerations", "forward dynamics, against pinocchio", "peers.py", "Pinocchio"),
    ("frames of all links", "forward kinematics", "peers.py", "pytorch_kinematics"),
    ("a simulation step with friction", "step, Euler, gravity, damping, friction, float64", "envs.py", "MuJoCo"),
)
TIMES = re.compile(r"([\d.]+) x \(([\d.]+) against ([\d.]+) ns\)")


def rounded(x: str) -> str:
    """A time without its digits after the point, where those say nothing."""
    return f"{float(x):.0f}"


def table() -> str:
    """The five rows, and the machine that they were measured on."""
    lines = ["| seven-joint arm, per arm | torchdq | other package | ratio |", "|---|---|---|---|"]
    for name, row, script, other in ROWS:
        line = next(x for x in report.shown(script).splitlines() if x.startswith(f"| {row}"))
        ratio, ours, theirs = map(rounded, TIMES.search(line).groups())  # type: ignore[union-attr]
        lines.append(f"| {name} | {ours} ns | {theirs} ns, {other} | {ratio} x |")
    (machine,) = re.findall(r"^Measured on: processor (.*?), vector instructions (\w+)", report.shown("peers.py"), re.M)
    (without,) = re.findall(r"; (\d+) x where mujoco has no dry friction", line)
    said = (
        f"One thread of an {machine[0]} ({machine[1]}), 4096 arms at once, float64. "
        "The packages of a row ran in turns.\n"
        f"MuJoCo finds dry friction by a solver; without dry friction the last ratio is {without} x."
    )
    return "\n".join([*lines, "", said])


def follow(arguments: argparse.Namespace) -> None:
    """Write the rows into the README, if a script that measures them has written its page."""
    if arguments.page:
        report.between_marks(table(), __file__)


def main() -> None:
    """The rows, printed, and written where the option asks for it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--page", action="store_true", help="write the rows into the README")
    arguments = parser.parse_args()
    print(table())
    follow(arguments)


if __name__ == "__main__":
    main()
