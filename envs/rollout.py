"""Rollouts of environments: a block of steps under a policy, as one call where that can be."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.loop_call import repeat
from torchdq.envs.actions import Actions
from torchdq.envs.block import AFTER, DRAWN, FLAGS, NEXT, SPARE, WEIGHT, Block
from torchdq.envs.pushes import WIDTH
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


def rollout_of(rows: dict[str, Tensor], worst: float) -> Rollout:
    """Rollout of the rows of a block; failed steps have the worst reward, and NaN among the rows of the task."""
    failed, actions = rows.pop("failed"), rows.pop("action")
    observations, reward, final = rows.pop("observation"), rows.pop("reward"), rows.pop("final")
    ended, truncated = rows.pop("ended"), rows.pop("truncated")
    if failed.any():
        reward = reward.masked_fill(failed, worst)
        shape = (*failed.shape, 1)
        rows = {name: x.masked_fill(failed.view(shape[: x.ndim]), torch.nan) for name, x in rows.items()}
    clipped = (actions.clamp(-1.0, 1.0) != actions).sum(-1)
    info = {"clipped": clipped, "nonfinite": failed, **rows}
    return Rollout(observations, actions, reward, ended, truncated, final, info)


def stepped(
    step: Callable[[Tensor], tuple[Tensor, Tensor, Tensor, Tensor, dict[str, Any]]],
    observation: Tensor,
    policy: Callable[[Tensor], Tensor],
    steps: int,
    noise: Tensor | None,
    unit: float,
) -> Rollout:
    """Rollout by so many calls of a function that takes a step."""
    rows, infos = list[tuple[Tensor, ...]](), list[dict[str, Any]]()
    first = observation[None]
    for k in range(steps):
        found = policy(observation)
        actions = unit * (found if noise is None else found + noise[k])
        observation, reward, ended, truncated, info = step(actions)
        rows.append((observation, actions, reward, ended, truncated, info.get("final_obs", observation)))
        infos.append({name: x for name, x in info.items() if "final" not in name})
    observations, actions, rewards, terminated, truncated, final = map(torch.stack, zip(*rows, strict=True))
    info = {name: torch.stack([x[name] for x in infos]) for name in infos[0]}
    return Rollout(torch.cat([first, observations]), actions, rewards, terminated, truncated, final, info)


class Blocks:
    """Steps of environments as one call, and the next episode of every row, which is drawn before.

    Args:
        reset: start of episodes.
        actions: meaning of the actions.
        limit: steps of an episode.
    """

    def __init__(self, reset: Reset, actions: Actions, limit: float) -> None:
        drawn = [owned for r in reset.randomised for owned in r.bases.items()]
        rows = {f"{owner}.{name}": x.clone() for (owner, name), x in drawn}  # of its own
        scene = reset.scene.with_parameters(rows) if rows else reset.scene
        self.reset, self.actions, self.limit = reset, actions, limit
        self.ahead = Reset(scene, reset.checked, reset.randomised, reset.pushes, None)
        self.next: dict[str, Tensor] = {}  # buffers of the next episodes
        self.drawn_at: Streams | None = None  # where the streams of starts were then

    def __call__(
        self, buffers: Mapping[str, Tensor], policy: Network, steps: int, noise: Tensor | None, unit: float
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Rows of every step, by name, and the buffers after the last; drawn parameters are written into the scene."""
        found, at = list[dict[str, Tensor]](), 0
        while at < steps:
            part = None if noise is None else noise[at:]
            rows, after = self._called(buffers, policy, steps - at, part, unit)
            short = rows.pop("short").any(1)
            if short.any():
                # up to the first step at which a row would need a second episode or push, which then are drawn
                number = int(short.int().argmax())
                rows, after = self._called(buffers, policy, number, None if part is None else part[:number], unit)
                del rows["short"]
            self.actions.require_finite(rows["action"])
            for r in self.reset.randomised:
                for (owner, name), x in r.tensors(self.reset.scene).items():
                    x.copy_(after.pop(f"{owner}.{name}"))
            buffers = {**buffers, **after}
            at += len(rows["reward"])
            found.append(rows)
        if len(found) > 1:
            for rows in found[:-1]:
                rows["observation"] = rows["observation"][:-1]  # the next part begins with the last
            found = [{name: torch.cat([rows[name] for rows in found]) for name in found[0]}]
        return found[0], dict(buffers)

    def _called(
        self, buffers: Mapping[str, Tensor], policy: Network, steps: int, noise: Tensor | None, unit: float
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Rows of every step, and what has changed after the last, as one call."""
        scene, pushes = self.reset.scene, self.reset.pushes
        streams, following = Streams(buffers["key"], buffers["counter"]), self._following(buffers)
        given = {name: buffers[name] for name in (*STATE, "goal", *KEPT) if name in buffers}
        drawn = [f"{owner}.{name}" for r in self.reset.randomised for owner, name in r.bases]
        given |= {DRAWN + name: buffers[name] for name in pushes} | {name: scene.parameters[name] for name in drawn}
        like, n = buffers["observation"], len(buffers["observation"])
        carried = tuple(given)
        fixed = {NEXT + name: following[name.removeprefix(DRAWN)] for name in carried}
        after = {PUSHED + k: streams.column(PUSHED + k).uniform(WIDTH, like.dtype) for k in range(len(pushes))}
        for k, (name, push) in enumerate(pushes.items(), PUSHED):
            fixed[SPARE + name] = push.drawn(after[k][0])
        fixed |= {name: x for name, x in scene.parameters.items() if name not in drawn}
        fixed |= {"limit": like.new_tensor([self.limit]), "unit": like.new_tensor([unit])}
        fixed |= {"scale": self.actions.scale, **{WEIGHT + name: x for name, x in policy.weights().items()}}
        stepped, counter = {}, streams.counter.clone()
        if noise is not None:
            stepped["noise of actions"] = noise
        if scene.noises and steps:
            stepped["noise"], counter[:, NOISE] = streams.column(NOISE).series(steps, scene.noises, like.dtype)
        given["steps"] = buffers["steps"].to(like.dtype)[:, None]
        given["used"] = like.new_zeros(n, 1 + len(pushes))
        what = self._block(policy, carried)
        ends = [name for name in given if name != "observation"]
        found = repeat(what, steps, given, stepped, fixed, ends, backend=scene.backend)
        used = found.pop("used") != 0
        counter[:, STARTS] = torch.where(used[:, 0], following["counter"][:, STARTS], counter[:, STARTS])
        for k in after:
            counter[:, k] = torch.where(used[:, k - PUSHED + 1], after[k][1].counter, counter[:, k])
        changed = {name.removeprefix(DRAWN): found.pop(name) for name in ends if name != "used"}
        changed["steps"], changed["counter"] = changed["steps"][:, 0].to(torch.int32), counter
        changed["observation"] = found["observation"][-1]
        rows = {name.removeprefix(AFTER): x != 0 if name in FLAGS else x for name, x in found.items()}
        return rows, changed

    def _block(self, policy: Network, carried: tuple[str, ...]) -> Block:
        """The computation."""
        scene, checked, kind = self.reset.scene, self.reset.checked, self.actions.kind
        inputs: list[str] = [
            name for name in ("goal", "carry", "time", "action") if name in checked.task.inputs(scene.n)
        ]
        inputs += {"torque": ["torque"], "residual": ["torque", "reference"]}.get(kind, [kind])
        state = [name for name in STATE if name in scene.spec.state]
        asked = [*state, *inputs, *self.reset.pushes, *(["noise"] if scene.noises else []), *scene.parameters]
        pushes, stage = tuple(self.reset.pushes.items()), Stage(scene.spec, "step", checked)
        width = len(checked.task.bounds(self.reset.robot))
        return Block(stage, width, policy.form, kind, self.actions.joints, pushes, carried, tuple(asked))

    def _following(self, buffers: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Buffers and parameters of every row's next episode, drawn where those at hand were taken."""
        streams = Streams(buffers["key"], buffers["counter"])
        now, before = streams.column(STARTS), self.drawn_at
        taken = torch.ones_like(now.key, dtype=torch.bool)
        if before is not None:
            taken = (now.key != before.key) | (now.counter != before.counter)
        rows = Indexed(taken.nonzero()[:, 0])
        if len(rows.indices):
            fresh, _ = self.ahead(rows, streams.rows(rows), buffers["observation"].dtype)
            self.next = {name: rows.replaced(self.next[name], x) if self.next else x for name, x in fresh.items()}
            self.drawn_at = now
        drawn = [owned for r in self.reset.randomised for owned in r.tensors(self.ahead.scene).items()]
        return self.next | {f"{owner}.{name}": x for (owner, name), x in drawn}
