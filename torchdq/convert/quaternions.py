"""Orders of the components of a quaternion."""

from torch import Tensor

from torchdq.dq.components import checked


def to_xyzw(r: Tensor) -> Tensor:
    """Quaternion [..., 4] in the order (x, y, z, w), from (w, x, y, z).

    >>> import torch
    >>> to_xyzw(torch.tensor([1.0, 2, 3, 4]))
    tensor([2., 3., 4., 1.])
    """
    return checked("r", r, 4).roll(-1, -1)


def from_xyzw(r: Tensor) -> Tensor:
    """Quaternion [..., 4] in the order (w, x, y, z), from (x, y, z, w).

    >>> import torch
    >>> from_xyzw(torch.tensor([2.0, 3, 4, 1]))
    tensor([1., 2., 3., 4.])
    """
    return checked("r", r, 4).roll(1, -1)
