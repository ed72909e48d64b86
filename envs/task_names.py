"""Tasks by the names under which environments take them."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

from torchdq.envs.manipulation import Lift, Pick, Push
from torchdq.envs.tasks import EpisodeTask, Reach, Track
from torchdq.envs.walk import Walk
from torchdq.envs.wipe import Wipe
from torchdq.errors import ArgumentError, UnknownNameError

TASKS: dict[str, EpisodeTask] = {"reach": Reach(), "track": Track(), "walk": Walk(), "wipe": Wipe()}
TASKS |= {"push": Push(), "lift": Lift(), "pick": Pick()}


def task_of(task: str | EpisodeTask) -> EpisodeTask:
    """Task, by its name or by itself."""
    if isinstance(task, str):
        if task not in TASKS:
            raise UnknownNameError("task", task, TASKS)
        return TASKS[task]
    if isinstance(task, type) or not hasattr(task, "rows"):
        raise ArgumentError(
            f"task must be the name of one or an object like those of torchdq.envs.tasks, found {task!r}"
            + (f"; {task.__name__} is a class, call it" if isinstance(task, type) else "")
        )
    known: set[str] = {entry.name for entry in fields(task)} if is_dataclass(task) else set()
    if unknown := getattr(task, "__dict__", {}).keys() - known:
        raise ArgumentError(
            f"task has the attributes {', '.join(unknown)}, which are not fields, so tasks that differ in them would "
            f"share a program; make {type(task).__name__} a dataclass(frozen=True) with these fields"
        )
    return task
