"""Backends as objects: each runs programs on the tensors of some devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchdq.errors import TorchdqError
from torchdq.program.program import Program

Kernel = Callable[[Sequence[Tensor], int], list[Tensor]]
"""Outputs of a program from its arguments, tensors [samples, width] or [width], and the number of samples."""


class Backend:
    """A way to run programs."""

    name: str  # as users say it
    differentiable: bool  # whether torch sees its operations: then it traces, differentiates and transforms them itself

    def refusal(self, device: torch.device) -> TorchdqError | None:
        """Error that says why it cannot run on a device; None: it can."""
        raise NotImplementedError

    def available(self, device: torch.device) -> bool:
        """Whether programs can run on a device."""
        return self.refusal(device) is None

    def kernel(self, program: Program, dtype: torch.dtype, device: torch.device) -> Kernel:
        """Function that computes all outputs of a program in one precision."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"
