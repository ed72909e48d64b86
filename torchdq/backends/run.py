"""Execution of a program with a backend."""

from collections.abc import Sequence

from torch import Tensor

from torchdq.backends.backend import Backend
from torchdq.backends.precision import Guarded, guarded
from torchdq.program.autograd import differentiable, in_a_graph
from torchdq.program.program import Program


def run(program: Program, inputs: Sequence[Tensor], backend: Backend) -> Sequence[Tensor]:
    """Results of a program, differentiable to any order.

    Args:
        program: the program.
        inputs: its arguments, tensors [samples, width], uniform ones [width]; results have the same layout.
        backend: the backend that runs it.
    """
    if backend.differentiable or not in_a_graph(inputs):
        return guarded(backend, program, inputs)
    return differentiable(Guarded(backend), program, inputs)
