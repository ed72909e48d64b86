"""Trials of what may be missing where a verdict is poor: gains of the drives, rotors, a payload in the test motions."""

import contextlib
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

from torchdq.base.progress import Progress
from torchdq.errors import TorchdqError
from torchdq.learning import Evaluation, Identified, Motion, evaluate, identify_payload
from torchdq.learning.evaluate import GOOD, Verdict, torques_by
from torchdq.learning.logs.motions import stack_samples
from torchdq.robot import Robot

HELPED = 0.8  # part of the error that may be left at most, to be called a help


class Trial(NamedTuple):
    """Error that something else leaves."""

    name: str  # option of the command, or what it is
    error: float  # of the torques in the motions to test on, mean over the joints
    helps: bool

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a table."""
        return self.name, f"{self.error:.1%}", "helps" if self.helps else ""


HEADER = ("tried", "error of the torques", "")


def trials(
    described: Robot,
    found: Identified,
    measured: Evaluation,
    test: Sequence[Motion],
    options: dict[str, Callable[[], Identified]],
    frame: str | None,
) -> tuple[Trial, ...]:
    """Errors with other options, and with a payload, where what was found is poor; none where it is not."""
    before = float(measured.found.mean())
    if before <= GOOD or measured.verdict not in (Verdict.POOR, Verdict.KEEP_DESCRIPTION):
        return ()
    errors = {"nothing else": before}
    with warnings.catch_warnings(), Progress("trying what may be missing"):
        warnings.simplefilter("ignore")
        for name, other in options.items():
            with contextlib.suppress(TorchdqError):  # some options cannot go together
                errors[name] = float(evaluate(described, other(), test).found.mean())
        with contextlib.suppress(TorchdqError):
            known = torques_by(found, test)
            held, size = identify_payload(found.by_these_gains(), known, frame=frame), stack_samples(known).tau.std(0)
            error, mass = before * float((held.rms / size).mean() / (held.before / size).mean()), float(held.mass)
            if mass > 3 * float(held.mass_error):
                errors[f"{mass:.3g} kg at {held.frame} in the motions to test on (--payload)"] = error
    return tuple(Trial(name, error, error < HELPED * before) for name, error in errors.items())
