"""Differences of systems: compilers, libraries, processes, owners of files. Nothing else asks which one it is."""

import _ctypes
import os
import shlex
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress

COMPILERS: tuple[str, ...] = ("cc", "gcc", "clang")  # that are looked for on the path
ZIG: tuple[str, ...] = ()  # arguments that ziglang's compiler alone needs
MATH = "-lm"  # argument that links sine, cosine and others
CUDA, NVRTC, BUILTINS = "libcuda.so.1", "libnvrtc.so.{}", "libnvrtc-builtins.so.{}.{}"  # names of libraries

if sys.platform == "win32":
    COMPILERS = ()  # gcc puts wide vectors on the stack where they are not aligned (its bug 54412); clang has no libc
    ZIG = ("--rtlib=compiler-rt", "-Wl,--no-entry")
    MATH = "-lucrtbase"
    CUDA, NVRTC, BUILTINS = "nvcuda.dll", "nvrtc64_{}0_0.dll", "nvrtc-builtins64_{}{}.dll"
elif sys.platform == "darwin":
    NVRTC = ""


def arguments(command: str) -> list[str]:
    """Arguments of a command line, in which backslashes of Windows separate folders."""
    return shlex.split(command.replace("\\", "/") if sys.platform == "win32" else command)


def unload(library: int) -> None:
    """Unload the library of a handle."""
    if sys.platform == "win32":
        _ctypes.FreeLibrary(library)
    else:
        _ctypes.dlclose(library)


def end(process: "subprocess.Popen[bytes]") -> None:
    """End a process that began a session, and all that it started."""
    if sys.platform == "win32":
        if process.poll() is None:
            subprocess.run(("taskkill", "/F", "/T", "/PID", str(process.pid)), capture_output=True, check=False)
    else:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def after_fork(call: Callable[[], object]) -> None:
    """Call a function at the beginning of every process that is forked from this one."""
    if sys.platform != "win32":  # which has no forks
        os.register_at_fork(after_in_child=call)


def own(status: os.stat_result, alone: bool = False) -> bool:
    """Whether a file is the user's, and, if asked, no one else can write it. Windows guards the folders of a user."""
    if sys.platform == "win32":
        return True
    return status.st_uid == os.getuid() and not (alone and status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))
