"""Evaluation of an identified robot on motions that it was not identified from, and the verdict about it."""

import warnings
from collections.abc import Sequence
from enum import Enum
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import require_object
from torchdq.base.tables import table
from torchdq.dynamics.friction import smooth_sign
from torchdq.findings import Finding
from torchdq.functional import inverse_dynamics
from torchdq.learning.evaluation.diagnostics import diagnose
from torchdq.learning.identification.identified import Identified
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.motions import Motion, several, stack_samples
from torchdq.robot import Robot

GAINED = 0.95  # part of the error of the description that may be left at most, so that there is something gained
GOOD, FAIR = 0.1, 0.3  # parts of the torque that are left unexplained at most
SEEN = 0.005  # difference of two errors that is mentioned
UNLIKE = 2.0  # times the forecast error from which motions are unlike those that were learned from
MEANING = (
    f"Good means that, in the mean over the joints, at most {GOOD:.0%} of the torque's standard deviation is left "
    f"unexplained, and at no joint more than {FAIR:.0%}; Fair means at most {FAIR:.0%} in the mean. The share in 95 % "
    "intervals does not count: near 95 % the standard errors are right."
)


class Verdict(Enum):
    """Whether to use an identified robot."""

    GOOD = "Good"
    FAIR = "Fair"
    POOR = "Poor"
    KEEP_DESCRIPTION = "Keep the description"


class Evaluation(NamedTuple):
    """Errors of the torques in motions that were not learned from.

    Errors are root mean squares over the standard deviation of the measured torque: 0 is perfect, 1 no better than a
    constant. `file` are those of a file of the robot, which has no other friction than viscous and Coulomb friction;
    `forecast` those on the parts of the motions learned from that were left out to choose the model.

    Printed, it is a table with the verdict.
    """

    joints: tuple[str, ...]
    seconds: float  # duration of the rows [s]
    described: Tensor  # [n] error of the description, without friction
    found: Tensor  # [n] error of what was identified
    within: Tensor  # [n] share of the measured torques in the intervals that should hold 95 %
    file: Tensor | None = None  # [n] error of a file of the robot found; None: there is no file
    findings: tuple[Finding, ...] = ()  # what is probably wrong in the motions
    forecast: Tensor | None = None  # [n] error of what was identified on parts left out; None: none were
    far: tuple[Finding, ...] = ()  # links whose masses are far from the description, with their factors

    @property
    def verdict(self) -> Verdict:
        """Whether to use what was found: the file, if there is one."""
        return self._verdict(self.found if self.file is None else self.file)

    def _verdict(self, used: Tensor) -> Verdict:
        """Verdict about errors [n]."""
        before, after = float(self.described.mean()), float(used.mean())
        if after > GAINED * before:
            return Verdict.KEEP_DESCRIPTION
        if after <= GOOD and float(used.max()) <= FAIR:
            return Verdict.GOOD
        return Verdict.FAIR if after <= FAIR else Verdict.POOR

    @property
    def summary(self) -> str:
        """The verdict with its reasons, in a few sentences."""
        used, by = (self.found, "") if self.file is None else (self.file, " by the file")
        before, after, whole = (float(x.mean()) for x in (self.described, used, self.found))
        change = f"the error of the torques{by} is {after:.1%} of their standard deviation, {before:.1%} as described"
        text = f"{self.verdict.value}: in {self.seconds:.1f} s that were not learned from, {change}."
        if after > whole + SEEN:
            both = f"{self._verdict(self.found).value}, {whole:.1%}"
            text += f" The identified model: {both}; a file cannot represent all of it."
        if self.forecast is not None and whole > UNLIKE * float(self.forecast.mean()):
            unlike = "these motions, or their pauses, are unlike those that it was identified from"
            text += f" The forecast was {float(self.forecast.mean()):.1%}: {unlike}."
        if self.verdict is Verdict.KEEP_DESCRIPTION:
            return text
        if self.far:
            masses = ", ".join(f"{one.subject} ({one.value:.2g} times)" for one in self.far)
            text += f" But its masses are far from those described, {masses}: is it this robot, with torques in N m?"
        worst = int(used.argmax())
        if float(used[worst]) > FAIR:
            own = float(self.found[worst])
            cure = ": look at its picture" if own > FAIR else f", {own:.1%} with all that was found"
            text += f" Worst is {self.joints[worst]} with {float(used[worst]):.1%}{cure}."
        if worse := [name for name, x, y in zip(self.joints, self.described, used, strict=True) if y > x]:
            text += f" Not better than described: {', '.join(worse)}."
        if self.verdict is Verdict.POOR and not self.findings:
            text += " Something is missing: gains of the drives, a payload, rotor inertia, or another time base."
        return text

    def table(self) -> tuple[tuple[str, ...], list[tuple[str, ...]]]:
        """Heads of the table of errors, and a row of cells for each joint."""
        heads = ("error as described", "forecast", "identified", "by the file")
        columns = dict(zip(heads, (self.described, self.forecast, self.found, self.file), strict=True))
        errors = {head: x.tolist() for head, x in columns.items() if x is not None}
        numbers = zip(self.joints, *errors.values(), self.within.tolist(), strict=True)
        rows = [(name, *(f"{x:.3f}" for x in some), f"{share:.0%}") for name, *some, share in numbers]
        return ("joint", *errors, "in 95 % intervals"), rows

    def __str__(self) -> str:
        return f"{table(*self.table())}\n\n{self.summary}"


def evaluate(
    described: Robot, found: Identified, motions: Motion | Sequence[Motion], file: Robot | None = None
) -> Evaluation:
    """Errors of the torques of an identified robot in motions that it was not identified from, as `Evaluation`.

    Args:
        described: the robot as it was before.
        found: from `identify`.
        motions: motions from `smooth`. Where gains of the drives were estimated, their torques are those by these
            gains.
        file: robot of a file that was written of `found`, whose friction is its damping and friction; None: no file.
    Raises:
        ArgumentError: `found` is of another type, or the motions have no torques.
    Warns:
        LogWarning: units, signs or columns of the motions seem to be wrong; the same are in `Evaluation.findings`.

    >>> import torchdq
    >>> from torchdq.learning import read_log, smooth, train_test_split, identify
    >>> train, test = train_test_split(smooth(read_log("log.csv")))  # doctest: +SKIP
    >>> print(evaluate(robot, identify(robot, train), test).verdict)  # doctest: +SKIP
    Verdict.GOOD
    """
    require_object("found", found, Identified, "torchdq.learning", "identify(robot, motions)")
    known = torques_by(found, motions)
    q, qd, qdd, tau = rows = stack_samples(known)
    predicted = found.by_these_gains().predict(known)  # motion by motion: friction remembers nothing of the one before
    size = tau.std(0)
    size = size.where(size > 1e-6 * size.max(), size.mean())  # of a finger without an effort, that of the others

    def error(torques: Tensor) -> Tensor:
        return (tau - torques).square().mean(0).sqrt() / size

    with torch.no_grad():
        torques = partial(inverse_dynamics, described)
        before, after, of_file = error(torques(q, qd, qdd)), error(predicted.tau), None
        if file is not None:
            friction = file.damping.to(qd) * qd + file.friction.to(qd) * smooth_sign(qd, found.sign_width)
            of_file = error(inverse_dynamics(file, q, qd, qdd) + friction)
        poor = float(after.mean()) > FAIR  # the model may be right, and the file wrong
        findings = tuple(diagnose(described, torques, rows, found.sign_width)) if poor else ()
    if findings:
        warnings.warn(LogWarning(*findings, where="the motions to test on"), stacklevel=2)
    seconds = float(sum(motion.time[-1] - motion.time[0] for motion in known))
    within = ((tau >= predicted.low) & (tau <= predicted.high)).double().mean(0)
    chosen = found.selection
    forecast = chosen.chosen.scores.mean(0).sqrt() if chosen is not None else None
    far = tuple(one for one in found.findings if one.code == "mass.far")
    return Evaluation(described.joint_names, seconds, before, after, within, of_file, findings, forecast, far)


def torques_by(found: Identified, motions: Motion | Sequence[Motion]) -> Sequence[Motion]:
    """Motions with torques in N m, by the gains of the drives if those were estimated."""
    if found.gains is None:
        return several(motions)
    gains = found.gains.value.numpy()
    return [x if x.tau is None else x._replace(tau=x.tau * gains, known_gains=True) for x in several(motions)]
