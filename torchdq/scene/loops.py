"""Rollouts as loops: steps, task and recorded policy in one call, with gradients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as checkpointed

from torchdq.backends.loop_call import repeat, repeatable
from torchdq.robot.robot import constants
from torchdq.scene.integrators import Unrecorded
from torchdq.scene.model import SceneModel
from torchdq.scene.policies import Linear, Network
from torchdq.scene.recording import Stage
from torchdq.scene.spec import POLICY, Task
from torchdq.scene.state import State

MANY = 128  # rows up to which the loop differentiates weights


class Plan(NamedTuple):
    """Computation of a rollout, beside its states."""

    policy: Linear | Network | None = None
    task: Task | None = None
    total: tuple[str, ...] = ()  # rows of the task of which the sum over the steps is wanted
    ends: bool = False  # whether the last state is wanted alone


def loops(scene: SceneModel, state: State, policy: Linear | Network | None = None) -> bool:
    """Whether steps of a scene are one loop: recorded ones, of plain tensors, by a backend that compiles.

    Of many rows, torch's matrix products differentiate the weights of a network faster.
    """
    q, weights = state.q, () if policy is None else policy.weights().values()
    learns = torch.is_grad_enabled() and any([x.requires_grad for x in weights])
    return not (
        (learns and q.numel() > MANY * q.shape[-1])
        or isinstance(scene.integrator, Unrecorded)
        or scene.computed
        or (scene.precision == "double" and q.dtype == torch.float32)
        or not repeatable(q, scene.backend)
    )


def looped(
    scene: SceneModel,
    start: Mapping[str, Tensor],
    series: Mapping[str, Tensor],
    steps: int,
    plan: Plan,
    checkpoint: int = 0,
) -> dict[str, Tensor]:
    """Rows of a rollout by name: of what is carried those of all steps and the start, or the last; and the task's.

    Args:
        start: rows that are carried: those of the state, and what the task remembers.
        series: inputs [steps, ...], without torques where there are none.
        checkpoint: for the gradient of the last state and of totals, one state in so many is kept; 0: all.
    """
    constants(scene.robot)  # raises if they were changed in place
    if scene.noises and "noise" not in series:
        series = {**series, "noise": scene.random(start["q"], steps)}
    fixed, policy = scene.parameters, plan.policy
    if policy is not None:
        fixed = {**fixed, **{f"{POLICY}.{name}": x for name, x in policy.weights().items()}}
        series = {**series, **policy.stepped()}
    what = Stage(scene.spec, "step", plan.task, policy=None if policy is None else policy.form)
    names = tuple(start), tuple(series), tuple(fixed)

    def part(count: int, *tensors: Tensor) -> dict[str, Tensor]:
        values = iter(tensors)
        carried, stepped, same = (dict(zip(some, values, strict=False)) for some in names)
        return repeat(what, count, carried, stepped, same, plan.total, plan.ends, scene.backend)

    if not (checkpoint and plan.ends and torch.is_grad_enabled()):
        return part(steps, *start.values(), *series.values(), *fixed.values())
    parts: list[dict[str, Tensor]] = []
    for first in range(0, max(steps, 1), checkpoint):
        rows = [x[first : first + checkpoint] for x in series.values()]
        count = min(checkpoint, steps - first)
        parts.append(checkpointed(part, count, *start.values(), *rows, *fixed.values(), use_reentrant=False))
        start = {name: parts[-1][name] for name in start}
    return {name: _joined([x[name] for x in parts], name, start, plan.total) for name in parts[0]}


def _joined(parts: Sequence[Tensor], name: str, carried: Mapping[str, Tensor], total: Sequence[str]) -> Tensor:
    """Row of a rollout of those of its parts."""
    if name in total:
        return torch.stack([*parts]).sum(0)
    return parts[-1] if name in carried else torch.cat([*parts])
