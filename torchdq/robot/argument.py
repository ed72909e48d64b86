"""Checks of the argument `robot`, which public functions share."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from torchdq.errors import ArgumentError, UnphysicalError
from torchdq.robot.arrays import matrices
from torchdq.robot.check import consistency
from torchdq.robot.fields import readable
from torchdq.robot.model import batches, factors
from torchdq.robot.robot import Robot


def require_robot(x: Any) -> Robot:
    """Robot x; raises, with a way to make one, if it is something else."""
    if isinstance(x, Robot):
        return x
    way = "make one with Robot.from_urdf, from_dh or from_screws"
    if isinstance(x, str | Path):
        way = "load it with Robot.from_urdf(...), or a shipped robot with torchdq.robots.load(...)"
    elif isinstance(getattr(x, "robot", None), Robot):
        way = f"{type(x).__name__} holds one as its attribute `robot`"
    elif isinstance(x, type):
        way = f"it is a class, {way}"
    found = x.__name__ if isinstance(x, type) else type(x).__name__
    raise ArgumentError(f"robot must be a torchdq.Robot, found {found}; {way}")


def require_single(x: Any) -> Robot:
    """Robot x; raises unless it is one, without batch axes."""
    robot = require_robot(x)
    for name, axes in batches(robot).items():
        raise ArgumentError(f"{name} of robot {robot.name!r} has batch axes {axes}; one robot at a time is needed")
    return robot


def require_motors(robot: Robot, coupling: Sequence[Sequence[float]] | None) -> None:
    """Raise if a log is of motors that a matrix couples, and the coordinates of the robot are others."""
    S = factors(robot)
    if coupling is not None and len(S) == robot.n and not torch.allclose(S, torch.tensor(coupling).to(S), atol=1e-6):
        raise ArgumentError(
            f"robot must have the motors as coordinates, since the transmission of the layout couples joints, found "
            f"{robot.name!r} with {', '.join(robot.joint_names)}; give robot.couple(layout.coupling, names)"
        )


def require_bodies(robot: Robot, what: str) -> None:
    """Raise unless the inertias of a robot's links are those of bodies, which `what` needs."""
    if not all(readable(x, True) for x in (robot.mass, robot.inertia)):
        return
    mass, inertia = robot.mass.detach(), matrices(robot.inertia.detach())
    faults = consistency.bodies(robot.link_names, mass, inertia)
    if faults := [fault for fault in faults if fault.code in consistency.MISSHAPEN]:
        raise UnphysicalError(
            f"{what} needs physically consistent inertias, found in robot {robot.name!r}\n  "
            + "\n  ".join(map(str, faults))
            + f"\nCorrect them; {consistency.NEAREST}, where a robot is loaded and in robot.replace.",
            *faults,
        )
