"""How episodes begin: start, goal, parameters and first observation, drawn from the environments' own random numbers.

At the beginning of an episode only sensors act, so that what it takes does not depend on what else is simulated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchdq.backends.choice import choose
from torchdq.backends.run import run
from torchdq.caches import PROGRAMS, remembered
from torchdq.envs.randomization import Varied
from torchdq.envs.recording import Task
from torchdq.envs.rng import Streams
from torchdq.envs.scene import Scene
from torchdq.envs.tasks import EpisodeTask
from torchdq.program.program import Argument, Program, record
from torchdq.robot import Robot
from torchdq.robot.robot import SHAPES, arguments


@dataclass(frozen=True, eq=False)
class Beginning:
    """How the episodes of a scene and a task begin.

    Args:
        scene: its sensors are the last of its effects.
        task: of the episodes.
        watched: what is observed of it.
        varied: parameters of the scene that are drawn as well.
    """

    scene: Scene
    task: EpisodeTask
    watched: Task
    varied: tuple[Varied, ...]
    others: Scene = field(init=False, repr=False)  # the scene without sensors
    senses: Scene = field(init=False, repr=False)  # the scene with nothing else

    def __post_init__(self) -> None:
        bare = self.scene.replace(controller=None)
        others = [effect for effect in bare.effects if effect.SLOT != "sensor"]
        object.__setattr__(self, "others", bare.replace(effects=others))
        object.__setattr__(self, "senses", bare.replace(effects=bare.effects[len(others) :]))

    def __call__(self, rows: Tensor, streams: Streams, dtype: torch.dtype) -> dict[str, Tensor]:
        """Everything of a new episode in some rows, by name, shape [k, ...]; parameters are written into the scene.

        Args:
            rows: numbers of the rows [k].
            streams: of those rows.
            dtype: of the numbers.
        """
        widths = [self.task.draws(self.scene.robot), *[v.width for v in self.varied], self.scene.noises]
        u, streams = streams.uniform(sum(widths), dtype)
        u, *drawn, noise = u.split(widths, 1)
        for v, x in zip(self.varied, drawn, strict=True):
            v.draw(self.scene, rows, x)
        program = _program(self.task, self.scene.robot)
        outputs = run(program, [u], choose(self.scene.backend, u.device))
        fresh = {result.name: x for result, x in zip(program.results, outputs, strict=True)}
        steps = rows.new_zeros(len(rows), dtype=torch.int32)
        fresh.update(streams._asdict(), steps=steps, finished=steps.to(torch.bool))
        return fresh | self._sensed(rows, fresh, noise)

    def _sensed(self, rows: Tensor, fresh: dict[str, Tensor], noise: Tensor) -> dict[str, Tensor]:
        """What is remembered, read and observed at the start."""
        senses = _of_rows(self.senses, rows)
        state, seen = senses.begin(fresh["q"], fresh["qd"], asked(self.task, fresh, senses), noise, self.watched)
        found = {"observation": seen["observation"], "reference": seen["reference"]}
        if state.reading is not None:
            found["reading"] = state.reading
        # what sensors remember stands behind what the others do
        memories = [x for x in (self._remembered(*state[:2]), state.memory) if x is not None]
        return found | ({"memory": torch.cat(memories, 1)} if memories else {})

    def _remembered(self, q: Tensor, qd: Tensor) -> Tensor | None:
        """What the effects other than sensors remember."""
        if any(effect.memory(self.scene.n) for effect in self.others.effects):
            return self.others.start(q, qd).memory
        return None


def asked(task: Task, now: Mapping[str, Tensor], scene: Scene, action: Tensor | None = None) -> dict[str, Tensor]:
    """What a task asks for beside the state: goal [N, ...], time [N, 1] and action [N, n]; no action: none yet."""
    wanted = task.inputs(scene.n)
    given = {"goal": now["goal"]}
    if "time" in wanted:
        given["time"] = (now["steps"].to(now["goal"].dtype) * scene.dt)[:, None]
    if "action" in wanted and action is not None:
        given["action"] = action
    return given


def _of_rows(scene: Scene, rows: Tensor) -> Scene:
    """A scene with some rows of whatever differs from row to row."""
    changed = {}
    for name in arguments(scene.robot):
        x = getattr(scene.robot, name)
        if x.ndim > len(SHAPES[name]):
            changed[name] = x[rows]
    effects = []
    for effect in scene.effects:
        batched = {name: x[rows] for name, x in effect.tensors().items() if x.ndim > len(effect.SHAPES[name])}
        effects.append(replace(effect, **batched) if batched else effect)
    if not changed and all(a is b for a, b in zip(effects, scene.effects, strict=True)):
        return scene
    return scene.replace(robot=scene.robot.replace(**changed) if changed else scene.robot, effects=effects)


@remembered(PROGRAMS)
def _program(task: EpisodeTask, robot: Robot) -> Program:
    """Program of start and goal."""
    argument = Argument("u", task.draws(robot))
    return record(f"{type(task).__name__.lower()}_{robot.name}", [argument], lambda u: task.start(robot, u))
