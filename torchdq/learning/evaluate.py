"""Trial of an identified robot on motions that no number was found from, and the verdict about it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.tables import table
from torchdq.dynamics.friction import smooth_sign
from torchdq.errors import ArgumentError
from torchdq.functional import inverse_dynamics
from torchdq.learning.evaluation.diagnostics import LogWarning, doubts
from torchdq.learning.identification.identified import Identified
from torchdq.learning.logs.motions import Motion, cut, samples
from torchdq.robot import Robot

LEARNED = 2 / 3  # share of a single motion that is learned from
WORTH = 0.95  # part of the error of the description that must be left at most, so that there is something gained
GOOD, FAIR = 0.1, 0.3  # parts of the torque that are left unexplained at most
SEEN = 0.005  # difference of two errors that is worth a sentence
MEANING = (
    f"Good means that, in the mean over the joints, at most {GOOD:.0%} of the torque's standard deviation is left "
    f"unexplained, and at no joint more than {FAIR:.0%}; Fair means at most {FAIR:.0%} in the mean. The share in 95 % "
    "intervals does not count: it says whether the standard errors are right, near 95 % they are."
)


class TorqueTrial(NamedTuple):
    """Errors of the torques in motions that were not learned from.

    Errors are root mean squares over the standard deviation of the measured torque: 0 is perfect, 1 no better than a
    constant. `file` are those of a file of the robot, which has no other friction than viscous and Coulomb friction.
    """

    joints: tuple[str, ...]
    seconds: float  # duration of the rows [s]
    described: Tensor  # [n] error of the description, without friction
    found: Tensor  # [n] error of what was identified
    within: Tensor  # [n] share of the measured torques in the intervals that should hold 95 %
    file: Tensor | None = None  # [n] error of a file of the robot found; None: there is no file

    @property
    def verdict(self) -> str:
        """Whether to use what was found, in a few sentences: the file, if there is one."""
        got, by = (self.found, "") if self.file is None else (self.file, " by the file")
        before, after = float(self.described.mean()), float(got.mean())
        change = f"the error of the torques{by} is {after:.1%} of their standard deviation, {before:.1%} as described"
        worst = int(got.argmax())
        if after > WORTH * before:
            rank = "Keep the description"
        elif after <= GOOD and float(got[worst]) <= FAIR:
            rank = "Good"
        else:
            rank = "Fair" if after <= FAIR else "Poor"
        text = f"{rank}: in {self.seconds:.1f} s that were not learned from, {change}."
        if self.file is not None and after > float(self.found.mean()) + SEEN:
            text += (
                f" It is {float(self.found.mean()):.1%} with all that was found: a file cannot hold all of that, "
                "`identify` in Python does."
            )
        if rank == "Keep the description":
            return text
        if float(got[worst]) > FAIR:
            whole = float(self.found[worst])
            cure = ": look at its picture" if whole > FAIR else f", {whole:.1%} with all that was found"
            text += f" Worst is {self.joints[worst]} with {float(got[worst]):.1%}{cure}."
        lost = [name for name, x, y in zip(self.joints, self.described, got, strict=True) if float(y) > float(x)]
        if lost:
            text += f" Not better than described: {', '.join(lost)}."
        if rank == "Poor":
            text += " Something is missing: gains of the drives, a payload, rotor inertia, or another time base."
        return text

    @property
    def header(self) -> tuple[str, ...]:
        """Names of the columns of `rows`."""
        found = ("identified",) if self.file is None else ("identified", "by the file")
        return ("joint", "error as described", *found, "in 95 % intervals")

    def rows(self) -> list[tuple[str, ...]]:
        """Cells of the table of errors, a row for each joint."""
        errors = [x for x in (self.described, self.found, self.file) if x is not None]
        numbers = zip(self.joints, *(x.tolist() for x in errors), self.within.tolist(), strict=True)
        return [(name, *(f"{x:.3f}" for x in some), f"{share:.0%}") for name, *some, share in numbers]

    def __str__(self) -> str:
        return f"{table(self.header, self.rows())}\n\n{self.verdict}"


def apart(motions: Sequence[Motion]) -> tuple[list[Motion], list[Motion]]:
    """Motions to learn from and motions to test on: the last one, or the last third of the only one."""
    if not motions:
        raise ArgumentError("motions must be at least one, found none")
    if len(motions) > 1:
        return list(motions[:-1]), [motions[-1]]
    first, last = cut(motions[0], LEARNED)
    return [first], [last]


def trial(described: Robot, found: Identified, motions: Sequence[Motion]) -> TorqueTrial:
    """Trial of an identified robot on motions that it was not identified from.

    Args:
        described: the robot as it was before.
        found: from `identify`.
        motions: motions from `smooth`. Where gains of the drives were sought, their torques are those by these gains.
    """
    known = torques_by(found, motions)
    q, qd, qdd, tau = samples(known)
    with torch.no_grad():
        before = inverse_dynamics(described, q, qd, qdd)
    told = found.by_these_gains().predict(known)  # motion by motion: friction remembers nothing of the one before
    size = tau.std(0)
    left = (tau - told.tau).square().mean(0).sqrt() / size
    if float(left.mean()) > FAIR:  # the model may be right, and the file wrong
        _warn_of_faults(described, found, (q, qd, qdd, tau))
    return TorqueTrial(
        described.joint_names,
        float(sum(motion.time[-1] - motion.time[0] for motion in known)),
        (tau - before).square().mean(0).sqrt() / size,
        left,
        ((tau >= told.low) & (tau <= told.high)).double().mean(0),
    )


def _warn_of_faults(described: Robot, found: Identified, rows: Sequence[Tensor]) -> None:
    """Warn of units, signs and columns of the motions to test on, (q, qd, qdd, tau), that seem to be wrong."""
    with torch.no_grad():
        doubt = doubts(described, partial(inverse_dynamics, described), rows, found.width)
    if doubt:
        warnings.warn(f"in the motions to test on, {doubt}", LogWarning, stacklevel=3)


def with_file(measured: TorqueTrial, file: Robot, found: Identified, motions: Sequence[Motion]) -> TorqueTrial:
    """Trial with the errors of a file of the robot, whose friction is its damping and friction.

    Args:
        measured: from `trial`.
        file: the robot that the file holds.
        found: from `identify`.
        motions: those of the trial.
    """
    q, qd, qdd, tau = samples(torques_by(found, motions))
    friction = file.damping.to(qd) * qd + file.friction.to(qd) * smooth_sign(qd, found.width)
    with torch.no_grad():
        left = tau - friction - inverse_dynamics(file, q, qd, qdd)
    return measured._replace(file=left.square().mean(0).sqrt() / tau.std(0))


def torques_by(found: Identified, motions: Sequence[Motion]) -> list[Motion]:
    """Motions with torques in N m, by the gains of the drives if those were sought."""
    if found.gains is None:
        return list(motions)
    gains = found.gains.value.numpy()
    return [
        motion._replace(tau=None if motion.tau is None else motion.tau * gains, known_gains=True) for motion in motions
    ]
