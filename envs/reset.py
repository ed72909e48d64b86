"""Reset: start, goal, parameters and first observation of episodes, drawn from the environments' own random numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchdq.backends.choice import BackendName, choose
from torchdq.backends.precision import run
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.closures import held_velocities
from torchdq.envs.loops import Loops
from torchdq.envs.pushes import DRAWS, Pushes
from torchdq.envs.randomization import Randomised
from torchdq.envs.rng import Streams, ranged, seeded
from torchdq.envs.row_selection import Host, Masked, SomeRows
from torchdq.envs.tasks import Checked
from torchdq.envs.torch_task import Functions, require_finite_start
from torchdq.program.program import Argument, Program, record
from torchdq.robot import Robot
from torchdq.scene.defaults import mean_robot
from torchdq.scene.recording import Stage
from torchdq.scene.scene import Scene
from torchdq.scene.spec import OBJECTS

KEPT = ("observation", "reference", "carry")  # rows of a task that an environment keeps from step to step
SPARE = "spare "  # before the name of a push: that which follows it, drawn ahead
STARTS, NOISE, PUSHED = 0, 1, 2  # columns of the streams: of starts, noise of sensors, and pushes, one for each input


@dataclass(eq=False)
class Reset:
    """Random start of the episodes of a scene and a task."""

    scene: Scene
    checked: Checked  # the task, with the check of its numbers
    randomised: tuple[Randomised, ...]  # parameters of the scene that are drawn as well
    pushes: Mapping[str, Pushes]  # inputs that are drawn as well
    functions: Functions | None  # functions of tensors that replace parts of the task; None: there are none
    dtype: torch.dtype  # of what is drawn
    loops: Loops | None = None  # closed loops of the robot; None: it has none

    def __post_init__(self) -> None:
        scene = self.scene
        acting = [x for x in scene.effects if x.SLOT in ("sensor", "body") or x.memory(scene.n)]  # seen at a start
        self.opening, self.robot = scene.replace(effects=acting, controller=None), mean_robot(scene.robot)

    @property
    def drawn(self) -> dict[str, Tensor]:
        """The scene's own tensors that are drawn for every episode."""
        return {f"{i}.{name}": x for r in self.randomised for (i, name), x in r.tensors(self.scene).items()}

    def __call__(self, rows: SomeRows, streams: Streams) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Buffers of new episodes and rows of the task at their start, by name, shape [k, ...].

        Drawn parameters are written into the scene.

        Args:
            rows: the environments.
            streams: random numbers of those environments.
        """
        task, own, looks = self.checked.task, self.functions, not isinstance(rows, Masked)
        draws = [task.draws(self.robot), 0 if own is None else own.task.draws]
        widths = [*draws, *[r.width for r in self.randomised], *[DRAWS] * len(self.pushes), self.scene.noises]
        u, after = streams.column(STARTS).uniform(sum(widths), self.dtype)
        u, u_own, *drawn, noise = u.split(widths, 1)
        begun, drawn = drawn[len(self.randomised) :], drawn[: len(self.randomised)]
        for parameters, x in zip(self.randomised, drawn, strict=True):
            parameters.draw(self.scene, rows, x)
        fresh = started(self.checked, own, self.robot, (u, u_own), self.scene.backend, looks)
        if self.loops is not None:
            there = [fresh.pop("there")] if "there" in fresh else []
            fresh["q"], *there = self.loops.closed(torch.cat([fresh["q"], *there])).split(len(u))
            fresh["qd"] = held_velocities(self.loops.robot, fresh["q"], fresh["qd"], self.scene.backend)
            if there:
                aim = _aim(self.checked, self.robot)
                (fresh["goal"],) = run(aim, there, choose(self.scene.backend, u.device))
        steps = u.new_zeros(len(u))
        fresh.update(streams.with_column(STARTS, after)._asdict(), steps=steps, finished=steps.to(torch.bool))
        for (name, pushes), x in zip(self.pushes.items(), begun, strict=True):
            fresh[name] = pushes.drawn(x)
        opening, wanted = _of_rows(self.opening, rows), task.inputs(self.scene.n)
        given = {"goal": fresh["goal"]} | ({"time": steps[:, None]} if "time" in wanted else {})
        moved = {name: fresh[name] for name in self.scene.spec.moving}
        state, seen = opening._begin(moved, given, noise, self.checked)
        if own is not None:
            now = own.now(state, fresh["goal"], steps, seen, scene=lambda: _of_rows(self.scene, rows))
            seen["observation"] = own.observed(now)
            if looks:
                require_finite_start("observation", seen["observation"])
        return fresh | state.rows() | {name: seen.pop(name) for name in KEPT if name in seen}, seen

    def with_spares(self, buffers: Mapping[str, Tensor], masks: Sequence[Tensor], host: Host) -> dict[str, Tensor]:
        """Buffers whose spare pushes are drawn in the rows of a mask [N] for each input, at first in all of them."""
        found, streams = dict(buffers), Streams.of(buffers)
        for k, ((name, pushes), mask) in enumerate(zip(self.pushes.items(), masks, strict=True), PUSHED):
            rows, stream = host.some(mask), streams.column(k)
            u, after = stream.rows(rows).uniform(DRAWS, self.dtype)
            spare = pushes.drawn(u)
            found[SPARE + name] = rows.replaced(buffers.get(SPARE + name, spare), spare)
            streams = streams.with_column(k, stream.with_rows(rows, after))
        return {**found, **streams._asdict()}

    def streams(self, seed: int | Sequence[int], num_envs: int, device: torch.device) -> Streams:
        """Streams of a seed, or of one for every row."""
        return seeded(seed, num_envs, device).split(PUSHED + len(self.pushes))


def _of_rows(scene: Scene, rows: SomeRows) -> Scene:
    """Scene of some environments: their rows of every tensor that has one row per environment."""
    if isinstance(rows, Masked):
        return scene

    def chosen(x: Tensor, axes: int) -> Tensor:
        return rows.of(x) if x.ndim > axes and len(x) > 1 else x

    if not scene.parameters and not scene.computed:
        return scene
    found, stage = copy(scene), Stage(scene.spec, "begin")
    parameters = {name: chosen(x, len(stage.axes(name))) for name, x in scene.parameters.items()}
    effects = [
        replace(effect.of_rows(chosen), **{name: parameters[f"{i}.{name}"] for name in effect.tensors()})
        for i, effect in enumerate(scene.effects)
    ]
    parts: list[tuple[int, Any]] = [(OBJECTS - k, body) for k, body in enumerate(scene.objects)]
    objects = [
        replace(body, **{name: parameters[f"{owner}.{name}"] for name in body.tensors()}) for owner, body in parts
    ]
    for name, value in {"parameters": parameters, "effects": tuple(effects), "objects": tuple(objects)}.items():
        object.__setattr__(found, name, value)  # without the checks of a new scene, which take a millisecond
    return found


def started(
    checked: Checked,
    own: Functions | None,
    robot: Robot,
    draws: tuple[Tensor, Tensor],
    backend: BackendName | None,
    looks: bool,
) -> dict[str, Tensor]:
    """Rows of the start of a task and of its functions, of random numbers of either; `looks` as in these."""
    u, u_own = draws
    if spans := checked.task.spans():
        u = torch.cat([u[:, : -len(spans)], ranged(u[:, -len(spans) :], spans)], 1)
    program = _program(checked, robot)
    outputs = run(program, [u], choose(backend, u.device))
    fresh = {result.name: x for result, x in zip(program.results, outputs, strict=True)}
    given = {} if own is None else own.started(u_own, looks)
    if "goal" in given:
        fresh.pop("there", None)
    return fresh | given


@remembered(PROGRAMS)
def _aim(checked: Checked, robot: Robot) -> Program:
    """Program of the goal of positions at which loops are closed."""
    return record(f"aim_{robot.name}", [Argument("q", robot.n)], lambda q: {"goal": checked.task.aim(robot, q)})


@remembered(PROGRAMS)
def _program(checked: Checked, robot: Robot) -> Program:
    """Program of start and goal."""
    argument = Argument("u", checked.task.draws(robot))
    name = type(checked.task).__name__.lower()
    return record(f"{name}_{robot.name}", [argument], lambda u: checked.start(robot, u))
