"""Several processes that share one training run, as `torchrun` starts them; for the other examples."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

import torch
import torch.distributed as dist
from torch import Tensor


class Team(NamedTuple):
    """Processes of a run and this one's rank among them; a process alone is a team of one."""

    rank: int = 0
    size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process is the one that writes and prints."""
        return self.rank == 0

    def share(self, rows: Tensor) -> Tensor:
        """Rows of a batch that this process computes."""
        return rows[self.rank :: self.size]

    def summed(self, tensors: list[Tensor]) -> list[Tensor]:
        """Sums of tensors over the team, in one message."""
        if self.size == 1:
            return tensors
        flat = torch.cat([x.flatten() for x in tensors])
        dist.all_reduce(flat)
        parts = flat.split([x.numel() for x in tensors])
        return [part.view_as(x).to(x.dtype) for part, x in zip(parts, tensors, strict=True)]


@contextmanager
def team(device: torch.device) -> Iterator[Team]:
    """Team of this process: joined here if `torchrun` started it, unless the caller has joined already.

    Args:
        device: device of the model; it decides between nccl and gloo.
    """
    if dist.is_available() and dist.is_initialized():
        yield Team(dist.get_rank(), dist.get_world_size())
    elif int(os.environ.get("WORLD_SIZE", "1")) > 1:
        if device.type == "cuda":
            torch.cuda.set_device(device)  # nccl sends from the current device
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        try:
            yield Team(dist.get_rank(), dist.get_world_size())
        finally:
            dist.destroy_process_group()
    else:
        yield Team()
