"""Bodies that are fixed to each other, as one body."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq import dq
from torchdq.robot.arrays import SIX, matrices


class RigidBody(NamedTuple):
    """Mass and its distribution, seen in a frame."""

    mass: Tensor  # [...] [kg]
    com: Tensor  # [..., 3] centre of mass [m]
    inertia: Tensor  # [..., 6] about the centre of mass: xx xy yy xz yz zz [kg m^2]


def lumped(body: RigidBody, others: Iterable[tuple[Tensor, RigidBody]]) -> RigidBody:
    """RigidBody with others fixed to it, each seen in a frame that has a pose [8] in the frame of the first."""
    mass, com, inertia = body
    for X, other in others:
        R, p = dq.to_rotation_matrix(X[..., :4]), dq.translation(X)
        total = mass + other.mass
        share = torch.where(total == 0, 0.0, other.mass / torch.where(total == 0, 1.0, total))
        apart = (R @ other.com.unsqueeze(-1)).squeeze(-1) + p - com
        rotated = (R @ matrices(other.inertia) @ R.mT)[..., *SIX]
        square = apart.square().sum(-1, keepdim=True) * torch.eye(3, dtype=apart.dtype, device=apart.device)[*SIX]
        steiner = square - apart[..., SIX[0]] * apart[..., SIX[1]]
        inertia = inertia + rotated + (mass * share).unsqueeze(-1) * steiner
        com = com + share.unsqueeze(-1) * apart
        mass = total
    return RigidBody(mass, com, inertia)
