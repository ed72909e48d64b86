"""Interface of a backend, which runs programs on tensors of some devices."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchdq.errors import TorchdqError
from torchdq.program.program import Program

Kernel = Callable[[Sequence[Tensor], int], list[Tensor]]
"""Outputs of a program from its arguments, tensors [samples, width] or [width], and the number of samples."""


class Backend:
    """Interface of a backend."""

    name: str  # in `torchdq.backend(name)` and in arguments `backend`
    differentiable: bool  # whether it runs torch operations, which torch itself traces, differentiates and transforms

    def refusal(self, device: torch.device) -> TorchdqError | None:
        """Error that says why programs cannot run on a device; None: they can."""
        raise NotImplementedError

    def available(self, device: torch.device) -> bool:
        """Whether programs can run on a device."""
        return self.refusal(device) is None

    def kernel(self, program: Program, dtype: torch.dtype, device: torch.device) -> Kernel:
        """Function that computes all outputs of a program in one precision."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"
