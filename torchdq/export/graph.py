"""Graph of torch operations of a program, as a file that `torch.export.load` reads, for any number of samples."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torchdq.export import files
from torchdq.export.files import Exported
from torchdq.program.program import Program


class _Module(nn.Module):
    """Call of a program as a module, which torch.export takes."""

    def __init__(self, call: Callable[..., Any]):
        super().__init__()
        self.call = call

    def forward(self, *arguments: Tensor) -> Any:
        """Results of the call."""
        return self.call(*arguments)


def write(folder: Path, name: str, program: Program, dtype: torch.dtype, call: Callable[..., Any]) -> Exported:
    """File in a folder, which is made if it is not there; the graph takes the arguments of the program, as `call`."""
    batch = torch.export.Dim("batch")
    samples = tuple([torch.zeros(*[2] * (not a.uniform), a.width, dtype=dtype) for a in program.arguments])
    axes = tuple([None if a.uniform else {0: batch} for a in program.arguments])
    content = io.BytesIO()
    torch.export.save(torch.export.export(_Module(call), samples, dynamic_shapes=(axes,)), content)
    return Exported(name, *files.write(folder, {f"{name}.pt2": content.getvalue()}))
