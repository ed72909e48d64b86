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
from torch.utils.checkpoint import checkpoint as checkpointed

from torchdq.base.checks import require_choice, require_count, require_tensor
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.program.transforms import without_values
from torchdq.scene.loops import Plan, looped, loops
from torchdq.scene.model import SceneModel
from torchdq.scene.policies import Linear, Network
from torchdq.scene.spec import Task
from torchdq.scene.state import State, initial_motion, nonfinite_rows, require_state

CARRY = "carry"  # row of a task that is its input at the next step
LONG = 50  # steps from which a rollout reports its progress
LONG_LOOP = 1_000_000  # steps of joints from which a loop does, since a thread takes as long as a short rollout
Policy = Callable[[State, int], Tensor]
Done = Callable[[State], Tensor]
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
            look at `state.measured`. One of `torchdq.envs.policies` is recorded with the steps, which is faster, and
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
    >>> scene.rollout(scene.start(torch.ones(3, 2)), steps=50, policy=lambda s, k: -4 * s.q - s.qd).q.shape
    torch.Size([50, 3, 2])
    """
    scene.spec.require_inputs((name for name in inputs if name != "noise"), task)
    series = {name: x for name, x in (("torque", torque), *inputs.items()) if x is not None}
    require_state(state)
    require_choice("nonfinite", nonfinite, get_args(Nonfinite))
    _require_function("policy", policy, "state, k")
    _require_function("done", done, "state")
    own = policy.stepped() if isinstance(policy, Linear | Network) else {}
    count = _length({**{name: x for name, x in series.items() if name != CARRY}, **own}, steps, policy)
    require_count("checkpoint", checkpoint, least=0)
    totals = (total,) if isinstance(total, str) else tuple(total)
    plan = Plan(policy if isinstance(policy, Linear | Network) else None, task, totals, ends)
    if isinstance(policy, Linear) and scene.robot.floating:
        raise ArgumentError(f"policy must be a function for robot {scene.robot.name!r}: a floating base has no gains")
    by_loop = (policy is None or plan.policy is not None) and done is None and loops(scene, state, plan.policy)
    if by_loop:
        states, rows = _by_loop(scene, state, series, count, plan, checkpoint)
    else:
        states, rows = _by_steps(scene, state, series, count, plan, {"policy": policy, "done": done}, checkpoint)
    for name in totals:
        if name not in rows:
            raise ArgumentError(f"total must name rows of the task, {', '.join(rows) or 'none'}, found {name!r}")
    if nonfinite == "warn" and count and (by_loop or not without_values((state.q,))):
        _warn(scene, state, states, ends)
    return states if task is None else (states, rows)


def _by_loop(
    scene: SceneModel, state: State, series: Mapping[str, Tensor], steps: int, plan: Plan, checkpoint: int
) -> tuple[State, dict[str, Tensor]]:
    """States after each step, and the task's rows, by one call."""
    start, series = state.rows(), {**series}
    if CARRY in series:
        start[CARRY] = series.pop(CARRY)
    with Progress(f"rollout of {steps} steps") if steps * state.q.numel() > LONG_LOOP else nullcontext():
        found = looped(scene, start, series, steps, plan, checkpoint)
    rows = {name: x[1:] if name in start and not plan.ends else x for name, x in found.items()}
    return State(**{name: rows.pop(name) for name in state.rows()}), rows


def _by_steps(
    scene: SceneModel,
    state: State,
    series: Mapping[str, Tensor],
    steps: int,
    plan: Plan,
    functions: Mapping[str, Callable[..., Tensor] | None],
    checkpoint: int,
) -> tuple[State, dict[str, Tensor]]:
    """States after each step, and the task's rows, by so many calls; of `checkpoint` states, the gradient keeps one."""
    unseen = without_values((state.q,))
    again = bool(checkpoint) and torch.is_grad_enabled() and not (unseen or state.q.is_inference())
    asked = {name: _Asked(name, x, again, {}) for name, x in functions.items() if x is not None}
    idle = _finite(scene, state) if "done" in asked else state
    carry, series = series.get(CARRY), {name: x for name, x in series.items() if name != CARRY}
    follow, notice = _Steps(scene, series, plan, asked, idle), Progress(f"rollout of {steps} steps")
    read = _tensors_read(scene, series, asked) if again else []

    def part(first: int, last: int, carry: Tensor | None, *tensors: Tensor | None) -> list[_After]:
        found, state = [], State._make(tensors[: len(State._fields)])
        for k in range(first, last):
            notice.at(f"step {k + 1} of {steps}")
            state, rows = follow.after(k, state, carry)
            carry = None if carry is None else rows[CARRY]
            found.append((state, rows))
        return found

    # torch refuses the gradient if an argument of what it runs again was changed in place since
    run = partial(checkpointed, part, use_reentrant=False) if again else part
    stride, end = checkpoint or max(steps, 1), state
    found: list[_After] = []
    with notice if steps >= LONG and not unseen else nullcontext():
        for first in range(0, steps, stride):
            found += run(first, min(first + stride, steps), carry, *end, *read)
            end, rows = found[-1]
            carry = None if carry is None else rows[CARRY]
    return _joined(found, state, plan)


_After = tuple[State, dict[str, Tensor]]  # state after a step, and rows of the task


def _joined(found: Sequence[_After], start: State, plan: Plan) -> _After:
    """States and rows of all steps."""
    if not found:
        return State._make(None if x is None else x[None][:0] for x in start), {}
    parts = zip(*[state for state, _ in found], strict=True)
    states = State._make(None if x[0] is None else torch.stack(x) for x in parts)
    rows = {name: [rows[name] for _, rows in found] for name in found[-1][1]}
    joined = {
        name: sum(x[1:], x[0]) if name in plan.total else x[-1] if plan.ends and name == CARRY else torch.stack(x)
        for name, x in rows.items()
    }
    return states.last if plan.ends else states, joined


@torch.no_grad()
def _warn(scene: SceneModel, start: State, states: State, ends: bool) -> None:
    """Warn of rows that are not finite at the start, and of those that are no longer so at the end."""
    states = State._make(None if x is None else x[None] for x in states) if ends else states
    if math.isfinite(sum([x[-1].sum().item() for x in states.rows().values()])):
        return  # what is not finite remains so
    if message := nonfinite_rows(start, scene.robot):
        warnings.warn(message, stacklevel=4)
    lost = start.finite() & ~states.finite()
    if rows := int(lost[-1].sum()):
        total, step = len(lost), 1 + int(lost.flatten(1).any(1).int().argmax())
        first = "" if ends else f", the first at step {step} of {total}"
        warnings.warn(
            f"{rows} of {lost[-1].numel()} rows left the finite range{first}; "
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


def _tensors_read(scene: SceneModel, series: Mapping[str, Tensor], asked: Mapping[str, _Asked]) -> list[Tensor]:
    """Tensors that the steps read, beside the state: of the scene, of the inputs, and of modules and functions."""
    parts = [*(x.function for x in asked.values()), *(x for effect in scene.effects for x in vars(effect).values())]
    recorded = [part for part in parts if isinstance(part, Linear | Network)]
    parts += [x for part in recorded for x in (*part.stepped().values(), *part.weights().values())]
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


class _Asked(NamedTuple):
    """Function of the user, which must depend on its arguments alone where it is called again for the gradient."""

    name: str
    function: Callable[..., Tensor]
    again: bool
    first: dict[int, Tensor]  # results of the first call by step, if there is another

    def _buffers(self) -> list[tuple[str, Tensor, int]]:
        """Buffers of a function that is a module, by name, and how often each was changed in place."""
        found = self.function.named_buffers() if self.again and isinstance(self.function, nn.Module) else ()
        return [(name, x, x._version) for name, x in found if not x.is_inference()]

    def at(self, k: int, *arguments: Any) -> Tensor:
        """Result of the function at a step."""
        before, x = self._buffers(), self.function(*arguments)
        if not self.again or not isinstance(x, Tensor):
            return x
        changed = [a[0] for a, b in zip(before, self._buffers(), strict=False) if a[1] is not b[1] or a[2] != b[2]]
        first = self.first.setdefault(k, x.detach().clone())
        other = first.shape != x.shape or bool(((first != x) & ~(first.isnan() & x.isnan())).any())
        if changed or other:
            found = f"that it changes its buffer {changed[0]!r}" if changed else "another result the second time"
            raise ArgumentError(
                f"{self.name} must depend on its arguments alone where checkpoint is not 0, since it is called again "
                f"for the gradient, found {found}; use checkpoint=0, or a {self.name} that remembers nothing, as "
                f"modules do after eval(), and take the gradient before a tensor that it reads is changed"
            )
        return x


class _Steps(NamedTuple):
    """Steps of a rollout, by their numbers."""

    scene: SceneModel
    series: Mapping[str, Tensor]
    plan: Plan
    asked: Mapping[str, _Asked]
    idle: State  # state from which rows that have ended are stepped

    def after(self, k: int, state: State, carry: Tensor | None) -> _After:
        """State after step k of the rows that have not ended, and the task's rows, which are zero where they have."""
        if "done" not in self.asked:
            return self._stepped(k, state, carry)
        with torch.no_grad():
            ended = self.asked["done"].at(k, state)
        shape = state.q.shape[:-1]
        if not isinstance(ended, Tensor) or ended.dtype != torch.bool or ended.shape != shape:
            raise ArgumentError(f"done must return a tensor of bool of shape {tuple(shape)}, found {_kind(ended)}")
        # a row that has ended is stepped from its start, or a finite state instead, and that step is left out: where it
        # ended the gradient may not be finite, and zero times that would be NaN in the parameters that all rows share
        found, rows = self._stepped(k, _where(ended, self.idle, state), carry)
        idle = {name: carry if name == CARRY and carry is not None else torch.zeros_like(x) for name, x in rows.items()}
        masks = {name: ended.view(*shape, *[1] * (x.ndim - ended.ndim)) for name, x in rows.items()}
        rows = {name: torch.where(masks[name], idle[name], x) for name, x in rows.items()}
        return _where(ended, state, found), rows

    def _stepped(self, k: int, state: State, carry: Tensor | None) -> _After:
        given = {} if carry is None else {CARRY: carry}
        given |= {name: x[k] for name, x in self.series.items()}
        noise = given.pop("noise", None)
        if self.plan.policy is not None:
            torque = self.plan.policy.at({**state.rows(), **given}, k)
            given["torque"] = given["torque"] + torque if "torque" in given else torque
        elif "policy" in self.asked:
            given["torque"] = torque = self.asked["policy"].at(k, state, k)
            n, dtype = self.scene.n, state.q.dtype
            if not isinstance(torque, Tensor) or torque.shape[-1:] != (n,) or torque.dtype != dtype:
                raise ArgumentError(
                    f"policy must return torques, a tensor [..., {n}] of {dtype}, found {_kind(torque)}"
                )
        return self.scene.advance(state, given, noise, self.plan.task)


def _where(rows: Tensor, a: State, b: State) -> State:
    """State of a in some rows, of b in the others."""
    pairs = zip(a, b, strict=True)
    return State._make(None if x is None or y is None else torch.where(rows[..., None], x, y) for x, y in pairs)


def _kind(x: Any) -> str:
    """Kind of a value, in words."""
    return f"{x.dtype} of shape {tuple(x.shape)}" if isinstance(x, Tensor) else type(x).__name__
