"""Conventions of Pinocchio. Nothing is differentiated through its own poses; rows of tensors are differentiable."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdq import dq
from torchdq.base.checks import destination
from torchdq.base.optional import imported
from torchdq.convert.rows import from_xyzw, parts, row, to_xyzw
from torchdq.dq.components import checked, unit
from torchdq.errors import ArgumentError

if TYPE_CHECKING:
    import pinocchio


def to_pinocchio(x: Tensor) -> pinocchio.SE3:
    """Placement aMb of Pinocchio for one pose x = X_AB [8].

    Raises:
        ArgumentError: x is a batch.

    >>> import torch
    >>> from torchdq import dq
    >>> x = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3]))
    >>> to_pinocchio(x).translation
    array([1., 2., 3.])
    """
    pinocchio = imported("pinocchio", "pin", "to_pinocchio", "'torchdq[pinocchio]'")
    if checked("x", x, 8).ndim != 1:
        raise ArgumentError(f"x must be one pose of shape (8,), found {tuple(x.shape)}; convert row by row")
    x = x.detach().cpu().double()
    return pinocchio.SE3(dq.to_rotation_matrix(dq.rotation(x)).numpy(), dq.translation(x).numpy())


def from_pinocchio(
    placement: pinocchio.SE3, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Pose X_AB [8], with w >= 0, of Pinocchio's placement aMb.

    Args:
        placement: pose of Pinocchio, SE3.
        dtype, device: those of the result.

    >>> import torch
    >>> from torchdq import dq
    >>> x = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3]))
    >>> from_pinocchio(to_pinocchio(x))
    tensor([1.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.5000, 1.0000, 1.5000],
           dtype=torch.float64)
    """
    matrix: Any = getattr(placement, "homogeneous", None)
    if matrix is None:
        raise ArgumentError(f"placement must be an SE3 of Pinocchio, found {type(placement).__name__}")
    return dq.from_matrix(torch.tensor(matrix, dtype=torch.float64)).to(**destination(dtype, device))


def motion_to_pinocchio(twist: Tensor) -> Tensor:
    """Motion [..., 6] (linear [m/s], angular [rad/s]) of Pinocchio in the same frame, from a twist or its rate.

    >>> import torch
    >>> motion_to_pinocchio(torch.tensor([1.0, 2, 3, 4, 5, 6]))
    tensor([4., 5., 6., 1., 2., 3.])
    """
    return checked("twist", twist, 6).roll(3, -1)


def motion_from_pinocchio(motion: Tensor) -> Tensor:
    """Twist, or spatial acceleration, [..., 6] as (angular [rad/s], linear [m/s]), from Pinocchio's (linear, angular).

    >>> import torch
    >>> motion_from_pinocchio(torch.tensor([4.0, 5, 6, 1, 2, 3]))
    tensor([1., 2., 3., 4., 5., 6.])
    """
    return checked("motion", motion, 6).roll(3, -1)


def configuration_to_pinocchio(X_WB: Tensor, q: Tensor) -> Tensor:
    """Configuration [..., 7 + n] of Pinocchio, for joints of one coordinate.

    >>> import torch
    >>> configuration_to_pinocchio(
    ...     torch.tensor([1.0, 0, 0, 0, 0, 0.5, 1, 1.5]), torch.tensor([0.7])
    ... )
    tensor([1.0000, 2.0000, 3.0000, 0.0000, 0.0000, 0.0000, 1.0000, 0.7000])
    """
    return row(dq.translation(X_WB), to_xyzw(dq.rotation(X_WB)), q)


def configuration_from_pinocchio(configuration: Tensor) -> tuple[Tensor, Tensor]:
    """Pose X_WB [..., 8] of the base and joint positions q [..., n], from Pinocchio's configuration [..., 7 + n].

    Raises:
        ArgumentError: a quaternion is not unit; `torchdq.dq.normalize` makes it so.

    >>> import torch
    >>> from torchdq import dq
    >>> X_WB, q = configuration_from_pinocchio(torch.tensor([1.0, 2, 3, 0, 0, 0, 1, 0.7]))
    >>> dq.translation(X_WB), q
    (tensor([1., 2., 3.]), tensor([0.7000]))
    """
    position, rotation, q = parts("configuration", configuration, 3, 4)
    return dq.from_pose(from_xyzw(unit("configuration", rotation)), position), q


def velocity_to_pinocchio(V_WB_B: Tensor, qd: Tensor) -> Tensor:
    """Velocity [..., 6 + n] of Pinocchio from the twist of the base and qd; accelerations are converted alike.

    >>> import torch
    >>> velocity_to_pinocchio(torch.tensor([1.0, 2, 3, 4, 5, 6]), torch.tensor([7.0]))
    tensor([4., 5., 6., 1., 2., 3., 7.])
    """
    return row(motion_to_pinocchio(V_WB_B), qd)


def velocity_from_pinocchio(velocity: Tensor) -> tuple[Tensor, Tensor]:
    """Twist V_WB_B [..., 6] of the base and qd [..., n], or accelerations, from Pinocchio's [..., 6 + n].

    >>> import torch
    >>> velocity_from_pinocchio(torch.tensor([4.0, 5, 6, 1, 2, 3, 7]))
    (tensor([1., 2., 3., 4., 5., 6.]), tensor([7.]))
    """
    base, qd = parts("velocity", velocity, 6)
    return motion_from_pinocchio(base), qd


def forces_to_pinocchio(F_B: Tensor, tau: Tensor) -> Tensor:
    """Generalised forces [..., 6 + n] of Pinocchio, from the wrench (force, moment) on the base and torques.

    >>> import torch
    >>> forces_to_pinocchio(torch.tensor([1.0, 2, 3, 4, 5, 6]), torch.tensor([7.0]))
    tensor([1., 2., 3., 4., 5., 6., 7.])
    """
    return row(checked("F_B", F_B, 6), tau)


def forces_from_pinocchio(forces: Tensor) -> tuple[Tensor, Tensor]:
    """Wrench F_B [..., 6] on the base and torques tau [..., n], from Pinocchio's generalised forces [..., 6 + n].

    >>> import torch
    >>> forces_from_pinocchio(torch.tensor([1.0, 2, 3, 4, 5, 6, 7]))
    (tensor([1., 2., 3., 4., 5., 6.]), tensor([7.]))
    """
    F_B, tau = parts("forces", forces, 6)
    return F_B, tau
