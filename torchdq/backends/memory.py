"""Memory of tensors, as kernels read it."""

from collections.abc import Sequence

from torch import Tensor


def dense(tensors: Sequence[Tensor]) -> list[Tensor]:
    """Tensors whose memory holds their numbers, row by row; those that are views of other numbers are copied.

    torch keeps the sign of some views apart, and a zero of its own without memory.
    """
    return [_read(x) if x.is_neg() or not x.is_contiguous() or x._is_zerotensor() else x for x in tensors]


def _read(x: Tensor) -> Tensor:
    return x.new_zeros(x.shape) if x._is_zerotensor() else x.resolve_neg().contiguous()
