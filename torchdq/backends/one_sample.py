"""Calls of a compiled program with one sample, in a few microseconds.

Checking the tensors of a call one by one takes longer than the program itself. Here torch compares type, dtype, device,
sizes and strides of all tensors at once, as it does for its compiled graphs, and the sample's rows are passed on where
they are. That comparison is private to torch (`transforms.alike`): where it is absent every call takes the common way,
and a test of `alike` pins what it means in the torch that is installed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from ctypes import addressof, c_double, c_float
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from torchdq.backends.backend import Form, contiguous
from torchdq.backends.c import COMPILED, CompiledKernel
from torchdq.backends.choice import present
from torchdq.backends.compiler import BuildError
from torchdq.backends.precision import largest_growth
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.program.program import Program
from torchdq.program.transforms import alike, dispatching, empty_on_cpu, transforming


class OneSample(NamedTuple):
    """Compiled program in one precision, for rows [width] on the CPU."""

    run: Callable[..., None]
    fits: Callable[..., bool]  # whether torch has no more to do with rows than to hold their numbers
    forms: tuple[Form, ...]  # those of the results
    ends: tuple[int, ...]  # sizes of arguments and results [bytes]
    growth: Any  # C type of the error growth; None: the program has no such output
    limit: float  # largest accepted error growth

    def __call__(self, inputs: Sequence[Any], out: Sequence[Any] | None) -> Sequence[Tensor] | None:
        """Results, in the tensors `out` if they are given; None: this call is not such a case, and nothing was done.

        Where errors grow too much, `out` has been written to, but nothing else.
        """
        if present() not in ("auto", "c") or transforming() or dispatching():
            return None
        found = [empty_on_cpu(*form) for form in self.forms] if out is None else out
        try:
            if not self.fits(*inputs, *found):
                return None
        except TypeError:  # not all are tensors, or there are fewer
            return None
        pointers = [x.data_ptr() for x in (*inputs, *found)]
        if out is not None and self._overlap(pointers, len(inputs)):
            return None
        if self.growth is None:
            self.run(1, None, *pointers)
            return found
        growth = self.growth()
        self.run(1, None, *pointers, addressof(growth))
        return found if growth.value <= self.limit else None

    def _overlap(self, pointers: Sequence[int], inputs: int) -> bool:
        """Whether a result shares memory with an argument or another result."""
        ends = self.ends
        for k in range(inputs, len(pointers)):
            begin, size = pointers[k], ends[k]
            for i in range(k):
                if -ends[i] < pointers[i] - begin < size:
                    return True
        return False


@remembered(PROGRAMS)
def one_sample(program: Program, dtype: torch.dtype) -> OneSample | None:
    """Calls of a program with one sample; None: it cannot be compiled here, and runs as any batch does."""
    if COMPILED.refusal(torch.device("cpu")) is not None:
        return None
    try:
        kernel = cast(CompiledKernel, COMPILED.kernel(program, dtype, torch.device("cpu")))
    except BuildError:
        return None
    widths = [*(a.width for a in program.arguments), *(len(r.values) for r in program.results)]
    forms = [contiguous((width,), dtype) for width in widths]
    return OneSample(
        kernel.compiled.run,
        alike(forms),
        tuple(forms[len(program.arguments) :]),
        tuple(width * dtype.itemsize for width in widths),
        None if program.growth is None else c_double if dtype == torch.float64 else c_float,
        largest_growth(dtype),
    )
