"""Models learned of an arm that MuJoCo simulates: the rows of `examples/06_residual_learning.py`.

    python benchmarks/simulated_plant.py [--quick] [--seeds N] [--samples N N] [--seconds T] [--page] [--json FILE]

With `--page` the picture of the page is drawn anew, too.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import numpy as np
import report

PICTURE = report.ROOT / "examples" / "figures" / "residual_learning.png"
HEADS = ("model", "nMSE near", "nMSE far", "tracking near, mrad", "tracking far, mrad")


def page(example: Any, found: dict[int, Any], seconds: float) -> str:
    """Table of the documentation: means over arms, with the most samples."""
    size = max(found)
    arms = found[size]
    rows = []
    for name in next(iter(arms.values())):
        values = [example.numbers(arms, name, field) for field in example.Result._fields]
        rows.append([name, *(f"{np.mean(x):.3g}" if x else "" for x in values)])
    table = "\n".join(f"| {' | '.join(row)} |" for row in [HEADS, ["---"] * len(HEADS), *rows])
    how = f"Models were learned from {size} samples of each, and tracked motions of {seconds:g} s."
    return f"{table}\n\nMeans over {len(arms)} arms. {how}"


def main() -> None:
    """Table and picture of all models."""
    parser = report.parser(__doc__, "one arm, few samples and steps")
    parser.add_argument("--seeds", type=int, default=5, help="number of arms")
    parser.add_argument("--samples", type=int, nargs="+", default=None, help="numbers of samples, upwards")
    parser.add_argument("--seconds", type=float, default=12.0, help="length of every motion [s]")
    parser.add_argument("--jobs", type=int, default=2, help="processes to share the work")
    arguments = parser.parse_args()
    example = import_module("06_residual_learning")
    with tempfile.TemporaryDirectory() as folder:
        given: dict[str, Any] = {} if arguments.samples is None else {"samples": tuple(arguments.samples)}
        given |= {name: getattr(arguments, name) for name in ("seeds", "seconds", "jobs", "quick")}
        found = example.main(example.Args(**given, out=Path(folder)))
        if arguments.page:
            shutil.copy(Path(folder) / PICTURE.name, PICTURE)
    plain = example.plain(found)
    report.finish(
        arguments, __file__, page(example, found, arguments.seconds), report.machine("mujoco"), samples=[plain]
    )


if __name__ == "__main__":
    main()
