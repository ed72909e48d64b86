"""Poses of SciPy. Nothing is differentiated through them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchdq.base.checks import destination
from torchdq.base.optional import imported
from torchdq.dq.components import checked
from torchdq.errors import ArgumentError

if TYPE_CHECKING:
    from scipy.spatial.transform import RigidTransform


def to_scipy(x: Tensor) -> RigidTransform:
    """RigidTransform of scipy, with the leading axes of x, for the poses x = X_AB [..., 8].

    `to_scipy(x).apply(p)` takes points from B to A, and products compose as `dq.mul` does. Needs scipy >= 1.16, and
    >= 1.17 for more than one leading axis.

    Args:
        x: poses, shape [..., 8].

    >>> import torch
    >>> from torchdq import dq
    >>> x = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3]))
    >>> to_scipy(x).translation
    array([1., 2., 3.])
    """
    transforms = imported("scipy.spatial.transform", "scipy", "to_scipy")
    return transforms.RigidTransform.from_dual_quat(
        checked("x", x, 8).detach().cpu().double().numpy(), scalar_first=True
    )


def from_scipy(
    transform: RigidTransform, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Poses X_AB [..., 8] of a scipy RigidTransform, with its leading axes.

    Args:
        transform: poses of scipy.
        dtype, device: those of the result.

    >>> import torch
    >>> from torchdq import dq
    >>> x = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3]))
    >>> from_scipy(to_scipy(x))
    tensor([1.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.5000, 1.0000, 1.5000],
           dtype=torch.float64)
    """
    if not hasattr(transform, "as_dual_quat"):
        raise ArgumentError(f"transform must be a RigidTransform of scipy, found {type(transform).__name__}")
    return torch.as_tensor(transform.as_dual_quat(scalar_first=True).copy(), **destination(dtype, device))
