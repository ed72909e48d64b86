"""Interface of a backend, which runs programs on tensors of some devices, and memory of tensors as kernels read it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from torchdq.errors import TorchdqError
from torchdq.program.loop import Loop
from torchdq.program.program import LARGEST_GROWTH, Program

Form = tuple[tuple[int, ...], tuple[int, ...], torch.dtype]  # size, strides and dtype of a tensor


class Kernel(Protocol):
    """Function that computes all outputs of a program; the results alone if the backend `guards` them."""

    def __call__(self, inputs: Sequence[Tensor], samples: int) -> list[Tensor]:
        """Outputs [samples, width], summed ones [width], from arguments [samples, width], uniform ones [width]."""


class DirectKernel(Kernel, Protocol):
    """Kernel of a backend that is not differentiable: it also writes to tensors that exist."""

    def into(self, inputs: Sequence[Tensor], results: Sequence[Tensor], samples: int) -> None:
        """Compute the outputs, none of them summed, into given tensors.

        All tensors are contiguous and of one dtype; only their number of elements matters.
        """


class LoopKernel(Protocol):
    """Function that computes all outputs of a loop, of which the last is the largest error growth of every sample."""

    def __call__(self, inputs: Sequence[Tensor], samples: int, steps: int) -> list[Tensor]:
        """Outputs of the shapes of `program.loop.shapes`, from arguments [samples, width], of steps or uniform."""


class Backend:
    """Interface of a backend."""

    name: str  # in `torchdq.backend(name)` and in arguments `backend`
    differentiable: bool  # whether it runs torch operations, which torch itself traces, differentiates and transforms
    guards: bool = False  # whether kernels recompute rows of large error growth themselves, and return results alone

    def refusal(self, device: torch.device) -> TorchdqError | None:
        """Error that says why programs cannot run on a device; None: they can."""
        raise NotImplementedError

    def kernel(self, program: Program, dtype: torch.dtype, device: torch.device) -> Kernel:
        """Function that computes all outputs of a program in one precision."""
        raise NotImplementedError

    def loop(self, loop: Loop, dtype: torch.dtype, device: torch.device, samples: int) -> LoopKernel:
        """Function that computes all outputs of a loop in one precision, for about so many samples."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"


def largest_growth(dtype: torch.dtype) -> float:
    """Largest accepted error growth in a precision."""
    return LARGEST_GROWTH.double if dtype == torch.float64 else LARGEST_GROWTH.single


def contiguous(shape: tuple[int, ...], dtype: torch.dtype) -> Form:
    """Form of a contiguous tensor."""
    return shape, tuple([math.prod(shape[k + 1 :]) for k in range(len(shape))]), dtype


def dense(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Tensors whose memory holds their numbers, row by row; those that are views of other numbers are copied.

    torch keeps the sign of some views apart, and a zero of its own without memory.
    """
    return [_read(x) if x.is_neg() or not x.is_contiguous() or x._is_zerotensor() else x for x in tensors]


def share_memory(x: Tensor, y: Tensor) -> bool:
    """Whether the memory between the first and the last numbers of two tensors overlaps."""
    return x.data_ptr() < _end(y) and y.data_ptr() < _end(x)


def _end(x: Tensor) -> int:
    """Address behind the last number."""
    if x.is_contiguous():
        return x.data_ptr() + x.nbytes
    last = sum([(size - 1) * stride for size, stride in zip(x.shape, x.stride(), strict=True)])
    return x.data_ptr() + (last + 1) * x.itemsize


def _read(x: Tensor) -> Tensor:
    return x.new_zeros(x.shape) if x._is_zerotensor() else x.resolve_neg().contiguous()
