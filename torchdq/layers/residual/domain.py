"""States that a network was trained on, and how far others are from them."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchdq.layers.residual.smooth import smooth_step

CENTRES = 48  # states that stand for all that were trained on
ROWS = 4096  # most rows that the centres are chosen among
FAR = 1e4  # size of a scaled feature beyond which it is far away, however far
OPEN = 1e30  # reach of a domain without an end
LEAST = 0.25  # least reach, per scaled feature
FADED = 2.0  # distance, in units of the reach, from which nothing is left


class Domain(nn.Module):
    """Trained states: factors [..., groups] that are one among them and fade to zero away from them.

    The squared distance of a state x from the centres c_k is a soft minimum of those from each,

        d^2 = -s^2 log sum_k exp(-|x - c_k|^2 / s^2),

    and the factor falls from one at d = reach to exactly zero at d = 2 reach, along a polynomial in d^2 whose first and
    second derivatives have no jump. A new domain has no end.

    Args:
        groups: number of networks side by side; each has its own domain.
        features: number of features of each.

    >>> domain = Domain(1, 2)
    >>> domain.cover(torch.zeros(10, 1, 2))
    >>> domain(torch.tensor([[[0.0, 0.0]], [[5.0, 0.0]]]))
    tensor([[1.],
            [0.]])
    """

    centres: Tensor
    softness: Tensor
    reach: Tensor

    def __init__(self, groups: int, features: int):
        super().__init__()
        self.register_buffer("centres", torch.zeros(groups, CENTRES, features, dtype=torch.float64))
        self.register_buffer("softness", torch.ones(groups, dtype=torch.float64))
        self.register_buffer("reach", torch.full((groups,), OPEN, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        """Factors [..., groups] for scaled features x [..., groups, features]."""
        return self.factor(self.squared_distance(x))

    def squared_distance(self, x: Tensor) -> Tensor:
        """Squared distances [..., groups] from the centres; less than zero between several of them."""
        return -self.softness.to(x).square() * torch.logsumexp(self._nearness(x), -1)

    def factor(self, squared_distance: Tensor) -> Tensor:
        """Factors [..., groups] at squared distances."""
        reach = self.reach.to(squared_distance)
        return 1 - smooth_step((squared_distance / reach / reach - 1) / (FADED**2 - 1))

    @torch.no_grad()
    def cover(self, x: Tensor) -> None:
        """Choose the centres among scaled features x [rows, groups, features], and reach just as far as all of them.

        Every centre after the first, which is the row nearest to the mean, is the row farthest from those before it.
        """
        x = x.detach().to(self.centres)
        some = x[:: -(-len(x) // ROWS)].transpose(0, 1)  # [groups, rows, features]
        groups = torch.arange(len(some), device=x.device)
        left = torch.full(some.shape[:2], torch.inf, dtype=x.dtype, device=x.device)
        chosen = (some - some.mean(1, keepdim=True)).square().sum(-1).argmin(1)
        for k in range(CENTRES):
            self.centres[:, k] = some[groups, chosen]
            left = left.minimum((some - self.centres[:, k, None]).square().sum(-1))
            chosen = left.argmax(1)
        # half the largest distance of a row to its nearest centre, and not much less than the features spread
        least = LEAST * math.sqrt(x.shape[-1])
        self.softness.copy_((left.amax(1).sqrt() / 2).clamp_min(least / 2))
        self.reach.fill_(OPEN)
        farthest = torch.stack([self.squared_distance(part).amax(0) for part in x.split(ROWS)]).amax(0)
        self.reach.copy_(farthest.clamp_min(0).sqrt().clamp_min(least))

    def _nearness(self, x: Tensor) -> Tensor:
        """Negative squared distances [..., groups, centres] in units of the squared softness."""
        x, centres = x.clamp(-FAR, FAR), self.centres.to(x)
        s = self.softness.to(x).square().unsqueeze(-1)
        across = torch.einsum("...gf,gkf->...gk", x, (2 / s).unsqueeze(-1) * centres)
        return across - (x.square().sum(-1, keepdim=True) / s + centres.square().sum(-1) / s)
