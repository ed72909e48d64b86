"""Identification on recordings of real arms, split in many ways: the models that were chosen beside simpler ones.

    python benchmarks/splits.py DATA [--quick] [--only WORD] [--json FILE] [--page]

DATA is the folder of the recordings that docs/learning.md names. A row is one split: motions to learn from, and others
to test on. Models: the description; with friction, rotor inertia and offset; with all inertial parameters, too; the
one that `identify` chose; and that one with a residual network, where `fit` kept it. Where friction remembers, which a
layer cannot, the network learns what is left beyond the chosen model's predictions. The numbers are squared residuals
over the variance of the torque, mean over joints, and in brackets the mean over joints of RMSE over standard deviation.

A row is marked where what was chosen is worse than the description with friction by more than the standard error that
`identify` states, as a mean or at a joint, in the units of its scores, in which a joint that is hardly driven hardly
counts; and where the network makes it worse by more than the standard error of the gain that `fit` states.
"seen" is the share of the test samples whose positions and velocities were in the training motions as well, to a
twentieth of their spread: a motion that repeats itself asks for a memory, not for a model. "in 95 %" are the shares of
the test torques in the 95 % intervals of what was chosen, in brackets of the joint with the fewest, and of what was
chosen with the network.
"""

from __future__ import annotations

import functools
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
from recordings import LAYOUTS, predicted, residual_samples

from torchdq import DQRNEA, ResidualDynamics, Robot, effects
from torchdq.learning import (
    Identified,
    LogWarning,
    Model,
    Motion,
    fit,
    identify,
    read_log,
    smooth,
    stack_samples,
    train_test_split,
)
from torchdq.learning.evaluation.blocks import REGIONS
from torchdq.learning.fit import ValidationGain
from torchdq.learning.identification.evidence import STILL
from torchdq.learning.identification.identified import Prediction

SIX = ("02_06-20sec_5harm", "02_06-20sec_10harm", "02_05-20sec_12harm", "02_10-20sec_7harm", "02_10-30sec_12harm")
SIX = (*SIX, "02_12-40sec_12harm")
PENDULUM = {"mass": (0.5594, 0.6043), "com": (-0.3, 0.1838), "inertia": (0.05347, 0.02392)}  # the authors' model 2.0
PASS = 12.84  # time after which the motion of the Panda repeats itself [s]
TRAINING = {"steps": 400, "batch": 256, "rate": 1e-2, "decay": 0.3}  # of the networks
SEEN = 0.05  # distance of states that count as the same, in units of their spread
ROWS = (6000, 600)  # most states that the distances are computed from and to


class Split(NamedTuple):
    """Motions to learn from, and to test on."""

    name: str
    robot: Robot
    train: Sequence[Motion]
    test: Sequence[Motion]


class Row(NamedTuple):
    """Scores of a split: mean squared residual over variance, and mean of the roots."""

    name: str
    seen: float  # share of the test samples whose states were trained on
    description: tuple[float, float]
    friction: tuple[float, float]
    identified: tuple[float, float]
    chosen: tuple[float, float]
    covered: float  # share of the torques in 95 % intervals of the one that was chosen
    lowest: float  # the same of the joint that has the fewest
    expected: float
    error: float
    model: str
    seconds: float
    worse: bool  # whether the one that was chosen breaks its promise
    joints: tuple[str, ...]  # at which it is worse than with friction, by more than its error there


class Models(NamedTuple):
    """Models of the training motions of a split, and the time that the choice took [s]."""

    friction: Identified
    identified: Identified
    chosen: Identified
    seconds: float


class Trained(NamedTuple):
    """What was chosen with a network, what that gains on held-out rows, and how long it took [s]."""

    network: ResidualDynamics
    gain: ValidationGain
    seconds: float


class Network(NamedTuple):
    """Scores of a split with a residual network."""

    chosen: tuple[float, float]  # without it
    residual: tuple[float, float]
    error: float  # standard error of the gain, mean over joints
    weights: tuple[float, ...]  # of the joints
    ratios: tuple[float, ...]  # RMSE of the joints, with the network over without
    covered: float  # share of the torques in 95 % intervals
    seconds: float

    @property
    def worse(self) -> bool:
        """True if the network breaks its promise."""
        return self.residual[0] > self.chosen[0] + self.error


def ur10e(data: Path, quick: bool) -> list[Split]:
    """Splits of a UR10e: by motion, by kind of motion, first part against last, little data."""
    folder = data / "ur10e_innopolis"
    robot = Robot.from_urdf(folder / "ur10e.urdf", on_unphysical="ignore")

    def motion(name: str) -> Motion:
        return smooth(read_log(folder / f"ur-20_{name}.csv", LAYOUTS["ur10e"]))

    six = [motion(name) for name in (SIX[:3] if quick else SIX)]
    test = motion("02_19_14harm50sec")
    found = [Split("UR10e, six motions to another", robot, six, [test])]
    if quick:
        return found
    first, last = train_test_split(test, 0.5)
    slow = sorted(six, key=lambda one: float(abs(one.qd).mean()))
    one_joint = [motion(f"01_22-joint_{k}") for k in range(1, 6)]
    return [
        *found,
        Split("UR10e, six motions to one another day", robot, six, [motion("01_31-unload")]),
        Split("UR10e, six motions to joints one by one", robot, six, one_joint),
        Split("UR10e, joints one by one to a motion", robot, one_joint, [test]),
        Split("UR10e, three slow motions to three fast ones", robot, slow[:3], slow[3:]),
        Split("UR10e, three fast motions to three slow ones", robot, slow[3:], slow[:3]),
        Split("UR10e, first half of a motion to its last", robot, first, last),
        Split("UR10e, last half of a motion to its first", robot, last, first),
        Split("UR10e, 10 s to a motion of 50 s", robot, train_test_split(six[0], 0.5)[0], [test]),
    ]


def panda_recording(data: Path) -> tuple[Robot, Motion]:
    """Panda as its authors describe it, and the one recording of it."""
    folder = data / "panda_gaz2019"
    motion = smooth(read_log(folder / "panda_exciting_traj1.csv", LAYOUTS["panda"]))
    return Robot.from_urdf(folder / "panda_gaz2019.urdf"), motion


def panda(data: Path, quick: bool) -> list[Split]:
    """Splits of one motion of a Panda."""
    robot, motion = panda_recording(data)
    found = []
    for share in (0.6,) if quick else (0.6, 0.3):
        first, last = train_test_split(motion, share)
        found.append(Split(f"Panda, first {share:.0%} to the rest", robot, first, last))
    if quick:
        return found
    once, _ = train_test_split(motion, PASS / float(motion.time[-1] - motion.time[0]))
    first, last = train_test_split(once, 0.6)
    return [*found, Split("Panda, first 60% of one pass to its rest", robot, first, last)]


def pendulum(data: Path, quick: bool) -> list[Split]:
    """Splits of a double pendulum, by motion and by speed."""
    folder = data / "double_pendulum_dfki_A0"
    text = (folder / "double_pendulum_A0_model_1.0.urdf").read_text()
    robot = Robot.from_urdf(re.sub(r"<joint name=\"base_weld\".*?</joint>", "", text, flags=re.S))
    mass, com, about = (torch.tensor(x, dtype=torch.float64) for x in PENDULUM.values())
    inertia = (about - mass * com**2).clamp_min(1e-4)[:, None] * torch.tensor([1.0, 0, 1, 0, 0, 1], dtype=torch.float64)
    robot = robot.replace(mass=mass, com=com[:, None] * torch.eye(3, dtype=torch.float64)[2], inertia=inertia)

    @functools.cache
    def motion(k: int) -> Motion:
        return smooth(read_log(folder / f"trajectory_{k:02d}.csv.gz", LAYOUTS["double_pendulum"]))

    def motions(*numbers: int) -> list[Motion]:
        return [motion(k) for k in numbers]

    slow, fast = (0, 1, 2, 3), (4, 5, 11)
    pairs = [(slow, (11,)), (fast, (0,))] if quick else [(slow, (k,)) for k in fast] + [(fast, (k,)) for k in slow]
    pairs += [] if quick else [((1, 2, 3), (0,)), ((0, 1, 2, 3), (12, 13)), ((0,), (1,)), ((3,), (11,))]
    found = [
        Split(f"pendulum, {', '.join(map(str, a))} to {', '.join(map(str, b))}", robot, motions(*a), motions(*b))
        for a, b in pairs
    ]
    first, last = train_test_split(motions(0)[0], 0.5)
    return [*found, Split("pendulum, first half of a motion to its last", robot, first, last)]


def seen(split: Split) -> float:
    """Share of the test samples whose positions and velocities are also those of a training sample."""
    train, test = (
        torch.cat([torch.cat([one.q, one.qd], 1) for one in map(stack_samples, x)]) for x in (split.train, split.test)
    )
    spread = train.std(0)
    some, others = (x[:: -(-len(x) // most)] / spread for x, most in zip((train, test), ROWS, strict=True))
    nearest = torch.cdist(others, some).amin(1) / math.sqrt(len(spread))
    return float((nearest < SEEN).double().mean())


def scores(left: torch.Tensor, tests: Sequence[Motion]) -> tuple[float, float]:
    """Mean over joints of squared residual over variance, and of its root."""
    squares = left.square().mean(0) / stack_samples(tests).tau.var(0)
    return float(squares.mean()), float(squares.sqrt().mean())


def scored(found: Identified, tests: Sequence[Motion]) -> tuple[float, float]:
    """Scores of an identified robot."""
    return scores(found.predict(tests).tau - stack_samples(tests).tau, tests)


def worse(models: Models, split: Split) -> tuple[bool, tuple[str, ...]]:
    """Whether the promise is broken, and the joints at which it is: by the standard errors over the blocks left out."""
    tau, selection = stack_samples(split.test).tau, models.chosen.selection
    assert selection is not None
    largest = torch.stack([stack_samples(motion).tau.var(0) for motion in split.train]).amax(0)
    unit = tau.var(0).maximum(STILL * largest)  # of the scores
    squares = [(one.predict(split.test).tau - tau).square().mean(0) / unit for one in (models.chosen, models.friction)]
    more, blocks = squares[0] - squares[1], selection.chosen.scores[:-REGIONS]
    joints = (more > blocks.std(0) / len(blocks) ** 0.5).tolist()
    names = zip(models.chosen.robot.joint_names, joints, strict=True)
    return float(more.mean()) > selection.chosen.error, tuple(name for name, yes in names if yes)


def inside(told: Prediction, tau: torch.Tensor) -> torch.Tensor:
    """Share of the torques of each joint that are in the 95 % intervals [n]."""
    return ((tau >= told.low) & (tau <= told.high)).double().mean(0)


def held(found: Identified, tests: Sequence[Motion]) -> tuple[float, float]:
    """Share of the torques in the 95 % intervals of an identified robot, and that of the joint with the fewest."""
    shares = inside(found.predict(tests), stack_samples(tests).tau)
    return float(shares.mean()), float(shares.amin())


def learned(split: Split) -> Models:
    """Models of the training motions of a split."""
    plain = Model(friction=(effects.Viscous(), effects.Coulomb()), offset=True, armature=True)
    friction = identify(split.robot, split.train, plain, prior=math.inf)
    identified = identify(split.robot, split.train, plain, prior=1.0)
    start = time.perf_counter()
    chosen = identify(split.robot, split.train)
    return Models(friction, identified, chosen, time.perf_counter() - start)


def measured(split: Split, models: Models) -> Row:
    """Row of a split."""
    q, qd, qdd, tau = stack_samples(split.test)
    description = scores(DQRNEA(split.robot)(q, qd, qdd) - tau, split.test)
    three = (scored(one, split.test) for one in models[:3])
    selection = models.chosen.selection
    assert selection is not None, "the recordings are long enough to leave blocks out"
    best = selection.chosen
    expected = (best.score, best.error, best.name)
    return Row(
        split.name,
        seen(split),
        description,
        *three,
        *held(models.chosen, split.test),
        *expected,
        models.seconds,
        *worse(models, split),
    )


def trained(split: Split, found: Identified) -> Trained:
    """Network beside what was chosen."""
    start = time.perf_counter()
    torch.manual_seed(0)
    network = ResidualDynamics(found.layer())
    gain = fit(network, [residual_samples(found, network, motion) for motion in split.train], **TRAINING).residual
    assert gain is not None
    return Trained(network, gain, time.perf_counter() - start)


def with_network(split: Split, found: Identified, trained: Trained) -> Network:
    """Scores with the network beside what was chosen."""
    network, gain, seconds = trained
    parts = [predicted(found, network, motion) for motion in split.test]
    tau, told = stack_samples(split.test).tau, Prediction(*map(torch.cat, zip(*parts, strict=True)))
    left = [found.predict(split.test).tau - tau, told.tau - tau]
    without, error = (x.square().mean(0).sqrt() for x in left)
    return Network(
        *(scores(x, split.test) for x in left),
        float(gain.standard_errors.square().sum().sqrt() / len(without)),
        tuple(gain.weight.tolist()),
        tuple((error / without).tolist()),
        float(inside(told, tau).mean()),
        seconds,
    )


def page(rows: Sequence[tuple[Row, Network]]) -> str:
    """Table of the splits for the documentation."""
    heads = ("split", "seen", "description", "+ friction", "identified", "chosen", "+ residual", "in 95 %", "worse")
    lines = [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
    for row, network in rows:
        roots = (row.description, row.friction, row.identified, row.chosen, network.residual)
        marks = (
            ["than + friction"] * row.worse
            + [f"at {', '.join(row.joints)}"] * bool(row.joints)
            + ["with the residual"] * network.worse
        )
        errors = [f"{root:.3f}" for _, root in roots]
        shares = f"{100 * row.covered:.0f} ({100 * row.lowest:.0f}), {network.covered:.0%}"
        cells = (row.name, f"{row.seen:.0%}", *errors, shares, ", ".join(marks) or "no")
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Table of all splits."""
    parser = report.parser(__doc__, "few splits")
    parser.add_argument("data", type=Path, nargs="?", default=Path(os.environ.get("TORCHDQ_DATA", "data")))
    parser.add_argument("--only", default="", help="splits whose name holds this word")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", LogWarning)
    arms: tuple[Callable[[Path, bool], list[Split]], ...] = (ur10e, panda, pendulum)
    splits = [one for arm in arms for one in arm(arguments.data, arguments.quick) if arguments.only in one.name]
    rows: list[tuple[Row, Network]] = []
    known: dict[tuple[int, ...], tuple[Models, Trained]] = {}  # by the training motions, which splits share
    heads = ("description", "+ friction", "identified", "chosen", "+ residual")
    print(f"{'split':46s} seen {' '.join(f'{head:>16s}' for head in heads)}   {'expected':>18s}     s  model")
    for split in splits:
        motions = tuple(map(id, split.train))
        if motions not in known:
            models = learned(split)
            known[motions] = models, trained(split, models.chosen)
        models, residual = known[motions]
        row, network = measured(split, models), with_network(split, models.chosen, residual)
        rows.append((row, network))
        every = (row.description, row.friction, row.identified, row.chosen, network.residual)
        five = " ".join(f"{a:8.4f} ({b:.3f})" for a, b in every)
        expected = f"{row.expected:8.4f} +- {row.error:.4f}"
        marks = (
            " WORSE" * row.worse
            + f" WORSE AT {', '.join(row.joints)}" * bool(row.joints)
            + f" WORSE BY {network.residual[0] - network.chosen[0]:.2g}" * network.worse
        )
        print(f"{row.name:46s} {row.seen:4.0%} {five}   {expected} {row.seconds:5.1f}  {row.model}{marks}")
        weights = " ".join(f"{weight:.2f} ({ratio:.2f})" for weight, ratio in zip(*network[3:5], strict=True))
        print(f"{'':8s}weights of the residual, and error with over without: {weights}")
        shares = f"{row.covered:.0%} and {network.covered:.0%} in 95 % intervals"
        print(f"{'':8s}gain known to {network.error:.1g}, {shares}, {network.seconds:.0f} s", flush=True)
    for what, names in (
        (
            "worse than the description with friction by more than the expected error",
            [a.name for a, _ in rows if a.worse],
        ),
        ("worse at a joint, in the same way", [f"{a.name} ({', '.join(a.joints)})" for a, _ in rows if a.joints]),
        ("worse with the residual by more than its standard error", [a.name for a, b in rows if b.worse]),
    ):
        print(f"\n{what}: {', '.join(names) or 'none'}")
    found = [a._asdict() | {"network": b._asdict()} for a, b in rows]
    report.finish(arguments, __file__, page(rows), report.machine(), splits=found)


if __name__ == "__main__":
    main()
