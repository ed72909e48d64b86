"""Every URDF file below some folders, with a fixed and a floating base: torques against Pinocchio, and who refuses it.

    python benchmarks/corpus.py FOLDER... [--quick] [--json FILE]

A file is read by `Robot.from_urdf` and by the command line, with their defaults. Torques at random states are compared
with those of Pinocchio, relative to the largest of them. Mimic joints follow their drivers; the reference is reduced
to the same coordinates. Each file that differs, or that one of them refuses alone, is listed with its cause.
"""

from __future__ import annotations

import sys
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import report
import torch
from robots import Reference

import torchdq
from torchdq import floating
from torchdq.command.report import ReportCommand
from torchdq.errors import TorchdqError

STATES = 3
BOUND = 1e-8  # relative error of torques
READERS: dict[str, Callable[[Path, Any], torchdq.Robot]] = {
    "Python": lambda path, base: torchdq.Robot.from_urdf(path, base=base),
    "command line": lambda path, base: ReportCommand(robot=str(path), base=base).load().robot,
}


def verdict(path: Path, base: str, reader: str) -> tuple[str, str]:
    """Who reads a file, and the cause of a refusal or the error of torques."""
    try:
        robot, cause = READERS[reader](path, base), ""
    except TorchdqError as error:
        robot, cause = None, " ".join(str(error).split())
    try:
        pin.buildModelFromUrdf(str(path), *[pin.JointModelFreeFlyer()] * (base == "floating"))
    except (ValueError, RuntimeError) as error:
        other = " ".join(str(error).split())
        return ("refused by both", cause) if robot is None else ("read by torchdq alone", other)
    if robot is None:
        return "refused by torchdq alone", cause
    error = torque_error(robot, path)
    return ("agrees" if error <= BOUND else "differs"), f"{error:.1e}"


def torque_error(robot: torchdq.Robot, path: Path) -> float:
    """Largest difference of torques at random states, relative to the largest torque."""
    reference, rng, worst, size = Reference(path, robot), np.random.default_rng(0), 0.0, 1e-300
    for _ in range(STATES):
        r, p = rng.normal(size=4), rng.normal(size=3)
        X = torchdq.dq.from_pose(torch.from_numpy(r / np.linalg.norm(r)), torch.from_numpy(p))
        V, A = (torch.from_numpy(rng.normal(size=6)) for _ in range(2))
        q, qd, qdd = (torch.from_numpy(rng.normal(size=robot.n)) for _ in range(3))
        with torchdq.backend("eager"):
            if robot.floating:
                found = torch.cat(floating.inverse_dynamics(robot, X, q, V, qd, A, qdd), -1)
            else:
                found = torchdq.inverse_dynamics(robot, q, qd, qdd)
        v, a = (reference.velocity(x.numpy(), y.numpy()) for x, y in ((V, qd), (A, qdd)))
        expected = reference.forces(reference.configuration(X.numpy(), q.numpy()), v, a)
        if expected.size:
            worst = max(worst, float(np.abs(found.numpy() - expected).max()))
            size = max(size, float(np.abs(expected).max()))
    return worst / size


def main() -> None:
    """Examine all files."""
    options = report.parser(__doc__ or "", "every twentieth file", page=False)
    options.add_argument("folders", nargs="+", type=Path, metavar="FOLDER")
    given = options.parse_args()
    warnings.simplefilter("ignore")
    rows: list[dict[str, str]] = []
    counts: Counter[tuple[str, str, str]] = Counter()
    for folder in given.folders:
        for path in sorted(folder.rglob("*.urdf"))[:: 20 if given.quick else 1]:
            for base in ("fixed", "floating"):
                for reader in READERS:
                    found, cause = verdict(path, base, reader)
                    counts[base, reader, found] += 1
                    rows.append({"file": str(path), "base": base, "reader": reader, "verdict": found, "cause": cause})
                    if found not in ("agrees", "refused by both"):
                        print(f"{path} ({base}, {reader}): {found}: {cause[:300]}")
                    sys.stdout.flush()
    for (base, reader, found), count in sorted(counts.items()):
        print(f"{base:9} {reader:13} {found:24} {count:5}")
    report.into_json(given.json, machine=report.machine("torch", "pin"), rows=rows)


if __name__ == "__main__":
    main()
