"""Pseudo-inertias J = integral of (1, p) (1, p)^T dm of bodies, positive definite where a body can exist.

Near a body J_0 = C C^T, others have B = C^-1 J C^-T near one. The divergence of B from one is

    2 (tr B - log det B - 4),

about |B - 1|^2 for small changes, the same in all axes and units, and infinite where a body cannot exist (T. Lee, P.
Wensing, F. C. Park, "Geometric robot dynamic identification: a convex programming approach", T-RO 36 (2020)).
"""

import itertools

import torch
from torch import Tensor

from torchdq import dq
from torchdq.robot.arrays import second_moments


def _basis() -> Tensor:
    """Orthonormal basis [10, 4, 4] of the symmetric matrices."""
    basis = torch.zeros(10, 4, 4, dtype=torch.float64)
    for k, (i, j) in enumerate(itertools.combinations_with_replacement(range(4), 2)):
        basis[k, i, j] = basis[k, j, i] = 1.0 if i == j else 0.5**0.5
    return basis


BASIS = _basis()


def pseudo_inertia(pi: Tensor) -> Tensor:
    """Pseudo-inertias [..., 4, 4] of inertial parameters [..., 10], in the order of `Robot.inertial_parameters`."""
    J = pi.new_zeros(*pi.shape[:-1], 4, 4)
    J[..., 0, 0] = pi[..., 0]
    J[..., 0, 1:] = J[..., 1:, 0] = pi[..., 1:4]
    J[..., 1:, 1:] = second_moments(pi[..., 4:])
    return J


def inertial_parameters(J: Tensor) -> Tensor:
    """Inertial parameters [..., 10] of pseudo-inertias [..., 4, 4]."""
    return torch.cat([J[..., 0], inertia_of(J[..., 1:, 1:])], -1)


def inertia_of(second: Tensor) -> Tensor:
    """Inertia [..., 6] (xx xy yy xz yz zz) of second moments [..., 3, 3]."""
    x, y, z = second.diagonal(dim1=-2, dim2=-1).unbind(-1)
    xy, xz, yz = second[..., 0, 1], second[..., 0, 2], second[..., 1, 2]
    return torch.stack([y + z, -xy, x + z, -xz, -yz, x + y], -1)


def bodies_of(L: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mass [...] [kg], centre of mass [..., 3] [m] and inertia about it [..., 6] [kg m^2] of L L^T, L lower triangular.

    The second moments about the centre of mass are a square, so that the body can exist, rounded or not.
    """
    return L[..., 0, 0].square(), L[..., 1:, 0] / L[..., :1, 0], inertia_of(L[..., 1:, 1:] @ L[..., 1:, 1:].mT)


def moved(X_BF: Tensor) -> Tensor:
    """Matrix [10, 10] that takes inertial parameters about a frame F to those about B; `X_BF` [8] is F's pose in B."""
    T = torch.eye(4, dtype=X_BF.dtype)
    matrix = dq.to_matrix(X_BF)
    T[1:, 0], T[1:, 1:] = matrix[:3, 3], matrix[:3, :3]
    return inertial_parameters(T @ pseudo_inertia(torch.eye(10, dtype=X_BF.dtype)) @ T.mT).T


def relative(y: Tensor) -> Tensor:
    """Matrices B [..., 4, 4] of the entries [..., 10] of B - 1 in an orthonormal basis of the symmetric matrices."""
    return torch.eye(4, dtype=y.dtype) + (y @ BASIS.flatten(1)).unflatten(-1, (4, 4))


def divergence(B: Tensor) -> Tensor:
    """2 (tr B - log det B - 4) of matrices B [..., 4, 4]; infinite where one is not positive definite."""
    L, info = torch.linalg.cholesky_ex(B)
    found = 2 * (B.diagonal(dim1=-2, dim2=-1) - 1 - 2 * L.diagonal(dim1=-2, dim2=-1).log()).sum(-1)
    return torch.where(info == 0, found, torch.inf)


def divergence_slopes(B: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient [..., 10] and Hessian [..., 10, 10] of the divergence by the entries of B [..., 4, 4]."""
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(B))
    products = inverse[..., None, :, :] @ BASIS
    gradient = 2 * (torch.eye(4, dtype=B.dtype) - inverse).flatten(-2) @ BASIS.flatten(1).T
    return gradient, 2 * products.flatten(-2) @ products.mT.flatten(-2).mT
