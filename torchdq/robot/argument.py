"""Check of the argument `robot`, which every public function shares."""

from pathlib import Path
from typing import Any

from torchdq.errors import ArgumentError
from torchdq.robot.robot import Robot


def require_robot(x: Any, name: str = "robot") -> Robot:
    """Robot x; raises, with a way to make one, if it is something else."""
    if isinstance(x, Robot):
        return x
    way = "make one with Robot.from_urdf, from_dh or from_screws"
    if isinstance(x, str | Path):
        way = "load it with Robot.from_urdf(...), or a shipped robot with torchdq.robots.load(...)"
    elif isinstance(getattr(x, "robot", None), Robot):
        way = f"{type(x).__name__} holds one as its attribute `robot`"
    raise ArgumentError(f"{name} must be a torchdq.Robot, found {type(x).__name__}; {way}")
