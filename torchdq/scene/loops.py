"""Rollouts as loops: steps, task and recorded policy in one call, with gradients."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.backends.loop_call import repeat, repeatable
from torchdq.robot.robot import constants
from torchdq.scene.model import SceneModel
from torchdq.scene.policies import Linear, Network
from torchdq.scene.recording import Stage
from torchdq.scene.spec import POLICY, Task
from torchdq.scene.state import State

CARRY = "carry"  # row of a task that is its input at the next step
MANY = 128  # rows up to which the loop differentiates weights
Policy = Callable[[State, int], Tensor]
Done = Callable[[State], Tensor]
# steps of a rollout from the first to the one before the last, and the rows that are carried: rows of these steps
Part = Callable[[int, int, dict[str, Tensor]], dict[str, Tensor]]


class Plan(NamedTuple):
    """Computation of a rollout, beside its states."""

    policy: Policy | None = None
    done: Done | None = None
    task: Task | None = None
    total: tuple[str, ...] = ()  # rows of the task of which the sum over the steps is wanted
    ends: bool = False  # whether the last state is wanted alone

    @property
    def recorded(self) -> Linear | Network | None:
        """Policy that is recorded with the steps."""
        return self.policy if isinstance(self.policy, Linear | Network) else None

    @property
    def last(self) -> tuple[str, ...]:
        """Names of rows of which the last is wanted alone."""
        return (CARRY, *State._fields) if self.ends else ()

    def after(self, rows: Mapping[str, Tensor], start: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Rows without those of the start, which are the first of what is carried."""
        return {name: x[1:] if name in start and not self.ends else x for name, x in rows.items()}


def loops(scene: SceneModel, state: State, policy: Linear | Network | None = None) -> bool:
    """Whether steps of a scene are one loop: recorded ones, of plain tensors, by a backend that compiles.

    Of many rows, torch's matrix products differentiate the weights of a network faster.
    """
    q, weights = state.q, () if policy is None else policy.weights().values()
    learns = torch.is_grad_enabled() and any([x.requires_grad for x in weights])
    return not (
        (learns and q.numel() > MANY * q.shape[-1])
        or scene.looped
        or scene.computed
        or (scene.precision == "double" and q.dtype == torch.float32)
        or not repeatable(q, scene.backend)
    )


def looped(scene: SceneModel, series: Mapping[str, Tensor], steps: int, plan: Plan, like: Tensor) -> Part:
    """Part of a rollout by one call, of inputs [steps, ...], without torques where there are none."""
    constants(scene.robot)  # raises if they were changed in place
    fixed, policy = scene.parameters, plan.recorded
    if scene.noises and "noise" not in series:
        series = {**series, "noise": scene._random(like, steps)}
    if policy is not None:
        fixed = {**fixed, **{f"{POLICY}.{name}": x for name, x in policy.weights().items()}}
        series = {**series, **policy.stepped()}
    what = Stage(scene.spec, "step", plan.task, policy=None if policy is None else policy.form)

    def part(first: int, last: int, start: dict[str, Tensor]) -> dict[str, Tensor]:
        count = last - first
        rows = series if count == steps else {name: x[first:last] for name, x in series.items()}
        return plan.after(repeat(what, count, start, rows, fixed, plan.total, plan.ends, scene.backend), start)

    return part
