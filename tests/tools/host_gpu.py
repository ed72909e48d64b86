"""Kernels of the GPU backend on the host: the very same text, compiled as C, with the threads of a block as a loop.

`HOST` is such a backend, by the name "host"; `BACKWARDS` runs the threads of a block from the last to the first, so
that results that depend on the order of threads show themselves. A missing barrier cannot be seen here, nor a
function of the GPU that is wrong.
"""

import ctypes
import hashlib
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import pytest

from torchdq.backends import choice
from torchdq.backends.compiler import compiler
from torchdq.backends.cuda import Cuda
from torchdq.backends.cuda_kernel import CudaKernel, CudaLoop

# without optimisation it takes a tenth of the time to compile
FLAGS = ("-x", "c", "-DHOST", "-D__restrict__=restrict", "-O0", "-w", "-shared", "-fPIC")


@cache
def folder() -> Path:
    """Folder of the compiled texts of this process."""
    return Path(tempfile.mkdtemp(prefix="torchdq-host-"))


@cache
def function(text: str, *flags: str):
    """Function of a text, compiled for the host."""
    path = folder() / hashlib.sha256("\0".join((text, *flags)).encode()).hexdigest()[:24]
    path.with_suffix(".cu").write_text(text)
    subprocess.run([*compiler().command, *FLAGS, *flags, "-o", f"{path}.so", f"{path}.cu", "-lm"], check=True)
    return ctypes.CDLL(f"{path}.so").run


class Host(Cuda):
    """GPU backend whose kernels run on the host."""

    def __init__(self, name: str, *flags: str):
        self.name, self.flags = name, flags
        self.kernel, self.loop = cache(self.kernel), cache(self.loop)

    def refusal(self, device):
        return None if device.type == "cpu" else AssertionError(device)

    def kernel(self, program, dtype, device):
        return CudaKernel(program, dtype, self.build)

    def loop(self, loop, dtype, device, samples):
        return CudaLoop(loop, dtype, self.build)

    def build(self, text, name, arrays):
        run = function(text, *self.flags)

        def launch(blocks, threads, samples, pointers, device):
            assert len(pointers) == arrays and (blocks - 1) * threads < samples <= blocks * threads
            run(ctypes.c_longlong(samples), *map(ctypes.c_longlong, pointers))

        return launch


HOST, BACKWARDS = Host("host"), Host("backwards", "-DREVERSED")


@pytest.fixture(autouse=True)
def host_backends(monkeypatch):
    """Names "host" and "backwards" for these backends, for the file that has this fixture."""
    for backend in (HOST, BACKWARDS):
        monkeypatch.setitem(choice.BACKENDS, backend.name, (backend,))
