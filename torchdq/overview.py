"""Page about a robot: its report, the operations of its functions, and the growth of rounding errors."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchdq import floating, functional
from torchdq.errors import SingularInertiaError
from torchdq.functions.catalogue import FLOATING, RECIPES, Function
from torchdq.functions.options import options_of
from torchdq.notice import Notice
from torchdq.program.program import Argument
from torchdq.robot import Robot
from torchdq.robot.robot import constants
from torchdq.tables import table

SHOWN = ("inverse_dynamics", "forward_dynamics", "mass_matrix", "closed_form", "regressor")
WRENCHES = ("f_tip", "f_ext", "f_base")
POSITIONS = 100  # number of random positions
COUNTED = ("multiplications", "additions", "divisions", "sines", "roots")


def overview(robot: Robot) -> str:
    """Page about a robot, without compiling anything.

    >>> import torchdq
    >>> page = overview(torchdq.robots.load("two_link"))
    >>> "inverse_dynamics" in page and "largest growth" in page
    True
    """
    with Notice(f"counting operations of robot {robot.name!r}") as notice:
        rows = []
        for name in SHOWN:
            notice.at(name)
            rows.append((name, *_counted(robot, name)))
    operations = table(("function", *COUNTED), rows)
    return f"{robot.report()}\n\noperations per sample:\n{operations}\n\n{_growth(robot)}\n"


def _counted(robot: Robot, name: str) -> tuple[str, ...]:
    """Operations of a function, or why it has none."""
    full = FLOATING + name if robot.floating else name
    what = Function(constants(robot), full, options_of(robot, name, ()) if not robot.floating else ())
    wanted = [argument for argument, _, _ in RECIPES[full].arguments if argument not in WRENCHES]
    taken = tuple(Argument(argument, math.prod(what.axes(argument))) for argument in wanted)
    try:
        count = what.program(taken).count()
    except SingularInertiaError:
        return ("undefined: a joint moves no inertia", *[""] * (len(COUNTED) - 1))
    return tuple(str(getattr(count, kind)) for kind in COUNTED)


def _growth(robot: Robot) -> str:
    """Words for the growth of rounding errors in forward dynamics at random positions within the limits."""
    if not robot.n and not robot.floating:
        return "rounding errors: there is no joint to accelerate"
    generator = torch.Generator().manual_seed(0)
    lower, upper = (x.clamp(-math.pi, math.pi) for x in robot.limits[:2])
    q = lower + (upper - lower) * torch.rand(POSITIONS, robot.n, generator=generator, dtype=torch.float64)
    try:
        growth = _growth_at(robot, q)
    except SingularInertiaError as error:
        return f"rounding errors: accelerations are undefined, {error}"
    worst, usual = float(growth.max()), float(growth.median())
    return (
        f"rounding errors of accelerations, at {POSITIONS} random positions: magnified {usual:.3g} times in the "
        f"median, largest growth {worst:.3g}; torques and kinematics keep all digits"
    )


def _growth_at(robot: Robot, q: Tensor) -> Tensor:
    if not robot.floating:
        return functional.error_growth(robot, q, "eager")
    return floating.error_growth(robot, torch.eye(1, 8, dtype=q.dtype)[0], q, "eager")
