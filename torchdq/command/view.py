"""Command `view`: a robot in the browser."""

import math
import sys
import time
from contextlib import closing, suppress
from dataclasses import dataclass

import torch

from torchdq import dq
from torchdq.command.command import RobotCommand, per_joint
from torchdq.command.outcome import Outcome
from torchdq.envs.render import Viewer, room
from torchdq.robot import Robot

FRAMES = 30.0  # [Hz]
PERIOD = 4.0  # time in which a joint goes there and back [s]
SWAY = 0.4  # part of the room within the limits that a joint uses


@dataclass(kw_only=True)
class ViewCommand(RobotCommand):
    """The robot in the browser, its joints swaying one after the other. Ctrl-C ends it.

    A robot with a floating base has its lowest point on the ground.

    Example: torchdq view panda
    """

    q: tuple[float, ...] = ()
    """Positions to show instead, one for each joint [rad or m]."""
    port: int = 8080
    """Port of the address; the next free one is taken."""
    seconds: float | None = None
    """Time after which it ends [s]; by default at Ctrl-C."""

    def outcome(self) -> Outcome:
        """Address, after the end."""
        robot = self.load_moving().robot
        q = per_joint("q", self.q, robot)
        viewer = Viewer(robot, self.port)
        sys.stderr.write(f"torchdq: {robot.name} at {viewer.url}; Ctrl-C ends it\n")
        start, shown = time.monotonic(), 0
        with suppress(KeyboardInterrupt), closing(viewer):
            while self.seconds is None or time.monotonic() < start + self.seconds:
                at = swaying(robot, time.monotonic() - start) if q is None else q
                viewer.show(at, X_WB=standing(viewer, at) if robot.floating else None)
                shown += 1
                time.sleep(1 / FRAMES)
        return Outcome(
            (f"{shown} pictures of {robot.name}",), {"robot": robot.name, "url": viewer.url, "frames": shown}
        )


def standing(viewer: Viewer, q: torch.Tensor) -> torch.Tensor:
    """Pose [8] of a floating base that stands upright on the lowest point of the robot."""
    lowest = float(viewer.skeleton.ends(q)[..., 2].min())
    return dq.from_pose(torch.tensor([1.0, 0.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, -lowest]))


def swaying(robot: Robot, t: float) -> torch.Tensor:
    """Positions [n] at a time [s]: one joint after the other leaves the middle of its room and comes back."""
    lower, upper = room(robot)
    q = (lower + upper) / 2
    if robot.n:
        joint, phase = int(t / PERIOD) % robot.n, 2 * math.pi * (t % PERIOD) / PERIOD
        q[joint] += SWAY * (upper - lower)[joint] * math.sin(phase)
    return q
