"""Programs as operations of torch: gradients, forward mode, `vmap` and traced graphs.

Derivatives of a program are programs, run in the same way, so only the arguments are kept between forward and
backward. The function that runs a program is an argument; this module does not depend on a backend.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from hashlib import sha256
from typing import Protocol

import torch
from torch import Tensor, library

from torchdq.base.caches import LAYOUTS, PROGRAMS, Bounded, remembered
from torchdq.errors import ArgumentError
from torchdq.program import autodiff
from torchdq.program.program import Argument, Program, samples_of
from torchdq.program.transforms import (
    Level,
    SingleLevelFunction,
    alive,
    any_requires_grad,
    batches_of_gradients,
    functional,
    in_a_batch_of_gradients,
    innermost,
    jit_tracing,
    transforming,
    with_batch,
    without_batch,
)

vjp = remembered(PROGRAMS)(autodiff.vjp)
jvp = remembered(PROGRAMS)(autodiff.jvp)


class Execute(Protocol):
    """Function that runs programs, without gradients."""

    def __call__(self, program: Program, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
        """Results of a program."""

    @property
    def by_torch(self) -> Execute:
        """Function that runs them as torch's own operations, which all transforms of torch support."""


def in_a_graph(inputs: Sequence[Tensor]) -> bool:
    """Whether torch must record operations on these tensors: for gradients, in a transform or in torch.jit.trace."""
    return transforming() or jit_tracing() or (torch.is_grad_enabled() and any_requires_grad(*inputs))


def differentiable(execute: Execute, program: Program, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
    """Results of a program, recorded for gradients and transforms only where torch needs it."""
    return _transformed(execute, program, inputs) if functional() else _plain(execute, program, inputs)


def _plain(execute: Execute, program: Program, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
    """Results of a program outside of the transforms of torch.func."""
    return recorded(execute, program, inputs) if in_a_graph(inputs) else execute(program, inputs)


def recorded(execute: Execute, program: Program, inputs: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Results of a program, recorded for gradients."""
    return _Differentiable.apply(execute, program, *inputs)


def _gradients(ctx, needed: Sequence[bool], cotangents: Sequence[Tensor]) -> list:
    """Gradients of the inputs that need one, by the vector-Jacobian product of the program; None for the others."""
    rows = ctx.saved_tensors  # read once, as torch's checkpoints ask for
    derivative = vjp(ctx.program, tuple([k for k, wanted in enumerate(needed) if wanted]))
    gradients = iter(_derived(ctx, derivative, rows, cotangents))
    # of a row that was broadcast, autograd sums them
    return [next(gradients) if wanted else None for wanted in needed]


def _derived(ctx, derivative: Program, rows: Sequence[Tensor], directions: Sequence[Tensor]) -> Sequence[Tensor]:
    """Results of a derivative; directions that autograd maps over are a batch."""
    inputs = [*rows, *directions]
    if not in_a_batch_of_gradients(directions):
        whole = [x.contiguous() for x in directions]  # that of a sum is one number without others in memory
        return ctx.run(ctx.execute, derivative, [*rows, *whole])
    levels = batches_of_gradients()
    aligned = [x.unsqueeze(0) if a.uniform else x for x, a in zip(inputs, derivative.arguments, strict=True)]
    for level in reversed(levels):
        aligned = [without_batch(x, level) for x in aligned]
    if in_a_batch_of_gradients(aligned):  # an empty one
        return ctx.execute.by_torch(derivative, inputs)
    found = _transformed(ctx.execute, per_sample(derivative), aligned)
    found = [y.sum(-2) if r.summed else y for y, r in zip(found, derivative.results, strict=True)]
    for level in levels:
        found = [with_batch(y, level) for y in found]
    return found


class _Differentiable(torch.autograd.Function):
    """Program with reverse-mode gradients, and with tangents in forward mode."""

    @staticmethod
    def forward(ctx, execute: Execute, program: Program, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.execute, ctx.program, ctx.run = execute, program, differentiable
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)
        return tuple(execute(program, inputs))

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        return None, None, *_gradients(ctx, ctx.needs_input_grad[2:], cotangents)

    @staticmethod
    def jvp(ctx, _execute, _program, *tangents: Tensor | None) -> tuple[Tensor, ...]:
        wrt = tuple(k for k, t in enumerate(tangents) if t is not None)
        present = [t for t in tangents if t is not None]
        return tuple(_derived(ctx, jvp(ctx.program, wrt), ctx.saved_tensors, present))


# --- transforms of torch.func ----------------------------------------------------------------------------------------


def _transformed(execute: Execute, program: Program, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
    """Results of a program under the transforms that are active, each of which removes itself, the last one first.

    Axes that `vmap` maps over are batch axes, which broadcast until the program runs. This takes a fraction of the time
    of torch's own way for an `autograd.Function`, which searches all arguments for tensors at every transform.
    """
    level, inputs = innermost(), [alive(x) for x in inputs]
    if level is None:
        return _of_any_axes(partial(_plain, execute), program, inputs)
    if level.maps:
        return _mapped(level, execute, program, inputs)
    if not level.differentiates:
        return _of_any_axes(execute.by_torch, program, inputs)
    if all([level.constant(x) is x for x in inputs]):
        with level.below():
            return _transformed(execute, program, inputs)
    with level.recording():
        return _AtLevel.apply((execute, level), program, *[level.differentiated(x) for x in inputs])


def _mapped(level: Level, execute: Execute, program: Program, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
    """Results of a program under `vmap`, whose axis becomes the first one."""
    pairs = [level.unmapped(x) for x in inputs]
    if all(dim is None for _, dim in pairs):
        with level.below():
            return _transformed(execute, program, inputs)
    with level.below():
        own = [x.ndim - (dim is not None) + a.uniform for (x, dim), a in zip(pairs, program.arguments, strict=True)]
        rows = []
        for (x, dim), a, ndim in zip(pairs, program.arguments, own, strict=True):
            x = x.movedim(dim, 0) if dim else x
            x = x.unsqueeze(-2) if a.uniform else x
            lacking = 0 if dim is None else max(own) - ndim
            rows.append(x.reshape(x.shape[0], *(1,) * lacking, *x.shape[1:]) if lacking else x)
        found = _transformed(execute, per_sample(program), rows)
        found = [y.sum(-2) if r.summed else y for y, r in zip(found, program.results, strict=True)]
    return [level.mapped(y) for y in found]


def _of_any_axes(run: Callable[..., Sequence[Tensor]], program: Program, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
    """Results of a program whose arguments may have several axes that broadcast, by a function of rows."""
    ndim = max([x.ndim for x in inputs])
    if ndim <= 2:
        return run(program, inputs)
    sizes = zip(*[(1,) * (ndim - x.ndim) + x.shape[:-1] for x in inputs], strict=True)
    batch = [next((n for n in among if n != 1), 1) for among in sizes]
    samples = math.prod(batch)
    rows = [x.expand(*batch, -1).reshape(samples, x.shape[-1]) for x in inputs]
    return [y.view(*batch, y.shape[-1]) for y in run(program, rows)]


class _AtLevel(SingleLevelFunction):
    """Program under a transform that differentiates."""

    @staticmethod
    def forward(ctx, how: tuple[Execute, Level], program: Program, *inputs: Tensor) -> tuple[Tensor, ...]:
        (ctx.execute, level), ctx.program, ctx.run = how, program, _transformed
        ctx.save_for_backward(*inputs)
        ctx.save_for_forward(*inputs)
        rows = [level.constant(x) for x in inputs]
        with level.below_recording():
            found = _transformed(ctx.execute, program, rows)
        return tuple([level.result(y) for y in found])

    backward, jvp = staticmethod(_Differentiable.backward), staticmethod(_Differentiable.jvp)


@remembered(PROGRAMS)
def per_sample(program: Program) -> Program:
    """Program without uniform arguments and without sums over samples; the program itself if it has none."""
    if not any([x.uniform for x in program.arguments]) and not any([r.summed for r in program.results]):
        return program
    return replace(
        program,
        arguments=tuple(Argument(a.name, a.width) for a in program.arguments),
        results=tuple(r._replace(summed=False) for r in program.results),
    )


# --- traced graphs ---------------------------------------------------------------------------------------------------

_named: Bounded[str, tuple[Execute, Program]] = Bounded(LAYOUTS)


def named(execute: Execute, program: Program) -> str:
    """Name by which a traced graph calls a program: a hash of its text."""
    name = sha256(f"{execute}\n{program}".encode()).hexdigest()
    _named[name] = execute, program
    return name


def _found(name: str) -> tuple[Execute, Program]:
    """Program of a name.

    A graph from torch's cache on disk may name derivatives that this process has not recorded yet; they are recorded.
    """
    if name not in _named:
        primal, derived, wrt = name.rpartition(":")
        if not derived:
            raise ArgumentError(
                "a traced graph calls a program that was recorded in another process or removed by clear_caches; trace "
                "or export the graph again in this process"
            )
        execute, program = _found(primal)
        _named[name] = execute, vjp(program, tuple(map(int, wrt.split(","))))
    return _named[name]


# A graph that torch.compile traces calls `evaluate`, which is differentiable; where autograd sees it, it becomes `run`,
# so a compiled graph calls `run` alone. `library.custom_op` would take ten microseconds more at each call.
_LIBRARY = library.Library("torchdq", "DEF")
for _name in ("evaluate", "run"):
    _LIBRARY.define(f"{_name}(str program, Tensor[] inputs) -> Tensor[]", tags=(torch.Tag.pt2_compliant_tag,))
operator = torch.ops.torchdq.evaluate.default  # results of a program, which a graph calls by its name
_run = torch.ops.torchdq.run.default


def _executed(program: str, inputs: Sequence[Tensor]) -> list[Tensor]:
    execute, found = _found(program)
    return [*execute(found, inputs)]


def _empty(program: str, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Results without values."""
    _, found = _found(program)
    samples = samples_of(found, inputs)
    return [inputs[0].new_empty((len(r.values),) if r.summed else (samples, len(r.values))) for r in found.results]


class _DifferentiableByName(torch.autograd.Function):
    """Program of a name, with reverse-mode gradients."""

    @staticmethod
    def forward(ctx, program: str, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.program = program
        ctx.save_for_backward(*inputs)
        return tuple(_run(program, inputs))

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        needed = ctx.needs_input_grad[1:]
        wrt = ",".join([str(k) for k, wanted in enumerate(needed) if wanted])
        gradients = iter(operator(f"{ctx.program}:{wrt}", [*ctx.saved_tensors, *cotangents]))
        return None, *[next(gradients) if wanted else None for wanted in needed]


def _recorded(program: str, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
    if transforming():  # only torch's own operations carry tangents
        execute, found = _found(program)
        return list(execute.by_torch(found, inputs))
    if torch.is_grad_enabled() and any_requires_grad(*inputs):
        return list(_DifferentiableByName.apply(program, *inputs))
    return _run(program, inputs)


for _name in ("evaluate", "run"):
    _LIBRARY.impl(_name, _executed, "CompositeExplicitAutograd")
    library.register_fake(f"torchdq::{_name}", _empty, lib=_LIBRARY)
_LIBRARY.impl("evaluate", _recorded, "Autograd")
