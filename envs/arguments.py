"""Arguments of environments, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import torch
from gymnasium.vector import AutoresetMode
from torch import Tensor

from torchdq.base.checks import require_tensor
from torchdq.envs.tasks import EpisodeTask, Reach, Track
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.posed import GEOMETRY
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.model import batches
from torchdq.robot.shipped import ROBOTS, load
from torchdq.scene.scene import Scene

MEMORY = "memory"  # name of the rows that effects remember
COUNTS = ("steps", "counter")  # entries of a saved state that count from 0
METHODS = ("inputs", "draws", "start", "bounds", "rows")  # every task has them
TASKS: dict[str, EpisodeTask] = {"reach": Reach(), "track": Track()}


def autoreset_of(mode: AutoresetMode | str) -> AutoresetMode:
    """Autoreset mode, by itself, by its value or by its name."""
    for member in AutoresetMode:
        if mode is member or (isinstance(mode, str) and mode in (member.value, member.name)):
            return member
    known = ", ".join(f"{member.name!r} or {member.value!r}" for member in AutoresetMode)
    raise ArgumentError(f"autoreset_mode must be one of {known}, or a gymnasium.vector.AutoresetMode, found {mode!r}")


def task_of(task: str | EpisodeTask) -> EpisodeTask:
    """Task, by its name or by itself."""
    if isinstance(task, str):
        if task not in TASKS:
            raise UnknownNameError("task", task, TASKS)
        return TASKS[task]
    if isinstance(task, type) or not all(callable(getattr(task, name, None)) for name in METHODS):
        raise ArgumentError(
            f"task must be the name of one or an object with the methods {', '.join(METHODS)}, like those of "
            f"torchdq.envs.tasks, found {task!r}"
            + (f"; {task.__name__} is a class, call it" if isinstance(task, type) else "")
        )
    known: set[str] = {field.name for field in fields(task)} if is_dataclass(task) else set()
    unknown = [name for name in getattr(task, "__dict__", {}) if name not in known]
    if unknown:
        raise ArgumentError(
            f"task has the attributes {', '.join(unknown)}, which are no fields, so tasks that differ in them would "
            f"share a program; make {type(task).__name__} a dataclass(frozen=True) with these fields"
        )
    try:
        hash(task)
    except TypeError as error:
        raise ArgumentError(
            f"task must be hashable, found {task!r}; make {type(task).__name__} a dataclass(frozen=True) whose fields "
            f"are hashable"
        ) from error
    return task


def robot_of(robot: str | Path | Robot) -> Robot:
    """Robot with one geometry: a shipped one by its name, one of a URDF file, or itself."""
    if isinstance(robot, str) and robot in ROBOTS:
        robot = load(robot)
    elif isinstance(robot, str) and not robot.lstrip().startswith("<") and Path(robot).suffix == "":
        raise UnknownNameError("shipped robot", robot, ROBOTS)
    found = robot if isinstance(robot, Robot) else Robot.from_urdf(robot)
    if found.floating:
        raise ArgumentError(
            f"robot {found.name!r} must have a fixed base in environments, found a free one, which a Scene can step"
        )
    for name in (*GEOMETRY, "home"):
        x = getattr(found, name)
        if x is not None and x.ndim > len(SHAPES[name]):
            raise ArgumentError(f"{name} of robot {found.name!r} has batch axes; environments need one geometry")
    if any(x.ndim > 1 for x in found.limits):
        raise ArgumentError(
            f"limits of robot {found.name!r} have batch axes; environments need one set of limits, which scales "
            "actions and observations: give one by robot.replace(limits=...), or make environments for each robot"
        )
    return found


def check_scene(scene: Scene, num_envs: int) -> None:
    """Raise if an effect takes an input that an environment cannot supply, or has another number of rows."""
    for field, batch in batches(scene.robot).items():
        if batch not in ((1,), (num_envs,)):
            raise ArgumentError(
                f"{field} of robot {scene.robot.name!r} must be one for all or have {num_envs} rows, found the batch "
                f"axes {batch}"
            )
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


def saved(rows: Mapping[str, Tensor], scene: Scene) -> dict[str, Tensor]:
    """Rows as they are saved: what effects remember is named after them, so that no others take it for theirs."""
    owners = ", ".join(type(effect).__name__ for effect in scene.effects if effect.memory(scene.n))
    return {f"{MEMORY} of {owners}" if name == MEMORY else name: x for name, x in rows.items()}


def state_of(state: Mapping[str, Tensor], blank: Mapping[str, Tensor], scene: Scene) -> dict[str, Tensor]:
    """Rows of a saved state; raises unless it has the names, dtypes and shapes of a blank one, and is finite."""
    own = saved(blank, scene)
    if not isinstance(state, Mapping):
        raise ArgumentError(f"state must be a dict of tensors, from get_state(), found {type(state).__name__}")
    if set(state) != set(own):
        raise ArgumentError(
            f"state must have the entries {sorted(own)}, found {sorted(map(str, state))}; was it saved by an "
            "environment with other effects?"
        )
    for name, x in state.items():
        label, like = f"state[{name!r}]", own[name]
        require_tensor(label, x)
        if x.shape != like.shape or x.dtype != like.dtype:
            raise ArgumentError(
                f"{label} must be {like.dtype} of shape {tuple(like.shape)}, found {x.dtype} of shape "
                f"{tuple(x.shape)}; was it saved by an environment with other arguments?"
            )
        wrong = x.isnan() if "." in name else ~x.isfinite()  # a parameter may be an infinite limit
        if len(bad := wrong.nonzero()):
            found = x[tuple(bad[0])].item()
            raise ArgumentError(f"{label} must be finite, found {found} in row {bad[0, 0].item()}")
        if name in COUNTS and bool((x < 0).any()):
            raise ArgumentError(f"{label} must not be negative, found {x.min().item()}")
    return {name: state[key] for name, key in zip(blank, own, strict=True)}


def reset_mask_of(mask: Any, num_envs: int, device: torch.device, looks: bool) -> Tensor | None:
    """Mask [N] of the rows to reset; None: all of them. Raises if it has none and the host `looks` at it."""
    if mask is None:
        return None
    mask = torch.as_tensor(mask, device=device)
    if mask.dtype != torch.bool or mask.shape != (num_envs,):
        raise ArgumentError(
            f"reset_mask must be a bool of shape ({num_envs},), found {mask.dtype} of {tuple(mask.shape)}"
        )
    if looks and not bool(mask.any()):
        raise ArgumentError("reset_mask must be true in at least one row, found none; do not call reset then")
    return mask
