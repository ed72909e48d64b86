"""Options that commands share."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
import tyro
from torch import Tensor

from torchdq.command.outcome import Outcome
from torchdq.command.robots import NamedRobot, robot_of
from torchdq.errors import ArgumentError
from torchdq.robot import Robot
from torchdq.robot.check.consistency import OnUnphysical
from torchdq.robot.loading import Base

RobotName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ROBOT")]
Dtype = Literal["float64", "float32"]


@dataclass(kw_only=True)
class Command:
    """Command with its options."""

    json: bool = False
    """Write one JSON object instead of text."""

    def outcome(self) -> Outcome:
        """Result of the command."""
        raise NotImplementedError


@dataclass(kw_only=True)
class RobotCommand(Command):
    """Command about a robot."""

    robot: RobotName
    """URDF, xacro or MJCF file, shipped robot, or name in robot_descriptions."""
    base: Base | None = None
    """Base of the robot; by default fixed, or as an MJCF file has it."""
    joints: tuple[str, ...] = ()
    """Joints to keep, by name or pattern; the others are locked at zero."""
    tip: str | None = None
    """Frame of the end effector; by default the only leaf of the tree."""
    on_unphysical: OnUnphysical = "warn"
    """What to do with a body that cannot exist."""

    def load(self) -> NamedRobot:
        """Robot, and the file that it is from."""
        return robot_of(self.robot, self.base, self.joints, self.tip, self.on_unphysical)

    def load_moving(self) -> NamedRobot:
        """Robot with a joint at least, and the file that it is from."""
        source = self.load()
        if not source.robot.n:
            raise ArgumentError(f"robot {source.robot.name!r} must have a joint that moves, found none in {self.robot}")
        return source


def per_joint(name: str, values: Sequence[float], robot: Robot) -> Tensor | None:
    """Numbers of an option for each joint [n]; None: not given."""
    if values and len(values) != robot.n:
        raise ArgumentError(f"{name} must be {robot.n} numbers, one for each joint, found {len(values)}")
    return torch.tensor(values, dtype=torch.float64) if values else None
