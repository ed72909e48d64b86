"""Kernel of a program on a GPU: outputs, marks of rows, and the launches, on tensors of any device.

What compiles the text and launches it is handed over, so that the kernels run on the host as well.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchdq.backends.backend import dense
from torchdq.backends.cuda_loop import BLOCK, loop_source, recomputing_loop_source
from torchdq.backends.cuda_source import marks, recomputing_source, source, staged
from torchdq.program.loop import Loop, shapes
from torchdq.program.program import Program

# called with the numbers of blocks, of threads in each and of samples, the addresses of all arrays, before which a loop
# has the number of steps, and the device
Launcher = Callable[[int, int, int, Sequence[int], torch.device], None]
Build = Callable[[str, str, int], Launcher]  # from a text, the name of its program, and the number of arrays


class CudaKernel:
    """Program in one precision, one thread per sample; nothing in it waits for the GPU."""

    def __init__(self, program: Program, dtype: torch.dtype, build: Build):
        single = dtype == torch.float32
        self.program, self.dtype = program, dtype
        self.marks, self.stage = marks(program, single), staged(program, single)
        arrays = len(program.arguments) + len(program.results) + self.marks
        self.launch = build(source(program, single), program.name, arrays)
        self.recompute = build(recomputing_source(program), program.name, arrays) if self.marks else None
        self.widths = [(len(r.values), r.summed) for r in program.results]

    def __call__(self, inputs: Sequence[Tensor], samples: int) -> list[Tensor]:
        """Results of the program; arguments that are not contiguous are copied."""
        blocks, device = -(-samples // self.stage.block), inputs[0].device
        found, sums = [], {}  # sums: of the blocks, first those of the kernel, then those of the recomputed rows
        for k, (width, summed) in enumerate(self.widths):
            if summed and k in self.stage.results:
                sums[k] = torch.empty((1 + self.marks, blocks, width), dtype=self.dtype, device=device)
                found.append(sums[k][0])
            else:
                found.append(torch.empty((samples, width), dtype=self.dtype, device=device))
        again = [sums[k][1] if k in sums else y for k, y in enumerate(found)] if self.marks else []
        self._run(dense(inputs), found, again, samples, device)
        return [
            (sums[k].sum((0, 1)) if k in sums else y.sum(0)) if summed else y
            for k, (y, (_, summed)) in enumerate(zip(found, self.widths, strict=True))
        ]

    def into(self, inputs: Sequence[Tensor], results: Sequence[Tensor], samples: int) -> None:
        """Compute the results, none of them summed, into given tensors; see `DirectKernel`."""
        self._run(inputs, results, results, samples, inputs[0].device)

    def _run(
        self,
        inputs: Sequence[Tensor],
        results: Sequence[Tensor],
        again: Sequence[Tensor],
        samples: int,
        device: torch.device,
    ) -> None:
        """Launcher the kernel, and the one that recomputes marked rows into `again`."""
        if not samples:
            return
        blocks, block = -(-samples // self.stage.block), self.stage.block
        lost = [torch.empty(samples, dtype=torch.uint8, device=device)] if self.marks else []
        self.launch(blocks, block, samples, [x.data_ptr() for x in (*inputs, *results, *lost)], device)
        if self.recompute is not None:
            self.recompute(blocks, block, samples, [x.data_ptr() for x in (*inputs, *again, *lost)], device)


class CudaLoop:
    """Loop in one precision, one thread per sample; nothing in it waits for the GPU."""

    def __init__(self, loop: Loop, dtype: torch.dtype, build: Build):
        single = dtype == torch.float32
        self.loop, self.dtype, self.marks = loop, dtype, marks(loop.body, single)
        texts = [loop_source(loop, single), *([recomputing_loop_source(loop)] if self.marks else [])]
        arrays = 1 + len(loop.arguments) + len(loop.body.results) + self.marks
        self.launches = [build(text, loop.name, arrays) for text in texts]

    def __call__(self, inputs: Sequence[Tensor], samples: int, steps: int) -> list[Tensor]:
        """Results of the loop; arguments that are not contiguous are copied."""
        device, found = inputs[0].device, []
        for shape, r in zip(shapes(self.loop, samples, steps), self.loop.body.results, strict=False):
            rows = (samples, *shape) if r.summed else shape
            found.append(torch.empty(rows, dtype=self.dtype, device=device))
        lost = [torch.empty(samples, dtype=torch.uint8, device=device)] if self.marks else []
        tensors = [*dense(inputs), *found, *lost]
        for launch in self.launches if samples else ():
            launch(-(-samples // BLOCK), BLOCK, samples, [steps, *(x.data_ptr() for x in tensors)], device)
        return [y.sum(0) if r.summed else y for y, r in zip(found, self.loop.body.results, strict=True)]
