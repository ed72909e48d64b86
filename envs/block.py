"""A block of steps as one call: policy, step and the start of new episodes, recorded one after the other.

    observation, weights -> action -> inputs of the scene -> step with the task -> end of the episode

Everything random is drawn before: the noise of actions and sensors, and for every row the next episode and the next
push. The result "short" says where a row would need a second one within a block.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from torchdq.backends.call import Computation, Shape
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.dynamics.posed import Row
from torchdq.envs.actions import Kind
from torchdq.envs.pushes import WIDTH, Pushes
from torchdq.envs.reset import KEPT
from torchdq.envs.tasks import STATE
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import at_least, clip, maximum, minimum, select
from torchdq.program.loop import Chain, Link
from torchdq.program.program import Argument, Program, record
from torchdq.scene.policies import NetworkForm
from torchdq.scene.recording import Stage
from torchdq.scene.spec import Rows

NEXT, DRAWN, SPARE, WEIGHT, AFTER = "next ", "drawn ", "spare ", "weight ", "after "  # before the names of rows
FLAGS = ("failed", "ended", "truncated", "short")  # results of every step


class _BlockFields(NamedTuple):
    """Fields of `Block`."""

    stage: Stage  # the step, with the task
    width: int  # of an observation
    network: NetworkForm  # policy
    kind: Kind  # meaning of the actions
    joints: tuple[int, ...]  # that they move
    pushes: tuple[tuple[str, Pushes], ...]
    carried: tuple[str, ...]  # rows that a new episode replaces
    asked: tuple[str, ...]  # arguments of the step, in its order


class Block(_BlockFields, Computation):
    """A step of environments and of their policy, as a computation of `torchdq.backends.call`.

    Arguments are those of the step; of every `carried` one also the next episode's, "next ...", and of every push that
    which is drawn, "drawn ...", and the one that follows, "spare ...".
    """

    def axes(self, name: str) -> Shape:
        """Trailing axes of an argument or result."""
        n, k, plain = self.stage.spec.robot.n, len(self.joints), name.removeprefix(NEXT)
        if name.startswith(WEIGHT):
            return self.network.axes(n, {})[name.removeprefix(WEIGHT)]
        own = {"observation": self.width, "final": self.width, "reference": 3 * n, "scale": n, "action": k}
        own |= {"noise of actions": k, "steps": 1, "limit": 1, "unit": 1, "used": 1 + len(self.pushes)}
        own |= {kind + name: WIDTH for name, _ in self.pushes for kind in (DRAWN, SPARE)}
        return (own[plain],) if plain in own else self.stage.axes(plain)

    def shared(self, name: str) -> bool:
        """True for a parameter, a weight, and numbers of the environments."""
        return name in ("scale", "unit", "limit") or name.startswith(WEIGHT) or self.stage.shared(name)

    def results(self, program: Program) -> tuple[Shape, ...]:
        """Trailing axes of the results."""
        found = []
        for name, values, _ in program.results:
            task = name.startswith(AFTER)
            number = name in FLAGS or (task and len(values) == 1)
            found.append(() if number else (len(values),) if task else self.axes(name))
        return tuple(found)

    def program(self, arguments: tuple[Argument, ...]) -> Any:
        """Chain of policy, commands, step and end."""
        return _chain(self, arguments)

    # --- links ---

    def act(self, rows: Mapping[str, Row]) -> Rows:
        """Actions of the policy."""
        weights = {name.removeprefix(WEIGHT): row for name, row in rows.items() if name.startswith(WEIGHT)}
        found = self.network.recorded(rows["observation"], weights)
        if len(found) != len(self.joints):
            raise ArgumentError(f"policy must return {len(self.joints)} numbers, one per action, found {len(found)}")
        noise, (unit,) = rows.get("noise of actions", [0.0] * len(found)), rows["unit"]
        return {"action": [unit * (x + y) for x, y in zip(found, noise, strict=True)]}

    def command(self, rows: Mapping[str, Row]) -> Rows:
        """Inputs of the step, and what they change: pushes, and whether those drawn ahead were taken."""
        n, reference, dt = self.stage.spec.robot.n, rows["reference"], self.stage.spec.dt
        action: list = [0.0] * n
        for joint, x in zip(self.joints, rows["action"], strict=True):
            action[joint] = clip(x, -1.0, 1.0)
        # bounded once more, since a compiler may contract a product with a sum that follows
        scaled = [clip(s * x, -s, s) for s, x in zip(rows["scale"], action, strict=True)]
        before, after = (maximum(k * dt, 0.0) for k in (rows["steps"][0], rows["steps"][0] + 1.0))
        found: Rows = {"clipped": action, "time": [after], "torque": scaled}
        if self.kind in ("target", "reference"):
            moved = [a + b for a, b in zip(reference[:n], scaled, strict=True)]
            found |= {"target": moved, "commanded": [*moved, *reference[n:]]}
        else:
            found["commanded"] = reference
        taken = []
        for name, pushes in self.pushes:
            now, push, over = pushes.recorded(before, rows[DRAWN + name], rows[SPARE + name])
            found |= {name: now, AFTER + DRAWN + name: push}
            taken.append(over)
        return found | ({"taken": taken} if taken else {})

    def end(self, rows: Mapping[str, Row]) -> Rows:
        """Ends of episodes, and what is carried to the next step, in new episodes if those have ended."""
        failed = 1.0 - at_least(rows["after valid"][0], 1.0)  # where that is NaN, too
        (steps,), used = rows["steps"], rows["used"]
        ended = maximum(failed, select(rows["after terminated"][0], 1.0, 0.0)) if "after terminated" in rows else failed
        truncated = at_least(steps + 1.0, rows["limit"][0])
        done = maximum(ended, truncated)
        needed = [done, *rows.get("taken", ())]
        short = 0.0
        for a, b in zip(needed, used, strict=True):
            short = maximum(short, minimum(a, b))
        found: Rows = {}
        for name in self.carried:
            now = rows.get(AFTER + name, rows[name])
            if name in (*STATE, *KEPT):
                now = [select(failed, a, b) for a, b in zip(rows[name], now, strict=True)]
            if name == "observation":
                found["final"] = now
            found[name] = [select(done, a, b) for a, b in zip(rows[NEXT + name], now, strict=True)]
        found["steps"] = [select(done, 0.0, steps + 1.0)]
        found["used"] = [maximum(a, b) for a, b in zip(needed, used, strict=True)]
        return found | {"failed": [failed], "ended": [ended], "truncated": [truncated], "short": [short]}


@remembered(PROGRAMS)
def _chain(what: Block, arguments: tuple[Argument, ...]) -> Chain:
    """Chain of a block; its step is the very program of a step."""
    known = {a.name: a for a in arguments}
    pushes = [name for name, _ in what.pushes]

    def link(name: str, algorithm: Callable[[Mapping[str, Row]], Rows], *names: str) -> Link:
        taken = [known[x] for x in names if x in known]
        rows = [a.name for a in taken]
        program = record(name, taken, lambda *x: algorithm(dict(zip(rows, x, strict=True))))
        gives = tuple([r.name for r in program.results])
        known.update({r.name: Argument(r.name, len(r.values)) for r in program.results})
        return Link(program, tuple(rows), gives)

    weights = [x for x in known if x.startswith(WEIGHT)]
    act = link("policy", what.act, "observation", "noise of actions", "unit", *weights)
    pushed = [kind + name for name in pushes for kind in (DRAWN, SPARE)]
    command = link("command", what.command, "action", "reference", "steps", "scale", *pushed)
    sized = [Argument(x, math.prod(what.stage.axes(x)), x in known and known[x].uniform) for x in what.asked]
    program = what.stage.program(tuple(sized))
    given = {"reference": "commanded", "action": "clipped"}
    gives = tuple([AFTER + r.name for r in program.results])
    step = Link(program, tuple([given.get(x, x) for x in what.asked]), gives)
    known.update({x: Argument(x, len(r.values)) for x, r in zip(gives, program.results, strict=True)})
    own = [AFTER + x for x in (*what.carried, "valid", "terminated")]
    after = [NEXT + x for x in what.carried]
    end = link("end", what.end, *what.carried, *after, *own, "steps", "limit", "used", "taken")
    rows = [x for x in gives if x not in own]
    wanted = (*what.carried, "steps", "used", "action", "final", *FLAGS, *rows)
    return Chain(f"block_{program.name}", arguments, (act, command, step, end), wanted)
