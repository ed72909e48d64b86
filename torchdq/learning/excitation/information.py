"""Information of a motion about the base parameters of a robot."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.dynamics.friction import smooth_sign
from torchdq.functional import regressor
from torchdq.learning.identification.base_parameters import SEPARATE, base_of, inverse_of
from torchdq.robot import Robot

States = tuple[Tensor, Tensor, Tensor]  # q, qd and qdd [..., samples, n]


class BaseParameters(NamedTuple):
    """Base parameters beta = `base` @ phi of all parameters phi, those of `Identified.names`: tau = Z[:, leading] beta.

    Each is one parameter, which names it, and those that torques cannot separate from it.
    """

    robot: Robot
    coefficients: tuple[str, ...]  # those of rotor, viscous, coulomb and offset that there are
    sign_width: float  # velocity below which dry friction is viscous [rad/s or m/s]
    noise: Tensor  # [n] standard deviation of a torque [N m or N]
    base: Tensor  # [rank, k]
    leading: Tensor  # [rank] indices of the parameters that name them
    sizes: Tensor  # [k] root mean square of a sample's torques per unit of every parameter, over the noise

    @classmethod
    def of(
        cls, robot: Robot, coefficients: Sequence[str], sign_width: float, noise: Tensor, states: States
    ) -> "BaseParameters":
        """Base parameters that torques in some states depend on: many random q, qd and qdd [samples, n]."""
        Z = _columns(robot, states, coefficients, sign_width) / noise[:, None]
        base, size = base_of(Z.flatten(0, 1))
        alone = (base == 1) & ((base != 0).sum(0) == 1)
        return cls(robot, tuple(coefficients), sign_width, noise, base, alone.int().argmax(1), size)

    def columns(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Torques per unit of each, over the noise, [..., n, rank]."""
        Z = _columns(self.robot, (q, qd, qdd), self.coefficients, self.sign_width)
        return Z.index_select(-1, self.leading) / self.noise[:, None]

    def information(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Mean information [..., rank, rank] of samples [..., samples, n] about sizes times beta."""
        Z = (self.columns(q, qd, qdd) / self.sizes[self.leading]).flatten(-3, -2)
        return Z.mT @ Z / q.shape[-2]

    def errors(self, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
        """Standard errors [rank] that the torques of samples [samples, n] leave; infinite without information."""
        A = len(q) * self.information(q, qd, qdd)
        size = A.diagonal().sqrt().clamp_min(1e-100)
        e, V = torch.linalg.eigh(A / size / size[:, None])
        identifiable = e > SEPARATE * e[-1]
        variance = V.square() @ inverse_of(e * identifiable)
        unknown = (V.square()[:, ~identifiable] > 1e-6).any(1)
        return torch.where(unknown, torch.inf, variance.sqrt() / size / self.sizes[self.leading])

    def condition(self, q: Tensor, qd: Tensor, qdd: Tensor) -> float:
        """Condition number of the matrix of all torques per unit of the base parameters, over the noise."""
        return float(torch.linalg.cond(self.columns(q, qd, qdd).flatten(0, 1)))


def _columns(robot: Robot, states: States, coefficients: Sequence[str], sign_width: float) -> Tensor:
    """Torque per unit of every parameter [..., n, k]."""
    q, qd, qdd = states
    own = {"rotor": qdd, "viscous": qd, "coulomb": smooth_sign(qd, sign_width), "offset": torch.ones_like(qd)}
    return torch.cat([regressor(robot, q, qd, qdd), *(torch.diag_embed(own[name]) for name in coefficients)], -1)
