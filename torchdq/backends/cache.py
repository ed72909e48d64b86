"""Compilation of C source into a function, and the cache of compiled libraries on disk.

Libraries lie in a directory that only the user can write. The name of a file is the hash of everything it depends on:
source, compiler, flags and processor. The file ends with a hash of its content: one that is incomplete, was changed or
belongs to another user is rebuilt and never loaded. A file gets its name by one atomic rename, after it was loaded once
and is complete. One thread of one process builds a program; the others wait for it.

The directory has a bound: a build removes the libraries that were used least recently. A library in memory is unloaded
with the last reference to its function.
"""

import _ctypes
import ctypes
import fcntl
import hashlib
import os
import platform
import shutil
import stat
import sys
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from torchdq.backends.c_source import pieces_of
from torchdq.backends.compiler import BuildError, compiler, no_compiler, run
from torchdq.caches import remembered
from torchdq.notice import Notice, warn_once

FLAGS = ("-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno", "-shared", "-fPIC", "-w")
LIMIT = 600.0  # time in which a program must be compiled [s]
ABANDONED = 3600.0  # age from which a build's files are taken to be left by a killed process [s]
LARGEST = 2**30  # size of all libraries in the directory [bytes]
ROOM = 2**22  # a folder in which a file of this size cannot be written is full [bytes]
PROCESSES = 4  # processes that compile one program at most


@remembered(1)
def _processor() -> str:
    """Features of the processor that -march=native depends on."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        kinds = sorted({line for line in lines if line.startswith(("flags", "Features", "model name", "CPU part"))})
    except OSError:
        kinds = []
    return "\n".join([platform.machine(), platform.processor(), sys.platform, *kinds])


# --- folders ---------------------------------------------------------------------------------------------------------


def directory() -> Path:
    """Directory of the built libraries, private to the user: `$TORCHDQ_CACHE`, or torchdq in the user's cache.

    If it cannot be written, or others can write it, one for this process alone, with a warning.
    """
    stated = os.environ.get("TORCHDQ_CACHE")
    try:
        base = Path(stated) if stated else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchdq"
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = base.stat()
        if status.st_uid != os.getuid() or status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
            return _temporary(f"others than you can write {base}")
        if not os.access(base, os.W_OK | os.X_OK):
            return _temporary(f"{base} cannot be written")
    except (OSError, RuntimeError) as error:
        return _temporary(str(error))
    return base


def _temporary(reason: str) -> Path:
    """Directory for this process alone, with a warning that says why it is needed."""
    try:
        found = _made()
    except OSError as error:
        raise BuildError(
            f"no folder can hold compiled programs: {reason}; {error}; name one in $TORCHDQ_CACHE"
        ) from error
    warn_once(
        "cache",
        f"compiled programs are not kept, so every process compiles them anew: {reason}; name a folder that only you "
        "can write, with some room, in $TORCHDQ_CACHE",
    )
    return found


@cache
def _made() -> Path:
    return Path(tempfile.mkdtemp(prefix="torchdq-"))


def _full(folder: Path) -> bool:
    """Whether nothing more can be written to a folder."""
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(ROOM))
    except OSError:
        return True
    return False


def _sweep(folder: Path) -> None:
    """Remove what killed builds left, and the libraries that were used least recently if all are too large."""
    now, libraries = time.time(), []
    for entry in folder.iterdir():
        with suppress(OSError):  # another process removed it
            status = entry.stat()
            if entry.suffix == ".so":
                libraries.append((status.st_mtime, status.st_size, entry))
            elif entry.name.startswith(".build-") and now - status.st_mtime > ABANDONED:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    size = 0
    for _, own, entry in sorted(libraries, reverse=True):
        size += own
        if size > LARGEST:
            entry.unlink(missing_ok=True)


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Context that one thread of one process is in at a time; who waited longer than a build may take, enters too."""
    deadline = time.monotonic() + LIMIT
    with path.open("w") as file:
        with suppress(OSError):  # a file system without locks
            while not _locked(file.fileno()) and time.monotonic() < deadline:
                time.sleep(0.02)
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def _locked(file: int) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


# --- libraries -------------------------------------------------------------------------------------------------------


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


def _opened(path: Path, pointers: int = 0) -> Callable[..., None]:
    """Function `run` of a library, which is unloaded with the last reference to the function.

    Functions of `ctypes.CDLL` refer to themselves and its libraries stay, so the function is made from its address.
    """
    try:
        library = _ctypes.dlopen(str(path), ctypes.DEFAULT_MODE)
        address = _ctypes.dlsym(library, "run")
    except OSError as error:
        raise BuildError(f"{path} is no library with a function 'run': {error}") from error
    function = ctypes.CFUNCTYPE(None, ctypes.c_long, *(ctypes.c_void_p,) * pointers)(address)
    weakref.finalize(function, _ctypes.dlclose, library).atexit = False
    return function


def _compile(path: Path, key: str, source: str, name: str) -> None:
    """Build a library under its name."""
    found = compiler()
    if found is None:
        raise no_compiler()
    _sweep(path.parent)
    with tempfile.TemporaryDirectory(prefix=".build-", dir=path.parent, ignore_cleanup_errors=True) as made:
        folder, library = Path(made), Path(made) / "program.so"
        (folder / "program.c").write_text(source)
        command = [*found.command, *FLAGS]
        try:
            _run_compiler(command, folder, library, min(pieces_of(source), os.cpu_count() or 1, PROCESSES))
            _opened(library)
        except BuildError as error:
            raise BuildError(f"{found.command[0]} could not compile the program {name!r}: {error}") from error
        body = library.read_bytes()
        with library.open("ab") as file:
            file.write(_digest(key, body))
            file.flush()
            os.fsync(file.fileno())
        library.replace(path)


def _run_compiler(command: list[str], folder: Path, library: Path, pieces: int) -> None:
    """Compile a source, in several processes at once if it is long."""
    source = str(folder / "program.c")
    if pieces == 1:
        run([[*command, "-o", str(library), source, "-lm"]], LIMIT, folder)
        return
    objects = [str(folder / f"{k}.o") for k in range(pieces)]
    parts = [f"-DPIECES={pieces}", "-c", source]
    run([[*command, *parts, f"-DPIECE={k}", "-o", to] for k, to in enumerate(objects)], LIMIT, folder)
    run([[*command, "-o", str(library), *objects, "-lm"]], LIMIT, folder)


def entry_key(source: str) -> str:
    """Name of the library of a source: hash of everything it depends on."""
    found = compiler()
    version = "" if found is None else "\n".join([*found.command, found.version])
    return hashlib.sha256("\0".join([source, version, *FLAGS, _processor()]).encode()).hexdigest()


def _built(folder: Path, source: str, name: str, pointers: int) -> Callable[..., None]:
    """Function of a source from a folder, compiled unless it is there."""
    key = entry_key(source)
    path = folder / f"{key}.so"
    try:
        if not _intact(path, key):
            with Notice(f"compiling {name}, once for this machine"), _alone(folder / f".build-{key}.lock"):
                if not _intact(path, key):  # another thread or process may have built it meanwhile
                    _compile(path, key, source, name)
        os.utime(path)  # used now
    except OSError as error:
        raise BuildError(f"the program {name!r} cannot be stored: {error}") from error
    return _opened(path, pointers)


def load(source: str, name: str, pointers: int) -> Callable[..., None]:
    """Function `run` of a C source, compiled unless the cache has it.

    Args:
        pointers: number of pointers that it takes after the number of samples.
    Raises:
        BuildError: the program cannot be compiled, or there is no room for it.
    """
    folder = directory()
    try:
        return _built(folder, source, name, pointers)
    except BuildError as error:
        if not _full(folder):
            raise
        return _built(_temporary(f"the disk of {folder} is full, {error}"), source, name, pointers)
