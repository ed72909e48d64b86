"""Backend "c": programs compiled from C for the CPU."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchdq.backends import c_library, threads
from torchdq.backends.backend import Form, contiguous, dense
from torchdq.backends.c_loop import Body, body_of, long, source, taken_as
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
FEW = 32  # bytes of the vectors for few samples: a loop takes 0.7 to 0.9 of the time that it does with those of 64
COMPILED, COMPILED_OR_EAGER = C(), COrTorch()


def _few(samples: int, dtype: torch.dtype) -> bool:
    """Whether samples of a loop fit into a vector of half the size that the processor has."""
    return samples * dtype.itemsize <= FEW and c_library.wide()


@remembered(PROGRAMS)
def _compiled(what: Program | Loop, dtype: torch.dtype, few: bool = False) -> Any:
    """Kernel of a program or loop, or the error of its build, made once per process."""
    try:
        return CompiledKernel(what, dtype, few)
    except BuildError as error:
        return error


@remembered(PROGRAMS)
def _library(body: Body, dtype: torch.dtype, few: bool) -> tuple[c_library.Library, tuple[Any, ...], tuple[int, ...]]:
    """Library of a body, those of long links of a chain, which live as long, and the addresses of their parts."""
    program, links = body.program, tuple[Any, ...]()
    if isinstance(program, Chain):
        links = tuple([_library(body_of(x.program), dtype, few) for x in program.links if long(x.program)])
    with Progress(f"writing {program.name} in C"):
        code = source(body, dtype == torch.float32, few)
    arrays = len(program.arguments) + len(body.added) + len(outputs(program))
    library = c_library.load(code, program.name, arrays)
    return library, links, tuple([address for one, _, _ in links for address in one.parts])


class CompiledKernel:
    """Compiled program or loop in one precision, for few samples or any number."""

    def __init__(self, what: Program | Loop, dtype: torch.dtype, few: bool = False):
        program = what.body if isinstance(what, Loop) else what
        results = outputs(program)
        self.what, self.dtype = what, dtype
        self.compiled, self.links, self.addresses = _library(body_of(what), dtype, few)
        self.operations, self.grows = program.count().total, program.growth is not None
        self.summed = [r.summed for r in results]
        # bytes between the rows of two samples, for arguments and outputs; a summed output has one row per part
        shared = [a.uniform or (isinstance(what, Loop) and k in what.common) for k, a in enumerate(what.arguments)]
        self.strides = [
            (0 if x else a.width * dtype.itemsize, False) for x, a in zip(shared, what.arguments, strict=True)
        ]
        self.strides += [(len(r.values) * dtype.itemsize, r.summed) for r in results]
        self.states: list[tuple[int, int]] = []  # those of `starts`
        if isinstance(what, Loop):
            self.states = [(k, r) for k, r in what.carried if r in what.kept]
            # glibc keeps freed memory up to twice the largest block that was freed; new pages cost more than the steps
            empty_on_cpu((LARGEST_KEPT,), (1,), torch.uint8)

    def __call__(self, inputs: Sequence[Tensor], samples: int, steps: int = 1) -> list[Tensor]:
        """Outputs of the program or loop; arguments that are not contiguous are copied."""
        backwards = isinstance(self.what, Loop) and self.what.backwards
        if isinstance(self.what, Loop) and not steps:
            return interpreted_loop(self.what, inputs, samples, steps, interpreted)
        number, size = threads.shares(samples, self.operations * steps, any(self.summed))
        parts = max(1, -(-samples // size))
        plan, forms = _plan(self.what, samples, steps, parts, self.dtype, self.addresses)
        given, found = dense(inputs), [empty_on_cpu(*form) for form in forms]
        pointers = [x.data_ptr() for x in (*given, *found)]  # copies among them live until the function has returned
        for k, r, size_of in self.starts(samples):
            # a copy by torch into a view takes as long as twenty steps of an arm
            ctypes.memmove(pointers[len(given) + r] + steps * size_of * backwards, pointers[k], size_of)
            pointers[len(given) + r] += size_of * (not backwards)
        self._run(samples, None if plan is None else ctypes.addressof(plan), pointers, number, size)
        return [y.sum(0) if summed else y for y, summed in zip(found, self.summed, strict=True)]

    def starts(self, samples: int) -> list[tuple[int, int, int]]:
        """Carried results that are kept, and so is their start: argument, result, and bytes of all samples."""
        return [(k, r, samples * self.strides[k][0]) for k, r in self.states]

    def plan(self, samples: int, steps: int) -> Any:
        """Plan of `run` for samples that one thread computes; None: that of one step."""
        return _plan(self.what, samples, steps, 1, self.dtype, self.addresses)[0]

    def into(self, inputs: Sequence[Tensor], results: Sequence[Tensor], samples: int) -> None:
        """Compute the outputs of a program, none of them summed, into given tensors; see `DirectKernel`."""
        pointers = [x.data_ptr() for x in (*inputs, *results)]
        self._run(samples, None, pointers, *threads.shares(samples, self.operations, False))

    def _run(self, samples: int, plan: int | None, pointers: Sequence[int], number: int, size: int) -> None:
        """Call the function on parts of some samples, shared among a number of threads."""
        if samples <= size:
            self.compiled.run(samples, plan, *pointers)
            return
        pairs = list(zip(pointers, self.strides, strict=True))

        def part(k: int) -> None:
            at = [p + (k if summed else k * size) * stride for p, (stride, summed) in pairs]
            self.compiled.run(min(size, samples - k * size), plan, *at)

        threads.run(part, -(-samples // size), number)


@remembered(LAYOUTS)
def _plan(
    what: Program | Loop, samples: int, steps: int, parts: int, dtype: torch.dtype, addresses: Sequence[int]
) -> tuple[Any, list[Form]]:
    """Plan of `run`, None for a program, and forms of the outputs: summed ones have a row for each part of samples."""
    if isinstance(what, Loop):
        numbers = (steps, samples, *taken_as(what), *addresses)
        plan = (ctypes.c_int64 * len(numbers))(*numbers)
        results, rows = outputs(what.body), shapes(what, samples, steps)
    else:
        plan, results = None, outputs(what)
        rows = [(*((samples,) if not r.summed else ()), len(r.values)) for r in results]
    return plan, [
        contiguous((parts, *shape) if result.summed else shape, dtype)
        for shape, result in zip(rows, results, strict=True)
    ]
