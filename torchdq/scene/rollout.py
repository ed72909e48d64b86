"""Rollouts: steps one after the other, under given inputs or under a policy."""

from __future__ import annotations

import inspect
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint as torch_checkpoint
from torch.utils.checkpoint import set_checkpoint_early_stop

from torchdq.base.checks import require_choice, require_count, require_tensor
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.program.loop import by_steps, joined
from torchdq.program.transforms import without_values
from torchdq.scene.loops import CARRY, Done, Part, Plan, Policy, looped, loops
from torchdq.scene.model import SceneModel
from torchdq.scene.policies import Linear, Network
from torchdq.scene.spec import Task
from torchdq.scene.state import State, bent_balls, initial_motion, nonfinite_rows, require_state

LONG = 50  # steps from which a rollout reports its progress
LONG_LOOP = 1_000_000  # steps of joints from which a loop does, since a thread takes as long as a short rollout
Nonfinite = Literal["warn", "ignore"]


def rollout(
    scene: SceneModel,
    state: State,
    torque: Tensor | None = None,
    steps: int | None = None,
    policy: Policy | None = None,
    done: Done | None = None,
    checkpoint: int = 0,
    nonfinite: Nonfinite = "warn",
    task: Task | None = None,
    total: str | Sequence[str] = (),
    ends: bool = False,
    **inputs: Tensor | None,
) -> Any:
    """States after each of a number of steps, shape [steps, ...]; `last` of it is where another rollout goes on.

    With a task, a pair: states, and the task's rows [steps, ...] by name, such as its reward.

    Args:
        state: initial state; it is not part of the result.
        torque: [steps, ..., n]; None: none, for `steps` steps.
        steps: number of steps; None: as many as there are torques.
        policy: function `policy(state, k)` of the state and the number of the step, from 0, that returns the torques
            of this step, shape [..., n], instead of `torque`; a module, for instance. Where there are sensors it should
            look at `state.measured`. One of `torchdq.scene.policies` is recorded with the steps, which is faster, and
            adds to `torque`.
        done: function `done(state)` that is True, shape [...], for rows that have ended: they keep this state to the
            end of the rollout, and their gradient is that of the steps they took. None: no row ends.
        checkpoint: for the gradient, one state in so many is kept, and the others are computed again; 0 keeps the
            inputs of every step. `policy` and `done` are then called again, and must remember nothing: no filter,
            counter or batch norm. Without effect under torch.compile and inside of transforms of `torch.func`.
        nonfinite: "warn": warn if rows are not finite at the start, or no longer at the end; "ignore": do not.
        task: rows of numbers that are recorded with a step, as those of environments; see `torchdq.envs.tasks`.
        total: name or names of rows of the task of which the sum over the steps is returned, shape [...].
        ends: whether only the last state is returned, shape [...]; with `checkpoint`, the gradient keeps no other.
        inputs: as in `step`, shape [steps, ...], and those of the task; its "carry" is given as it is before the first
            step, shape [..., k].

    >>> import torch, torchdq
    >>> scene = torchdq.Scene(torchdq.robots.load("two_link"))
    >>> scene.rollout(
    ...     scene.start(torch.ones(3, 2)), steps=50, policy=lambda s, k: -4 * s.q - s.qd
    ... ).q.shape
    torch.Size([50, 3, 2])
    """
    if task is not None and (isinstance(task, type) or not hasattr(task, "rows")):
        raise ArgumentError(f"task must have the methods inputs(n) and rows(view), as tasks.Reach(), found {task!r}")
    scene.spec.require_inputs((name for name in inputs if name != "noise"), task)
    series = {name: x for name, x in (("torque", torque), *inputs.items()) if x is not None}
    require_state(state)
    require_choice("nonfinite", nonfinite, get_args(Nonfinite))
    _require_function("policy", policy, "state, k")
    _require_function("done", done, "state")
    totals: Sequence[Any] = total if isinstance(total, list | tuple) else (total,)
    plan = Plan(policy, done, task, tuple(totals), ends)
    start = state.rows() | ({CARRY: series.pop(CARRY)} if CARRY in series else {})
    count = _length(series if plan.recorded is None else {**series, **plan.recorded.stepped()}, steps, policy)
    require_count("checkpoint", checkpoint, least=0)
    by_loop = (not count or (policy is plan.recorded and done is None)) and loops(scene, state, plan.recorded)
    traced = not by_loop and without_values((state.q,))
    # a loop keeps its states alone, and returns them unless the last is wanted alone
    checkpoint_useful = ends if by_loop else not (traced or state.q.is_inference())
    use_checkpoints = checkpoint and count and checkpoint_useful and torch.is_grad_enabled()
    notice = Progress(f"rollout of {count} steps")
    long = count * state.q.numel() > LONG_LOOP if by_loop else count >= LONG and not traced
    with notice if long else nullcontext():
        if by_loop:
            part = looped(scene, series, count, plan, state.q)
        else:
            idle = state if done is None else _finite(scene, state)
            part = _Steps(scene, series, plan, idle, lambda k: notice.at(f"step {k + 1} of {count}")).part
        read = partial(_tensors_read, scene, series, plan)
        rows = _checkpointed(part, start, count, plan, checkpoint, read) if use_checkpoints else part(0, count, start)
    states = State(**{name: rows.pop(name) for name in state.rows()})
    summable = rows.keys() - {CARRY}
    for name in plan.total:
        if name not in summable:
            known = ", ".join([x for x in rows if x in summable]) or "none"
            raise ArgumentError(f"total must name rows of the task, {known}, found {name!r}")
    if nonfinite == "warn" and count and not traced:
        _warn(scene, state, states, ends)
    return states if task is None else (states, rows)


def _checkpointed(
    part: Part, start: dict[str, Tensor], steps: int, plan: Plan, stride: int, read: Callable[[], list[Tensor]]
) -> dict[str, Tensor]:
    """Rows of a rollout, of which the gradient keeps a state in `stride` and computes the others again."""
    ends, found, before = dict[int, dict[str, Tensor]](), list[dict[str, Tensor]](), read()
    versions = [(id(x), x._version) for x in before]  # a change may show in the gradient alone

    def checked(first: int, start: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        rows = part(first, min(first + stride, steps), start)
        whole = {*plan.total, *plan.last}
        end = {name: x if name in whole else x[-1].clone() for name, x in rows.items()}
        seen = ends.setdefault(first, {name: x.detach().clone() for name, x in end.items()})
        same = all([torch.allclose(x, end[name], 0.0, 0.0, equal_nan=True) for name, x in seen.items()])
        if not same or [(id(x), x._version) for x in read()] != versions:
            raise ArgumentError(
                "policy, done and all tensors that a step reads must remain the same where checkpoint is not 0, since "
                f"steps are computed again for the gradient, found {'changed tensors' if same else 'other rows'}; use "
                "checkpoint=0, or functions that remember nothing, as modules do after eval(), and take the gradient "
                "before a tensor that they read is changed"
            )
        return rows, {name: end[name] for name in start}

    for first in range(0, steps, stride):
        with set_checkpoint_early_stop(False):  # to the end of a part, which is compared
            rows, start = torch_checkpoint(checked, first, start, use_reentrant=False)
        found.append(rows)
    return joined({name: [rows[name] for rows in found] for name in rows}, torch.cat, plan.total, plan.last)


def _warn(scene: SceneModel, start: State, states: State, ends: bool) -> None:
    """Warn of rows that are not finite at the start or no longer at the end, and of ball joints near right angles."""
    if message := bent_balls(states.q, scene.robot):
        warnings.warn(message, stacklevel=4)
    rows = [x.detach() for x in states.rows().values()]
    if math.isfinite(sum([(x if ends else x[-1]).sum().item() for x in rows])):
        return  # what is not finite remains so
    states = State._make(None if x is None else x[None] for x in states) if ends else states
    if message := nonfinite_rows(start, scene.robot):
        warnings.warn(message, stacklevel=4)
    lost = start.finite() & ~states.finite()
    if number := int(lost[-1].sum()):
        total, step = len(lost), 1 + int(lost.reshape(len(lost), -1).any(1).int().argmax())
        first = "" if ends else f", the first at step {step} of {total}"
        warnings.warn(
            f"{number} of {lost[-1].numel()} rows left the finite range{first}; "
            f"scene.check(state, seconds) finds a step or an integrator that is stable",
            stacklevel=4,
        )


def _length(series: Mapping[str, Tensor], steps: int | None, policy: Policy | None) -> int:
    """Number of steps, after a check of everything that has one."""
    for name, x in series.items():
        if callable(x) and not isinstance(x, Tensor):
            raise ArgumentError(f"{name} must be a tensor, found a function; give one as policy(state, k)")
        require_tensor(name, x)
        if x.ndim < 2:
            raise ArgumentError(f"{name} must have the shape [steps, ...], found {tuple(x.shape)}")
    if policy is not None and not isinstance(policy, Linear | Network) and "torque" in series:
        raise ArgumentError("torque and policy exclude each other; add the torques in the policy")
    lengths = {name: len(x) for name, x in series.items()}
    total = steps if steps is not None else next(iter(lengths.values()), None)
    if total is None:
        raise ArgumentError("steps must be given where there is no torque, whose first axis says how many they are")
    if any(length != total for length in lengths.values()):
        raise ArgumentError(f"steps and the first axes of the inputs must agree, found {steps} and {lengths}")
    require_count("steps", total, least=0)
    return total


def _require_function(name: str, x: Any, arguments: str) -> None:
    """Raise unless x is None, or a function that can be called with those arguments."""
    if x is None or torch.compiler.is_compiling():  # signatures cannot be compiled
        return
    found = x
    if callable(x):
        try:
            found = inspect.signature(x.forward if isinstance(x, nn.Module) else x)
            found.bind(*arguments.split(", "))
            return
        except ValueError:  # some functions written in C do not tell theirs
            return
        except TypeError:
            found = f"one of {found}"
    raise ArgumentError(f"{name} must be a function {name}({arguments}), found {found}")


def _tensors_read(scene: SceneModel, series: Mapping[str, Tensor], plan: Plan) -> list[Tensor]:
    """Tensors that the steps read, beside the state: of the scene, of the inputs, and of modules and functions."""
    parts: list[Any] = [plan.policy, plan.done, *(x for effect in scene.effects for x in vars(effect).values())]
    if plan.recorded is not None:
        parts += [*plan.recorded.stepped().values(), *plan.recorded.weights().values()]
    for closed in [inspect.getclosurevars(part) for part in parts if inspect.isfunction(part)]:
        parts += [*closed.nonlocals.values(), *closed.globals.values()]
    found = [*scene.parameters.values(), *series.values(), *(part for part in parts if isinstance(part, Tensor))]
    found += [x for part in parts if isinstance(part, nn.Module) for x in (*part.parameters(), *part.buffers())]
    # tensors made in inference mode do not tell whether they were changed
    return [x for x in found if not x.is_inference()]


def _finite(scene: SceneModel, state: State) -> State:
    """State with zeros and the unit pose in rows that are not finite."""
    zero = State._make(None if x is None else torch.zeros_like(x) for x in state)
    return _where(state.finite(), state, zero._replace(**initial_motion(scene.spec, {"q": zero.q})))


class _Steps(NamedTuple):
    """Steps of a rollout, by their numbers."""

    scene: SceneModel
    series: Mapping[str, Tensor]
    plan: Plan
    idle: State  # state from which rows that have ended are stepped
    notice: Callable[[int], None]  # of the progress

    def part(self, first: int, last: int, start: dict[str, Tensor]) -> dict[str, Tensor]:
        """Rows of steps that are calls of their own."""
        steps, plan = range(first, last), self.plan
        return plan.after(by_steps(self.after, start, steps, torch.stack, plan.total, plan.last), start)

    def after(self, k: int, before: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Rows after step k of those that have not ended, and the task's rows, which are zero where they have."""
        self.notice(k)
        state = State(**{name: before[name] for name in State._fields if name in before})
        if self.plan.done is None:
            return self._stepped(k, state, before)
        with torch.no_grad():
            ended = self.plan.done(state)
        shape = state.q.shape[:-1]
        if not isinstance(ended, Tensor) or ended.dtype != torch.bool or ended.shape != shape:
            raise ArgumentError(f"done must return a tensor of bool of shape {tuple(shape)}, found {_kind(ended)}")
        # a row that has ended is stepped from its start, or a finite state instead, and that step is left out: where it
        # ended the gradient may not be finite, and zero times that would be NaN in the parameters that all rows share
        found = self._stepped(k, _where(ended, self.idle, state), before)
        held = {**{name: torch.zeros_like(x) for name, x in found.items() if name not in before}, **before}
        masks = {name: ended.view(*shape, *[1] * (x.ndim - ended.ndim)) for name, x in found.items()}
        return {name: torch.where(masks[name], held[name], x) for name, x in found.items()}

    def _stepped(self, k: int, state: State, before: Mapping[str, Tensor]) -> dict[str, Tensor]:
        given = {CARRY: before[CARRY]} if CARRY in before else {}
        given |= {name: x[k] for name, x in self.series.items()}
        noise, policy = given.pop("noise", None), self.plan.policy
        if self.plan.recorded is not None:
            found, control = self.plan.recorded.at({**state.rows(), **given}, k), self.plan.recorded.control
            given[control] = given[control] + found if control in given else found
        elif policy is not None:
            given["torque"] = torque = policy(state, k)
            n, dtype = self.scene.n, state.q.dtype
            if not isinstance(torque, Tensor) or torque.shape[-1:] != (n,) or torque.dtype != dtype:
                raise ArgumentError(
                    f"policy must return torques, a tensor [..., {n}] of {dtype}, found {_kind(torque)}"
                )
        after, rows = self.scene._advance(state, given, noise, self.plan.task)
        return {**after.rows(), **rows}


def _where(rows: Tensor, a: State, b: State) -> State:
    """State of a in some rows, of b in the others."""
    pairs = zip(a, b, strict=True)
    return State._make(None if x is None or y is None else torch.where(rows[..., None], x, y) for x, y in pairs)


def _kind(x: Any) -> str:
    """Kind of a value, in words."""
    return f"{x.dtype} of shape {tuple(x.shape)}" if isinstance(x, Tensor) else type(x).__name__
