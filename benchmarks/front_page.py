"""Speed on the first pages: two pictures, four rows for the README, three numbers for the site.

    python benchmarks/front_page.py [--page]

They are those of docs/prices.md, and nothing is measured. The scripts that measure them end with it.
"""

from __future__ import annotations

import argparse
import json
import re
from typing import NamedTuple

import report
from accuracy import peers

# name on the first pages, name in the table of a script, the script, what is said of it on the first page of the site
ROWS = (
    ("joint torques of a motion", "inverse dynamics", "peers.py", "Joint torques of a motion"),
    ("torques and their gradients", "inverse dynamics, forward + backward", "peers.py", "Torques and their gradients"),
    ("joint accelerations", "forward dynamics", "peers.py", None),
    ("a simulation step with friction", "Euler, float64", "envs.py", "A simulation step with friction"),
)


BATCHES, ACCURACY = (report.ROOT / f"benchmarks/results/{name}.json" for name in ("batches", "accuracy"))


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


def batches(picture: str) -> str:
    """Picture over batch sizes at an address, and what it shows at both ends."""
    found = json.loads(BATCHES.read_text("utf-8"))
    sizes, times = found["sizes"], found["times"]["inverse_dynamics"]
    call, ours, theirs = times["torchdq, function"], times["torchdq, compiled object"], times["Pinocchio"]
    first = next(n for n, a, b in zip(sizes, ours, theirs, strict=True) if a < b)
    at = sizes.index(4096)
    alternative = "Inverse dynamics of a Panda per second against the batch size, 1 to 65536, on one thread: "
    alternative += f"Pinocchio is ahead for one arm, torchdq from {first} arms on, MuJoCo and frax nowhere"
    said = f"One arm: a call of Pinocchio takes {theirs[0] / 1e3:.1f} us, one of torchdq {call[0] / 1e3:.1f} us, or "
    said += (
        f"{ours[0] / 1e3:.1f} us as a compiled object. From {first} arms on torchdq is faster, at 4096 by a factor of "
    )
    said += f"{theirs[at] / ours[at]:.0f}."
    return f"![{alternative}]({picture})\n\n{said}"


def precision(picture: str) -> str:
    """Picture of errors over time at an address, and what it shows at one error."""
    found, error = json.loads(ACCURACY.read_text("utf-8"))["peers"], 1e-6
    many, one, theirs = (peers.reached(found, x, error) for x in (peers.OURS, peers.ONE, "MuJoCo RK4"))
    said = f"One second of motion of an arm to an error of {error:.0e} by `RungeKutta4`: {many:.0f} us for each of "
    said += f"{peers.BATCH} arms, {one:.0f} us for one alone; {theirs:.0f} us by MuJoCo."
    return f"![{peers.ALTERNATIVE}]({picture})\n\n{said}"


def table() -> str:
    """The pictures, the four rows, and the machine that they were measured on."""
    lines = ["| seven-joint arm, per arm | torchdq | other package | ratio |", "|---|---|---|---|"]
    for name, task, script, _ in ROWS:
        row = measured(task, script)
        lines.append(f"| {name} | {row.ours} ns | {row.theirs} ns, {row.package} | {row.ratios[0]} x |")
    said = f"{machine()} The packages of a row ran in turns.\n"
    said += f"MuJoCo finds dry friction by a solver; without dry friction the last ratio is {row.ratios[1]} x."
    pictures = [batches("docs/pictures/batches.svg"), precision("docs/pictures/precision.svg")]
    return "\n".join([*lines, "", said, "", "\n\n".join(pictures)])


def tiles() -> str:
    """The three numbers, as cards of the site, and the pictures."""
    lines = ['<div class="grid cards speed" markdown>', ""]
    for _, task, script, name in ROWS:
        if name:
            row = measured(task, script)
            without = f"; {row.ratios[1]} x if MuJoCo has no dry friction" if row.ratios[1:] else ""
            lines += [f"-   **{row.ratios[0]} x** as fast as {row.package}", ""]
            lines += [f"    {name}: {row.ours} ns per arm against {row.theirs} ns{without}.", ""]
    pictures = [batches("pictures/batches.svg"), precision("pictures/precision.svg")]
    pair = "\n\n".join(f"<div markdown>\n\n{picture}\n\n</div>" for picture in pictures)
    return "\n".join([*lines, "</div>", "", machine(), "", f'<div class="grid pair" markdown>\n\n{pair}\n\n</div>'])


def machine() -> str:
    """Conditions of all rows: machine, batch and precision."""
    (found,) = re.findall(
        r"^Measured .* on: processor (.*?), vector instructions (\w+)", report.shown("peers.py"), re.M
    )
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
