"""Errors of torques: noise, and weights of a last layer that few samples decide."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchdq.base.tables import summary


class PredictedTorques(NamedTuple):
    """Torques with the errors of measurements beside them, each [..., n]."""

    tau: Tensor  # [N m or N]
    error: Tensor  # [N m or N], standard error of a measured torque: noise and what the model does not know
    low: Tensor  # [N m or N], end of the interval that holds 95 % of measured torques
    high: Tensor  # [N m or N]

    def __repr__(self) -> str:
        return summary("PredictedTorques", {name: (x, "N m or N") for name, x in self._asdict().items()})


class Posterior(nn.Module):
    """Errors of torques [..., n]: of what was measured on left-out rows, and of the last layer's weights.

    The outputs are linear in the weights of the last layer, so that with Gaussian noise and a Gaussian prior the
    weights are Gaussian too, in closed form: for the hidden features h with a one beside them,

        variance of the output = noise^2 c h^T (H^T H + ridge)^-1 h,

    where the c rows along which the noise is correlated count as one. Where the domain's factor is less than one the
    error grows with the distance, in units of what the residual was over all rows.

    Args:
        groups: number of networks side by side.
        width: width of their last hidden layer; 0: of no network that is known here, so that its weights are certain.
        n: number of joints.
    """

    root: Tensor
    noise: Tensor
    correlation: Tensor
    unexplained: Tensor
    quantile: Tensor

    def __init__(self, groups: int, width: int, n: int):
        super().__init__()
        self.register_buffer("root", torch.zeros(groups, width + 1, width + 1, dtype=torch.float64))
        for name in ("noise", "correlation", "unexplained", "quantile"):
            self.register_buffer(name, torch.zeros(n, dtype=torch.float64))

    @property
    def measured(self) -> bool:
        """Whether the errors are known; `torchdq.learning.fit` measures them."""
        return bool((self.quantile > 0).any())

    def leverage(self, hidden: Tensor) -> Tensor:
        """h^T (H^T H + ridge)^-1 h [..., groups] of hidden features [..., groups, width]."""
        return torch.einsum("...gh,ghk->...gk", with_constant(hidden.to(self.root)), self.root).square().sum(-1)

    def errors(self, leverage: Tensor, factor: Tensor, distance: Tensor, weight: Tensor) -> Tensor:
        """Standard errors [..., n] of measured torques.

        Args:
            leverage: of the hidden features, [..., n].
            factor: the domain's, [..., n].
            distance: from the domain, in units of its reach, [..., n].
            weight: of the residual, [n].
        """
        of_weights = (weight * factor * self.noise).square() * self.correlation * leverage
        outside = ((1 - factor) * distance * self.unexplained).square()
        return (self.noise.square() + of_weights + outside).sqrt()

    @torch.no_grad()
    def learn(self, hidden: Tensor, ridge: Tensor) -> None:
        """Take in hidden features [rows, groups, width] of training rows; `ridge` [groups] is the prior's weight."""
        H = with_constant(hidden.to(self.root)).transpose(0, 1)
        one = torch.eye(H.shape[-1], dtype=H.dtype, device=H.device)
        e, V = torch.linalg.eigh(H.mT @ H + ridge[:, None, None] * one)
        self.root.copy_(V * e.clamp_min(1e-9 * e.amax()).rsqrt().unsqueeze(-2))


def with_constant(hidden: Tensor) -> Tensor:
    """Hidden features with a one beside them, for the bias."""
    return torch.cat([hidden, torch.ones_like(hidden[..., :1])], -1)
