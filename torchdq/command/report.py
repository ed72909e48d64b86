"""Command `report`: what is read of a robot's file, and what is wrong with it."""

from __future__ import annotations

from dataclasses import dataclass

from torchdq.command.command import RobotCommand
from torchdq.command.outcome import Grid, Outcome
from torchdq.command.reports.overview import COUNTED, overview
from torchdq.robot.check.report import HEADER


@dataclass(kw_only=True)
class ReportCommand(RobotCommand):
    """Content of a robot's file: what is used, what is not, and what is wrong with it.

    Example: torchdq report arm.urdf
    """

    def outcome(self) -> Outcome:
        """Page about the robot."""
        robot = self.load().robot
        page = overview(robot)
        notes = [*map(str, page.report.notes)]
        text = (
            page.report.summary,
            Grid(HEADER, page.report.joints),
            "notes:",
            Grid((), [("-", note) for note in notes or ("nothing else in the description",)]),
            "operations per sample:",
            Grid(("function", *COUNTED), page.rows()),
            page.rounding(),
        )
        data = {
            "robot": robot.name,
            "base": "floating" if robot.floating else "fixed",
            "joints": [
                dict(zip(("name", "kind", "link", "mass", "limits"), row, strict=True)) for row in page.report.joints
            ],
            "coordinates": robot.joint_names,
            "limits": robot.limits._asdict(),
            "links": [
                {"name": name, "mass": mass, "com": com}
                for name, mass, com in zip(robot.link_names, robot.mass, robot.com, strict=True)
            ],
            "frames": robot.frame_names,
            "notes": notes,
            "operations": {name: None if count is None else count._asdict() for name, count in page.operations.items()},
            "error_growth": None if page.growth is None else page.growth._asdict(),
            "reason": page.reason,
        }
        return Outcome(text, data)
