"""Rollouts of environments: a block of steps under a policy, as one call where that can be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.loop_call import repeat
from torchdq.base.checks import require_tensor
from torchdq.envs.actions import Actions
from torchdq.envs.block import FLAGS, INFO, NEXT, SPARE, WEIGHT, Block
from torchdq.envs.pushes import DRAWS
from torchdq.envs.reset import KEPT, NOISE, PUSHED, STARTS, Reset
from torchdq.envs.rng import Streams
from torchdq.envs.row_selection import Indexed
from torchdq.envs.tasks import STATE
from torchdq.scene.policies import Network
from torchdq.scene.recording import Stage


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
    clipped = (rows["action"].clamp(-1.0, 1.0) != rows["action"]).sum(-1)
    info = {name.removeprefix(INFO): x for name, x in rows.items() if name.startswith(INFO)}
    info |= {"clipped": clipped, "nonfinite": rows["failed"]}
    found = rows["observation"], rows["action"], rows["reward"], rows["ended"], rows["truncated"], rows["final"]
    return Rollout(*found, info)


def stepped(
    step: Callable[[Tensor], tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]],
    observation: Tensor,
    policy: Callable[[Tensor], Tensor],
    steps: int,
    noise: Tensor | None,
    unit: float,
) -> Rollout:
    """Rollout by so many calls of a function that takes a step."""
    observations, rows, infos = [observation], list[tuple[Tensor, ...]](), list[dict[str, Any]]()
    for k in range(steps):
        found = policy(observations[-1].clone())  # which it may write into
        require_tensor("what policy returns", found)
        actions = unit * (found if noise is None else found + noise[k])
        observation, *others, info = step(actions)
        observations.append(observation)
        rows.append((actions, *others, info.get("final_obs", observation)))
        infos.append({name: x for name, x in info.items() if "final" not in name})
    info = {name: torch.stack([x[name] for x in infos]) for name in infos[0]}
    actions, rewards, terminated, truncated, final = map(torch.stack, zip(*rows, strict=True))
    return Rollout(torch.stack(observations), actions, rewards, terminated, truncated, final, info)


class Blocks:
    """Steps of environments as one call, and the next episode of every row, which is drawn before.

    Args:
        reset: start of episodes.
        actions: meaning of the actions.
        limit: steps of an episode.
    """

    def __init__(self, reset: Reset, actions: Actions, limit: float) -> None:
        rows = {name: x.clone() for name, x in reset.drawn.items()}  # of its own
        scene = reset.scene.with_parameters(rows) if rows else reset.scene
        self.reset, self.actions, self.limit = reset, actions, limit
        self.ahead = Reset(scene, reset.checked, reset.randomised, reset.pushes, None)
        self.next: dict[str, Tensor] = {}  # buffers of the next episodes
        self.drawn_at: Streams | None = None  # where the streams of starts were then

    def __call__(
        self, buffers: Mapping[str, Tensor], policy: Network, steps: int, noise: Tensor | None, unit: float
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Rows of every step, by name, and the buffers after the last; drawn parameters are written into the scene."""
        found, now, at = list[dict[str, Tensor]](), {**buffers, **self.reset.drawn}, 0
        while at < steps:
            part = None if noise is None else noise[at:]
            rows, after, whole = self._called(now, policy, steps - at, part, unit)
            if whole < steps - at:
                # up to the first step at which a row would need a second episode or push, which then are drawn
                rows, after, _ = self._called(now, policy, whole, None if part is None else part[:whole], unit)
            self.actions.require_finite(rows["action"])
            now = {**now, **after, "observation": rows["observation"][-1].clone()}
            at += len(rows["reward"])
            found.append(rows)
        for rows in found[:-1]:
            rows["observation"] = rows["observation"][:-1]  # the next part begins with the last
        if len(found) > 1:
            found = [{name: torch.cat([rows[name] for rows in found]) for name in found[0]}]
        for name, x in self.reset.drawn.items():
            x.copy_(now.pop(name))
        return found[0], now

    def _called(
        self, buffers: Mapping[str, Tensor], policy: Network, steps: int, noise: Tensor | None, unit: float
    ) -> tuple[dict[str, Tensor], dict[str, Tensor], int]:
        """Rows of every step, what has changed after the last, and the number of steps for which enough was drawn."""
        scene, pushes, like = self.reset.scene, self.reset.pushes, buffers["observation"]
        streams, following = Streams.of(buffers), self._following(buffers)
        names = (*STATE, "goal", *KEPT, *pushes, *self.reset.drawn)
        given = {name: buffers[name] for name in names if name in buffers}
        spare = [streams.column(k).uniform(DRAWS, like.dtype) for k, _ in enumerate(pushes, PUSHED)]
        own = {NEXT + name: following[name] for name in given}
        own |= {SPARE + name: push.drawn(u) for (name, push), (u, _) in zip(pushes.items(), spare, strict=True)}
        shared = {"limit": like.new_tensor([self.limit]), "unit": like.new_tensor([unit]), "scale": self.actions.scale}
        shared |= {WEIGHT + name: x for name, x in policy.weights().items()}
        stepped, columns = {}, [streams.counter[:, NOISE]]
        if noise is not None:
            stepped["noise of actions"] = noise
        if scene.noises and steps:
            stepped["noise"], columns[0] = streams.column(NOISE).series(steps, scene.noises, like.dtype)
        carried = {**given, "steps": buffers["steps"].to(like.dtype)[:, None]}
        carried["used"] = like.new_zeros(len(like), 1 + len(pushes))
        rest = {name: x for name, x in scene.parameters.items() if name not in given}
        lead = ((shared, 0), (carried | own, 1), (stepped, 2))
        axes = {name: tuple(x.shape[axes:]) for rows, axes in lead for name, x in rows.items()}
        what = self._block(policy, tuple(given), tuple(axes.items()))
        ends = [name for name in carried if name not in ("observation", "used")]
        found = repeat(what, steps, carried, stepped, {**own, **shared, **rest}, ends, backend=scene.backend)
        used = found.pop("used")
        whole = int((used <= 1).flatten(1).all(1).sum()) - 1
        begun, *over = (used[-1] != 0).unbind(1)
        columns.insert(STARTS, torch.where(begun, following["counter"][:, STARTS], streams.counter[:, STARTS]))
        for k, (x, (_, after)) in enumerate(zip(over, spare, strict=True), PUSHED):
            columns.append(torch.where(x, after.counter, streams.counter[:, k]))
        changed = {name: found.pop(name) for name in ends} | {"counter": torch.stack(columns, 1)}
        changed["steps"] = changed["steps"][:, 0].to(torch.int32)
        return {name: x != 0 if name in FLAGS else x for name, x in found.items()}, changed, whole

    def _block(self, policy: Network, carried: tuple[str, ...], own: tuple[tuple[str, tuple[int, ...]], ...]) -> Block:
        """The computation."""
        scene, checked, kind = self.reset.scene, self.reset.checked, self.actions.kind
        wanted = checked.task.inputs(scene.n)
        inputs: list[str] = [name for name in ("goal", "carry", "time", "action") if name in wanted]
        meant = {"torque": ["torque"], "residual": ["torque", "reference"], "pose": ["reference"]}
        inputs += meant.get(kind, [kind])
        state = [name for name in STATE if name in scene.spec.state]
        asked = (*state, *inputs, *self.reset.pushes, *(["noise"] if scene.noises else []), *scene.parameters)
        pushes, stage = tuple(self.reset.pushes), Stage(scene.spec, "step", checked)
        return Block(stage, policy.form, kind, self.actions.joints, self.actions.pose, pushes, carried, asked, own)

    def _following(self, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Buffers and parameters of every row's next episode, drawn where those at hand were taken."""
        streams = Streams.of(buffers)
        now, before = streams.column(STARTS), self.drawn_at
        taken = torch.ones_like(now.key, dtype=torch.bool)
        if before is not None:
            taken = (now.key != before.key) | (now.counter != before.counter)
        rows = Indexed(taken.nonzero()[:, 0])
        if len(rows.indices):
            fresh, _ = self.ahead(rows, streams.rows(rows), buffers["observation"].dtype)
            self.next = {name: rows.replaced(self.next[name], x) if self.next else x for name, x in fresh.items()}
            self.drawn_at = now
        return self.next | self.ahead.drawn
