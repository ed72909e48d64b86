"""Memory of tensors, as kernels read it."""

from collections.abc import Sequence

from torch import Tensor


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
