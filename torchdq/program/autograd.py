"""Programs as operations of torch: gradients, forward mode, `vmap` and traced graphs.

Derivatives of a program are programs, run in the same way, so only the arguments are kept between forward and
backward. The function that runs a program is an argument; this module does not depend on a backend.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from typing import Protocol

import torch
from torch import Tensor, library

from torchdq.base.caches import LAYOUTS, PROGRAMS, Bounded, remembered
from torchdq.errors import ArgumentError
from torchdq.program import autodiff
from torchdq.program.program import Argument, Program, samples_of
from torchdq.program.transforms import any_requires_grad, in_a_batch_of_gradients, jit_tracing, transforming

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
    if transforming():
        return _Transformable.apply(execute, program, *inputs)
    return _Differentiable.apply(execute, program, *inputs) if in_a_graph(inputs) else execute(program, inputs)


def _gradients(ctx, needed: Sequence[bool], cotangents: Sequence[Tensor]) -> list:
    """Gradients of the inputs that need one, by the vector-Jacobian product of the program; None for the others."""
    derivative, rows = vjp(ctx.program, tuple([k for k, wanted in enumerate(needed) if wanted])), ctx.saved_tensors
    whole = [y.contiguous() for y in cotangents]  # that of a sum is one number without others in memory
    gradients = iter(_derived(ctx.execute, derivative, rows, whole))
    return [next(gradients) if wanted else None for wanted in needed]


def _derived(
    execute: Execute, derivative: Program, rows: Sequence[Tensor], directions: Sequence[Tensor]
) -> Sequence[Tensor]:
    """Results of a derivative, by torch's own operations where autograd maps over directions."""
    if in_a_batch_of_gradients(directions):
        return execute.by_torch(derivative, [*rows, *directions])
    return differentiable(execute, derivative, [*rows, *directions])


class _Differentiable(torch.autograd.Function):
    """Program with reverse-mode gradients."""

    @staticmethod
    def forward(ctx, execute: Execute, program: Program, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.execute, ctx.program = execute, program
        ctx.save_for_backward(*inputs)
        return tuple(execute(program, inputs))

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        return None, None, *_gradients(ctx, ctx.needs_input_grad[2:], cotangents)


class _Transformable(torch.autograd.Function):
    """Program for `torch.func` and forward-mode differentiation; slower per call than `_Differentiable`."""

    @staticmethod
    def forward(execute: Execute, program: Program, *inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(execute(program, inputs))

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.execute, ctx.program, *rows = inputs
        ctx.save_for_backward(*rows)
        ctx.save_for_forward(*rows)

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        return None, None, *_gradients(ctx, ctx.needs_input_grad[2:], cotangents)

    @staticmethod
    def jvp(ctx, _execute, _program, *tangents: Tensor | None) -> tuple[Tensor, ...]:
        wrt = tuple(k for k, t in enumerate(tangents) if t is not None)
        present = [t for t in tangents if t is not None]
        return tuple(_derived(ctx.execute, jvp(ctx.program, wrt), ctx.saved_tensors, present))

    @staticmethod
    def vmap(info, in_dims, execute: Execute, program: Program, *inputs: Tensor):
        size, arguments = info.batch_size, program.arguments
        dims = in_dims[2:]
        samples = next(
            (x.shape[int(d == 0)] for x, d, a in zip(inputs, dims, arguments, strict=True) if not a.uniform), 1
        )
        rows = []
        for x, d, a in zip(inputs, dims, arguments, strict=True):
            x = x.unsqueeze(0) if d is None else x.movedim(d, 0)
            x = x.unsqueeze(1) if a.uniform else x
            rows.append(x.expand(size, samples, a.width).reshape(size * samples, a.width))
        results = [y.reshape(size, samples, y.shape[-1]) for y in differentiable(execute, per_sample(program), rows)]
        results = [y.sum(1) if r.summed else y for y, r in zip(results, program.results, strict=True)]
        return tuple(results), (0,) * len(results)


@remembered(PROGRAMS)
def per_sample(program: Program) -> Program:
    """Program without uniform arguments and without sums over samples."""
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
