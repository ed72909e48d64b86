"""Command `report`: what is read of a robot's file, what is wrong with it, and what its functions cost."""

import math
from dataclasses import dataclass

import torch

from torchdq import floating, functional
from torchdq.base.progress import Progress
from torchdq.command.command import RobotCommand
from torchdq.command.outcome import Grid, Outcome
from torchdq.dynamics.friction import COLUMNS, SPEEDS, STATED
from torchdq.errors import SingularInertiaError
from torchdq.functions.catalogue import FLOATING, RECIPES, Function
from torchdq.functions.options import options_of
from torchdq.numbers.ops import Count
from torchdq.program.program import Argument
from torchdq.robot import Robot
from torchdq.robot.check.consistency import OnUnphysical
from torchdq.robot.check.report import BOUNDED, HEADER, MOTORS
from torchdq.robot.robot import constants

SHOWN = ("inverse_dynamics", "forward_dynamics", "mass_matrix", "closed_form", "regressor")
POSITIONS = 100  # number of random positions
COUNTED = ("multiplications", "additions", "divisions", "sines", "roots")
UNDEFINED = ("undefined: a joint moves no inertia", *[""] * (len(COUNTED) - 1))


@dataclass(kw_only=True)
class ReportCommand(RobotCommand):
    """Contents of a robot's file: what is used, what is not, and what is wrong with it.

    Example: torchdq report arm.urdf
    """

    on_unphysical: OnUnphysical = "warn"
    """Treatment of bodies that cannot exist, which are also reported."""

    def outcome(self) -> Outcome:
        """Page about the robot, without compiling anything."""
        robot = self.load().robot
        report = robot.report()
        with Progress(f"counting operations of robot {robot.name!r}") as progress:
            operations = {}
            for name in SHOWN:
                progress.at(name)
                operations[name] = _counted(robot, name)
        counts = {name: None if count is None else count._asdict() for name, count in operations.items()}
        growth, reason = _growth(robot)
        rounding = f": {reason}"
        if growth:
            rounding = (
                f" of accelerations, at {POSITIONS} random positions: magnified {growth['median']:.3g} times in the "
                f"median, largest growth {growth['worst']:.3g}; torques and kinematics keep all digits"
            )
        notes = [*map(str, report.notes)]
        text = (
            report.summary,
            Grid(HEADER, report.joints),
            *((f"{BOUNDED}:", Grid(MOTORS, report.motors)) if report.motors else ()),
            *((f"{STATED}:", Grid(COLUMNS, report.friction)) if report.friction else ()),
            *(("notes:", Grid((), [("-", note) for note in notes])) if notes else ()),
            "operations per sample:",
            Grid(
                ("function", *COUNTED),
                [(name, *([str(x[kind]) for kind in COUNTED] if x else UNDEFINED)) for name, x in counts.items()],
            ),
            f"rounding errors{rounding}",
        )
        data = {
            "robot": robot.name,
            "base": "floating" if robot.floating else "fixed",
            "joints": [
                dict(zip(("name", "kind", "link", "mass", "limits"), row, strict=True)) for row in report.joints
            ],
            "coordinates": robot.joint_names,
            "friction": {"speeds": SPEEDS, "torques": [[float(x) for x in row[1:]] for row in report.friction]},
            "limits": robot.limits._asdict(),
            "links": [
                {"name": name, "mass": mass, "com": com}
                for name, mass, com in zip(robot.link_names, robot.mass, robot.com, strict=True)
            ],
            "frames": robot.frame_names,
            "notes": notes,
            "operations": counts,
            "error_growth": growth,
            "reason": reason,
        }
        return Outcome(text, data)


def _counted(robot: Robot, name: str) -> Count | None:
    """Operations of a function; None: undefined, since a joint moves no inertia."""
    full = FLOATING + name if robot.floating else name
    what = Function(constants(robot), full, options_of(robot, name, ()) if not robot.floating else ())
    taken = tuple(Argument(x.name, math.prod(what.axes(x.name))) for x in RECIPES[full].present(full, None))
    try:
        return what.program(taken).count()
    except SingularInertiaError:
        return None


def _growth(robot: Robot) -> tuple[dict[str, float] | None, str]:
    """Factors by which accelerations magnify rounding errors, or None, and why there are none."""
    if not robot.n and not robot.floating:
        return None, "there is no joint to accelerate"
    generator = torch.Generator().manual_seed(0)
    lower, upper = (x.clamp(-math.pi, math.pi) for x in robot.limits[:2])
    q = lower + (upper - lower) * torch.rand(POSITIONS, robot.n, generator=generator, dtype=torch.float64)
    try:
        if robot.floating:
            found = floating.error_growth(robot, torch.eye(1, 8, dtype=q.dtype)[0], q, "eager")
        else:
            found = functional.error_growth(robot, q, "eager")
    except SingularInertiaError as error:
        return None, f"accelerations are undefined, {error}"
    return {"median": float(found.median()), "worst": float(found.max())}, ""
