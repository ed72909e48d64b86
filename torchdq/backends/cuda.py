"""Backend "cuda": programs compiled for NVIDIA GPUs at run time, by the compiler that torch's CUDA build installs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache as once
from typing import Any

import torch
from torch import Tensor

from torchdq.backends import cuda_driver, nvrtc
from torchdq.backends.compiler import BuildError, Compiled
from torchdq.backends.cuda_kernel import CudaKernel, CudaLoop, Launcher
from torchdq.backends.precision import guarded
from torchdq.backends.torch import EAGER, InterpretedKernel
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.program.loop import Loop
from torchdq.program.program import Program


class Cuda(Compiled):
    """Backend that compiles programs for GPUs."""

    name = "cuda"
    guards = True

    def refusal(self, device: torch.device) -> TorchdqError | None:
        """Error that says why programs cannot run on a device; None: they can."""
        if device.type != "cuda":
            return ArgumentError(
                f"backend 'cuda' runs on NVIDIA GPUs, and the arguments are on the device {device.type!r}; move them "
                "by x.to('cuda'), or leave the backend 'auto'"
            )
        return _refusal(device.index or 0)

    def compiled(self, what: Program | Loop, dtype: torch.dtype, device: torch.device, samples: int) -> Any:
        """Kernel of a program, or of a loop for any number of samples, or the error of its build."""
        return _compiled(what, dtype, _architecture(device.index or 0))


class _GuardedByTorch(InterpretedKernel):
    """Program run by torch, with the fallback to float64."""

    def __call__(self, inputs: Sequence[Tensor], samples: int) -> list[Tensor]:
        """Results of the program."""
        return guarded(EAGER, self.program, inputs)


class CudaOrTorch(Cuda):
    """Backend that compiles programs for GPUs, and runs as torch operations those that cannot be compiled."""

    or_torch, by_torch = True, _GuardedByTorch


CUDA, CUDA_OR_EAGER = Cuda(), CudaOrTorch()


@once
def _architecture(index: int) -> int:
    """Compute capability of a GPU, 90 for 9.0."""
    major, minor = torch.cuda.get_device_capability(index)
    return 10 * major + minor


@once
def _refusal(index: int) -> BuildError | None:
    """Error that says why programs cannot be compiled for a GPU; None: they can."""
    if torch.version.hip is not None:
        return BuildError("programs are compiled for NVIDIA GPUs alone, and this torch is built for ROCm")
    compiler = nvrtc.found()
    if isinstance(compiler, str):
        return BuildError(compiler)
    try:
        compiler.target(_architecture(index))
    except BuildError as error:
        return error
    return None


@remembered(PROGRAMS)
def _compiled(what: Program | Loop, dtype: torch.dtype, architecture: int) -> Any:
    """Kernel of a program or loop, or the error of its build, made once per process."""

    compiler = nvrtc.found()
    if isinstance(compiler, str):
        return BuildError(compiler)

    def build(text: str, name: str, arrays: int) -> Launcher:
        return cuda_driver.Module(compiler.load(text, name, architecture)).kernel("run", arrays)

    try:
        return CudaLoop(what, dtype, build) if isinstance(what, Loop) else CudaKernel(what, dtype, build)
    except BuildError as error:
        return error
