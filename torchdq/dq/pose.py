"""Poses as values: a small immutable class around a tensor of unit dual quaternions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree

from torchdq.algebra import dual_quaternion, quaternion
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Pure
from torchdq.base.checks import TensorValue, destination
from torchdq.dq import poses, tensors
from torchdq.dq.components import checked, unit
from torchdq.dq.formulas import computed
from torchdq.errors import ArgumentError


@dataclass(frozen=True, eq=False)
class Pose(TensorValue):
    """Pose X_AB of a frame B in a frame A, a rigid motion, around a tensor [..., 8].

        X_AC = X_AB @ X_BC,   X_BA = X_AB.inverse(),   p_A = X_AB.apply(p_B)
        xi = (X.inverse() @ X_des).log()

    Every function of this package that takes poses takes these and plain tensors alike. Results are tensors, of which
    `Pose(torchdq.forward_kinematics(robot, q, "tip"))` makes poses. Leading axes are batch axes and broadcast, and
    `X[i]` are some of a batch; dtype and device are those of the tensor. torch.func and torch.compile take poses as
    arguments and results; a full graph of torch.compile needs `multiply`, since it does not trace `@` between objects.

    A motion xi [..., 6] is (angular [rad], linear [m]), the order of twists: the constant twist in B's axes that
    carries the frame from A to B in one second. It is the whole motion, twice the half-angle screw of `dq.exp` and
    `dq.log`. Pinocchio and jaxlie give the same numbers with the linear part first.

    Args:
        parameters: unit dual quaternion r + (eps/2) p r, shape [..., 8]; its negative is the same pose.

    >>> # a quarter turn about z, 1 m up
    >>> X_AB = Pose.exp(torch.tensor([0.0, 0.0, torch.pi / 2, 0.0, 0.0, 1.0]))
    >>> X_AB.apply(torch.tensor([1.0, 0.0, 0.0])).round(decimals=3) + 0.0
    tensor([0., 1., 1.])
    >>> torch.allclose((X_AB.inverse() @ X_AB).log(), torch.zeros(6), atol=1e-6)
    True
    """

    parameters: Tensor

    def __post_init__(self) -> None:
        checked("parameters", self.parameters, 8)

    @staticmethod
    def identity(
        batch: Sequence[int] = (), dtype: torch.dtype | None = None, device: torch.device | str | None = None
    ) -> Pose:
        """Pose of a frame in itself, with these batch axes."""
        return Pose(torch.eye(1, 8, dtype=dtype, device=device)[0].expand(*batch, 8))

    @staticmethod
    def from_matrix(matrix: Tensor) -> Pose:
        """Pose of a homogeneous matrix [..., 4, 4]; raises as `torchdq.dq.from_matrix`."""
        return Pose(poses.from_matrix(matrix))

    @staticmethod
    def from_rotation_and_translation(rotation: Tensor, translation: Tensor) -> Pose:
        """Pose of a unit quaternion (w, x, y, z) [..., 4] and the position of B's origin in A [m], [..., 3]."""
        r, p = unit("rotation", checked("rotation", rotation, 4)), checked("translation", translation, 3)
        return Pose(computed(dual_quaternion.from_pose, rotation=r, translation=p))

    @staticmethod
    def exp(xi: Tensor) -> Pose:
        """Pose reached by a motion xi [..., 6] from the identity."""
        return Pose(poses.exp(0.5 * checked("xi", xi, 6)))

    def to(self, dtype: Any = None, device: torch.device | str | None = None) -> Pose:
        """Same pose in another dtype, on another device, or both."""
        return Pose(self.parameters.to(**destination(dtype, device)))

    def __getitem__(self, index: Any) -> Pose:
        """Poses at an index of the batch axes."""
        return Pose(torch.stack([x[index] for x in self.parameters.unbind(-1)], -1))

    def as_matrix(self) -> Tensor:
        """Homogeneous matrix [..., 4, 4]."""
        return poses.to_matrix(self.parameters)

    def rotation(self) -> Tensor:
        """Unit quaternion (w, x, y, z) [..., 4] that turns B components into A components."""
        return poses.rotation(self.parameters)

    def translation(self) -> Tensor:
        """Position of B's origin in A [m], [..., 3]."""
        return poses.translation(self.parameters)

    def apply(self, points: Tensor) -> Tensor:
        """Points [..., 3] given in B [m], in A."""
        return computed(_moved, pose=self.parameters, points=checked("points", points, 3))

    def multiply(self, other: Pose) -> Pose:
        """Composition X_AC = X_AB X_BC, also `X_AB @ X_BC`; raises unless both are poses."""
        if not isinstance(other, Pose):
            raise ArgumentError(f"a Pose is multiplied by a Pose, found {type(other).__name__}; use torchdq.dq.Pose(X)")
        return Pose(computed(dual_quaternion.mul, pose=self.parameters, other=other.parameters))

    __matmul__ = multiply

    def inverse(self) -> Pose:
        """Pose X_BA of A in B."""
        return Pose(tensors.conj(self.parameters))

    def log(self) -> Tensor:
        """Shortest motion xi [..., 6], which turns by at most pi; at exactly pi see `torchdq.dq.log_shortest`."""
        return 2.0 * poses.log_shortest(self.parameters)

    def adjoint(self) -> Tensor:
        """Matrix [..., 6, 6] that expresses twists (angular, linear) and wrenches (force, moment) of B in A."""
        return tensors.ad_matrix(self.parameters)

    def normalize(self) -> Pose:
        """Closest unit dual quaternion, after rounding errors of many products."""
        return Pose(tensors.normalize(self.parameters))


def _moved(x: DualQuaternion, p: Pure) -> Pure:
    """Point in A of one in B."""
    return quaternion.add(quaternion.rotate(x[0], p), dual_quaternion.translation(x))


def _of_leaves(leaves: Any, _: None) -> Pose:
    """Pose around whatever a transform puts instead of its tensor."""
    pose = object.__new__(Pose)
    object.__setattr__(pose, "parameters", *leaves)
    return pose


_pytree.register_pytree_node(
    Pose,
    lambda pose: ([pose.parameters], None),
    _of_leaves,
    flatten_with_keys_fn=lambda pose: ([(_pytree.GetAttrKey("parameters"), pose.parameters)], None),
)
