"""A block of steps as one call: policy, step and the start of new episodes, recorded one after the other.

    observation, weights -> action and inputs of the scene -> step with the task -> end of the episode

Everything random is drawn before: the noise of actions and sensors, and for every row the next episode and the next
push. The result "used" counts those taken, since a block holds only as far as no row needs a second one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from torchdq.backends.call import Computation, Shape
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.dq.components import form
from torchdq.dynamics.posed import Row
from torchdq.envs.actions import Kind
from torchdq.envs.pose_actions import PoseActions
from torchdq.envs.pushes import recorded
from torchdq.envs.reset import KEPT
from torchdq.envs.tasks import STATE
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import at_least, clip, maximum, select
from torchdq.program.loop import Chain, Link
from torchdq.program.program import Argument, Program, record
from torchdq.scene.policies import NetworkForm
from torchdq.scene.recording import Stage
from torchdq.scene.spec import Rows

# before the names of rows: of the next episode, of the next push; of the policy; to and from the step; of the task
NEXT, SPARE, WEIGHT, GIVEN, AFTER, INFO = "next ", "spare ", "weight ", "given ", "after ", "info "
FLAGS = ("failed", "ended", "truncated")  # results of every step
WORST = -1000.0  # reward of a step that failed, worse than any episode


class _BlockFields(NamedTuple):
    """Fields of `Block`."""

    stage: Stage  # the step, with the task
    network: NetworkForm  # policy
    kind: Kind  # meaning of the actions
    joints: tuple[int, ...]  # that they move
    pose: PoseActions | None  # that they displace instead
    pushes: tuple[str, ...]  # inputs that are pushes
    carried: tuple[str, ...]  # rows that a new episode replaces
    asked: tuple[str, ...]  # arguments of the step, in its order
    own: tuple[tuple[str, Shape], ...]  # trailing axes of all arguments but the scene's parameters


class Block(_BlockFields, Computation):
    """A step of environments and of their policy, as a computation of `torchdq.backends.call`.

    Arguments are those of the step; of every `carried` one also the next episode's, "next ...", and of every push the
    one that follows, "spare ...".
    """

    def axes(self, name: str) -> Shape:
        """Trailing axes of an argument."""
        return dict(self.own)[name] if name in dict(self.own) else self.stage.axes(name)

    def shared(self, name: str) -> bool:
        """True for a parameter, a weight, and numbers of the environments."""
        return name in ("scale", "unit", "limit") or name.startswith(WEIGHT) or self.stage.shared(name)

    def results(self, program: Program) -> tuple[Shape, ...]:
        """Trailing axes of the results: none of flags and numbers of the task."""
        rows = {"action": (self.number,), "final": self.axes("observation")} | dict(self.own)
        sizes = [(name, len(values)) for name, values, _ in program.results]
        return tuple([rows.get(name, () if size == 1 else (size,)) for name, size in sizes])

    @property
    def number(self) -> int:
        """Number of actions."""
        return len(self.joints if self.pose is None else self.pose.names)

    def program(self, arguments: tuple[Argument, ...]) -> Any:
        """Chain of policy, step and end."""
        return _chain(self, arguments)

    # --- links ---

    def act(self, rows: Mapping[str, Row]) -> Rows:
        """Actions of the policy, the inputs of the step, and what they change: pushes, and whether one is over."""
        weights = {name.removeprefix(WEIGHT): row for name, row in rows.items() if name.startswith(WEIGHT)}
        output, (unit,) = self.network.recorded(rows["observation"], weights), rows["unit"]
        if len(output) != self.number:
            raise ArgumentError(f"policy must return {self.number} numbers, one per action, found {len(output)}")
        noise = rows.get("noise of actions", [0.0] * len(output))
        found: Rows = {"action": [unit * (x + y) for x, y in zip(output, noise, strict=True)]}
        dt = self.stage.spec.dt
        action: Row = [clip(x, -1.0, 1.0) for x in found["action"]]
        if self.pose is None:
            action, meant = self._of_joints(action, rows)
        else:
            X = self.pose.moved(form(rows["reference"]), action, rows["scale"])
            meant = {"reference": [*X[0], *X[1], *[0.0] * self.pose.still]}
        before, after = (maximum(k * dt, 0.0) for k in (rows["steps"][0], rows["steps"][0] + 1.0))
        found |= {GIVEN + name: row for name, row in meant.items()}
        found |= {GIVEN + "action": action, GIVEN + "time": [after], "over": []}
        for name in self.pushes:
            found[GIVEN + name], found[AFTER + name], over = recorded(before, rows[name], rows[SPARE + name])
            found["over"] = [*found["over"], over]
        return found

    def _of_joints(self, actions: Row, rows: Mapping[str, Row]) -> tuple[Row, Rows]:
        """Actions of all joints, and what they mean as an input of the scene."""
        n, reference = self.stage.spec.robot.n, rows["reference"]
        action: list = [0.0] * n
        for joint, x in zip(self.joints, actions, strict=True):
            action[joint] = x
        # bounded once more, since a compiler may contract a product with a sum that follows
        scaled = [clip(s * x, -s, s) for s, x in zip(rows["scale"], action, strict=True)]
        moved = [a + b for a, b in zip(reference[:n], scaled, strict=True)]
        meant = {"target": {"target": moved}, "reference": {"reference": [*moved, *reference[n:]]}}
        return action, meant.get(self.kind, {"torque": scaled})

    def end(self, rows: Mapping[str, Row]) -> Rows:
        """Ends of episodes, the task's rows, and what is carried to the next step, in new episodes if those ended."""
        task = {x.removeprefix(AFTER): row for x, row in rows.items() if x.startswith(AFTER)}
        now = {name: task.pop(name, rows[name]) for name in self.carried}
        (steps,), (limit,), (valid,) = rows["steps"], rows["limit"], task.pop("valid")
        failed = 1.0 - at_least(valid, 1.0)  # where that is NaN, too
        ended = maximum(failed, select(task.pop("terminated", [0.0])[0], 1.0, 0.0))
        truncated = at_least(steps + 1.0, limit)
        done = maximum(ended, truncated)
        for name in self.carried:
            if name in (*STATE, *KEPT):
                now[name] = [select(failed, a, b) for a, b in zip(rows[name], now[name], strict=True)]
        found: Rows = {"reward": [select(failed, WORST, *task.pop("reward"))], "final": now["observation"]}
        found |= {INFO + x: [select(failed, math.nan, y) for y in row] for x, row in task.items()}
        found |= {x: [select(done, a, b) for a, b in zip(rows[NEXT + x], now[x], strict=True)] for x in self.carried}
        found["steps"] = [select(done, 0.0, steps + 1.0)]
        found["used"] = [a + b for a, b in zip(rows["used"], [done, *rows["over"]], strict=True)]
        return found | {"failed": [failed], "ended": [ended], "truncated": [truncated]}


@remembered(PROGRAMS)
def _chain(what: Block, arguments: tuple[Argument, ...]) -> Chain:
    """Chain of a block; its step is the very program of a step."""
    known = {a.name: a for a in arguments}

    def link(name: str, algorithm: Callable[[Mapping[str, Row]], Rows]) -> Link:
        takes = tuple(known)
        return linked(
            record(name, tuple(known.values()), lambda *x: algorithm(dict(zip(takes, x, strict=True)))), takes
        )

    def linked(program: Program, takes: tuple[str, ...], prefix: str = "") -> Link:
        gives = tuple([prefix + r.name for r in program.results])
        known.update({x: Argument(x, len(r.values)) for x, r in zip(gives, program.results, strict=True)})
        return Link(program, takes, gives)

    act = link("act", what.act)
    sized = [Argument(x, math.prod(what.stage.axes(x)), x in known and known[x].uniform) for x in what.asked]
    program = what.stage.program(tuple(sized))
    step = linked(program, tuple([GIVEN + x if GIVEN + x in known else x for x in what.asked]), AFTER)
    end = link("end", what.end)
    return Chain(f"block_{program.name}", arguments, (act, step, end), ("action", *end.gives))
