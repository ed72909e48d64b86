"""Cache of compiled programs on disk: libraries of the C backend, machine code for GPUs.

Files lie in a directory that only the user can write. The name of a file is the hash of everything it depends on:
source, compiler, flags and processor. The file ends with a hash of its content: one that is incomplete, was changed or
belongs to another user is made anew and never used. A file gets its name by one atomic rename, when it is complete. One
thread of one process makes a file; the others wait for it.

The directory has a bound: what is made removes the files that were used least recently.
"""

import fcntl
import hashlib
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Literal, get_args

from torchdq.backends.compiler import BuildError
from torchdq.base.progress import Progress, warn_once

Suffix = Literal[".so", ".cubin"]
LIMIT = 600.0  # time in which a file must be made [s]
ABANDONED = 3600.0  # age from which what is being made is taken to be left by a killed process [s]
LARGEST = 2**30  # size of all files in the directory [bytes]
ROOM = 2**22  # a folder in which a file of this size cannot be written is full [bytes]
HASH = 32  # length of the hash at the end of a file [bytes]


# --- folders ---------------------------------------------------------------------------------------------------------


def directory() -> Path:
    """Directory of the compiled programs, private to the user: `$TORCHDQ_CACHE`, or torchdq in the user's cache.

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
        found = _own_folder()
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
def _own_folder() -> Path:
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
    """Remove what killed processes left, and the files that were used least recently if all are too large."""
    now, files = time.time(), []
    for entry in folder.iterdir():
        with suppress(OSError):  # another process removed it
            status = entry.stat()
            if entry.suffix in get_args(Suffix):
                files.append((status.st_mtime, status.st_size, entry))
            elif entry.name.startswith(".build-") and now - status.st_mtime > ABANDONED:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
    size = 0
    for _, own, entry in sorted(files, reverse=True):
        size += own
        if size > LARGEST:
            entry.unlink(missing_ok=True)


# --- files -----------------------------------------------------------------------------------------------------------


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


def _digest(key: str, body: bytes) -> bytes:
    return hashlib.sha256(key.encode() + body).digest()


def _intact(path: Path, key: str) -> bool:
    """Whether a file exists, belongs to the user, and has the content that was made."""
    try:
        # without waiting, should it be a pipe
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
            status = os.fstat(file.fileno())
            if status.st_uid != os.getuid() or not stat.S_ISREG(status.st_mode):
                return False
            data = file.read()
    except OSError:
        return False
    return len(data) > HASH and _digest(key, data[:-HASH]) == data[-HASH:]


def _make(path: Path, key: str, make: Callable[[Path], None]) -> None:
    """Make a file in a folder of its own, and give it its name."""
    _sweep(path.parent)
    with tempfile.TemporaryDirectory(prefix=".build-", dir=path.parent, ignore_cleanup_errors=True) as folder:
        new = Path(folder) / f"program{path.suffix}"
        make(new)
        body = new.read_bytes()
        with new.open("ab") as file:
            file.write(_digest(key, body))
            file.flush()
            os.fsync(file.fileno())
        new.replace(path)


def _found(path: Path, key: str, name: str, make: Callable[[Path], None]) -> Path:
    """File that is intact, made unless it was there."""
    try:
        if not _intact(path, key):
            with Progress(f"compiling {name}, once for this machine"), _alone(path.parent / f".build-{key}.lock"):
                if not _intact(path, key):  # another thread or process may have made it meanwhile
                    _make(path, key, make)
        os.utime(path)  # used now
    except OSError as error:
        raise BuildError(f"the program {name!r} cannot be stored: {error}") from error
    return path


def kept(key: str, suffix: Suffix, name: str, make: Callable[[Path], None]) -> Path:
    """Path of a compiled program, which is made unless the cache has it.

    The file is what `make` wrote, and a hash of it at the end; `content` is the file without the hash.

    Args:
        key: hash of everything that the compiled program depends on.
        name: what the program is called in messages.
        make: function that writes the compiled program to a path, in a folder where it may also write other files.
    Raises:
        BuildError: `make` raised it, or there is no room for the file.
    """
    folder = directory()
    try:
        return _found(folder / f"{key}{suffix}", key, name, make)
    except BuildError as error:
        if not _full(folder):
            raise
        instead = _temporary(f"the disk of {folder} is full, {error}")
        return _found(instead / f"{key}{suffix}", key, name, make)


def content(path: Path) -> bytes:
    """Compiled program in a file of the cache."""
    return path.read_bytes()[:-HASH]
