"""Rollouts: steps one after the other, under given inputs or under a policy."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, Literal, get_args

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as checkpointed

from torchdq.checks import require_choice, require_tensor
from torchdq.envs.starts import not_finite
from torchdq.envs.state import State, require_state
from torchdq.errors import ArgumentError
from torchdq.notice import Notice
from torchdq.program.transforms import without_values

if TYPE_CHECKING:
    from torchdq.envs.scene import Scene

LONG = 50  # steps from which a rollout says how far it is
Policy = Callable[[State], Tensor]
Lost = Literal["warn", "stop", "keep"]


def rollout(
    scene: Scene,
    state: State,
    series: Mapping[str, Tensor],
    steps: int | None,
    policy: Policy | None,
    checkpoint: int,
    lost: Lost,
) -> State:
    """States after each step; see `Scene.rollout`."""
    require_state(state)
    require_choice("lost", lost, get_args(Lost))
    total = _length(series, steps, policy)
    if not isinstance(checkpoint, int) or checkpoint < 0:
        raise ArgumentError(f"checkpoint must not be negative, a whole number, found {checkpoint!r}")
    read = lost != "keep" and not without_values((state.q,))
    if lost == "stop" and not read:
        raise ArgumentError("lost='stop' reads values, which tensors have none of inside a transform or a trace")
    start = scene.finite(state) if read else torch.tensor(False)
    notice = Notice(f"rollout of {total} steps")
    if lost == "warn" and read and (unusable := not_finite(scene, state)):
        warnings.warn(unusable, stacklevel=3)

    def gone(state: State) -> Tensor:
        """Rows that were finite at the start, and are not."""
        return start & ~scene.finite(state)

    def part(first: int, last: int, state: State) -> list[State]:
        found: list[State] = []
        for k in range(first, last):
            notice.at(f"step {k + 1} of {total}")
            given = {name: x[k] for name, x in series.items()}
            if policy is not None:
                given["torque"] = _commanded(policy, state, scene.n)
            state = scene.step(state, **given)
            if lost == "stop" and bool(gone(state).any()):
                break
            found.append(state)
        return found

    stride = checkpoint or max(total, 1)
    found: list[State] = []
    with notice if total >= LONG else nullcontext():
        for first in range(0, total, stride):
            last = min(first + stride, total)
            if checkpoint:
                found += checkpointed(part, first, last, state, use_reentrant=False)
            else:
                found += part(first, last, state)
            if len(found) < last:
                break
            state = found[-1]
    if not found:
        return State._make(None if x is None else x[None][:0] for x in state)
    if lost == "warn" and read and bool((rows := gone(found[-1])).any()):
        step = next(k for k, x in enumerate(found, 1) if bool(gone(x).any()))
        warnings.warn(
            f"{int(rows.sum())} of {rows.numel()} rows left the finite range, the first at step {step} of {total}; "
            f"scene.check(state, seconds) says which step or integrator holds",
            stacklevel=3,
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
    if not isinstance(total, int) or isinstance(total, bool) or total < 0:
        raise ArgumentError(f"steps must not be negative, a whole number, found {total!r}")
    return total


def _commanded(policy: Policy, state: State, n: int) -> Tensor:
    """Torques of a policy."""
    expected = f"torques, a tensor [..., {n}] of {state.q.dtype} like state.q"
    try:
        torque = policy(state)
    except (TypeError, AttributeError) as error:
        absent = [name for name in ("reading", "memory") if getattr(state, name) is None]
        if not absent or "NoneType" not in str(error):
            raise
        raise ArgumentError(
            f"policy must not use state.{' and state.'.join(absent)}, which is None, since the scene has no sensors or "
            f"no effect with a memory, found that it may: {error}; state.measured is there without sensors, too"
        ) from error
    if not isinstance(torque, Tensor):
        raise ArgumentError(f"policy must return {expected}, found {type(torque).__name__}")
    if torque.shape[-1:] != (n,) or torque.dtype != state.q.dtype:
        raise ArgumentError(f"policy must return {expected}, found {torque.dtype} of shape {tuple(torque.shape)}")
    return torque
