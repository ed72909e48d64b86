"""Speed on the first pages: a sentence and four rows for the README, three numbers for the site, two pictures.

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
    ("a simulation step with friction", "Euler, float64", "envs.py", "A simulation step with dry friction"),
)
ARM = "xArm7"  # of both scripts
LOOP = "Pinocchio has no batched derivatives: they are called in a loop, and the time includes that of Python."

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
    alternative += f"Pinocchio is fastest for one arm, torchdq from {first} arms on; MuJoCo and frax are slower"
    said = f"Joint torques of a Panda. For one arm, a call takes {theirs[0] / 1e3:.1f} us in Pinocchio, "
    said += f"{call[0] / 1e3:.1f} us in torchdq, and {ours[0] / 1e3:.1f} us as a compiled object of torchdq. From "
    said += f"{first} arms on torchdq is faster: {theirs[at] / call[at]:.0f} x for 4096 arms, and "
    said += f"{theirs[at] / ours[at]:.0f} x as a compiled object."
    return f"![{alternative}]({picture})\n\n{said}"


def precision(picture: str) -> str:
    """Picture of errors over time at an address, and what it shows at one error."""
    found, error = json.loads(ACCURACY.read_text("utf-8"))["peers"], 1e-6
    many, one, theirs = (peers.reached(found, x, error) for x in (peers.OURS, peers.ONE, "MuJoCo RK4"))
    said = f"Simulating one second of a Panda to an error of {error:.0e} with `RungeKutta4` takes {many:.0f} us per "
    said += f"arm for {peers.BATCH} arms, and {one:.0f} us for a single arm. MuJoCo takes {theirs:.0f} us."
    return f"![{peers.ALTERNATIVE}]({picture})\n\n{said}"


def table() -> str:
    """The pictures, the four rows, and the machine that they were measured on."""
    lines = [f"| {ARM}, per arm | torchdq | other package | ratio |", "|---|---|---|---|"]
    for name, task, script, _ in ROWS:
        row = measured(task, script)
        ratio = f"{row.ratios[1]} x; {row.ratios[0]} x with dry friction" if row.ratios[1:] else f"{row.ratios[0]} x"
        lines.append(f"| {name} | {row.ours} ns | {row.theirs} ns, {row.package} | {ratio} |")
    said = f"{machine()} The packages in each row were timed alternately.\n"
    said += (
        "MuJoCo solves for dry friction iteratively; with dry friction switched off in MuJoCo alone, the last ratio is "
    )
    said += f"{row.ratios[1]} x.\n{LOOP}"
    pictures = [batches("docs/pictures/batches.svg"), precision("docs/pictures/precision.svg")]
    return "\n".join([*lines, "", said, "", "\n\n".join(pictures)])


def tiles() -> str:
    """The three numbers, as cards of the site."""
    lines = ['<div class="grid cards speed" markdown>', ""]
    for _, task, script, name in ROWS:
        if name:
            row = measured(task, script)
            solved = f" without dry friction, {row.ratios[0]} x with it" if row.ratios[1:] else ""
            lines += [f"-   **{row.ratios[-1]} x** as fast as {row.package}{solved}", ""]
            lines += [f"    {name}: {row.ours} ns per arm, {row.theirs} ns in {row.package.split(',')[0]}.", ""]
    return "\n".join([*lines, "</div>", "", f"{ARM}. {machine()} {LOOP}"])


def pair() -> str:
    """The pictures, next to each other."""
    pictures = [batches("pictures/batches.svg"), precision("pictures/precision.svg")]
    parts = "\n\n".join(f"<div markdown>\n\n{picture}\n\n</div>" for picture in pictures)
    return f'<div class="grid pair" markdown>\n\n{parts}\n\n</div>'


def sentence() -> str:
    """The first row of the table, as a sentence."""
    row = measured(*ROWS[0][1:3])
    said = f"On one CPU thread, the joint torques of an {ARM} take {row.ours} ns per arm, and {row.theirs} ns in "
    said += (
        f"{row.package} (4096 arms at\nonce, float64). CUDA kernels compile and are tested on the host, but were never "
    )
    return f"{said}timed on a GPU."


def machine() -> str:
    """Conditions of all rows: machine, batch and precision."""
    (found,) = re.findall(
        r"^Measured .* on: processor (.*?), vector instructions (\w+)", report.shown("peers.py"), re.M
    )
    return f"One thread of an {found[0]} ({found[1]}), 4096 arms at once, float64."


README, INDEX = report.ROOT / "README.md", report.ROOT / "docs/index.md"
BLOCKS = {  # by page and name of the marks
    (README, "front_page.py, speed"): sentence,
    (README, "front_page.py"): table,
    (INDEX, "front_page.py, speed"): tiles,
    (INDEX, "front_page.py"): pair,
}


def follow(arguments: argparse.Namespace) -> None:
    """Update of the first pages, after a script that measures their numbers has written its own."""
    if arguments.page:
        for (page, name), text in BLOCKS.items():
            report.between_marks(text(), name, page)


def main() -> None:
    """The texts, printed, and written where the option asks for it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--page", action="store_true", help="write the texts into the README and the site")
    arguments = parser.parse_args()
    print("\n\n".join(text() for text in BLOCKS.values()))
    follow(arguments)


if __name__ == "__main__":
    main()
