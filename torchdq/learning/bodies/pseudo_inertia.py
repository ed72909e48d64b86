"""Bodies as pseudo-inertias J = integral of (1, p) (1, p)^T dm, which are positive definite where a body can exist."""

import torch
from torch import Tensor

from torchdq import dq
from torchdq.learning.identification.feasible import ENTRIES
from torchdq.robot.arrays import second_moments


def pseudo_inertia(pi: Tensor) -> Tensor:
    """Pseudo-inertias [..., 4, 4] of inertial parameters [..., 10], in the order of `Robot.inertial_parameters`."""
    J = pi.new_zeros(*pi.shape[:-1], 4, 4)
    J[..., 0, 0] = pi[..., 0]
    J[..., 0, 1:] = J[..., 1:, 0] = pi[..., 1:4]
    J[..., 1:, 1:] = second_moments(pi[..., 4:])
    return J


UNITS = pseudo_inertia(torch.eye(10, dtype=torch.float64))  # [10, 4, 4] of the inertial parameters
PARAMETERS = torch.linalg.inv(torch.einsum("pij,eij->pe", UNITS, ENTRIES))


def inertial_parameters(J: Tensor) -> Tensor:
    """Inertial parameters [..., 10] of pseudo-inertias [..., 4, 4]."""
    return torch.einsum("...ij,eij->...e", J, ENTRIES) @ PARAMETERS


def central(J: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mass [...] [kg], centre of mass [..., 3] [m] and inertia about it [..., 6] [kg m^2] of pseudo-inertias."""
    L = torch.linalg.cholesky(J)
    about = L[..., 1:, 1:] @ L[..., 1:, 1:].mT  # a square, so that the body can exist, rounded or not
    empty = torch.zeros_like(about[..., :1])
    whole = torch.cat([torch.zeros_like(J[..., :1, :]), torch.cat([empty, about], -1)], -2)
    return J[..., 0, 0], L[..., 1:, 0] / L[..., :1, 0], inertial_parameters(whole)[..., 4:]


def moved(X_BF: Tensor) -> Tensor:
    """Matrix [10, 10] that takes inertial parameters about a frame F to those about B; `X_BF` [8] is F's pose in B."""
    T = torch.eye(4, dtype=X_BF.dtype)
    matrix = dq.to_matrix(X_BF)
    T[1:, 0], T[1:, 1:] = matrix[:3, 3], matrix[:3, :3]
    return inertial_parameters(T @ UNITS.to(T) @ T.mT).T
