"""Orders of quaternions, and rows of a base and of the joints, as the other libraries have them."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchdq import dq
from torchdq.base.checks import require_tensor
from torchdq.dq.components import checked
from torchdq.errors import ArgumentError


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


def row(*parts: Tensor) -> Tensor:
    """Row of parts whose batch axes broadcast."""
    require_tensor("the row of the joints", parts[-1])  # the others are computed
    try:
        batch = torch.broadcast_shapes(*[x.shape[:-1] for x in parts])
    except RuntimeError as error:
        found = ", ".join(str(tuple(x.shape[:-1])) for x in parts)
        raise ArgumentError(f"the batch axes of the arguments must broadcast, found {found}") from error
    return torch.cat([x.expand(*batch, x.shape[-1]) for x in parts], -1)


def parts(name: str, x: Tensor, *sizes: int) -> Sequence[Tensor]:
    """First parts of a row, of these sizes, and the rest of it."""
    x = x if isinstance(x, Tensor) else torch.tensor(x)  # a copy, see `from_mujoco`
    if x.ndim == 0 or x.shape[-1] < sum(sizes):
        raise ArgumentError(f"{name} must end with an axis of {sum(sizes)} components or more, found {tuple(x.shape)}")
    return x.split([*sizes, x.shape[-1] - sum(sizes)], -1)


def to_base(X_WB: Tensor, v: Tensor) -> Tensor:
    """Vector [..., 3] in base axes, from world axes."""
    return dq.rotate(dq.conj(X_WB)[..., :4], v)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product of vectors [..., 3] whose batch axes broadcast."""
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))
