"""CUDA's driver: compiled kernels loaded, and launched on torch's current stream.

A library of kernels serves all GPUs of a process, and is unloaded with the last reference to it. A launch neither waits
nor allocates, so a CUDA graph can capture it; a graph names kernels without a reference to them, so libraries that one
captured stay loaded.
"""

from __future__ import annotations

import ctypes
import os
import threading
import weakref
from collections.abc import Callable, Sequence

import torch

from torchdq.backends.compiler import BuildError
from torchdq.base import system
from torchdq.base.caches import remembered
from torchdq.errors import ArgumentError, TorchdqError

BLOCKS = 2**31 - 1  # blocks of a launch
NO_CONTEXT = 201  # CUDA_ERROR_INVALID_CONTEXT
# what to do about an error, by its code
ADVICE = {
    2: "free memory of the GPU, or use smaller batches",
    **dict.fromkeys(
        (200, 209, 218, 221, 222),
        "NVRTC is newer than the driver, or does not know the GPU: update the driver, or name another NVRTC in "
        "$TORCHDQ_NVRTC",
    ),
    **dict.fromkeys(
        (214, 700, 702, *range(714, 720)),
        "this kernel or an operation before it failed: CUDA_LAUNCH_BLOCKING=1 shows which, and the process has to be "
        "started again",
    ),
}
OTHERWISE = "backend='eager' computes the same without it"

_handle, _out, _unsigned = ctypes.c_void_p, ctypes.POINTER(ctypes.c_void_p), ctypes.c_uint
_options = (ctypes.c_void_p, ctypes.c_void_p, _unsigned)
PROTOTYPES = {
    "cuInit": (_unsigned,),
    "cuGetErrorName": (ctypes.c_int, ctypes.POINTER(ctypes.c_char_p)),
    "cuGetErrorString": (ctypes.c_int, ctypes.POINTER(ctypes.c_char_p)),
    "cuDeviceGet": (ctypes.POINTER(ctypes.c_int), ctypes.c_int),
    "cuDevicePrimaryCtxRetain": (_out, ctypes.c_int),
    "cuCtxSetCurrent": (_handle,),
    "cuLibraryLoadData": (_out, ctypes.c_char_p, *_options, *_options),
    "cuLibraryUnload": (_handle,),
    "cuLibraryGetKernel": (_out, _handle, ctypes.c_char_p),
    "cuLaunchKernel": (_handle, *(_unsigned,) * 7, _handle, ctypes.c_void_p, ctypes.c_void_p),
}


class DriverError(TorchdqError, RuntimeError):
    """Failure of a GPU or its driver."""


class Driver:
    """Functions of CUDA's driver; raises `BuildError` if there is none at a path, or it is too old."""

    def __init__(self, path: str):
        self.call: dict[str, Callable[..., int]] = {}  # by their names; they return a status, 0 for success
        try:
            library = ctypes.CDLL(path)
        except OSError as error:
            raise BuildError(f"there is no CUDA driver: {error}; install NVIDIA's driver for this GPU") from error
        for name, arguments in PROTOTYPES.items():
            try:
                function = getattr(library, name)
            except AttributeError as error:
                raise BuildError(f"the CUDA driver {path} has no {name}; update it to version 12.0 or newer") from error
            function.argtypes, function.restype = arguments, ctypes.c_int
            self.call[name] = function
        if status := self.call["cuInit"](0):
            raise BuildError(self.said("the CUDA driver cannot be used", status))

    def said(self, what: str, status: int) -> str:
        """Message of an error: what did not happen, the name and description of the status, what to do."""
        words = []
        for name in ("cuGetErrorName", "cuGetErrorString"):
            text = ctypes.c_char_p()
            self.call[name](status, text)
            words.append((text.value or b"unknown").decode(errors="replace"))
        return f"{what}: {words[0]} ({status}), {words[1]}; {ADVICE.get(status, OTHERWISE)}"

    def enter(self, index: int) -> None:
        """Make the context that torch uses on a device that of this thread, which had none."""
        device, context = ctypes.c_int(), ctypes.c_void_p()
        status = self.call["cuDeviceGet"](device, index)
        status = status or self.call["cuDevicePrimaryCtxRetain"](context, device.value)
        if status := status or self.call["cuCtxSetCurrent"](context):
            raise DriverError(self.said(f"this thread cannot use the device cuda:{index}", status))


@remembered(1)
def driver() -> Driver:
    """Driver of this machine, or the library that `$TORCHDQ_CUDA_DRIVER` names."""
    return Driver(os.environ.get("TORCHDQ_CUDA_DRIVER") or system.CUDA)


class Module:
    """Compiled kernels in the memory of the GPUs that use them, from machine code (cubin) or PTX that ends with a zero.

    Raises `BuildError` if the code is not for this driver or its GPUs.
    """

    def __init__(self, code: bytes):
        self.driver, self.handle = driver(), ctypes.c_void_p()
        call = self.driver.call
        if status := call["cuLibraryLoadData"](self.handle, code, None, None, 0, None, None, 0):
            raise BuildError(self.driver.said("a compiled program cannot be loaded", status))
        weakref.finalize(self, call["cuLibraryUnload"], self.handle).atexit = False

    def kernel(self, name: str, pointers: int) -> Launch:
        """Kernel that takes the number of samples and so many pointers; raises `BuildError` if there is none."""
        handle = ctypes.c_void_p()
        if status := self.driver.call["cuLibraryGetKernel"](handle, self.handle, name.encode()):
            raise BuildError(self.driver.said(f"a compiled program has no kernel {name!r}", status))
        return Launch(self, handle, name, pointers)


class _Arguments(threading.local):
    """Arguments of a kernel, 64-bit numbers, and the array of their addresses, for every thread its own."""

    def __init__(self, count: int):
        self.values = (ctypes.c_int64 * count)()
        first, size = ctypes.addressof(self.values), ctypes.sizeof(ctypes.c_int64)
        self._addresses = (ctypes.c_void_p * count)(*range(first, first + count * size, size))
        self.at = ctypes.addressof(self._addresses)


def _public_stream(index: int) -> int:
    return torch.cuda.current_stream(index).cuda_stream


# torch's function without an object for the stream, where there is one
_stream: Callable[[int], int] = getattr(torch._C, "_cuda_getCurrentRawStream", _public_stream)
_captured: set[Module] = set()  # modules that CUDA graphs may name


class Launch:
    """Kernel that is launched by a call; see `Module.kernel`."""

    def __init__(self, module: Module, handle: ctypes.c_void_p, name: str, pointers: int):
        self.module, self.handle, self.name = module, handle, name
        self._launch = module.driver.call["cuLaunchKernel"]
        self._arguments = _Arguments(1 + pointers)

    def __call__(self, blocks: int, threads: int, samples: int, pointers: Sequence[int], device: torch.device) -> None:
        """Launch blocks of threads on torch's current stream of the device that the pointers are of; returns at once.

        Raises `ArgumentError` for more blocks than a launch has, and `DriverError` if the driver refuses the launch, or
        an operation before it failed.
        """
        if blocks == 0:
            return
        if blocks > BLOCKS:
            raise ArgumentError(
                f"a batch of {samples} samples needs {blocks} blocks of {threads} threads, and a launch has at most "
                f"{BLOCKS}; split the batch"
            )
        if device.index == torch.cuda.current_device():
            self._here(blocks, threads, samples, pointers, device.index)
        else:
            with torch.cuda.device(device.index):
                self._here(blocks, threads, samples, pointers, device.index)

    def _here(self, blocks: int, threads: int, samples: int, pointers: Sequence[int], index: int) -> None:
        """Launch the kernel on the current device."""
        if torch.cuda.is_current_stream_capturing():
            _captured.add(self.module)
        arguments = self._arguments
        arguments.values[:] = [samples, *pointers]
        grid = (blocks, 1, 1, threads, 1, 1, 0, _stream(index), arguments.at, None)
        status = self._launch(self.handle, *grid)
        if status == NO_CONTEXT:  # torch makes a context current in a thread only when it needs one
            self.module.driver.enter(index)
            status = self._launch(self.handle, *grid)
        if status:
            what = f"cuda:{index} did not launch the kernel {self.name!r} with {blocks} blocks of {threads} threads"
            raise DriverError(self.module.driver.said(what, status))
