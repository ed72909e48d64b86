"""Gains by a residual network on recordings of real arms, joint by joint: `examples/07_real_arm.py` on three logs.

    TORCHDQ_DATA=FOLDER python benchmarks/real_arm.py [FOLDER] [--quick] [--seeds N] [--steps N] [--page] [--json FILE]

The folder holds the recordings that docs/learning.md names. With `--page` the picture of the page is drawn anew, too.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import warnings
from concurrent.futures import ProcessPoolExecutor
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import report
from splits import SIX

from torchdq.learning import LogWarning

PICTURE = report.ROOT / "examples" / "figures" / "real_arm.png"
LONG, DAY = "02_19_14harm50sec", "01_31-unload"


def studies(data: Path) -> dict[str, dict[str, Any]]:
    """Arguments of the example by what is learned from."""
    ur, panda = data / "ur10e_innopolis", data / "panda_gaz2019"

    def logs(*names: str) -> list[Path]:
        return [ur / f"ur-20_{name}.csv" for name in names]

    arm = {"format": "ur10e", "robot": ur / "ur10e.urdf"}
    return {
        "six motions": {**arm, "train": logs(*SIX), "test": logs(LONG, DAY)},
        "Panda": {
            "format": "panda",
            "robot": panda / "panda_gaz2019.urdf",
            "train": [panda / "panda_exciting_traj1.csv"],
            "split": 0.6,
        },
        "seconds": {**arm, "train": logs(LONG), "split": 0.2},
    }


def lines(heads: list[str], rows: list[list[str]]) -> str:
    """Table of a page."""
    return "\n".join([f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *(f"| {' | '.join(x)} |" for x in rows)])


def page(found: dict[str, Any], steps: int) -> str:
    """Tables of the documentation: one motion joint by joint, and the means of all others."""
    first = found["six motions"]
    joints = [f"joint {j + 1}" for j in range(first.covered.shape[1])]
    rows = [[name, *(f"{x:.3f}" for x in (*scores[0], scores[0].mean()))] for name, scores in first.errors.items()]
    shares = [f"{x:.0%}" for x in (*first.covered[0], first.covered[0].mean())]
    rows.append(["torques in 95 % intervals", *shares])
    others = {
        "UR10e, another day": (first, 1),
        "Panda, first 60 % to the rest": (found["Panda"], 0),
        f"UR10e, {found['seconds'].learned:.0f} s to the rest of a motion": (found["seconds"], 0),
    }
    means = [[name, *(f"{x.errors[name][k].mean():.3f}" for x, k in others.values())] for name in first.errors]
    means.append(["torques in 95 % intervals", *(f"{x.covered[k].mean():.0%}" for x, k in others.values())])
    return (
        f"{lines(['model', *joints, 'mean'], rows)}\n\nMeans over joints on other logs:\n\n"
        f"{lines(['model', *others], means)}\n\nNetworks: {first.seeds} of each kind, trained for {steps} steps."
    )


def measured(given: dict[str, Any]) -> Any:
    """Result of the example with these arguments."""
    warnings.simplefilter("ignore", LogWarning)
    example = import_module("07_real_arm")
    return example.main(example.Args(**given))


def main() -> None:
    """Tables of all logs."""
    parser = report.parser(__doc__, "one seed and few steps")
    parser.add_argument("data", type=Path, nargs="?", default=Path(os.environ.get("TORCHDQ_DATA", "data")))
    parser.add_argument("--steps", type=int, default=2500, help="steps of every training")
    parser.add_argument("--seeds", type=int, default=2, help="networks of each log")
    parser.add_argument("--jobs", type=int, default=2, help="processes to share the work")
    arguments = parser.parse_args()
    how = {name: getattr(arguments, name) for name in ("seeds", "steps", "quick")}
    with tempfile.TemporaryDirectory() as folder:
        logs = {name: {**given, **how, "out": Path(folder) / name} for name, given in studies(arguments.data).items()}
        with ProcessPoolExecutor(arguments.jobs, get_context("spawn")) as pool:
            found = dict(zip(logs, pool.map(measured, logs.values()), strict=True))
        if arguments.page:
            shutil.copy(Path(folder) / "six motions" / PICTURE.name, PICTURE)
    plain = {
        name: {"tests": x.tests, "covered": x.covered.tolist(), **{k: e.tolist() for k, e in x.errors.items()}}
        for name, x in found.items()
    }
    report.finish(arguments, __file__, page(found, arguments.steps), report.machine(), logs=[plain])


if __name__ == "__main__":
    main()
