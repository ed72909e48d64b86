"""Some rows of tensors with a row per environment: by their indices, or by a mask where the host must not wait.

How many rows a mask has is known to the device alone. So on a GPU all rows are computed, and those of the mask kept.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Indexed(NamedTuple):
    """Rows by their indices [k]."""

    indices: Tensor

    def of(self, x: Tensor) -> Tensor:
        """These rows of a tensor [N, ...], shape [k, ...]."""
        return x[self.indices]

    def replaced(self, x: Tensor, fresh: Tensor) -> Tensor:
        """Copy of a tensor [N, ...] with other numbers [k, ...] in these rows."""
        return x.index_copy(0, self.indices, fresh)

    def write(self, x: Tensor, fresh: Tensor) -> None:
        """Write other numbers [k, ...] into these rows of a tensor [N, ...]."""
        x.index_copy_(0, self.indices, fresh)


class Masked(NamedTuple):
    """Rows by a mask [N]; what is computed is computed for all of them."""

    mask: Tensor

    def of(self, x: Tensor) -> Tensor:
        """All rows of a tensor [N, ...]."""
        return x

    def replaced(self, x: Tensor, fresh: Tensor) -> Tensor:
        """Copy of a tensor [N, ...] with the numbers of another [N, ...] in the rows of the mask."""
        return torch.where(column(self.mask, x), fresh, x)

    def write(self, x: Tensor, fresh: Tensor) -> None:
        """Write the numbers of another tensor [N, ...] into the rows of the mask."""
        x.copy_(self.replaced(x, fresh))


SomeRows = Indexed | Masked


class Host(NamedTuple):
    """Questions that the host may ask the device: for values, or none, since it would wait for them."""

    synchronises: bool

    def any(self, mask: Tensor) -> bool:
        """Whether a row of a mask [N] is true, or may be."""
        # `any` of one row takes a microsecond
        return not self.synchronises or bool(mask if len(mask) == 1 else mask.any())

    def some(self, mask: Tensor) -> SomeRows:
        """Rows of a mask [N]."""
        return Indexed(mask.nonzero().squeeze(1)) if self.synchronises else Masked(mask)


def column(mask: Tensor, x: Tensor) -> Tensor:
    """Mask [N] with as many axes as a tensor [N, ...]."""
    return mask.reshape(-1, *[1] * (x.ndim - 1))
