"""Poses, twists and quaternions in the conventions of other libraries.

Here a pose X_AB is [..., 8], a quaternion (w, x, y, z), a twist (angular, linear), a wrench (force, moment). Elsewhere:

    scipy      RigidTransform holds the same pose; its Rotation writes quaternions (x, y, z, w) by default
    Pinocchio  pin.SE3 holds the same pose; Motion is (linear, angular); Force is (linear, angular) = (force, moment),
               which is the order here, so that a wrench needs no conversion: `pin.Force(wrench.numpy())`
    MuJoCo     position and quaternion (w, x, y, z)
    Isaac      position and quaternion (x, y, z, w)

scipy and Pinocchio are imported when their converters are called. Nothing is differentiated through those two.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchdq import dq
from torchdq.checks import device_of
from torchdq.dq.components import checked
from torchdq.errors import ArgumentError
from torchdq.optional import imported

if TYPE_CHECKING:
    import pinocchio
    from scipy.spatial.transform import RigidTransform


# --- quaternion order ------------------------------------------------------------------------------------------------


def to_xyzw(r: Tensor) -> Tensor:
    """Quaternion [..., 4] in the order (x, y, z, w), from (w, x, y, z).

    >>> to_xyzw(torch.tensor([1.0, 2, 3, 4]))
    tensor([2., 3., 4., 1.])
    """
    return checked("r", r, 4).roll(-1, -1)


def from_xyzw(r: Tensor) -> Tensor:
    """Quaternion [..., 4] in the order (w, x, y, z), from (x, y, z, w).

    >>> from_xyzw(torch.tensor([2.0, 3, 4, 1]))
    tensor([1., 2., 3., 4.])
    """
    return checked("r", r, 4).roll(1, -1)


# --- MuJoCo ----------------------------------------------------------------------------------------------------------


def to_mujoco(x: Tensor) -> tuple[Tensor, Tensor]:
    """Position [..., 3] of B's origin in A [m] and unit quaternion (w, x, y, z) [..., 4] of the pose x = X_AB [..., 8].

    For Isaac, pass the quaternion on to `to_xyzw`.

    >>> position, rotation = to_mujoco(torch.tensor([1.0, 0, 0, 0, 0, 0.5, 1, 1.5]))
    >>> position, rotation
    (tensor([1., 2., 3.]), tensor([1., 0., 0., 0.]))
    """
    return dq.translation(x), dq.rotation(x)


def from_mujoco(position: Tensor, rotation: Tensor) -> Tensor:
    """Pose X_AB [..., 8] from MuJoCo's position and quaternion, e.g. `data.xpos` and `data.xquat`, with A the world.

    Args:
        position: position of B's origin in A [m], shape [..., 3], also as a numpy array.
        rotation: unit quaternion (w, x, y, z), shape [..., 4], also as a numpy array.

    >>> from_mujoco(torch.tensor([1.0, 2, 3]), torch.tensor([1.0, 0, 0, 0]))
    tensor([1.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.5000, 1.0000, 1.5000])
    """
    # MuJoCo's arrays are views into its state: a copy keeps the pose from changing with the next step
    position, rotation = (v if isinstance(v, Tensor) else torch.tensor(v) for v in (position, rotation))
    return dq.from_pose(rotation, position)


# --- scipy -----------------------------------------------------------------------------------------------------------


def to_scipy(x: Tensor) -> RigidTransform:
    """RigidTransform of scipy, with the leading axes of x, for the poses x = X_AB [..., 8].

    `to_scipy(x).apply(p)` takes points from B to A, and products compose as `dq.mul` does. Needs scipy >= 1.16, and
    >= 1.17 for more than one leading axis.
    """
    transforms = imported("scipy.spatial.transform", "scipy", "to_scipy")
    return transforms.RigidTransform.from_dual_quat(
        checked("x", x, 8).detach().cpu().double().numpy(), scalar_first=True
    )


def from_scipy(
    transform: RigidTransform, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Poses X_AB [..., 8] of a scipy RigidTransform, with its leading axes."""
    device = None if device is None else device_of("device", device)
    return torch.as_tensor(transform.as_dual_quat(scalar_first=True).copy(), dtype=dtype, device=device)


# --- Pinocchio -------------------------------------------------------------------------------------------------------


def to_pinocchio(x: Tensor) -> pinocchio.SE3:
    """Placement aMb of Pinocchio for one pose x = X_AB [8]."""
    import pinocchio

    if checked("x", x, 8).ndim != 1:
        raise ArgumentError(f"x must be one pose of shape (8,), found {tuple(x.shape)}; convert row by row")
    x = x.detach().cpu().double()
    return pinocchio.SE3(dq.to_rotation_matrix(dq.rotation(x)).numpy(), dq.translation(x).numpy())


def from_pinocchio(
    placement: pinocchio.SE3, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Pose X_AB [8], with w >= 0, of Pinocchio's placement aMb."""
    matrix: Any = placement.homogeneous
    device = None if device is None else device_of("device", device)
    return dq.from_matrix(torch.tensor(matrix, dtype=torch.float64)).to(dtype=dtype, device=device)


def motion_to_pinocchio(twist: Tensor) -> Tensor:
    """Motion [..., 6] in Pinocchio's order (linear [m/s], angular [rad/s]), from a twist or spatial acceleration.

    The frame stays the same. Wrenches are not converted: their order is (force, moment) in both.

    >>> motion_to_pinocchio(torch.tensor([1.0, 2, 3, 4, 5, 6]))
    tensor([4., 5., 6., 1., 2., 3.])
    """
    return dq.swap(checked("twist", twist, 6))


def motion_from_pinocchio(motion: Tensor) -> Tensor:
    """Twist, or spatial acceleration, [..., 6] as (angular [rad/s], linear [m/s]), from Pinocchio's (linear, angular).

    >>> motion_from_pinocchio(torch.tensor([4.0, 5, 6, 1, 2, 3]))
    tensor([1., 2., 3., 4., 5., 6.])
    """
    return dq.swap(checked("motion", motion, 6))
