"""Arguments of environments, checked."""

from __future__ import annotations

from pathlib import Path

from gymnasium.vector import AutoresetMode

from torchdq.envs.scene import Scene
from torchdq.envs.tasks import EpisodeTask, Reach, Track
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot import Robot
from torchdq.robot.posed import GEOMETRY
from torchdq.robot.robot import SHAPES
from torchdq.robot.shipped import ROBOTS, load

TASKS: dict[str, EpisodeTask] = {"reach": Reach(), "track": Track()}


def autoreset_of(mode: AutoresetMode | str) -> AutoresetMode:
    """Autoreset mode, by itself or by its value."""
    if mode not in {name for member in AutoresetMode for name in (member, member.value)}:
        raise ArgumentError(f"autoreset_mode must be one of {[*AutoresetMode]}, found {mode!r}")
    return AutoresetMode(mode)


def task_of(task: str | EpisodeTask) -> EpisodeTask:
    """Task, by its name or by itself."""
    if isinstance(task, str):
        if task not in TASKS:
            raise UnknownNameError("task", task, TASKS)
        return TASKS[task]
    if not callable(getattr(task, "start", None)):
        raise ArgumentError(f"task must be the name of one or like those of torchdq.envs.tasks, found {task!r}")
    return task


def robot_of(robot: str | Path | Robot) -> Robot:
    """Robot with one geometry: a shipped one by its name, one of a URDF file, or itself."""
    if isinstance(robot, str) and robot in ROBOTS:
        robot = load(robot)
    elif isinstance(robot, str) and not robot.lstrip().startswith("<") and Path(robot).suffix == "":
        raise UnknownNameError("shipped robot", robot, ROBOTS)
    found = robot if isinstance(robot, Robot) else Robot.from_urdf(robot)
    for name in (*GEOMETRY, "home"):
        x = getattr(found, name)
        if x is not None and x.ndim > len(SHAPES[name]):
            raise ArgumentError(f"{name} of robot {found.name!r} has batch axes; environments need one geometry")
    return found


def check_scene(scene: Scene, num_envs: int) -> None:
    """Raise if an effect takes an input that an environment cannot supply, or has another number of rows."""
    for effect in scene.effects:
        name = type(effect).__name__
        for wanted in effect.inputs(scene.n):
            raise ArgumentError(
                f"effects: {name} takes the input {wanted!r}, which an environment cannot supply; leave it out"
            )
        for parameter, x in effect.tensors().items():
            batch = tuple(x.shape[: x.ndim - len(effect.SHAPES[parameter])])
            if batch not in ((), (1,), (num_envs,)):
                raise ArgumentError(
                    f"{parameter} of {name} must be one for all or have {num_envs} rows, found the batch axes {batch}"
                )
