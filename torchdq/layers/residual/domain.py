"""States that a network was trained on, and how far others are from them."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

CENTRES = 48  # states that stand for all that were trained on
ROWS = 4096  # most rows that the centres are chosen among
FAR = 1e4  # size of a scaled feature beyond which it is far away, however far
LEAST = 0.25  # least reach, per scaled feature
FADED = 2.0  # distance, in units of the reach, from which nothing is left


class Domain(nn.Module):
    """Trained states of every group of joints: factors that are one among them and fade to zero away from them.

    The squared distance of a state x from the centres c_k is a soft minimum of those from each,

        d^2 = -s^2 log sum_k exp(-|x - c_k|^2 / s^2),

    and the factor falls from one at d = reach to exactly zero at d = 2 reach, along a polynomial in d^2 whose first and
    second derivatives have no jump. A new domain has no end.

    Args:
        groups: number of groups, joints or one for all of them.
        features: number of features of a state.

    >>> domain = Domain(1, 2)
    >>> domain.cover(torch.zeros(10, 1, 2))
    >>> domain(torch.tensor([[[0.0, 0.0]], [[5.0, 0.0]]]))
    tensor([[1.],
            [0.]])
    """

    centres: Tensor  # [groups, centres, features]
    softness: Tensor  # [groups]
    reach: Tensor  # [groups]

    def __init__(self, groups: int, features: int):
        super().__init__()
        self.register_buffer("centres", torch.zeros(groups, CENTRES, features, dtype=torch.float64))
        self.register_buffer("softness", torch.ones(groups, dtype=torch.float64))
        self.register_buffer("reach", torch.full((groups,), 1e30, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        """Factors [..., groups] for scaled features x [..., groups, features]."""
        reach = self.reach.to(x)
        t = ((self._squared_distance(x) / reach / reach - 1) / (FADED**2 - 1)).clamp(0.0, 1.0)
        return 1 - t * t * t * (10 + t * (6 * t - 15))

    @torch.no_grad()
    def cover(self, x: Tensor) -> None:
        """Choose the centres among scaled features x [rows, groups, features], and reach just as far as all of them.

        Every centre after the first, which is the row nearest to the mean, is the row farthest from those before it.
        """
        x = x.to(self.centres)
        some, group = x[:: -(-len(x) // ROWS)], torch.arange(x.shape[1], device=x.device)
        left = torch.full_like(some[..., 0], torch.inf)
        chosen = (some - some.mean(0)).square().sum(-1).argmin(0)
        for k in range(CENTRES):
            self.centres[:, k] = some[chosen, group]
            left = left.minimum((some - some[chosen, group]).square().sum(-1))
            chosen = left.argmax(0)
        # half the largest distance of a row to its nearest centre, and not much less than the features spread
        least = LEAST * math.sqrt(x.shape[-1])
        self.softness.copy_((left.amax(0).sqrt() / 2).clamp_min(least / 2))
        farthest = torch.stack([self._squared_distance(part).amax(0) for part in x.split(ROWS)]).amax(0)
        self.reach.copy_(farthest.clamp_min(0).sqrt().clamp_min(least))

    def _squared_distance(self, x: Tensor) -> Tensor:
        """Squared distances [..., groups] from the centres; less than zero between several of them."""
        x, centres, s = x.clamp(-FAR, FAR), self.centres.to(x), self.softness.to(x).square()
        across = (x.unsqueeze(-2) @ centres.mT).squeeze(-2)
        away = x.square().sum(-1, keepdim=True) + centres.square().sum(-1) - 2 * across
        return -s * torch.logsumexp(-away / s[:, None], -1)
