"""The option `--device`, and training on a device; for the other examples."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from torchdq.learning import History, Samples, fit


@dataclass(kw_only=True)
class OnDevice:
    device: str = "cpu"
    """Device of what is simulated and trained, such as cuda; under torchrun, cuda is another GPU in every process."""

    @property
    def place(self) -> torch.device:
        """Device of this process."""
        found = torch.device(self.device)
        if found.type == "cuda" and found.index is None and "LOCAL_RANK" in os.environ:
            return torch.device("cuda", int(os.environ["LOCAL_RANK"]))
        return found


def fit_on(device: torch.device, model: nn.Module, *data: Samples | Sequence[Samples], **options: Any) -> History:
    """History of a fit on a device, of a model that lies on the CPU before and after; see `torchdq.learning.fit`."""
    history = fit(model.to(device), *data, **options)
    model.cpu()
    return history
