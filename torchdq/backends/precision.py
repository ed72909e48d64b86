"""Precision of a result: a program is run with a backend, and in float64 for rows whose rounding errors are too large.

The last output of a program is the factor by which it magnifies rounding errors. Rows over the float32 limit are
recomputed in float64 and rounded; rows over the float64 limit become NaN. Other rows do not change. The host
reads the factors; on a GPU, where that would be a synchronisation, the kernels of the backend do all of this.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Sequence
from functools import partial
from typing import NamedTuple, cast

import torch
from torch import Tensor

from torchdq.backends import choice
from torchdq.backends.backend import Backend, DirectKernel, Form, largest_growth
from torchdq.backends.c import C
from torchdq.backends.fast_call import FastCall, Forms, keep, learn, quick
from torchdq.backends.torch import EAGER, interpreted_loop
from torchdq.base.caches import LAYOUTS, remembered
from torchdq.errors import ArgumentError
from torchdq.program import loop_autograd
from torchdq.program.autograd import differentiable, in_a_graph, recorded
from torchdq.program.loop import Loop
from torchdq.program.program import Program, samples_of
from torchdq.program.transforms import (
    alike,
    empty_on_cpu,
    forward_mode,
    jit_tracing,
    modes,
    proxy_tracing,
    transforming,
    without_values,
)


class Guarded(NamedTuple):
    """Backend with the fallback to float64, as a function that runs programs."""

    backend: Backend

    def __call__(self, program: Program, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
        """Results of a program."""
        if self.backend.differentiable or any([r.summed for r in program.results]):
            return guarded(self.backend, program, inputs)
        key, _, quickly = quick((self, program), inputs)
        if quickly is not None:
            return quickly
        found, samples = guarded(self.backend, program, inputs), samples_of(program, inputs)
        names, like = tuple([r.name for r in program.results]), inputs[0].dtype
        shapes = [y.shape for y in found]  # torch records nothing here
        learn(
            key, self.backend, program, samples, 1, lambda: Forms.of(inputs, shapes, like, names, samples, learned=True)
        )
        return found

    @property
    def by_torch(self) -> Guarded:
        """Function that runs programs as torch's own operations."""
        return Guarded(EAGER)


def run(program: Program, inputs: Sequence[Tensor], backend: Backend) -> Sequence[Tensor]:
    """Results of a program, differentiable to any order; tensors are [samples, width], uniform ones [width]."""
    if backend.differentiable:
        return guarded(backend, program, inputs)
    if jit_tracing() or proxy_tracing():
        raise ArgumentError(
            f"torch.jit.trace and make_fx cannot record the compiled program {program.name!r}; trace with "
            "backend='eager', or use torch.export or torch.compile"
        )
    return differentiable(Guarded(backend), program, inputs)


def learn_graph(
    key: Hashable, backend: Backend, program: Program, given: Collection[Tensor | None], names: tuple[str, ...]
) -> None:
    """Let calls with a key of `quick` be fast where torch records gradients, for rows like these."""
    if not isinstance(backend, C):
        return
    rows = [x for x in given if x is not None]
    forms = tuple([(tuple(x.shape), tuple(x.stride()), x.dtype) for x in rows])
    absent, learned = tuple([x is None for x in given]), tuple([x.requires_grad for x in rows])
    keep(key, _graph_call(program, backend, forms, learned, absent, names), last=True)  # a look takes longer than in C


@remembered(LAYOUTS)
def _graph_call(
    program: Program,
    backend: Backend,
    forms: tuple[Form, ...],
    learned: tuple[bool, ...],
    absent: tuple[bool, ...],
    names: tuple[str, ...],
) -> FastCall:
    """Fast call of `run` where torch records gradients, for rows of these forms.

    Args:
        learned: whether each of the rows requires grad.
        absent: whether each argument of the call is None.
    """
    fits, execute = alike(forms, learned), Guarded(backend)

    def call(*given: Tensor | None) -> tuple[Tensor, ...] | None:
        rows = [x for x in given if x is not None]
        if (
            [x is None for x in given] != known
            or choice.present() != "auto"
            or forward_mode()
            or modes()
            or not fits(*rows)
        ):
            return None
        return recorded(execute, program, rows)

    known = list(absent)
    return FastCall(call, names)


def run_loop(
    loop: Loop, inputs: Sequence[Tensor], backend: Backend, samples: int, steps: int, among: int = 0
) -> Sequence[Tensor]:
    """Results of a loop; samples whose errors grow too much at one of the steps take all of them one by one.

    The kernel is that for the number of samples that these are `among`, if it is larger.
    """

    def one_by_one(rows: Sequence[Tensor], number: int) -> list[Tensor]:
        return interpreted_loop(loop, rows, number, steps, lambda program, x, _: run(program, x, backend))

    def at_once(rows: Sequence[Tensor], number: int) -> Sequence[Tensor]:
        return loop_autograd.differentiable(partial(_loop_outputs, backend, among), loop, rows, number, steps)

    count = len(loop.body.results)
    if not isinstance(backend, C) or transforming() or in_a_graph(inputs):
        loop, inputs = loop_autograd.apart(loop, inputs, samples)
    if backend.differentiable or transforming():
        return one_by_one(inputs, samples)[:count]
    found = at_once(inputs, samples)
    growth = found[count].detach() if len(found) > count and samples else None
    if growth is None or within_limit(growth, samples):
        return found[:count]
    loop, inputs = loop_autograd.apart(loop, inputs, samples)
    over = ~(growth[:, 0] <= largest_growth(growth.dtype))
    at, others = over.nonzero()[:, 0], (~over).nonzero()[:, 0]

    def chosen(rows: Tensor) -> list[Tensor]:
        given = enumerate(zip(inputs, loop.arguments, strict=True))
        return [x if a.uniform else x.index_select(int(k in loop.given), rows) for k, (x, a) in given]

    axes = [int(r in loop.kept) for r in range(count)]
    if in_a_graph(inputs):  # gradients of the rows over the limit may be 0 * inf
        rest = at_once(chosen(others), len(others))
    else:
        rest = [y.index_select(axis, others) for y, axis in zip(found, axes, strict=False)]
    return [
        y.new_empty(y.shape).index_copy(axis, at, few).index_copy(axis, others, many)
        for y, axis, few, many in zip(found, axes, one_by_one(chosen(at), len(at)), rest, strict=False)
    ]


def _loop_outputs(
    backend: Backend, among: int, loop: Loop, inputs: Sequence[Tensor], samples: int, steps: int
) -> list[Tensor]:
    return backend.loop(loop, inputs[0].dtype, inputs[0].device, max(samples, among))(inputs, samples, steps)


def guarded(backend: Backend, program: Program, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Results of a program; rows over the float32 limit are recomputed, rows over the float64 limit are NaN."""
    samples = samples_of(program, inputs)
    if program.growth is None or backend.guards:
        return _outputs(backend, program, inputs, samples)
    if not samples:
        return _outputs(backend, program, inputs, samples)[:-1]
    dtype = inputs[0].dtype
    readable = not (backend.differentiable and without_values(inputs))
    if not readable and dtype != torch.float64:
        # values cannot be read here, so all rows are computed in float64
        return [y.to(dtype) for y in guarded(backend, program, [x.double() for x in inputs])]
    *results, growth = _outputs(backend, program, inputs, samples)
    if readable and within_limit(growth, samples):
        return results
    return _mended(backend, program, inputs, results, growth)


def _mended(
    backend: Backend, program: Program, inputs: Sequence[Tensor], results: Sequence[Tensor], growth: Tensor
) -> list[Tensor]:
    """Results in which rows over the limit of their precision are recomputed, or NaN."""
    over = ~(growth[:, 0].detach() <= largest_growth(growth.dtype))
    double = growth.dtype == torch.float64
    if backend.differentiable or any(r.summed for r in program.results):
        return _or_nan(program, results, over) if double else _recomputed(backend, program, inputs, results, over)
    at = over.nonzero()[:, 0]
    wide = [] if double else guarded(backend, program, _among(program, inputs, at, torch.float64))
    for k, y in enumerate(results):  # memory of this call, which nobody has seen
        y.index_fill_(0, at, torch.nan) if double else y.index_copy_(0, at, wide[k].to(y.dtype))
    return list(results)


def unguarded(
    backend: Backend,
    program: Program,
    inputs: Sequence[Tensor],
    forms: Sequence[Form],
    samples: int,
    out: Sequence[Tensor] = (),
) -> list[Tensor]:
    """Results as those of `guarded`, in final shapes, without views on the way unless a row is over the limit.

    For a direct kernel on the CPU, a program without sums, at least one sample, and contiguous inputs of one dtype with
    the elements of [samples, width]. `out` are tensors for the results in the forms of the outputs; (): new ones.
    """
    like = inputs[0]
    found = [*out, *(empty_on_cpu(*form) for form in forms[len(out) :])]
    direct = cast(DirectKernel, backend.kernel(program, like.dtype, like.device))
    direct.into(inputs, found, samples)
    if program.growth is None or backend.guards:
        return found
    growth = found.pop()
    if within_limit(growth, samples):
        return found
    sizes = [[a.width] if a.uniform else [samples, a.width] for a in program.arguments]
    rows = [x.view(size) for x, size in zip(inputs, sizes, strict=True)]
    _mended(backend, program, rows, [y.view(samples, -1) for y in found], growth.view(samples, 1))
    return found


def within_limit(growth: Tensor, samples: int) -> bool:
    """Whether the errors of all rows grow less than the limit; False if one of them is NaN."""
    return (growth if samples == 1 else growth.amax()).item() <= largest_growth(growth.dtype)


def _outputs(backend: Backend, program: Program, inputs: Sequence[Tensor], samples: int) -> list[Tensor]:
    like = inputs[0]
    return backend.kernel(program, like.dtype, like.device)(inputs, samples)


def _or_nan(program: Program, results: Sequence[Tensor], over: Tensor) -> list[Tensor]:
    """Results with NaN in the rows over the limit, and in their gradients."""
    kept = torch.where(over, torch.nan, 1.0).to(results[0].dtype)
    return [y * kept.mean() if r.summed else kept[:, None] * y for y, r in zip(results, program.results, strict=True)]


def _recomputed(
    backend: Backend, program: Program, inputs: Sequence[Tensor], results: Sequence[Tensor], over: Tensor
) -> list[Tensor]:
    """Results with the rows over the limit recomputed in float64."""
    dtype = inputs[0].dtype
    at = over.nonzero()[:, 0]
    wide = [y.to(dtype) for y in guarded(backend, program, _among(program, inputs, at, torch.float64))]
    if not any(r.summed for r in program.results) and not any(y.requires_grad for y in results):
        return [y.index_copy(0, at, w) for y, w in zip(results, wide, strict=True)]
    others = (~over).nonzero()[:, 0]
    # a sum contains the rows over the limit, and gradients of these rows may be 0 * inf
    results = guarded(backend, program, _among(program, inputs, others, dtype))
    return [
        k + w if r.summed else w.new_empty(len(over), w.shape[1]).index_copy(0, at, w).index_copy(0, others, k)
        for k, w, r in zip(results, wide, program.results, strict=True)
    ]


def _among(program: Program, inputs: Sequence[Tensor], rows: Tensor, dtype: torch.dtype) -> list[Tensor]:
    """Arguments for some of the samples, in a dtype."""
    pairs = zip(inputs, program.arguments, strict=True)
    return [(x if a.uniform else x.index_select(0, rows)).to(dtype) for x, a in pairs]
