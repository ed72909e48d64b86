"""Steps of environments by the rules of an episode: one at a time, or a block under a policy as one call."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.call import evaluate
from torchdq.backends.loop_call import repeat
from torchdq.base.checks import require_tensor
from torchdq.envs.actions import SHARE, Meaning
from torchdq.envs.episode import (
    AFTER,
    GIVEN,
    HELD,
    INFO,
    JUDGED,
    NEXT,
    NOW,
    STEP_FLAGS,
    THEN,
    WEIGHT,
    Block,
    Form,
    Rule,
    act,
    end,
    undo,
)
from torchdq.envs.reset import KEPT, NOISE, SPARE, STARTS, Reset
from torchdq.envs.rng import Streams
from torchdq.envs.row_selection import Host, Indexed
from torchdq.envs.tasks import STATE
from torchdq.program.loop import by_steps
from torchdq.program.transforms import dispatching
from torchdq.robot.robot import constants
from torchdq.scene.policies import Network
from torchdq.scene.recording import Stage
from torchdq.scene.state import State


class Rollout(NamedTuple):
    """Results of a number of steps of N environments."""

    observations: Tensor  # [steps + 1, N, ...] before every step, and after the last
    actions: Tensor  # [steps, N, k], not clipped
    rewards: Tensor  # [steps, N]
    terminated: Tensor  # [steps, N]
    truncated: Tensor  # [steps, N]
    final_observations: Tensor  # [steps, N, ...] after every step, before the reset of the episodes that it ended
    info: dict[str, Tensor]  # rows of `info` [steps, N, ...]


def rollout_of(rows: dict[str, Tensor]) -> Rollout:
    """Rollout of the rows of a block."""
    info = {name.removeprefix(INFO): x for name, x in rows.items() if name.startswith(INFO)}
    failed, terminated, truncated, _ = (rows["flags"] != 0).unbind(-1)
    info |= {"clipped": rows[GIVEN + "clipped"].to(torch.int64), "nonfinite": failed}
    final = rows[NOW + "observation"]
    return Rollout(rows["observation"], rows["action"], rows["reward"], terminated, truncated, final, info)


def stepped(
    step: Callable[[Tensor], tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]],
    observation: Tensor,
    policy: Callable[[Tensor], Tensor],
    steps: int,
    noise: Tensor | None,
    unit: float,
) -> Rollout:
    """Rollout by so many calls of a function that takes a step."""

    def after(k: int, before: Mapping[str, Tensor]) -> dict[str, Tensor]:
        found = policy(before["observations"].clone())  # which it may write into
        require_tensor("what policy returns", found)
        actions = unit * (found if noise is None else found + noise[k])
        now, *others, info = step(actions)
        rows = zip(Rollout._fields, (now, actions, *others, info.get("final_obs", now)), strict=False)
        return {**dict(rows), **{INFO + name: x for name, x in info.items() if "final" not in name}}

    rows: dict[str, Tensor] = by_steps(after, {"observations": observation}, range(steps), torch.stack)
    info = {name.removeprefix(INFO): rows.pop(name) for name in [*rows] if name.startswith(INFO)}
    return Rollout(**rows, info=info)


class Step(NamedTuple):
    """Results of a step of N environments, before any of them begins another episode."""

    buffers: dict[str, Tensor]
    reward: Tensor  # [N]
    terminated: Tensor  # [N]
    truncated: Tensor  # [N]
    done: Tensor  # [N] one of both
    ends: bool  # whether one is done, or may be
    info: dict[str, Any]


class Steps:
    """Steps of environments by the rules of an episode.

    Args:
        reset: start of episodes, with the scene and the task.
        meaning: meaning of the actions.
        scale: size of a full action [k].
        limit: steps of an episode.
    """

    def __init__(self, reset: Reset, meaning: Meaning, scale: Tensor, limit: float) -> None:
        scene, unused = reset.scene, () if meaning.kind in SHARE else ("torque",)
        wanted = {**scene.spec.inputs(), **reset.checked.inputs(scene.n)}
        self.inputs = tuple([name for name in wanted if name not in unused])  # of the scene and the task
        shown = self.inputs if reset.functions is None else (*self.inputs, "action")
        self.reset, self.form = reset, Form(meaning, shown, tuple(reset.pushes), scene.dt)
        self.shared = {"scale": scale, "limit": scale.new_tensor(limit)}
        self.act = Rule(act, self.form, tuple(self.form.takes.items()))
        self.end = Rule(end, self.form, tuple([(name, ()) for name in (*JUDGED, "finite", "steps", "limit")]))
        recorded = reset.functions is None and not (scene.looped or scene.computed)
        self.at_once = recorded and (scene.precision == "auto" or scale.dtype == torch.float64)
        self.block: Block | None = None  # a step at once; None before the first
        self.ahead: Reset | None = None  # start of the next episodes, in a scene of its own
        self.next: dict[str, Tensor] = {}  # their buffers
        self.drawn_at: Streams | None = None  # where the streams of starts were then

    def __call__(self, buffers: Mapping[str, Tensor], actions: Tensor, host: Host, waiting: Tensor | None) -> Step:
        """Results of a step.

        Args:
            buffers: all that steps change, by name.
            actions: actions [N, k].
            host: what the host may ask the device.
            waiting: mask [N] of rows that have finished and were not reset, which fail; None: there are none.
        """
        reset, scene, after = self.reset, self.reset.scene, dict(buffers)
        given = {**buffers, "action": actions, **self.shared}
        if scene.noises:
            streams = Streams.of(buffers)
            given["noise"], drawn = streams.column(NOISE).uniform(scene.noises, actions.dtype)
            after |= streams.with_column(NOISE, drawn)._asdict()
        at_once = self.at_once and host.synchronises and not dispatching()
        rows = self._at_once(given) if at_once else self._by_links(given, host, waiting)
        flags = rows.pop("flags")
        failed, terminated, truncated, done = (flags != 0).unbind(1)
        info = {"clipped": rows.pop(GIVEN + "clipped").to(torch.int64), "nonfinite": failed}
        reward, after["steps"] = rows.pop("reward"), rows.pop("elapsed")
        if reset.pushes:
            after |= {push: rows.pop(GIVEN + THEN + push) for push in reset.pushes}
            after = reset.with_spares(after, (rows.pop(GIVEN + "over") != 0).unbind(1), host)
        rows = {name.removeprefix(AFTER): x for name, x in rows.items()}
        if (ends := host.any(done)) and host.any(failed):
            if host.synchronises:
                self.form.meaning.require_finite(actions)
            own = {STEP_FLAGS: flags, **{f"before {x}": buffers[x] for x in HELD if x in rows}, **rows}
            rule = Rule(undo, self.form, tuple([(name, tuple(x.shape[1:])) for name, x in own.items()]))
            rows = evaluate(rule, own, scene.backend)
        for name, x in rows.items():
            (after if name in HELD else info)[name] = x
        return Step(after, reward, terminated, truncated, done, ends, info)

    def _at_once(self, given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Rows of a step by one program: those of `_by_links`."""
        scene = self.reset.scene
        constants(scene.robot)  # raises if they were changed in place
        if self.block is None:
            names = [*STATE, "goal", *KEPT, *self.form.takes, *self.inputs, "steps", "limit"]
            own = {x: tuple(given[x].shape[x not in self.shared :]) for x in dict.fromkeys(names) if x in given}
            self.block = self._block(None, (), tuple(own.items()))
        taken = {name: given[name] for name, _ in self.block.own}
        taken |= {"noise": given["noise"]} if scene.noises else {}
        return evaluate(self.block, {**taken, **scene.parameters}, scene.backend)

    def _by_links(self, given: Mapping[str, Tensor], host: Host, waiting: Tensor | None) -> dict[str, Tensor]:
        """Rows of a step by one link after the other, with functions of torch between them."""
        reset, scene = self.reset, self.reset.scene
        if host.synchronises:
            self.form.meaning.require_finite(given["action"])
        acted = evaluate(self.act, {name: given[name] for name, _ in self.act.own}, scene.backend)
        inputs = {name: acted.get(name, given.get(name)) for name in self.inputs}
        state, rows = scene._advance(state_of(given), inputs, given.get("noise"), reset.checked)
        if (functions := reset.functions) is not None:
            now = functions.now(state, given["goal"].clone(), given["steps"] + 1, rows, acted["action"])
            rows = functions.after(now)
        judged = {name: rows.pop(name) for name in JUDGED if name in rows}
        if waiting is not None:
            judged["valid"] = judged["valid"].masked_fill(waiting, 0.0)
        judged |= {"finite": acted["finite"], "steps": given["steps"], "limit": given["limit"]}
        ended = evaluate(self.end, judged, scene.backend)
        found = {GIVEN + name: x for name, x in acted.items() if name.startswith(THEN) or name in ("clipped", "over")}
        return {**ended, **found, **{AFTER + name: x for name, x in {**state.rows(), **rows}.items()}}

    def rollout(
        self, buffers: Mapping[str, Tensor], policy: Network, steps: int, noise: Tensor | None, unit: float
    ) -> tuple[Rollout, dict[str, Tensor]]:
        """Results of a number of steps, and the buffers after the last; drawn parameters are written into the scene."""
        found, now, at = list[dict[str, Tensor]](), {**buffers, **self.reset.drawn}, 0
        while at < steps:
            part = None if noise is None else noise[at:]
            rows, after, whole = self._called(now, policy, steps - at, part, unit)
            if whole < steps - at:
                # up to the first step at which a row would need a second episode or push, which then are drawn
                rows, after, _ = self._called(now, policy, whole, None if part is None else part[:whole], unit)
            self.form.meaning.require_finite(rows["action"])
            now = {**now, **after, "observation": rows["observation"][-1].clone()}
            at += len(rows["reward"])
            found.append(rows)
        for rows in found[:-1]:
            rows["observation"] = rows["observation"][:-1]  # the next part begins with the last
        if len(found) > 1:
            found = [{name: torch.cat([rows[name] for rows in found]) for name in found[0]}]
        for name, x in self.reset.drawn.items():
            x.copy_(now.pop(name))
        return rollout_of(found[0]), now

    def _called(
        self, buffers: Mapping[str, Tensor], policy: Network, steps: int, noise: Tensor | None, unit: float
    ) -> tuple[dict[str, Tensor], dict[str, Tensor], int]:
        """Rows of every step, what has changed after the last, and the number of steps for which enough was drawn."""
        scene, pushes, like = self.reset.scene, self.reset.pushes, buffers["observation"]
        streams, following = Streams.of(buffers), self._following(buffers)
        names = (*STATE, "goal", *KEPT, *pushes, *self.reset.drawn)
        given = {name: buffers[name] for name in names if name in buffers}
        own = {NEXT + name: following[name] for name in given}
        own |= {SPARE + name: buffers[SPARE + name] for name in pushes}
        shared = {**self.shared, "unit": like.new_tensor([unit])}
        shared |= {WEIGHT + name: x for name, x in policy.weights().items()}
        stepped, columns = {}, list(streams.counter.unbind(1))
        if noise is not None:
            stepped["noise of actions"] = noise
        if scene.noises and steps:
            stepped["noise"], columns[NOISE] = streams.column(NOISE).series(steps, scene.noises, like.dtype)
        carried = {**given, "steps": buffers["steps"], "used": like.new_zeros(len(like), 1 + len(pushes))}
        rest = {name: x for name, x in scene.parameters.items() if name not in given}
        lead = ((shared, 0), (carried | own, 1), (stepped, 2))
        axes = {name: tuple(x.shape[axes:]) for rows, axes in lead for name, x in rows.items()}
        what = self._block(policy, tuple(given), tuple(axes.items()))
        ends = [name for name in carried if name not in ("observation", "used")]
        found = repeat(what, steps, carried, stepped, {**own, **shared, **rest}, ends, backend=scene.backend)
        used = found.pop("used")
        whole = int((used <= 1).flatten(1).all(1).sum()) - 1
        begun, *over = (used[-1] != 0).unbind(1)
        columns[STARTS] = torch.where(begun, following["counter"][:, STARTS], columns[STARTS])
        changed = {name: found.pop(name) for name in ends} | {"counter": torch.stack(columns, 1)}
        changed = self.reset.with_spares({**buffers, **changed}, over, Host(True))
        return found, changed, whole

    def _block(
        self, policy: Network | None, carried: tuple[str, ...], own: tuple[tuple[str, tuple[int, ...]], ...]
    ) -> Block:
        """The computation."""
        scene, checked = self.reset.scene, self.reset.checked
        state = [name for name in State._fields if name in scene.spec.state]
        asked = (*state, *self.inputs, *(["noise"] if scene.noises else []), *scene.parameters)
        network = None if policy is None else policy.form
        return Block(Stage(scene.spec, "step", checked), self.form, network, carried, asked, own)

    def _following(self, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Buffers and parameters of every row's next episode, drawn where those at hand were taken."""
        if self.ahead is None:
            drawn = {name: x.clone() for name, x in self.reset.drawn.items()}
            scene = self.reset.scene.with_parameters(drawn) if drawn else self.reset.scene
            self.ahead = replace(self.reset, scene=scene)
        streams = Streams.of(buffers)
        now, before = streams.column(STARTS), self.drawn_at
        taken = torch.ones_like(now.key, dtype=torch.bool)
        if before is not None:
            taken = (now.key != before.key) | (now.counter != before.counter)
        rows = Indexed(taken.nonzero()[:, 0])
        if len(rows.indices):
            fresh, _ = self.ahead(rows, streams.rows(rows))
            self.next = {name: rows.replaced(self.next[name], x) if self.next else x for name, x in fresh.items()}
            self.drawn_at = now
        return self.next | self.ahead.drawn


def state_of(buffers: Mapping[str, Tensor]) -> State:
    """State that is in the buffers."""
    return State(**{name: buffers[name] for name in STATE if name in buffers})
