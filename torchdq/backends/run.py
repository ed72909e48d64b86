"""Execution of a program with a backend."""

from collections.abc import Sequence

from torch import Tensor

from torchdq.backends.backend import Backend
from torchdq.backends.precision import Guarded, guarded
from torchdq.errors import ArgumentError
from torchdq.program.autograd import differentiable, in_a_graph
from torchdq.program.program import Program
from torchdq.program.transforms import jit_tracing, proxy_tracing


def run(program: Program, inputs: Sequence[Tensor], backend: Backend) -> Sequence[Tensor]:
    """Results of a program, differentiable to any order.

    Args:
        program: the program.
        inputs: its arguments, tensors [samples, width], uniform ones [width]; results have the same layout.
        backend: the backend that runs it.
    """
    if backend.differentiable:
        return guarded(backend, program, inputs)
    if jit_tracing() or proxy_tracing():
        raise ArgumentError(
            f"torch.jit.trace and make_fx cannot record the compiled program {program.name!r}; trace with "
            "backend='eager', or use torch.export or torch.compile"
        )
    if not in_a_graph(inputs):
        return guarded(backend, program, inputs)
    return differentiable(Guarded(backend), program, inputs)
