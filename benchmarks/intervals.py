"""Torques of recordings that took no part, in the 95 % intervals of models of the other recordings of the same arm.

Each recording of an arm without a load is left out in turn, and the others are identified. Of a Panda there is one
recording, of which each fifth is left out. Pooled over all recordings of an arm, 95 % of the torques should be in the
intervals of `Identified.predict`; those of one joint, or one motion, may be more or fewer.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import report
import splits
import torch

from torchdq.learning import LogWarning, Motion, identify, stack_samples, train_test_split
from torchdq.robot import Robot

FIFTHS = 5  # parts of the recording of the Panda


class Held(NamedTuple):
    """Shares of the torques of a motion that are in the intervals."""

    arm: str
    motion: str
    rows: int
    model: str
    shares: tuple[float, ...]  # share of the torques of each joint


class Arm(NamedTuple):
    """Recordings of an arm."""

    name: str
    robot: Robot
    motions: Sequence[Motion]
    pieces: bool  # whether they are pieces of one recording


def ur10e(data: Path) -> Arm:
    """Motions of a UR10e without a load, along sums of sines."""
    first, second, *_ = splits.ur10e(data, False)
    return Arm("UR10e", first.robot, [*first.train, *first.test, *second.test], False)


def panda(data: Path) -> Arm:
    """Parts of one recording of a Panda."""
    robot, rest = splits.panda_recording(data)
    parts = []
    for left in range(FIFTHS, 1, -1):
        (part,), (rest,) = train_test_split(rest, 1 / left)
        parts.append(part)
    return Arm("Panda", robot, [*parts, rest], True)


def pendulum(data: Path) -> Arm:
    """Motions of a double pendulum, slow and fast ones."""
    found = splits.pendulum(data, False)
    every = {id(motion): motion for split in found[:-1] for motion in (*split.train, *split.test)}
    return Arm("pendulum", found[0].robot, list(every.values()), False)


def others(arm: Arm, k: int) -> list[Motion]:
    """Motions but one."""
    return [motion for i, motion in enumerate(arm.motions) if i != k]


def held(arm: Arm, k: int) -> Held:
    """Shares of the torques of one motion, by models of the others."""
    test = [arm.motions[k]]
    found = identify(arm.robot, others(arm, k))
    selection = found.selection
    assert selection is not None, "the recordings are long enough to leave blocks out"
    predicted, tau = found.predict(test), stack_samples(test).tau
    name = f"part {k + 1}" if arm.pieces else Path(arm.motions[k].name).name.split(".")[0]
    return Held(arm.name, name, len(tau), selection.chosen.name, tuple(splits.inside(predicted, tau).tolist()))


def line(arm: str, found: Sequence[Held]) -> str:
    """Row of the table: shares pooled over the motions of an arm, and ranges over its joints and its motions."""
    rows = torch.tensor([float(one.rows) for one in found])
    shares = torch.tensor([one.shares for one in found])  # [motions, n]
    joints = (rows[:, None] * shares).sum(0) / rows.sum()
    ranges = [f"{100 * x.min():.0f} to {x.max():.0%}" for x in (joints, shares.mean(1))]
    return f"| {arm} | {len(found)} | {joints.mean():.1%} | {' | '.join(ranges)} |"


def page(found: Sequence[Held]) -> str:
    """Table for the documentation."""
    heads = ("arm", "left out in turn", "torques in 95 % intervals", "of one joint", "of one motion")
    arms = dict.fromkeys(one.arm for one in found)
    lines = [line(arm, [one for one in found if one.arm == arm]) for arm in arms]
    return "\n".join([f"| {' | '.join(heads)} |", "|---" * len(heads) + "|", *lines])


def main() -> None:
    """Table of all arms."""
    parser = report.parser(__doc__, "one arm")
    parser.add_argument("data", type=Path, nargs="?", default=Path(os.environ.get("TORCHDQ_DATA", "data")))
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", LogWarning)
    arms: tuple[Callable[[Path], Arm], ...] = (pendulum, panda, ur10e)
    found: list[Held] = []
    for arm in [make(arguments.data) for make in (arms[:1] if arguments.quick else arms)]:
        for k in range(len(arm.motions)):
            found.append(held(arm, k))
            one = found[-1]
            print(f"{arm.name:10s} {one.motion:32s} {sum(one.shares) / len(one.shares):6.1%}  {one.model}", flush=True)
        print(line(arm.name, [one for one in found if one.arm == arm.name]), flush=True)
    report.finish(arguments, __file__, page(found), report.machine(), motions=[one._asdict() for one in found])


if __name__ == "__main__":
    main()
