"""Rollouts: steps one after the other, under given inputs or under a policy."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import partial
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint as checkpointed

from torchdq.base.checks import require_choice, require_count, require_tensor
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.program.transforms import without_values
from torchdq.scene.model import SceneModel
from torchdq.scene.state import State, nonfinite_rows, require_state

LONG = 50  # steps from which a rollout reports its progress
Policy = Callable[[State], Tensor]
Nonfinite = Literal["warn", "stop", "ignore"]


def rollout(
    scene: SceneModel,
    state: State,
    torque: Tensor | None = None,
    steps: int | None = None,
    checkpoint: int = 0,
    policy: Policy | None = None,
    nonfinite: Nonfinite = "warn",
    **inputs: Tensor | None,
) -> State:
    """States after each of a number of steps, shape [steps, ...].

    Args:
        state: initial state; it is not part of the result.
        torque: [steps, ..., n]; None: none, for `steps` steps.
        steps: number of steps; None: as many as there are torques.
        checkpoint: for the gradient, one state in so many is kept, and the others are computed again; 0 keeps the
            inputs of every step.
        policy: function of the state that returns the torques of a step, shape [..., n], instead of `torque`; a
            module, for instance. Where there are sensors it should look at `state.measured`. With a checkpoint it
            is called again for the gradient, and must remember nothing: no filter, counter or batch norm.
        nonfinite: "warn": warn if rows are not finite at the start, or no longer at the end; "stop": end before
            the first step after which a row is no longer finite; "ignore": neither.
        inputs: as in `step`, shape [steps, ...].

    >>> import torch, torchdq
    >>> scene = torchdq.Scene(torchdq.robots.load("two_link"))
    >>> scene.rollout(scene.start(torch.ones(3, 2)), steps=50, policy=lambda s: -4 * s.q - s.qd).q.shape
    torch.Size([50, 3, 2])
    """
    scene.spec.require_inputs(name for name in inputs if name != "noise")
    series = {name: x for name, x in (("torque", torque), *inputs.items()) if x is not None}
    require_state(state)
    require_choice("nonfinite", nonfinite, get_args(Nonfinite))
    total = _length(series, steps, policy)
    require_count("checkpoint", checkpoint, least=0)
    unseen = without_values((state.q,))
    if nonfinite == "stop" and unseen:
        raise ArgumentError(
            "nonfinite='stop' reads values, which tensors have none of inside a transform, a trace or a graph"
        )
    warned = nonfinite == "warn" and not unseen
    start = state.finite() if nonfinite != "ignore" and not unseen else state.q.new_zeros((), dtype=torch.bool)
    notice = Progress(f"rollout of {total} steps")
    if warned and (message := nonfinite_rows(state, scene.robot)):
        warnings.warn(message, stacklevel=2)

    def diverged(state: State) -> Tensor:
        """Rows that were finite at the start, and are not."""
        return start & ~state.finite()

    again = bool(checkpoint) and torch.is_grad_enabled() and not unseen
    commands = None if policy is None else _Commands(policy, scene.n, again, {})

    def part(first: int, last: int, state: State) -> list[State]:
        found: list[State] = []
        for k in range(first, last):
            notice.at(f"step {k + 1} of {total}")
            given = {name: x[k] for name, x in series.items()}
            if commands is not None:
                given["torque"] = commands.at(k, state)
            state = scene.step(state, **given)
            if nonfinite == "stop" and bool(diverged(state).any()):
                break
            found.append(state)
        return found

    run = partial(checkpointed, part, use_reentrant=False) if checkpoint else part
    stride = checkpoint or max(total, 1)
    found: list[State] = []
    with notice if total >= LONG and not unseen else nullcontext():
        for first in range(0, total, stride):
            last = min(first + stride, total)
            found += run(first, last, state)
            if len(found) < last:
                break
            state = found[-1]
    if not found:
        return State._make(None if x is None else x[None][:0] for x in state)
    if warned and bool((rows := diverged(found[-1])).any()):
        step = next(k for k, x in enumerate(found, 1) if bool(diverged(x).any()))
        warnings.warn(
            f"{int(rows.sum())} of {rows.numel()} rows left the finite range, the first at step {step} of {total}; "
            f"scene.check(state, seconds) finds a step or an integrator that is stable",
            stacklevel=2,
        )
    return State._make(None if rows[0] is None else torch.stack(rows) for rows in zip(*found, strict=True))


def _length(series: Mapping[str, Tensor], steps: int | None, policy: Policy | None) -> int:
    """Number of steps, after a check of everything that has one."""
    for name, x in series.items():
        if callable(x) and not isinstance(x, Tensor):
            raise ArgumentError(f"{name} must be a tensor, found a function; one of the state is given as policy")
        require_tensor(name, x)
        if x.ndim < 2:
            raise ArgumentError(f"{name} must have the shape [steps, ...], found {tuple(x.shape)}")
    if policy is not None and not callable(policy):
        raise ArgumentError(f"policy must be a function of the state that returns torques, found {policy!r}")
    if policy is not None and "torque" in series:
        raise ArgumentError("torque and policy exclude each other; add the torques in the policy")
    lengths = {name: len(x) for name, x in series.items()}
    total = steps if steps is not None else next(iter(lengths.values()), None)
    if total is None:
        raise ArgumentError("steps must be given where there is no torque, whose first axis says how many they are")
    if any(length != total for length in lengths.values()):
        raise ArgumentError(f"steps and the first axes of the inputs must agree, found {steps} and {lengths}")
    require_count("steps", total, least=0)
    return total


class _Commands(NamedTuple):
    """Torques of a policy, which must depend on the state alone where it is called again for the gradient."""

    policy: Policy
    n: int
    again: bool
    first: dict[int, Tensor]  # torques of the first call by step, if there is another

    def _buffers(self) -> list[tuple[str, Tensor, int]]:
        """Buffers of a policy that is a module, by name, and how often each was changed in place."""
        found = self.policy.named_buffers() if self.again and isinstance(self.policy, nn.Module) else ()
        return [(name, x, x._version) for name, x in found if not x.is_inference()]

    def at(self, k: int, state: State) -> Tensor:
        """Torques of a step."""
        before, torque = self._buffers(), self.policy(state)
        if not isinstance(torque, Tensor) or torque.shape[-1:] != (self.n,) or torque.dtype != state.q.dtype:
            found = type(torque).__name__
            if isinstance(torque, Tensor):
                found = f"{torque.dtype} of shape {tuple(torque.shape)}"
            raise ArgumentError(
                f"policy must return torques, a tensor [..., {self.n}] of {state.q.dtype}, found {found}"
            )
        if not self.again:
            return torque
        changed = [a[0] for a, b in zip(before, self._buffers(), strict=False) if a[1] is not b[1] or a[2] != b[2]]
        first = self.first.setdefault(k, torque.detach().clone())
        other = first.shape != torque.shape or bool(((first != torque) & ~(first.isnan() & torque.isnan())).any())
        if changed or other:
            found = f"that it changes its buffer {changed[0]!r}" if changed else "other torques the second time"
            raise ArgumentError(
                f"policy must depend on the state alone where checkpoint is not 0, since it is called again for the "
                f"gradient, found {found}; use checkpoint=0, or a policy that remembers nothing, as after policy.eval()"
            )
        return torque
