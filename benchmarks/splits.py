"""Identification on recordings of real arms, split in many ways: the model that was chosen beside simpler ones.

    python benchmarks/splits.py DATA [--quick] [--only WORD] [--json FILE]

DATA is the folder of the recordings that docs/learning.md names. A row is one split: motions to identify the robot
from, and others to test it on. The numbers are squared residuals over the variance of the torque, mean over joints,
and below them in brackets the mean over joints of RMSE over standard deviation: of the description with friction,
rotor inertia and offset; of the same with all inertial parameters; of the model that `identify` chose; and the score
that it expected with its standard error. A row is marked where what was chosen is worse than the description with
friction by more than that error.
"""

from __future__ import annotations

import math
import os
import re
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import report
import torch
from recordings import LAYOUTS

from torchdq import Robot
from torchdq.learning import Identified, LogWarning, Motion, cut, identify, read, samples, smooth

SIX = ("02_06-20sec_5harm", "02_06-20sec_10harm", "02_05-20sec_12harm", "02_10-20sec_7harm", "02_10-30sec_12harm")
SIX = (*SIX, "02_12-40sec_12harm")
PENDULUM = {"mass": (0.5594, 0.6043), "com": (-0.3, 0.1838), "inertia": (0.05347, 0.02392)}  # the authors' model 2.0


class Split(NamedTuple):
    """Motions to learn from, and to test on."""

    name: str
    robot: Robot
    train: Sequence[Motion]
    test: Sequence[Motion]


class Row(NamedTuple):
    """Scores of a split: mean squared residual over variance, and mean of the roots."""

    name: str
    friction: tuple[float, float]
    identified: tuple[float, float]
    chosen: tuple[float, float]
    expected: float
    error: float
    model: str
    seconds: float

    @property
    def worse(self) -> bool:
        """True if the model chosen breaks its promise."""
        return self.chosen[0] > self.friction[0] + self.error


def ur10e(data: Path, quick: bool) -> list[Split]:
    """Splits of a UR10e: by motion, by kind of motion, first part against last, little data."""
    folder = data / "ur10e_innopolis"
    robot = Robot.from_urdf(folder / "ur10e.urdf", on_unphysical="ignore")

    def motion(name: str) -> Motion:
        return smooth(read(folder / f"ur-20_{name}.csv", LAYOUTS["ur10e"]))

    six = [motion(name) for name in (SIX[:3] if quick else SIX)]
    test = motion("02_19_14harm50sec")
    found = [Split("UR10e, six motions to another", robot, six, [test])]
    if quick:
        return found
    first, last = cut(test, 0.5)
    slow = sorted(six, key=lambda one: float(abs(one.qd).mean()))
    one_joint = [motion(f"01_22-joint_{k}") for k in range(1, 6)]
    return [
        *found,
        Split("UR10e, six motions to one another day", robot, six, [motion("01_31-unload")]),
        Split("UR10e, six motions to joints one by one", robot, six, one_joint),
        Split("UR10e, joints one by one to a motion", robot, one_joint, [test]),
        Split("UR10e, three slow motions to three fast ones", robot, slow[:3], slow[3:]),
        Split("UR10e, three fast motions to three slow ones", robot, slow[3:], slow[:3]),
        Split("UR10e, first half of a motion to its last", robot, [first], [last]),
        Split("UR10e, last half of a motion to its first", robot, [last], [first]),
        Split("UR10e, 10 s to a motion of 50 s", robot, [cut(six[0], 0.5)[0]], [test]),
    ]


def panda(data: Path, quick: bool) -> list[Split]:
    """Splits of one motion of a Panda."""
    folder = data / "panda_gaz2019"
    robot = Robot.from_urdf(folder / "panda_gaz2019.urdf")
    motion = smooth(read(folder / "panda_exciting_traj1.csv", LAYOUTS["panda"]))
    found = []
    for share in (0.6,) if quick else (0.6, 0.3):
        first, last = cut(motion, share)
        found.append(Split(f"Panda, first {share:.0%} to the rest", robot, [first], [last]))
    return found


def pendulum(data: Path, quick: bool) -> list[Split]:
    """Splits of a double pendulum, by motion and by speed."""
    folder = data / "double_pendulum_dfki_A0"
    text = (folder / "double_pendulum_A0_model_1.0.urdf").read_text()
    robot = Robot.from_urdf(re.sub(r"<joint name=\"base_weld\".*?</joint>", "", text, flags=re.S))
    mass, com, about = (torch.tensor(x, dtype=torch.float64) for x in PENDULUM.values())
    inertia = (about - mass * com**2).clamp_min(1e-4)[:, None] * torch.tensor([1.0, 0, 1, 0, 0, 1], dtype=torch.float64)
    robot = robot.replace(mass=mass, com=com[:, None] * torch.eye(3, dtype=torch.float64)[2], inertia=inertia)

    def motions(*numbers: int) -> list[Motion]:
        return [smooth(read(folder / f"trajectory_{k:02d}.csv.gz", LAYOUTS["double_pendulum"])) for k in numbers]

    slow, fast = (0, 1, 2, 3), (4, 5, 11)
    pairs = [(slow, (11,)), (fast, (0,))] if quick else [(slow, (k,)) for k in fast] + [(fast, (k,)) for k in slow]
    pairs += [] if quick else [((1, 2, 3), (0,)), ((0, 1, 2, 3), (12, 13)), ((0,), (1,)), ((3,), (11,))]
    found = [
        Split(f"pendulum, {', '.join(map(str, a))} to {', '.join(map(str, b))}", robot, motions(*a), motions(*b))
        for a, b in pairs
    ]
    first, last = cut(motions(0)[0], 0.5)
    return [*found, Split("pendulum, first half of a motion to its last", robot, [first], [last])]


def scored(found: Identified, tests: Sequence[Motion]) -> tuple[float, float]:
    """Mean over joints of squared residual over variance, and of its root."""
    tau = samples(tests).tau
    squares = (found.predict(tests).tau - tau).square().mean(0) / tau.var(0)
    return float(squares.mean()), float(squares.sqrt().mean())


def measured(split: Split) -> Row:
    """Row of a split."""
    motors = {"armature": True, "offset": True}
    friction = identify(split.robot, split.train, friction=True, prior=math.inf, **motors)
    identified = identify(split.robot, split.train, friction=True, prior=1.0, **motors)
    start = time.perf_counter()
    chosen = identify(split.robot, split.train, **motors)
    seconds = time.perf_counter() - start
    scores = (scored(one, split.test) for one in (friction, identified, chosen))
    ladder = chosen.report
    assert ladder is not None, "the recordings are long enough to leave blocks out"
    return Row(split.name, *scores, ladder.rung.score, ladder.rung.error, ladder.rung.name, seconds)


def main() -> None:
    """Table of all splits."""
    parser = report.parser(__doc__, "few splits", page=False)
    parser.add_argument("data", type=Path, nargs="?", default=Path(os.environ.get("TORCHDQ_DATA", "data")))
    parser.add_argument("--only", default="", help="splits whose name holds this word")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", LogWarning)
    arms: tuple[Callable[[Path, bool], list[Split]], ...] = (ur10e, panda, pendulum)
    splits = [one for arm in arms for one in arm(arguments.data, arguments.quick) if arguments.only in one.name]
    rows = []
    print(f"{'split':46s} {'+ friction':>16s} {'identified':>16s} {'chosen':>16s}  {'expected':>18s}     s  model")
    for split in splits:
        row = measured(split)
        rows.append(row)
        three = " ".join(f"{a:8.4f} ({b:.3f})" for a, b in (row.friction, row.identified, row.chosen))
        expected = f"{row.expected:8.4f} +- {row.error:.4f}"
        print(f"{row.name:46s} {three}  {expected} {row.seconds:5.1f}  {row.model}{' WORSE' * row.worse}", flush=True)
    worse = [row.name for row in rows if row.worse]
    print(f"\nworse than the description with friction by more than the expected error: {worse or 'none'}")
    facts = report.machine()
    print(report.words(facts))
    report.into_json(arguments.json, machine=facts, splits=[row._asdict() for row in rows])


if __name__ == "__main__":
    main()
