"""Speed on the first pages, from the tables of docs/prices.md: five rows for the README, three numbers for the site.

    python benchmarks/front_page.py [--page]

It measures nothing, so the numbers of all pages are the same. `peers.py --page` and `envs.py --page` end with it.
"""

from __future__ import annotations

import argparse
import re
from typing import NamedTuple

import report

# name on the first pages, name in the table of a script, the script, what is said of it on the first page of the site
ROWS = (
    ("joint torques of a motion", "inverse dynamics", "peers.py", "Joint torques of a motion"),
    ("torques and their gradients", "inverse dynamics, forward + backward", "peers.py", None),
    ("joint accelerations", "forward dynamics", "peers.py", None),
    ("frames of all links", "forward kinematics", "peers.py", "Frames of all links"),
    ("a simulation step with friction", "Euler, float64", "envs.py", "A simulation step with friction"),
)


class Row(NamedTuple):
    """Cells of a comparison: times of torchdq and of another package, and ratios, the first of these times."""

    ours: str
    theirs: str
    package: str
    ratios: tuple[str, ...]


def measured(task: str, script: str) -> Row:
    """Row of a task in the table of a script, without digits that say nothing."""
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in report.shown(script).splitlines()]
    _, ours, theirs, *ratios = next(cells for cells in lines if cells[:1] == [task])
    time, package = theirs.split(" ns, ")
    rounded = [f"{float(x.split()[0]):.0f}" for x in (ours, time, *ratios)]
    return Row(rounded[0], rounded[1], package, tuple(rounded[2:]))


def table() -> str:
    """The five rows, and the machine that they were measured on."""
    lines = ["| seven-joint arm, per arm | torchdq | other package | ratio |", "|---|---|---|---|"]
    for name, task, script, _ in ROWS:
        row = measured(task, script)
        lines.append(f"| {name} | {row.ours} ns | {row.theirs} ns, {row.package} | {row.ratios[0]} x |")
    said = f"{machine()} The packages of a row ran in turns.\n"
    said += f"MuJoCo finds dry friction by a solver; without dry friction the last ratio is {row.ratios[1]} x."
    return "\n".join([*lines, "", said])


def tiles() -> str:
    """The three numbers, as cards of the site."""
    lines = ['<div class="grid cards speed" markdown>', ""]
    for _, task, script, name in ROWS:
        if name:
            row = measured(task, script)
            without = f"; {row.ratios[1]} x if MuJoCo has no dry friction" if row.ratios[1:] else ""
            lines += [f"-   **{row.ratios[0]} x** as fast as {row.package}", ""]
            lines += [f"    {name}: {row.ours} ns per arm against {row.theirs} ns{without}.", ""]
    return "\n".join([*lines, "</div>", "", machine()])


def machine() -> str:
    """Conditions of all rows: machine, batch and precision."""
    (found,) = re.findall(r"^Measured on: processor (.*?), vector instructions (\w+)", report.shown("peers.py"), re.M)
    return f"One thread of an {found[0]} ({found[1]}), 4096 arms at once, float64."


PAGES = {report.ROOT / "README.md": table, report.ROOT / "docs/index.md": tiles}


def follow(arguments: argparse.Namespace) -> None:
    """Update of the first pages, after a script that measures their numbers has written its own."""
    if arguments.page:
        for page, text in PAGES.items():
            report.between_marks(text(), __file__, page)


def main() -> None:
    """The texts, printed, and written where the option asks for it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--page", action="store_true", help="write the texts into the README and the site")
    arguments = parser.parse_args()
    print("\n\n".join(text() for text in PAGES.values()))
    follow(arguments)


if __name__ == "__main__":
    main()
