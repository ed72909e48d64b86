"""Running a program on tensors: compiled or operation by operation, with derivatives, batches and transforms.

Arguments are tensors [samples, width], or [width] where the argument is uniform; so are results. Derivatives of a
program are programs, run in the same way, so nothing but the arguments is kept between forward and backward.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, lru_cache
from hashlib import sha256

import torch
from torch import Tensor
from torch.autograd import forward_ad

from torchdq.backends import c
from torchdq.backends import cache as build
from torchdq.errors import ArgumentError
from torchdq.program import autodiff as derive
from torchdq.program.program import LARGEST_GROWTH, Argument, Program

PER_THREAD = 1e6  # operations on vectors that are worth a thread: waking one takes as long as tens of thousands
KEPT = 1024  # programs of each kind that a process remembers
BLOCK = 64  # samples; threads get whole blocks, so that no vector is shared
PART = 64 * BLOCK  # samples whose sum is formed at once

# --- one program, one precision --------------------------------------------------------------------------------------


class Kernel:
    """A compiled program in one precision."""

    def __init__(self, program: Program, single: bool):
        self.program = program
        self.dtype = torch.float32 if single else torch.float64
        self.watched = program.growth is not None
        pointers = len(program.arguments) + len(program.results) + self.watched
        self.function = build.load(c.source(program, single), program.name, pointers)
        size = 4 if single else 8
        self.widths = [len(r.values) for r in program.results]
        self.any_summed = any(r.summed for r in program.results)
        # bytes from one sample's row to the next, of arguments and results
        self.strides = [0 if a.uniform else a.width * size for a in program.arguments]
        self.strides += [w * size for w in self.widths] + [1] * self.watched
        # samples that are worth a thread of their own
        self.share = max(BLOCK, int(8 * PER_THREAD / max(1, program.count().total)))

    def __call__(self, inputs: Sequence[Tensor], samples: int) -> list[Tensor]:
        """Results of dense arguments.

        Samples whose rounding errors would grow too far are computed in double precision; what they would there as
        well, is NaN.
        """
        device, outputs = inputs[0].device, self.program.results
        threads = min(torch.get_num_threads(), samples // self.share)
        size = max(samples, 1)
        if self.any_summed:
            size = PART  # a sum is the same, however many threads take part in it
        elif threads > 1:
            size = -(-samples // (threads * BLOCK)) * BLOCK
        starts = range(0, samples, size)
        parts = max(len(starts), 1)
        results = [
            torch.empty((parts if r.summed else samples, w), dtype=self.dtype, device=device)
            for r, w in zip(outputs, self.widths, strict=True)
        ]
        lost = [torch.empty((samples,), dtype=torch.bool, device=device)] if self.watched else []
        pointers = [x.data_ptr() for x in (*inputs, *results, *lost)]
        any_lost = (
            self.function(samples, *pointers) if parts == 1 else self.in_parts(pointers, samples, starts, threads)
        )
        if self.any_summed:
            results = [y.sum(0) if r.summed else y for y, r in zip(results, outputs, strict=True)]
        return self.mended(inputs, results, lost[0]) if any_lost else results

    def in_parts(self, pointers: Sequence[int], samples: int, starts: range, threads: int) -> int:
        """Whether any sample is lost, the samples in parts that are shared among threads."""
        # a part has its own row of a sum
        rows = [0] * len(self.program.arguments) + [int(r.summed) for r in self.program.results] + [0] * self.watched

        def run(first: int) -> int:
            any_lost = 0
            for k in range(first, len(starts), max(threads, 1)):
                at = [
                    p + (k if summed else starts[k]) * stride
                    for p, stride, summed in zip(pointers, self.strides, rows, strict=True)
                ]
                any_lost |= self.function(min(starts.step, samples - starts[k]), *at)
            return any_lost

        waiting = [_pool().submit(run, k) for k in range(1, threads)]
        any_lost = run(0)
        for job in waiting:
            any_lost |= job.result()
        return any_lost

    def mended(self, inputs: Sequence[Tensor], results: list[Tensor], lost: Tensor) -> list[Tensor]:
        """Results whose lost samples are those of double precision, or NaN."""
        outputs, at, others = self.program.results, lost.nonzero()[:, 0], (~lost).nonzero()[:, 0]
        if self.dtype == torch.float64:
            return [
                y + torch.nan if r.summed else y.index_fill_(0, at, torch.nan)
                for y, r in zip(results, outputs, strict=True)
            ]
        wide = kernel(self.program, False)(_among(self.program, inputs, at, torch.float64), len(at))
        wide = [y.to(self.dtype) for y in wide]
        # a sum holds the lost samples already
        kept = self(_among(self.program, inputs, others, self.dtype), len(others)) if self.any_summed else results
        return [
            k + w if r.summed else y.index_copy_(0, at, w)
            for y, k, w, r in zip(results, kept, wide, outputs, strict=True)
        ]


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max(2, os.cpu_count() or 2), thread_name_prefix="torchdq")


os.register_at_fork(after_in_child=_pool.cache_clear)  # threads do not survive a fork


@lru_cache(KEPT)
def kernel(program: Program, single: bool) -> Kernel:
    """Kernel of a program, compiled once per process and, in the cache, once per machine."""
    return Kernel(program, single)


vjp = lru_cache(KEPT)(derive.vjp)
jvp = lru_cache(KEPT)(derive.jvp)


# --- eager -----------------------------------------------------------------------------------------------------------


def eager(program: Program, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Results of a program, operation by operation in torch; differentiable by torch itself."""
    return [y.sum(0) if r.summed else y for y, r in zip(_rows(program, inputs), program.results, strict=True)]


def _rows(program: Program, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Results by sample, of which those whose rounding errors would grow too far are treated as in `Kernel`.

    Where tensors are traced or transformed, all are computed in double precision.
    """
    dtype = inputs[0].dtype
    if program.growth is not None and dtype != torch.float64 and _transformed(inputs):
        # what is traced or transformed cannot be asked which rows are lost
        return [y.to(dtype) for y in _rows(program, [x.double() for x in inputs])]
    results, lost = _operations(program, inputs)
    if lost is None:
        return results
    if dtype == torch.float64:
        kept = torch.where(lost, torch.nan, 1.0)[:, None]
        return [kept * y for y in results]  # gradients become NaN as well
    if not bool(lost.any()):
        return results
    # not masked: a sample that divides by zero in single precision would have gradients 0 * inf
    at, others = lost.nonzero()[:, 0], (~lost).nonzero()[:, 0]
    wide = _rows(program, _among(program, inputs, at, torch.float64))
    narrow = _rows(program, _among(program, inputs, others, dtype))
    return [
        torch.empty_like(y).index_copy(0, at, w.to(dtype)).index_copy(0, others, kept)
        for y, w, kept in zip(results, wide, narrow, strict=True)
    ]


def _among(program: Program, inputs: Sequence[Tensor], rows: Tensor, dtype: torch.dtype) -> list[Tensor]:
    """Arguments of some samples, in a dtype."""
    return [(x if a.uniform else x[rows]).to(dtype) for x, a in zip(inputs, program.arguments, strict=True)]


def _transformed(inputs: Sequence[Tensor]) -> bool:
    """Whether tensors are being traced or transformed, or have no values, and cannot be asked for them."""
    functorch = torch._C._functorch
    return (
        torch.compiler.is_compiling()
        or inputs[0].device.type == "meta"
        or torch._C._are_functorch_transforms_active()
        or any(map(functorch.is_legacy_batchedtensor, inputs))
    )


def _operations(program: Program, inputs: Sequence[Tensor]) -> tuple[list[Tensor], Tensor | None]:
    """Results by sample, operation by operation, and which samples are lost, if the program can tell."""
    samples = _samples(program, inputs)
    rows = [x.unbind(-1) for x in inputs]
    values: list = []  # tensors, or Python numbers

    def tensor(k: float) -> Tensor:
        x = values[int(k)]
        return x if isinstance(x, Tensor) else inputs[0].new_full((), x)

    for code, a, b in program.ops:
        if code == "in":
            values.append(rows[int(a)][b])
        elif code == "const":
            values.append(a)
        elif code == "sin":
            values.append(torch.sin(values[int(a)]))
        elif code == "cos":
            values.append(torch.cos(values[int(a)]))
        elif code in ("sqrt", "exp", "log", "floor"):
            values.append(getattr(torch, code)(tensor(a)))
        elif code in ("max", "min", "ge"):
            values.append(_compared(code, tensor(a), tensor(b)))
        else:
            x, y = values[int(a)], values[b]
            values.append(x + y if code == "add" else x - y if code == "sub" else x * y if code == "mul" else x / y)

    nothing = inputs[0][..., :0]  # a constant has gradients too, and they are zero

    def column(v: tuple[int, bool] | float) -> Tensor:
        x = v if isinstance(v, float) else -values[v[0]] if v[1] else values[v[0]]
        x = nothing.sum(-1) + x if isinstance(x, float) else x
        return x.expand(samples)

    results = [
        torch.stack([column(v) for v in r.values], -1) if r.values else nothing.expand(samples, 0)
        for r in program.results
    ]
    if program.growth is None:
        return results, None
    largest = LARGEST_GROWTH.double if inputs[0].dtype == torch.float64 else LARGEST_GROWTH.single
    return results, ~(column(program.growth).detach() <= largest)


def _compared(code: str, x: Tensor, y: Tensor) -> Tensor:
    if code == "ge":
        return (x >= y).to(x.dtype)
    # torch's own would share the gradient where both are equal; compiled programs give it to the first
    return torch.where((x >= y if code == "max" else x <= y) | (x != x), x, y)


# --- arguments -------------------------------------------------------------------------------------------------------


def row(x: Tensor, like: Tensor, shapes: tuple[tuple[int, ...], tuple[int, ...]]) -> Tensor:
    """A tensor as rows of a program, in the dtype and on the device of another: expanded, and then reshaped."""
    if x.dtype != like.dtype or x.device != like.device:
        x = x.to(like)
    return x if x.shape == shapes[1] else x.expand(shapes[0]).reshape(shapes[1])


# --- torch -----------------------------------------------------------------------------------------------------------


def _samples(program: Program, inputs: Sequence[Tensor]) -> int:
    return next((x.shape[0] for x, a in zip(inputs, program.arguments, strict=True) if not a.uniform), 1)


def _execute(program: Program, inputs: Sequence[Tensor]) -> list[Tensor]:
    return kernel(program, inputs[0].dtype == torch.float32)(
        [x.contiguous() for x in inputs], _samples(program, inputs)
    )


def _gradients(ctx, program: Program, needed: Sequence[bool], cotangents: Sequence[Tensor]) -> list:
    """Gradients of the inputs that need one, by the program's vector-Jacobian product."""
    wrt = tuple([k for k, wanted in enumerate(needed) if wanted])
    # autograd's own vmap (is_grads_batched) knows no rule for us, but torch's operations know it
    run = eager if any(map(torch._C._functorch.is_legacy_batchedtensor, cotangents)) else compiled
    gradients = iter(run(vjp(program, wrt), [*ctx.saved_tensors, *cotangents]))
    return [next(gradients) if wanted else None for wanted in needed]


class _Differentiable(torch.autograd.Function):
    """A compiled program with its gradients."""

    @staticmethod
    def forward(ctx, program: Program, *inputs: Tensor) -> tuple[Tensor, ...]:
        ctx.program = program
        ctx.save_for_backward(*inputs)
        return tuple(_execute(program, inputs))

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        return None, *_gradients(ctx, ctx.program, ctx.needs_input_grad[1:], cotangents)


class _Transformable(torch.autograd.Function):
    """The same for torch.func and forward-mode differentiation, whose bookkeeping costs more."""

    @staticmethod
    def forward(program: Program, *inputs: Tensor) -> tuple[Tensor, ...]:
        return tuple(_execute(program, inputs))

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.program = inputs[0]
        ctx.save_for_backward(*inputs[1:])
        ctx.save_for_forward(*inputs[1:])

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        return None, *_gradients(ctx, ctx.program, ctx.needs_input_grad[1:], cotangents)

    @staticmethod
    def jvp(ctx, _, *tangents: Tensor | None) -> tuple[Tensor, ...]:
        wrt = tuple(k for k, t in enumerate(tangents) if t is not None)
        present = [t for t in tangents if t is not None]
        return tuple(compiled(jvp(ctx.program, wrt), [*ctx.saved_tensors, *present]))

    @staticmethod
    def vmap(info, in_dims, program: Program, *inputs: Tensor):
        size = info.batch_size
        own = per_sample(program)
        samples = next(
            (
                x.shape[int(d == 0)]
                for x, d, a in zip(inputs, in_dims[1:], program.arguments, strict=True)
                if not a.uniform
            ),
            1,
        )
        rows = []
        for x, d, a in zip(inputs, in_dims[1:], program.arguments, strict=True):
            x = x.unsqueeze(0) if d is None else x.movedim(d, 0)
            x = x.unsqueeze(1) if a.uniform else x
            rows.append(x.expand(size, samples, a.width).reshape(size * samples, a.width))
        results = [y.reshape(size, samples, y.shape[-1]) for y in compiled(own, rows)]
        results = [y.sum(1) if r.summed else y for y, r in zip(results, program.results, strict=True)]
        return tuple(results), (0,) * len(results)


@lru_cache(KEPT)
def per_sample(program: Program) -> Program:
    """The program with nothing shared between samples: no uniform argument, no sum."""
    return replace(
        program,
        arguments=tuple(Argument(a.name, a.width) for a in program.arguments),
        results=tuple(r._replace(summed=False) for r in program.results),
    )


_known: dict[str, Program] = {}


def key(program: Program) -> str:
    """Name under which a compiled graph finds a program again."""
    name = sha256(str(program).encode()).hexdigest()
    _known[name] = program
    return name


def found(name: str) -> Program:
    """Program of a name; a graph that torch kept from an earlier process may name derivatives not yet recorded here."""
    if name not in _known:
        primal, derived, wrt = name.rpartition(":")
        if not derived:
            raise ArgumentError(
                "a graph calls a program that was recorded in another process; trace or export it again in this one"
            )
        _known[name] = vjp(found(primal), tuple(map(int, wrt.split(","))))
    return _known[name]


@torch.library.custom_op("torchdq::evaluate", mutates_args=())
def operator(program: str, inputs: Sequence[Tensor]) -> list[Tensor]:
    """Results of a program by its compiled kernel, for graphs that are traced: the program goes by its name."""
    return _execute(found(program), inputs)


@operator.register_fake
def _(program: str, inputs: Sequence[Tensor]) -> list[Tensor]:
    samples = _samples(found(program), inputs)
    return [
        inputs[0].new_empty((len(r.values),) if r.summed else (samples, len(r.values))) for r in found(program).results
    ]


def _setup(ctx, inputs, output) -> None:
    ctx.program = inputs[0]
    ctx.save_for_backward(*inputs[1])


def _backward(ctx, cotangents: Sequence[Tensor]):
    saved = ctx.saved_tensors
    wrt = tuple(k for k, needed in enumerate(ctx.needs_input_grad[1]) if needed)
    gradients = iter(operator(f"{ctx.program}:{','.join(map(str, wrt))}", [*saved, *cotangents]))
    return None, [next(gradients) if k in wrt else None for k in range(len(saved))]


operator.register_autograd(_backward, setup_context=_setup)


def compiled(program: Program, inputs: Sequence[Tensor]) -> Sequence[Tensor]:
    """Results of a program by its compiled kernel, with no more bookkeeping than is asked for."""
    if torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0:
        return _Transformable.apply(program, *inputs)
    if torch.is_grad_enabled() and any([x.requires_grad for x in inputs]):
        return _Differentiable.apply(program, *inputs)
    return _execute(program, inputs)
