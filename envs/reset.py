"""Reset: start, goal, parameters and first observation of episodes, drawn from the environments' own random numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torchdq.backends.choice import choose
from torchdq.backends.run import run
from torchdq.caches import PROGRAMS, remembered
from torchdq.envs.randomization import Randomised
from torchdq.envs.rng import Streams
from torchdq.envs.scene import Scene
from torchdq.envs.some_rows import SomeRows
from torchdq.envs.spec import Task
from torchdq.envs.tasks import Checked
from torchdq.envs.torch_task import Functions
from torchdq.program.program import Argument, Program, record
from torchdq.robot import Robot
from torchdq.robot.robot import SHAPES, arguments


@dataclass(frozen=True, eq=False)
class Reset:
    """Random start of the episodes of a scene and a task.

    Args:
        scene: the scene of the episodes.
        checked: the task of the episodes, with the check of its numbers.
        randomised: parameters of the scene that are drawn as well.
        functions: functions of tensors that replace parts of the task; None: there are none.
    """

    scene: Scene
    checked: Checked
    randomised: tuple[Randomised, ...]
    functions: Functions | None
    opening: Scene = field(init=False, repr=False)  # the scene with the effects that act at a start

    def __post_init__(self) -> None:
        acting = [e for e in self.scene.effects if e.SLOT == "sensor" or e.memory(self.scene.n)]
        object.__setattr__(self, "opening", self.scene.replace(effects=acting, controller=None))

    def __call__(self, rows: SomeRows, streams: Streams, dtype: torch.dtype) -> dict[str, Tensor]:
        """Buffers of new episodes, by name, shape [k, ...]; drawn parameters are written into the scene.

        Args:
            rows: the environments.
            streams: random numbers of those environments.
            dtype: dtype of the buffers.
        """
        task, own = self.checked.task, self.functions
        draws = [task.draws(self.scene.robot), 0 if own is None else own.task.draws]
        widths = [*draws, *[r.width for r in self.randomised], self.scene.noises]
        u, streams = streams.uniform(sum(widths), dtype)
        u, u_own, *drawn, noise = u.split(widths, 1)
        for parameters, x in zip(self.randomised, drawn, strict=True):
            parameters.draw(self.scene, rows, x)
        program = _program(self.checked, self.scene.robot)
        outputs = run(program, [u], choose(self.scene.backend, u.device))
        fresh = {result.name: x for result, x in zip(program.results, outputs, strict=True)}
        if own is not None:
            fresh.update(own.started(u_own))
        steps = torch.zeros(rows.number, dtype=torch.int32, device=u.device)
        fresh.update(streams._asdict(), steps=steps, finished=steps.to(torch.bool))
        opening = _of_rows(self.opening, rows)
        given = task_inputs(task, fresh, opening)
        state, seen = opening.begin(fresh["q"], fresh["qd"], given, noise, self.checked)
        if own is not None:
            seen["observation"] = own.first(own.now(state, fresh["goal"], steps, seen))
        return fresh | state.rows() | {"observation": seen["observation"], "reference": seen["reference"]}


def task_inputs(
    task: Task, buffers: Mapping[str, Tensor], scene: Scene, action: Tensor | None = None
) -> dict[str, Tensor]:
    """Inputs of a task, without the state: goal [N, ...], time [N, 1] and action [N, n], absent at a start."""
    wanted = task.inputs(scene.n)
    given = {"goal": buffers["goal"]}
    if "time" in wanted:
        given["time"] = (buffers["steps"].to(buffers["goal"].dtype) * scene.dt)[:, None]
    if "action" in wanted and action is not None:
        given["action"] = action
    return given


def _of_rows(scene: Scene, rows: SomeRows) -> Scene:
    """Scene of some environments: their rows of every tensor that has one row per environment."""

    def chosen(x: Tensor, axes: int) -> Tensor:
        return rows.of(x) if x.ndim > axes and len(x) > 1 else x

    tensors: dict[str, Any] = {
        name: chosen(getattr(scene.robot, name), len(SHAPES[name])) for name in arguments(scene.robot)
    }
    effects = [
        replace(effect, **{name: chosen(x, len(effect.SHAPES[name])) for name, x in effect.tensors().items()})
        for effect in scene.effects
    ]
    if not tensors and not any(effect.tensors() for effect in effects):
        return scene
    return scene.replace(robot=scene.robot.replace(**tensors) if tensors else scene.robot, effects=effects)


@remembered(PROGRAMS)
def _program(checked: Checked, robot: Robot) -> Program:
    """Program of start and goal."""
    argument = Argument("u", checked.task.draws(robot))
    name = type(checked.task).__name__.lower()
    return record(f"{name}_{robot.name}", [argument], lambda u: checked.start(robot, u))
