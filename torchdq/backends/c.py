"""Backend "c": programs compiled from C for the CPU."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdq.backends import cache, threads
from torchdq.backends.backend import Backend
from torchdq.backends.c_source import source
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.program.program import Program, outputs


class C(Backend):
    """Backend that compiles programs for the CPU."""

    name = "c"
    differentiable = False

    def refusal(self, device: torch.device) -> TorchdqError | None:
        """Error that says why programs cannot run on a device; None: they can."""
        if device.type != "cpu":
            return ArgumentError(f"backend 'c' runs on the CPU, and the arguments are on the device {device.type!r}")
        return None if cache.compiler() is not None else cache.no_compiler()

    def kernel(self, program: Program, dtype: torch.dtype, device: torch.device) -> CompiledKernel:
        """Compiled program in one precision, built unless the cache on disk has it."""
        return CompiledKernel(program, dtype)


COMPILED = C()


class CompiledKernel:
    """Compiled program in one precision."""

    def __init__(self, program: Program, dtype: torch.dtype):
        self.program, self.dtype = program, dtype
        results = outputs(program)
        pointers = len(program.arguments) + len(results)
        self.function = cache.load(source(program, dtype == torch.float32), program.name, pointers)
        self.operations = program.count().total
        self.widths = [(len(r.values), r.summed) for r in results]
        self.any_summed = any(r.summed for r in results)
        # bytes between the rows of two samples, for arguments and outputs; a summed output has one row per part
        self.strides = [(0 if a.uniform else a.width * dtype.itemsize, False) for a in program.arguments]
        self.strides += [(width * dtype.itemsize, summed) for width, summed in self.widths]

    def __call__(self, inputs: Sequence[Tensor], samples: int) -> list[Tensor]:
        """Outputs of the program; arguments that are not contiguous are copied."""
        inputs = [x.contiguous() for x in inputs]
        few = samples <= threads.BLOCK
        number, size = (1, samples) if few else threads.shares(samples, self.operations, self.any_summed)
        parts = 1 if few else -(-samples // size)
        found = [
            torch.empty((parts if summed else samples, width), dtype=self.dtype, device="cpu")
            for width, summed in self.widths
        ]
        pointers = [x.data_ptr() for x in (*inputs, *found)]
        if parts == 1:
            self.function(samples, *pointers)
        else:

            def part(k: int) -> None:
                at = [
                    p + (k if summed else k * size) * stride
                    for p, (stride, summed) in zip(pointers, self.strides, strict=True)
                ]
                self.function(min(size, samples - k * size), *at)

            threads.run(part, parts, number)
        if self.any_summed:
            return [y.sum(0) if summed else y for y, (_, summed) in zip(found, self.widths, strict=True)]
        return found
