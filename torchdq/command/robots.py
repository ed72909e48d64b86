"""Robots by a file or a name, whichever an argument of the command line holds."""

import os
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, NamedTuple

from torchdq.base.checks import matching
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError, MissingFileError, MissingLibraryError, UnknownNameError
from torchdq.robot import Robot, shipped
from torchdq.robot.check.consistency import OnUnphysical

ENDINGS = (".urdf", ".xml", ".xacro", ".mjcf")
HEAD = 2**16  # bytes in which a file says what it is
DESCRIPTION = "_description"  # end of the names in robot_descriptions


class NamedRobot(NamedTuple):
    """Robot, and the file that it was read from."""

    robot: Robot
    format: Literal["urdf", "xacro", "mjcf", "shipped", "named"]
    file: str  # "" for a shipped robot


def robot_of(
    name: str, base: str | None, joints: Sequence[str], tip: str | None, on_unphysical: OnUnphysical
) -> NamedRobot:
    """Robot of a name or a file.

    Raises:
        MissingFileError: there is nothing of that name.
        DescriptionError: a file cannot be read, or does not describe a robot.
    """
    given = {"base": base, "joints": list(joints), "tip": tip}
    options = {name: x for name, x in given.items() if x} | {"on_unphysical": on_unphysical}
    if name in shipped.names() and not Path(name).is_file():
        if base == "floating":
            raise ArgumentError(f"base must be 'fixed' for the shipped robot {name!r}, found 'floating'")
        robot = shipped.load(name)
        kept = matching("joints", joints, robot.joint_names, "joint")
        locked = [joint for joint in robot.joint_names if joint not in kept]
        robot = robot.lock(locked) if joints else robot
        return NamedRobot(robot if tip is None else robot.with_tip(tip), "shipped", "")
    with Progress(f"reading {name}"):
        path = Path(name)
        if os.sep in name or path.suffix.lower() in ENDINGS or path.exists() or "://" in name or name.startswith("~"):
            return _read(name, options)
        return _by_name(name, options)


def _read(name: str, options: dict[str, Any]) -> NamedRobot:
    """Robot of a file."""
    path = Path(name).expanduser()
    if name.endswith(".xacro"):
        return NamedRobot(Robot.from_xacro(name, **options), "xacro", name)
    if path.is_file() and os.access(path, os.R_OK):
        with path.open("rb") as file:
            if b"<mujoco" in file.read(HEAD):
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
