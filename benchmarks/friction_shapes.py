"""Value of each shape of friction on recordings of real arms: errors of `identify` without it.

    python benchmarks/friction_shapes.py DATA [--quick] [--json FILE] [--page]

Splits are those of `splits.py`. Where the model that was chosen has a shape at some joint, the motions are identified
again without it, and others may take its place. The numbers are errors on the motions that took no part, RMSE over
standard deviation, mean over joints, without the shape divided by those with it: above 1 the shape lowers the error.
"""

from __future__ import annotations

import math
import os
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import report
import splits
import torch

from torchdq.learning import LogWarning, Model, identify
from torchdq.learning.identification.terms import SHAPES, Term


@dataclass(frozen=True)
class Without(Model):
    """Model whose joints do not have some shapes of friction."""

    left_out: tuple[str, ...] = ()

    def candidates(self) -> list[Term]:
        """Terms of which a joint has those that improve its prediction."""
        return [term for term in super().candidates() if term.name not in self.left_out]


class Ratio(NamedTuple):
    """Error without a shape over that with it."""

    shape: str
    split: str
    joints: int  # that have the shape
    ratio: float


def shapes() -> dict[str, tuple[str, ...]]:
    """Terms of every shape by its name; a ripple has two."""
    found = dict[str, tuple[str, ...]]()
    for term in SHAPES:
        name = term.name.split()[0] if term.signed else term.name
        found[name] = (*found.get(name, ()), term.name)
    return found


def compared(split: splits.Split) -> list[Ratio]:
    """Ratios of the shapes that the model of a split has."""
    chosen = identify(split.robot, split.train)
    _, error = splits.scored(chosen, split.test)
    found = []
    for shape, names in shapes().items():
        own = [x for name in names if (x := chosen.coefficients(name)) is not None]
        joints = int((torch.stack(own) != 0).any(0).sum()) if own else 0
        if joints:
            _, without = splits.scored(identify(split.robot, split.train, Without(left_out=names)), split.test)
            found.append(Ratio(shape, split.name, joints, without / error))
            print(f"{shape:16s} {split.name:48s} {joints} joints, {error:.3f}, without {without:.3f}", flush=True)
    return found


def main() -> None:
    """Table of all shapes."""
    parser = report.parser(__doc__, "few splits")
    parser.add_argument("data", type=Path, nargs="?", default=Path(os.environ.get("TORCHDQ_DATA", "data")))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", LogWarning)
    arms = (splits.ur10e, splits.panda, splits.pendulum)
    found = [one for arm in arms for split in arm(arguments.data, arguments.quick) for one in compared(split)]
    lines = ["| shape | splits | joints | error without, mean | least | largest |", "|---|---|---|---|---|---|"]
    for shape in shapes():
        of = [one for one in found if one.shape == shape]
        ratios = [one.ratio for one in of]
        mean = math.exp(sum(map(math.log, ratios)) / len(ratios)) if ratios else math.nan
        cells = (f"{mean:.3f}", f"{min(ratios):.3f}", f"{max(ratios):.3f}") if ratios else ("-", "-", "-")
        lines.append(f"| {shape} | {len(of)} | {sum(one.joints for one in of)} | {' | '.join(cells)} |")
    text = "\n".join(lines)
    print(text)
    report.finish(arguments, __file__, text, report.machine(), ratios=[one._asdict() for one in found])


if __name__ == "__main__":
    main()
