"""Page about a robot: its report, the operations of its functions, and the growth of rounding errors."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq import floating, functional
from torchdq.base.progress import Notice
from torchdq.base.tables import table
from torchdq.errors import SingularInertiaError
from torchdq.functions.catalogue import FLOATING, RECIPES, Function
from torchdq.functions.options import options_of
from torchdq.program.program import Argument, Count
from torchdq.robot import Robot
from torchdq.robot.check.report import Report
from torchdq.robot.robot import constants

SHOWN = ("inverse_dynamics", "forward_dynamics", "mass_matrix", "closed_form", "regressor")
WRENCHES = ("f_tip", "f_ext", "f_base")
POSITIONS = 100  # number of random positions
COUNTED = ("multiplications", "additions", "divisions", "sines", "roots")


class Growth(NamedTuple):
    """Factors by which accelerations magnify rounding errors, at random positions within the limits."""

    median: float
    worst: float


class Overview(NamedTuple):
    """Page about a robot; `str` lays it out as text."""

    report: Report
    operations: dict[str, Count | None]  # per sample, by function; None: undefined, since a joint moves no inertia
    growth: Growth | None  # None: accelerations are undefined, or there are none
    reason: str  # why there is no growth; "" if there is

    def rows(self) -> list[tuple[str, ...]]:
        """Cells of the table of operations, a row for each function."""
        return [
            (name, *(str(getattr(count, kind)) for kind in COUNTED))
            if count is not None
            else (name, "undefined: a joint moves no inertia", *[""] * (len(COUNTED) - 1))
            for name, count in self.operations.items()
        ]

    def rounding(self) -> str:
        """Sentence about the growth of rounding errors."""
        if self.growth is None:
            return f"rounding errors: {self.reason}"
        return (
            f"rounding errors of accelerations, at {POSITIONS} random positions: magnified {self.growth.median:.3g} "
            f"times in the median, largest growth {self.growth.worst:.3g}; torques and kinematics keep all digits"
        )

    def __str__(self) -> str:
        operations = table(("function", *COUNTED), self.rows())
        return f"{self.report}\n\noperations per sample:\n{operations}\n\n{self.rounding()}\n"


def overview(robot: Robot) -> Overview:
    """Page about a robot, without compiling anything.

    >>> import torchdq
    >>> page = str(overview(torchdq.robots.load("two_link")))
    >>> "inverse_dynamics" in page and "largest growth" in page
    True
    """
    with Notice(f"counting operations of robot {robot.name!r}") as notice:
        operations = {}
        for name in SHOWN:
            notice.at(name)
            operations[name] = _counted(robot, name)
    return Overview(robot.report(), operations, *_growth(robot))


def _counted(robot: Robot, name: str) -> Count | None:
    """Operations of a function; None: undefined."""
    full = FLOATING + name if robot.floating else name
    what = Function(constants(robot), full, options_of(robot, name, ()) if not robot.floating else ())
    wanted = [argument for argument, _, _ in RECIPES[full].arguments if argument not in WRENCHES]
    taken = tuple(Argument(argument, math.prod(what.axes(argument))) for argument in wanted)
    try:
        return what.program(taken).count()
    except SingularInertiaError:
        return None


def _growth(robot: Robot) -> tuple[Growth | None, str]:
    """Growth of rounding errors in forward dynamics, or None and why there is none."""
    if not robot.n and not robot.floating:
        return None, "there is no joint to accelerate"
    generator = torch.Generator().manual_seed(0)
    lower, upper = (x.clamp(-math.pi, math.pi) for x in robot.limits[:2])
    q = lower + (upper - lower) * torch.rand(POSITIONS, robot.n, generator=generator, dtype=torch.float64)
    try:
        growth = _growth_at(robot, q)
    except SingularInertiaError as error:
        return None, f"accelerations are undefined, {error}"
    return Growth(float(growth.median()), float(growth.max())), ""


def _growth_at(robot: Robot, q: Tensor) -> Tensor:
    if not robot.floating:
        return functional.error_growth(robot, q, "eager")
    return floating.error_growth(robot, torch.eye(1, 8, dtype=q.dtype)[0], q, "eager")
