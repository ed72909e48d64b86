"""Rollouts as loops: steps, task and recorded policy in one call, with gradients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as checkpointed

from torchdq.backends.call import batch_of
from torchdq.backends.choice import BackendName
from torchdq.backends.loop_call import aligned, once, repeat, repeatable
from torchdq.robot.robot import constants
from torchdq.scene.integrators import Unrecorded
from torchdq.scene.model import SceneModel
from torchdq.scene.policies import Linear, Network
from torchdq.scene.recording import Stage
from torchdq.scene.spec import POLICY, Task
from torchdq.scene.state import State


class Plan(NamedTuple):
    """Computation of a rollout, beside its states."""

    policy: Linear | Network | None = None
    task: Task | None = None
    total: tuple[str, ...] = ()  # rows of the task of which the sum over the steps is wanted
    ends: bool = False  # whether the last state is wanted alone


def loops(scene: SceneModel, state: State) -> bool:
    """Whether steps of a scene are one loop: recorded ones, of plain tensors, by a backend that compiles."""
    q = state.q
    return not (
        isinstance(scene.integrator, Unrecorded)
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
    rollout = _Rollout(what, tuple(start), tuple(series), tuple(fixed), plan, scene.backend)
    if torch.is_grad_enabled() and any([x.requires_grad for x in rollout.weights([*fixed.values()])]):
        batch = batch_of(what, once(steps, {**start, **series, **fixed}, series))
        whole, q = (steps, *batch, scene.n), start["q"]
        torque = aligned(series["torque"], whole).expand(whole) if "torque" in series else q.new_zeros(whole)
        series = {**series, "torque": torque}
        rollout = rollout._replace(series=tuple(series), learns=True)
    again = bool(checkpoint) and plan.ends and torch.is_grad_enabled()
    if not again:
        return rollout(steps, *start.values(), *series.values(), *fixed.values())
    run = rollout._replace(again=True) if rollout.learns else partial(checkpointed, rollout, use_reentrant=False)
    parts: list[dict[str, Tensor]] = []
    for first in range(0, max(steps, 1), checkpoint):
        rows = [x[first : first + checkpoint] for x in series.values()]
        found = run(min(checkpoint, steps - first), *start.values(), *rows, *fixed.values())
        start = {name: found[name] for name in start}
        parts.append(found)
    return {name: _joined([part[name] for part in parts], name, start, plan.total) for name in parts[0]}


def _joined(parts: Sequence[Tensor], name: str, carried: Mapping[str, Tensor], total: Sequence[str]) -> Tensor:
    """Row of a rollout of those of its parts."""
    if name in total:
        return torch.stack([*parts]).sum(0)
    return parts[-1] if name in carried else torch.cat([*parts])


class _Rollout(NamedTuple):
    """Rollout as a function of its tensors."""

    what: Stage
    carried: tuple[str, ...]
    series: tuple[str, ...]
    fixed: tuple[str, ...]
    plan: Plan
    backend: BackendName | None
    learns: bool = False  # whether the weights of a network get gradients
    again: bool = False  # whether the states are then computed again

    def __call__(self, steps: int, *tensors: Tensor) -> dict[str, Tensor]:
        """Rows by name."""
        if not self.learns:
            return self.repeated(steps, tensors, self.plan.ends)
        names: list[str] = []
        found = _Learning.apply(self, steps, names, *tensors)
        return dict(zip(names, found, strict=True))

    def repeated(self, steps: int, tensors: Sequence[Tensor], ends: bool = False) -> dict[str, Tensor]:
        """Rows by name, by a loop."""
        values = iter(tensors)
        carried, series, fixed = (dict(zip(part, values, strict=False)) for part in self[1:4])
        return repeat(self.what, steps, carried, series, fixed, self.plan.total, ends, self.backend)

    def differentiable(
        self, steps: int, tensors: Sequence[Tensor], needed: Sequence[bool]
    ) -> tuple[list[Tensor], dict[str, Tensor]]:
        """Copies of the tensors that begin a graph, all but the weights, and the rows in it by name."""
        inner = [x.detach() for x in tensors]
        for k, name in enumerate(self.names[: len(tensors) - len(self.weights(tensors))]):
            inner[k].requires_grad_(needed[k] or name == "torque")
        with torch.enable_grad():
            return inner, self.repeated(steps, inner)

    def wanted(self, found: Mapping[str, Tensor]) -> list[Tensor]:
        """Rows that are returned, of those of all steps."""
        with torch.enable_grad():
            return [x[-1] if self.plan.ends and name in self.carried else x for name, x in found.items()]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the tensors."""
        return self.carried + self.series + self.fixed

    def weights(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """Weights of the policy, which are the last of the tensors."""
        count = sum([name.startswith(f"{POLICY}.") for name in self.fixed])
        return [*tensors[len(tensors) - count :]]


class _Learning(torch.autograd.Function):
    """Rollout under a network, of whose weights torch takes the gradient over all steps at once.

    The loop returns the gradient of the torque of every step; multiplied with the network's derivatives there, as
    matrices, it is that of the weights. Where higher derivatives are asked for, the loop sums them itself.
    """

    @staticmethod
    def forward(ctx, rollout: _Rollout, steps: int, names: list[str], *tensors: Tensor) -> tuple[Tensor, ...]:
        ctx.rollout, ctx.steps, ctx.kept = rollout, steps, None
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        if rollout.again:
            found = rollout.repeated(steps, tensors)
        else:
            ctx.kept = _, found = rollout.differentiable(steps, tensors, ctx.needs_input_grad[3:])
        names.extend(found)
        ends = rollout.plan.ends
        return tuple([x.detach().clone() if ends else x.detach() for x in rollout.wanted(found)])

    @staticmethod
    def backward(ctx, *cotangents: Tensor | None):
        rollout, tensors, needed = ctx.rollout, ctx.saved_tensors, ctx.needs_input_grad[3:]
        again = torch.is_grad_enabled()
        if again:
            inner = [x.view_as(x) for x in tensors]  # a state may depend on the weights by itself
            found = rollout.repeated(ctx.steps, inner)
        else:
            inner, found = ctx.kept or rollout.differentiable(ctx.steps, tensors, needed)
        given = zip(rollout.wanted(found), cotangents, strict=True)
        pairs = [(y, c) for y, c in given if c is not None and y.requires_grad]
        wanted = [k for k, x in enumerate(inner) if (needed[k] if again else x.requires_grad)]
        gradients: list[Tensor | None] = [None] * len(tensors)
        ends, weighted = [y for y, _ in pairs], [c for _, c in pairs]
        taken = torch.autograd.grad(
            ends, [inner[k] for k in wanted], weighted, create_graph=again, retain_graph=True, allow_unused=True
        )
        for k, gradient in zip(wanted, taken, strict=True):
            gradients[k] = gradient
        if not again:
            torque = gradients[rollout.names.index("torque")]
            weights = rollout.weights(tensors)
            gradients[len(tensors) - len(weights) :] = _of_weights(rollout, found, tensors, weights, torque)
        return None, None, None, *[x if wanted else None for x, wanted in zip(gradients, needed, strict=True)]


def _of_weights(
    rollout: _Rollout,
    found: Mapping[str, Tensor],
    tensors: Sequence[Tensor],
    weights: Sequence[Tensor],
    torque: Tensor | None,
) -> Sequence[Tensor | None]:
    """Gradients of the weights of a network, of the gradient of the torques of all steps."""
    policy = rollout.plan.policy
    if torque is None or policy is None:
        return [None] * len(weights)
    names = [name.partition(".")[2] for name in rollout.fixed[-len(weights) :]]
    rows = {name: x.detach()[:-1] for name, x in found.items() if name in rollout.carried}
    for name, x in zip(rollout.names, tensors, strict=True):
        if name in rollout.series:
            whole = (*torque.shape[:-1], x.shape[-1])
            rows[name] = aligned(x.detach(), whole).expand(whole)
    leaves = [x.detach().requires_grad_() for x in weights]
    with torch.enable_grad():
        torques = policy.at(rows, 0, dict(zip(names, leaves, strict=True)))
    return torch.autograd.grad(torques, leaves, torque, allow_unused=True)
