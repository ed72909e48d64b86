"""Pictures of a terminal after a command, for README and pages: what `torchdq report` and `torchdq id` print.

    python benchmarks/terminals.py [--write]

The robot is `examples/arm.urdf`; its logs are simulated, by an arm with other masses and more friction.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from html import escape
from pathlib import Path
from shutil import copy

import numpy as np
import report
from pages.diagram import MONO

import torchdq

sys.path.append(str(report.ROOT / "examples"))
from simulated_logs import real_arm, recorded

FOLDER, ARM = report.ROOT / "docs" / "pictures", report.ROOT / "examples" / "arm.urdf"
LOGS = tuple(f"run_{k}.csv" for k in range(1, 5))
COMMANDS = {"report": ("report", ARM.name), "id": ("id", ARM.name, *LOGS)}
COLUMNS, SIZE, LINE, MARGIN = 80, 13, 18, 20  # columns of the terminal; of its letters, lines and edges [pixels]
ADVANCE = 0.602 * SIZE  # of a letter
PAPER, INK, BRIGHT, PROMPT = "#0d1b2a", "#c9d3de", "#ffffff", "#f0913a"  # dark on every page, as the films are
BOLD = "\x1b[1m"


def logs(folder: Path) -> None:
    """Logs of a simulated arm, in a folder."""
    robot = torchdq.Robot.from_urdf(ARM)
    arm = real_arm(robot, 0)
    heads = ["time", *(f"{name}{k}" for name in ("q", "qd", "tau") for k in range(1, robot.n + 1))]
    for k, name in enumerate(LOGS):
        log = recorded(arm, 20.0, 100.0, k)
        rows = np.column_stack([log.time, log.q, log.qd, log.tau])
        np.savetxt(folder / name, rows, delimiter=",", header=",".join(heads), comments="")


def printed(name: str) -> str:
    """Text that a command prints on a terminal, with marks of bold words."""
    with tempfile.TemporaryDirectory() as folder:
        copy(ARM, folder)
        if name == "id":
            logs(Path(folder))
        width = {"COLUMNS": str(COLUMNS), "FORCE_COLOR": "1", "PYTHONPATH": str(report.ROOT)}
        order = [sys.executable, "-m", "torchdq", *COMMANDS[name]]
        done = subprocess.run(order, cwd=folder, env=os.environ | width, capture_output=True, text=True, check=True)
    return done.stdout.rstrip()


def picture(name: str, text: str) -> str:
    """Picture of a terminal with a command and its text, as SVG."""
    lines = [("$ ", PROMPT, f"torchdq {' '.join(COMMANDS[name])}"), *(("", "", line) for line in text.split("\n"))]
    width, height = 2 * MARGIN + COLUMNS * ADVANCE, 2 * MARGIN + LINE * len(lines) - 4
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:.0f}" height="{height:.0f}" '
    head += f'viewBox="0 0 {width:.0f} {height:.0f}" font-family="{MONO}" font-size="{SIZE}" fill="{INK}">'
    rows = [head, f'<rect width="100%" height="100%" rx="8" fill="{PAPER}"/>']
    for k, (prompt, colour, words) in enumerate(lines):
        plain = re.sub(r"\x1b\[\d*m", "", words).rstrip()
        if not plain:
            continue
        look = f' fill="{BRIGHT}" font-weight="bold"' if BOLD in words or prompt else ""
        mark = f'<tspan fill="{colour}">{prompt}</tspan>' if prompt else ""
        length = ADVANCE * len(prompt + plain)
        place = f'x="{MARGIN}" y="{MARGIN + LINE * k + SIZE - 2}" textLength="{length:.1f}" xml:space="preserve"'
        rows.append(f"<text {place}{look}>{mark}{escape(plain)}</text>")
    return "\n".join([*rows, "</svg>", ""])


def main() -> None:
    """Commands run, and drawn where the option asks for it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--write", action="store_true", help="draw them into docs/pictures")
    arguments = parser.parse_args()
    for name in COMMANDS:
        text = printed(name)
        print(text)
        if arguments.write:
            (FOLDER / f"terminal_{name}.svg").write_text(picture(name, text), encoding="utf-8")


if __name__ == "__main__":
    main()
