"""Options that commands share, and the robot that they name: by a file or by a name."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import torch
import tyro
from torch import Tensor

from torchdq.base.checks import matching
from torchdq.base.progress import Progress
from torchdq.command.outcome import Outcome
from torchdq.errors import ArgumentError, MissingFileError, MissingLibraryError, UnknownNameError
from torchdq.robot import Robot, shipped
from torchdq.robot.check.consistency import OnUnphysical
from torchdq.robot.description import Base
from torchdq.robot.xml_text import root_name

RobotName = Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ROBOT")]
Dtype = Literal["float64", "float32"]
ENDINGS = (".urdf", ".xml", ".xacro", ".mjcf")
HEAD = 2**20  # bytes in which a file says what it is
DEFAULTED = tyro.conf.arg(help_behavior_hint=lambda x: "" if x in ("", "None", "False") else f"(default: {x})")
DESCRIPTION = "_description"  # end of the names in robot_descriptions


class NamedRobot(NamedTuple):
    """Robot, and the file that it was read from."""

    robot: Robot
    format: Literal["urdf", "xacro", "mjcf", "shipped", "named"]
    file: str  # "" for a shipped robot


@dataclass(kw_only=True)
class Command:
    """Command with its options."""

    json: Annotated[bool, DEFAULTED] = False
    """Write one JSON object instead of text."""

    def __init_subclass__(cls) -> None:
        """Let the help state defaults that are values, and not those that mean absence."""
        cls.__annotations__ = {name: Annotated[kind, DEFAULTED] for name, kind in cls.__annotations__.items()}

    def outcome(self) -> Outcome:
        """Result of the command."""
        raise NotImplementedError


@dataclass(kw_only=True)
class RobotCommand(Command):
    """Command about a robot."""

    robot: RobotName
    """URDF, xacro or MJCF file, shipped robot, or name in robot_descriptions."""
    base: Base = "file"
    """Base of the robot: as the file has it, fixed, or floating."""
    joints: tuple[str, ...] = ()
    """Joints to keep, by name or pattern; the others are locked at zero."""
    tip: str | None = None
    """Frame of the end effector; by default the only leaf of the tree."""
    on_unphysical: OnUnphysical = "error"
    """What to do with a body that cannot exist."""

    def load(self) -> NamedRobot:
        """Robot, and the file that it is from."""
        name = self.robot
        if name in shipped.names() and not Path(name).is_file():
            if self.base == "floating":
                raise ArgumentError(f"base must be 'fixed' for the shipped robot {name!r}, found 'floating'")
            robot = shipped.load(name)
            if self.joints:
                kept = matching("joints", self.joints, robot.joint_names, "joint")
                robot = robot.lock([joint for joint in robot.joint_names if joint not in kept])
            return NamedRobot(robot if self.tip is None else robot.with_tip(self.tip), "shipped", "")
        given = {"base": self.base, "joints": list(self.joints), "tip": self.tip}
        options = {option: x for option, x in given.items() if x} | {"on_unphysical": self.on_unphysical}
        path = Path(name)
        is_file = os.sep in name or path.suffix.lower() in ENDINGS or path.exists() or "://" in name or name[:1] == "~"
        with Progress(f"reading {name}"):
            return (_read if is_file else _by_name)(name, options)

    def load_moving(self, or_free: bool = False) -> NamedRobot:
        """Robot with a joint at least or, if that will do, a floating base, and the file that it is from."""
        source = self.load()
        if not source.robot.n and not (or_free and source.robot.floating):
            raise ArgumentError(f"robot {source.robot.name!r} must have a joint that moves, found none in {self.robot}")
        return source


def _read(name: str, options: dict[str, Any]) -> NamedRobot:
    path = Path(name).expanduser()
    if name.endswith(".xacro"):
        return NamedRobot(Robot.from_xacro(name, **options), "xacro", name)
    if path.is_file() and os.access(path, os.R_OK):
        with path.open("rb") as file:
            if root_name(file.read(HEAD).decode("utf-8", "replace")) == "mujoco":
                return NamedRobot(Robot.from_mjcf(name, **options), "mjcf", name)
    return NamedRobot(Robot.from_urdf(name, **options), "urdf", name)


def _by_name(name: str, options: dict[str, Any]) -> NamedRobot:
    """Robot that robot_descriptions knows."""
    known = shipped.names()
    try:
        whole = name if name.endswith(DESCRIPTION) else f"{name}{DESCRIPTION}"
        return NamedRobot(Robot.from_name(whole, **options), "named", "")
    except (MissingLibraryError, UnknownNameError) as error:
        meant = "".join(f", did you mean {near!r}?" for near in get_close_matches(name, known, n=1))
        raise MissingFileError(
            f"there is no file or shipped robot {name!r}{meant or ';'} shipped are {', '.join(known)}; {error}"
        ) from error


def per_joint(name: str, values: Sequence[float], robot: Robot) -> Tensor | None:
    """Numbers of an option for each joint [n]; None: not given."""
    if values and len(values) != robot.n:
        raise ArgumentError(f"{name} must be {robot.n} numbers, one for each joint, found {len(values)}")
    return torch.tensor(values, dtype=torch.float64) if values else None
