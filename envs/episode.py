"""Rules of an episode, each written once, on numbers of any kind.

    actions -> act -> step of the scene with the task (-> functions of a `TorchTask`) -> end -> undo -> begin

A step of environments is their chain up to `end`, as one call, or one link after the other where functions of torch are
among them; `undo` follows only if a row has failed. A rollout repeats the whole chain in one call, with a recorded
policy before it and `begin` after it. Each link is a program of its own, so that all have bitwise the same results.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from torchdq.backends.call import Computation, Shape
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.dynamics.posed import Row
from torchdq.envs.actions import Meaning
from torchdq.envs.pushes import WIDTH, pushed
from torchdq.envs.reset import KEPT, SPARE
from torchdq.envs.tasks import STATE
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import absolute, at_least, below, clip, maximum, select
from torchdq.program.loop import Chain, Link
from torchdq.program.program import Argument, Program, record
from torchdq.scene.policies import NetworkForm
from torchdq.scene.recording import Stage
from torchdq.scene.spec import Rows

WORST = -1000.0  # reward of a step that failed, worse than any episode
HELD = (*STATE, *KEPT)  # rows that a failed step leaves as they were
THEN = "then "  # before the name of a push: as it is after the step
# before names in a chain: results of act, of the step, of undo; the next episode; rows of `info`; of the policy
GIVEN, AFTER, NOW, NEXT, INFO, WEIGHT = "given ", "after ", "now ", "next ", "info ", "weight "
JUDGED = ("valid", "reward", "terminated")  # rows of the task that end takes
FLAGS = ("failed", "terminated", "truncated", "done")
STEP_FLAGS = "flags of the step"  # among the rows of a task
ROWS = (*HELD, "action", "torque", "target", "time", "over", "flags")  # that have an axis even if they are one number


class Form(NamedTuple):
    """Environments, as far as their rules depend on them."""

    meaning: Meaning
    inputs: tuple[str, ...]  # of the scene and the task
    pushes: tuple[str, ...]  # those that are pushes
    dt: float

    @property
    def takes(self) -> dict[str, Shape]:
        """Arguments of `act`, and their trailing axes."""
        k, width = len(self.meaning.names), self.meaning.reference
        found: dict[str, Shape] = {"action": (k,), "scale": (k,), "steps": ()}
        found |= {"reference": (width,)} if width else {}
        return found | {name: (WIDTH,) for push in self.pushes for name in (push, SPARE + push)}


# --- rules -----------------------------------------------------------------------------------------------------------


def act(form: Form, rows: Mapping[str, Row]) -> Rows:
    """Inputs of a step for actions, which are clipped to [-1, 1], how many were, if they are finite, and pushes."""
    (steps,), action = rows["steps"], [clip(x, -1.0, 1.0) for x in rows["action"]]
    wide, given = form.meaning.inputs(action, rows["scale"], rows.get("reference", ()))
    given |= {"action": wide, "time": [(steps + 1.0) * form.dt]}
    found: Rows = {"clipped": [sum((below(1.0, absolute(x)) for x in rows["action"]), 0.0)]}
    found["finite"] = [math.prod(below(absolute(x), math.inf) for x in rows["action"])]
    for name in form.pushes:
        given[name], found[THEN + name], over = pushed(steps * form.dt, rows[name], rows[SPARE + name])
        found["over"] = [*found.get("over", ()), over]
    return {name: row for name, row in given.items() if name in form.inputs} | found


def end(form: Form, rows: Mapping[str, Row]) -> Rows:
    """Reward, steps of the episode so far, and `FLAGS`; the row "valid" is 1, or 0 or NaN where a step failed."""
    failed, elapsed = 1.0 - at_least(rows["valid"][0], 1.0) * rows["finite"][0], rows["steps"][0] + 1.0
    ended = maximum(failed, select(rows.get("terminated", [0.0])[0], 1.0, 0.0))
    truncated = at_least(elapsed, rows["limit"][0])
    flags = [failed, ended, truncated, maximum(ended, truncated)]
    return {"reward": [select(failed, WORST, *rows["reward"])], "elapsed": [elapsed], "flags": flags}


def undo(form: Form, rows: Mapping[str, Row]) -> Rows:
    """Rows of a failed step as they were before it, "before ...", and NaN where there was none."""
    (failed, *_), none = rows[STEP_FLAGS], [math.nan]
    return {
        name: [select(failed, a, b) for a, b in zip(rows.get(f"before {name}", none * len(row)), row, strict=True)]
        for name, row in rows.items()
        if name != STEP_FLAGS and not name.startswith("before ")
    }


def begin(form: Form, rows: Mapping[str, Row]) -> Rows:
    """Rows of the next episode, "next ...", where one is done, and how many episodes and pushes were taken."""
    *_, done = rows["flags"]
    found = {
        name: [select(done, a, b) for a, b in zip(rows[NEXT + name], row, strict=True)]
        for name, row in rows.items()
        if NEXT + name in rows
    }
    used = [a + b for a, b in zip(rows["used"], [done, *rows.get("over", ())], strict=True)]
    return {**found, "steps": [select(done, 0.0, *rows["elapsed"])], "used": used}


# --- one link --------------------------------------------------------------------------------------------------------


class _RuleFields(NamedTuple):
    """Fields of `Rule`."""

    rule: Callable[[Form, Mapping[str, Row]], Rows]
    form: Form
    own: tuple[tuple[str, Shape], ...]  # trailing axes of its arguments


class Rule(_RuleFields, Computation):
    """One of the rules, as a computation of `torchdq.backends.call`."""

    def axes(self, name: str) -> Shape:
        """Trailing axes of an argument."""
        return dict(self.own)[name]

    def shared(self, name: str) -> bool:
        """True for numbers of all environments."""
        return name in ("scale", "limit")

    def results(self, program: Program) -> tuple[Shape, ...]:
        """Trailing axes of the results: none of flags and of numbers of the task."""
        sizes = [(r.name, len(r.values)) for r in program.results]
        return tuple([(size,) if size != 1 or name in ROWS else () for name, size in sizes])

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the rule."""
        return _recorded(self.rule, self.form, arguments)


@remembered(PROGRAMS)
def _recorded(rule: Callable[..., Rows], form: Form, arguments: tuple[Argument, ...]) -> Program:
    names = [a.name for a in arguments]
    return record(rule.__name__, arguments, lambda *rows: rule(form, dict(zip(names, rows, strict=True))))


# --- all of them -----------------------------------------------------------------------------------------------------


class _BlockFields(NamedTuple):
    """Fields of `Block`."""

    stage: Stage  # the step, with the task
    form: Form
    network: NetworkForm | None  # policy; None: actions are an argument, and no episode begins
    carried: tuple[str, ...]  # rows that a new episode replaces
    asked: tuple[str, ...]  # arguments of the step, in its order
    own: tuple[tuple[str, Shape], ...]  # trailing axes of all arguments but the scene's parameters


class Block(_BlockFields, Computation):
    """A step of environments, under a policy as one of `torchdq.backends.loop_call`.

    Everything random is drawn before: noise, and for every row the next episode and the next push. The result "used"
    counts those taken, since a block holds only as far as no row needs a second one.
    """

    def axes(self, name: str) -> Shape:
        """Trailing axes of an argument."""
        return dict(self.own)[name] if name in dict(self.own) else self.stage.axes(name)

    def shared(self, name: str) -> bool:
        """True for a parameter, a weight, and numbers of all environments."""
        return name in ("scale", "unit", "limit") or name.startswith(WEIGHT) or self.stage.shared(name)

    def results(self, program: Program) -> tuple[Shape, ...]:
        """Trailing axes of the results: none of flags and numbers of the task."""
        sizes = [(r.name, len(r.values)) for r in program.results]
        rows = dict(self.own) | {y + name: axes for name, axes in self.own if name in HELD for y in (AFTER, NOW)}
        rows |= {"action": (len(self.form.meaning.names),), GIVEN + "over": (len(self.form.pushes),)}
        return tuple([rows.get(name, () if size == 1 else (size,)) for name, size in sizes])

    def program(self, arguments: tuple[Argument, ...]) -> Any:
        """Chain of policy, step and rules."""
        return _chain(self, arguments)

    def policy(self, rows: Mapping[str, Row]) -> Rows:
        """Actions of the policy."""
        weights = {name.removeprefix(WEIGHT): row for name, row in rows.items() if name.startswith(WEIGHT)}
        network: Any = self.network
        output, number = network.recorded(rows["observation"], weights), len(self.form.meaning.names)
        if len(output) != number:
            raise ArgumentError(f"policy must return {number} numbers, one per action, found {len(output)}")
        noise = rows.get("noise of actions", [0.0] * len(output))
        return {"action": [rows["unit"][0] * (x + y) for x, y in zip(output, noise, strict=True)]}


@remembered(PROGRAMS)
def _chain(what: Block, arguments: tuple[Argument, ...]) -> Chain:
    """Chain of a block; its step is the very program of a step."""
    known, links = {a.name: a for a in arguments}, list[Link]()

    def add(program: Program, takes: Sequence[str], prefix: str = "", names: Mapping[str, str] | None = None) -> None:
        gives = tuple([(names or {}).get(r.name, prefix + r.name) for r in program.results])
        known.update({x: Argument(x, len(r.values)) for x, r in zip(gives, program.results, strict=True)})
        links.append(Link(program, tuple(takes), gives))

    def rule(
        one: Callable[..., Rows], takes: Mapping[str, str], prefix: str = "", names: Mapping[str, str] | None = None
    ) -> None:
        given = {name: x for name, x in takes.items() if x in known}
        sized = [known[x]._replace(name=name) for name, x in given.items()]
        add(_recorded(one, what.form, tuple(sized)), tuple(given.values()), prefix, names)

    names = tuple(known)
    if what.network is not None:
        add(record("policy", arguments, lambda *x: what.policy(dict(zip(names, x, strict=True)))), names)
    rule(act, {name: name for name in what.form.takes}, GIVEN)
    sized = [Argument(x, math.prod(what.stage.axes(x)), x in known and known[x].uniform) for x in what.asked]
    given = [GIVEN + x if GIVEN + x in known else x for x in what.asked]
    add(what.stage.program(tuple(sized)), given, AFTER)
    rows, name = [r.name for r in links[-1].program.results], links[-1].program.name
    judged = {"finite": GIVEN + "finite", "steps": "steps", "limit": "limit"}
    rule(end, {**{name: AFTER + name for name in JUDGED}, **judged})
    left = [name for name in rows if name not in JUDGED]
    wanted: tuple[str, ...] = (GIVEN + "clipped", "flags", "reward")
    if what.network is None:
        pushes = [GIVEN + x for push in what.form.pushes for x in (THEN + push, "over")]
        wanted = ("elapsed", *wanted, *[AFTER + name for name in left], *dict.fromkeys(pushes))
        return Chain(f"step_{name}", arguments, tuple(links), wanted)
    before = {f"before {name}": name for name in left if name in HELD}
    held = {name: NOW + name for name in HELD}
    rule(undo, {STEP_FLAGS: "flags", **before, **{name: AFTER + name for name in left}}, INFO, held)
    task = [INFO + name for name in left if name not in HELD]
    now = {x: next(y for y in (NOW + x, GIVEN + THEN + x, x) if y in known) for x in what.carried}
    counted = {"flags": "flags", "elapsed": "elapsed", "used": "used", "over": GIVEN + "over"}
    rule(begin, {**counted, **now, **{NEXT + x: NEXT + x for x in what.carried}})
    wanted = ("action", *wanted, NOW + "observation", *task, *links[-1].gives)
    return Chain(f"block_{name}", arguments, tuple(links), wanted)
