"""Compilation of C source into a function, and the cache of compiled libraries on disk.

Libraries lie in a directory that only the user can write. The name of a file is the hash of everything it depends on:
source, compiler, flags and processor. The file ends with a hash of its content: one that is incomplete, was changed or
belongs to another user is rebuilt and never loaded. A complete file gets its name by one atomic rename, so any number
of processes may build the same program at once.
"""

import ctypes
import hashlib
import os
import platform
import shlex
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import NamedTuple

from torchdq.caches import remembered
from torchdq.errors import TorchdqError

FLAGS = ("-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-shared", "-fPIC", "-w")
SLOW = 1.0  # duration of a build from which a message is written [s]
ABANDONED = 3600.0  # age from which a build's folder is taken to be left by a killed process [s]


class BuildError(TorchdqError, RuntimeError):
    """Failure to find a C compiler, or to compile a program."""


def no_compiler() -> BuildError:
    """Error for a machine without a C compiler."""
    return BuildError("there is no C compiler; install gcc or clang, or name one in $CC")


class Compiler(NamedTuple):
    """C compiler of this machine."""

    command: tuple[str, ...]  # path and arguments
    version: str  # output of --version


@remembered(1)
def compiler() -> Compiler | None:
    """C compiler: `$CC`, which may have arguments, or cc, gcc or clang on the path; None: there is none."""
    for name in filter(None, (os.environ.get("CC"), "cc", "gcc", "clang")):
        program, *arguments = shlex.split(name) or [name]
        path = shutil.which(program)
        if path is None:
            continue
        command = (path, *arguments)
        try:
            version = subprocess.run([*command, "--version"], capture_output=True, text=True, timeout=20, check=True)
        except (OSError, subprocess.SubprocessError):
            continue
        return Compiler(command, version.stdout)
    return None


@remembered(1)
def _processor() -> str:
    """Features of the processor that -march=native depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        kinds = sorted({line for line in lines if line.startswith(("flags", "Features", "model name", "CPU part"))})
    except OSError:
        kinds = []
    return "\n".join([platform.machine(), platform.processor(), sys.platform, *kinds])


def directory() -> Path:
    """Directory of the built libraries, private to the user: `$TORCHDQ_CACHE`, or torchdq in the user's cache."""
    stated = os.environ.get("TORCHDQ_CACHE")
    base = Path(stated) if stated else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchdq"
    try:
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = base.stat()
        private = status.st_uid == os.getuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        if private and os.access(base, os.W_OK | os.X_OK):
            return base
    except OSError:
        pass
    return _temporary()


@cache
def _temporary() -> Path:
    """Directory for this process alone, used when the cache directory cannot be written or is not private."""
    return Path(tempfile.mkdtemp(prefix="torchdq-"))


def _digest(key: str, body: bytes) -> bytes:
    return hashlib.sha256(key.encode() + body).digest()


def _intact(path: Path, key: str) -> bool:
    """Whether a library exists, belongs to the user, and has the content that was built."""
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_uid != os.getuid():
                return False
            data = file.read()
    except OSError:
        return False
    return len(data) > 32 and _digest(key, data[:-32]) == data[-32:]


def _compile(path: Path, key: str, source: str, name: str) -> None:
    found = compiler()
    if found is None:
        raise no_compiler()
    _sweep(path.parent)
    with tempfile.TemporaryDirectory(prefix=".build-", dir=path.parent) as folder:
        text, library = Path(folder) / "program.c", Path(folder) / "program.so"
        text.write_text(source)
        announcement = threading.Timer(SLOW, _announce, (name,))
        announcement.daemon = True
        announcement.start()
        try:
            done = subprocess.run(
                [*found.command, *FLAGS, "-o", str(library), str(text), "-lm"], capture_output=True, text=True
            )
        finally:
            announcement.cancel()
        if done.returncode != 0:
            raise BuildError(f"{found.command[0]} could not compile the program {name!r}:\n{done.stderr[-2000:]}")
        body = library.read_bytes()
        with library.open("ab") as file:
            file.write(_digest(key, body))
            file.flush()
            os.fsync(file.fileno())
        library.replace(path)


def _sweep(base: Path) -> None:
    """Remove the folders of builds that were killed."""
    for folder in base.glob(".build-*"):
        try:
            abandoned = time.time() - folder.stat().st_mtime > ABANDONED
        except OSError:
            continue  # another process removed it
        if abandoned:
            shutil.rmtree(folder, ignore_errors=True)


def _announce(name: str) -> None:
    sys.stderr.write(f"torchdq: compiling {name}, once for this machine ...\n")


def entry_key(source: str) -> str:
    """Name of the library of a source: hash of everything it depends on."""
    found = compiler()
    version = "" if found is None else "\n".join([*found.command, found.version])
    return hashlib.sha256("\0".join([source, version, *FLAGS, _processor()]).encode()).hexdigest()


def load(source: str, name: str, pointers: int) -> Callable[..., None]:
    """Function `run` of a C source, compiled unless the cache has it.

    Args:
        pointers: number of pointers that it takes after the number of samples.
    """
    key = entry_key(source)
    path = directory() / f"{key}.so"
    if not _intact(path, key):
        _compile(path, key, source, name)
    function = ctypes.CDLL(str(path)).run
    function.restype = None
    function.argtypes = (ctypes.c_long, *(ctypes.c_void_p,) * pointers)
    return function
