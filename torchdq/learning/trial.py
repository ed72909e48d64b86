"""Trial of an identified robot on motions that no number was found from, and the verdict about it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.functional import inverse_dynamics
from torchdq.learning.identification.identified import Identified
from torchdq.learning.logs.motions import Motion, cut, samples
from torchdq.robot import Robot
from torchdq.tables import table

WIDE = 1.96  # standard deviations on either side that hold 95 % of normal numbers
LEARNED = 2 / 3  # share of a single motion that is learned from
WORTH = 0.95  # part of the error of the description that must be left at most, so that there is something gained
GOOD, FAIR = 0.1, 0.3  # parts of the torque that are left unexplained at most


class TorqueTrial(NamedTuple):
    """Errors of the torques in motions that were not learned from.

    Errors are root mean squares over the standard deviation of the measured torque: 0 is perfect, 1 no better than a
    constant.
    """

    joints: tuple[str, ...]
    seconds: float  # duration of the rows [s]
    described: Tensor  # [n] error of the description, without friction
    found: Tensor  # [n] error of what was identified
    within: Tensor  # [n] share of the measured torques in the intervals that should hold 95 %

    @property
    def verdict(self) -> str:
        """Whether to use what was found, in a few sentences."""
        before, after = float(self.described.mean()), float(self.found.mean())
        change = f"the error of the torques is {after:.1%} of their standard deviation, {before:.1%} as described"
        if after > WORTH * before:
            return f"Keep the description: in {self.seconds:.1f} s that were not learned from, {change}."
        rank = "Good" if after <= GOOD else "Fair" if after <= FAIR else "Poor"
        text = f"{rank}: in {self.seconds:.1f} s that were not learned from, {change}."
        worst = int(self.found.argmax())
        if float(self.found[worst]) > FAIR:
            text += f" Worst is {self.joints[worst]} with {float(self.found[worst]):.1%}: look at its picture."
        lost = [name for name, x, y in zip(self.joints, self.described, self.found, strict=True) if float(y) > float(x)]
        if lost:
            text += f" Not better than described: {', '.join(lost)}."
        if rank == "Poor":
            text += " Something is missing: gains of the drives, a payload, rotor inertia, or another time base."
        return text

    def rows(self) -> list[tuple[str, ...]]:
        """Cells of the table of errors, a row for each joint."""
        numbers = zip(self.joints, self.described.tolist(), self.found.tolist(), self.within.tolist(), strict=True)
        return [(name, f"{before:.3f}", f"{after:.3f}", f"{share:.0%}") for name, before, after, share in numbers]

    def __str__(self) -> str:
        return f"{table(HEADER, self.rows())}\n\n{self.verdict}"


HEADER = ("joint", "error as described", "error as identified", "in 95 % intervals")


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
    tau_hat, error = found.predict(q, qd, qdd)
    band = WIDE * (error.square() + found.noise.to(error).square()).sqrt()
    size = tau.std(0)
    return TorqueTrial(
        described.joint_names,
        float(sum(motion.time[-1] - motion.time[0] for motion in known)),
        (tau - before).square().mean(0).sqrt() / size,
        (tau - tau_hat).square().mean(0).sqrt() / size,
        ((tau - tau_hat).abs() <= band).double().mean(0),
    )


def torques_by(found: Identified, motions: Sequence[Motion]) -> list[Motion]:
    """Motions with torques in N m, by the gains of the drives if those were sought."""
    if found.gains is None:
        return list(motions)
    gains = found.gains.value.numpy()
    return [
        motion._replace(tau=None if motion.tau is None else motion.tau * gains, known_gains=True) for motion in motions
    ]
