"""Backend "c": programs compiled from C for the CPU."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchdq.backends import c_library, threads
from torchdq.backends.backend import Form, contiguous, dense
from torchdq.backends.c_loop import Body, body_of, source, taken_as
from torchdq.backends.compiler import BuildError, Compiled, compiler, no_compiler
from torchdq.backends.torch import interpreted, interpreted_loop
from torchdq.base.caches import LAYOUTS, PROGRAMS, remembered
from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.program.loop import Chain, Loop, shapes
from torchdq.program.program import Program, outputs
from torchdq.program.transforms import empty_on_cpu


class C(Compiled):
    """Backend that compiles programs for the CPU."""

    name = "c"

    def refusal(self, device: torch.device) -> TorchdqError | None:
        """Error that says why programs cannot run on a device; None: they can."""
        if device.type != "cpu":
            return ArgumentError(f"backend 'c' runs on the CPU, and the arguments are on the device {device.type!r}")
        return None if compiler() is not None else no_compiler()

    def compiled(self, what: Program | Loop, dtype: torch.dtype, device: torch.device, samples: int) -> Any:
        """Kernel of a program or a loop, for few samples or any number, or the error of its build."""
        return _compiled(what, dtype, isinstance(what, Loop) and _few(samples, dtype))


class COrTorch(C):
    """Backend that compiles programs for the CPU, and runs as torch operations those that cannot be compiled."""

    or_torch = True


LARGEST_KEPT = 2**25 - 2**16  # bytes of a block below the 32 MiB from which glibc keeps none
FEW = 32  # bytes of the vectors for few samples: a long loop takes 0.6 of the time that it does with those of 64 bytes
COMPILED, COMPILED_OR_EAGER = C(), COrTorch()


def _few(samples: int, dtype: torch.dtype) -> bool:
    """Whether samples of a loop fit into a vector of half the size that the processor has."""
    return samples * dtype.itemsize <= FEW and c_library.wide()


@remembered(PROGRAMS)
def _compiled(what: Program | Loop, dtype: torch.dtype, few: bool = False) -> Any:
    """Kernel of a program or loop, or the error of its build, made once per process."""
    try:
        return CompiledLoop(what, dtype, few) if isinstance(what, Loop) else CompiledKernel(what, dtype)
    except BuildError as error:
        return error


@remembered(PROGRAMS)
def _library(body: Body, dtype: torch.dtype, few: bool) -> tuple[c_library.Library, tuple[Any, ...], tuple[int, ...]]:
    """Library of a body, those of the links of a chain, which live as long, and the addresses of their parts."""
    program, links = body.program, tuple[Any, ...]()
    if isinstance(program, Chain):
        links = tuple([_library(body_of(link.program), dtype, few) for link in program.links])
    with Progress(f"writing {program.name} in C"):
        code = source(body, dtype == torch.float32, few)
    arrays = len(program.arguments) + len(body.added) + len(outputs(program))
    library = c_library.load(code, program.name, arrays)
    return library, links, tuple([address for one, _, _ in links for address in one.parts])


class CompiledKernel:
    """Compiled program in one precision."""

    def __init__(self, program: Program, dtype: torch.dtype):
        self.program, self.dtype = program, dtype
        results = outputs(program)
        self.run = _library(body_of(program), dtype, False)[0].run
        self.operations = program.count().total
        self.widths = [(len(r.values), r.summed) for r in results]
        self.any_summed = any(r.summed for r in results)
        # bytes between the rows of two samples, for arguments and outputs; a summed output has one row per part
        self.strides = [(0 if a.uniform else a.width * dtype.itemsize, False) for a in program.arguments]
        self.strides += [(width * dtype.itemsize, summed) for width, summed in self.widths]

    def __call__(self, inputs: Sequence[Tensor], samples: int) -> list[Tensor]:
        """Outputs of the program; arguments that are not contiguous are copied."""
        number, size = threads.shares(samples, self.operations, self.any_summed)
        parts = max(1, -(-samples // size))
        found = [
            empty_on_cpu((parts if summed else samples, width), (width, 1), self.dtype) for width, summed in self.widths
        ]
        self._run([*dense(inputs), *found], samples, number, size)
        if self.any_summed:
            return [y.sum(0) if summed else y for y, (_, summed) in zip(found, self.widths, strict=True)]
        return found

    def into(self, inputs: Sequence[Tensor], results: Sequence[Tensor], samples: int) -> None:
        """Compute the outputs, none of them summed, into given tensors; see `DirectKernel`."""
        if samples <= threads.BLOCK:
            self.run(samples, None, *[x.data_ptr() for x in (*inputs, *results)])
        else:
            self._run([*inputs, *results], samples, *threads.shares(samples, self.operations, False))

    def _run(self, tensors: Sequence[Tensor], samples: int, number: int, size: int) -> None:
        """Run the program on all tensors, with a number of threads and a number of samples in each part."""
        _in_parts(self.run, samples, None, [x.data_ptr() for x in tensors], self.strides, number, size)


class CompiledLoop:
    """Compiled loop in one precision, for few samples or any number."""

    def __init__(self, loop: Loop, dtype: torch.dtype, few: bool):
        self.loop, self.dtype, body = loop, dtype, loop.body
        results = outputs(body)
        self.library = _library(body_of(loop), dtype, few)
        self.operations = body.count().total
        # glibc keeps freed memory up to twice the largest block that was freed; new pages cost more than the steps
        empty_on_cpu((LARGEST_KEPT,), (1,), torch.uint8)
        self.summed = [r.summed for r in results]
        self.any_summed = any(self.summed)
        self.strides = [(0 if a.uniform else a.width * dtype.itemsize, False) for a in loop.arguments]
        self.strides += [(len(r.values) * dtype.itemsize, r.summed) for r in results]
        self.states = [(k, r) for k, r in loop.carried if r in loop.kept]  # of which the start is kept, too

    def __call__(self, inputs: Sequence[Tensor], samples: int, steps: int) -> list[Tensor]:
        """Outputs of the loop; arguments that are not contiguous are copied."""
        loop = self.loop
        if not steps:
            return interpreted_loop(loop, inputs, samples, steps, interpreted)
        number, size = threads.shares(samples, self.operations * steps, self.any_summed)
        library, _, addresses = self.library
        plan, forms = _plan(loop, samples, steps, max(1, -(-samples // size)), self.dtype, addresses)
        given, found = dense(inputs), [empty_on_cpu(*form) for form in forms]
        pointers = [x.data_ptr() for x in (*given, *found)]  # copies among them live until the function has returned
        for k, r in self.states:
            found[r][-1 if loop.backwards else 0] = given[k]
            if not loop.backwards:
                pointers[len(given) + r] += samples * self.strides[k][0]
        _in_parts(library.run, samples, ctypes.addressof(plan), pointers, self.strides, number, size)
        return [y.sum(0) if summed else y for y, summed in zip(found, self.summed, strict=True)]


@remembered(LAYOUTS)
def _plan(
    loop: Loop, samples: int, steps: int, parts: int, dtype: torch.dtype, addresses: Sequence[int]
) -> tuple[Any, list[Form]]:
    """Plan of `run`, and forms of the outputs, of which summed ones have a row for each part of the samples."""
    numbers = (steps, samples, *taken_as(loop), *addresses)
    pairs = zip(shapes(loop, samples, steps), outputs(loop.body), strict=True)
    forms = [contiguous((parts, *shape) if result.summed else shape, dtype) for shape, result in pairs]
    return (ctypes.c_long * len(numbers))(*numbers), forms


def _in_parts(
    function: Callable[..., None],
    samples: int,
    plan: int | None,
    pointers: Sequence[int],
    strides: Sequence[tuple[int, bool]],
    number: int,
    size: int,
) -> None:
    """Call a function on parts of some samples, shared among a number of threads."""
    if samples <= size:
        function(samples, plan, *pointers)
        return

    def part(k: int) -> None:
        at = [p + (k if summed else k * size) * stride for p, (stride, summed) in zip(pointers, strides, strict=True)]
        function(min(size, samples - k * size), plan, *at)

    threads.run(part, -(-samples // size), number)
