"""Cache of compiled programs on disk: libraries of the C backend, machine code for GPUs.

Files lie in a directory that only the user can write. The name of a file is the hash of everything it depends on:
source, compiler, flags and processor. The file ends with a hash of its content: one that is incomplete, was changed or
belongs to another user is made again and never used. A file gets its name by one atomic rename, when it is complete.
Processes that need the same file at the same time each make it.

The directory has a bound: what is made removes what was used least recently.
"""

import hashlib
import os
import shutil
import stat
import tempfile
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Literal

from torchdq.backends.compiler import BuildError
from torchdq.base import system
from torchdq.base.progress import Progress, warn_once

Suffix = Literal[".so", ".cubin"]
LARGEST = 2**30  # size of all files in the directory [bytes]
HASH = 32  # length of the hash at the end of a file [bytes]
_one_at_a_time = threading.Lock()


def key_of(*parts: str) -> str:
    """Hash of everything that a compiled program depends on, which names its file."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def directory() -> Path:
    """Directory of the compiled programs, private to the user: `$TORCHDQ_CACHE`, or torchdq in the user's cache.

    If it cannot be written, or others can write it, one for this process alone, with a warning.
    """
    stated = os.environ.get("TORCHDQ_CACHE")
    try:
        base = Path(stated) if stated else Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "torchdq"
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = base.stat()
        if not system.own(status, alone=True):
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
        f"compiled programs are not kept, so every process compiles them again: {reason}; name a folder that only you "
        "can write, with some room, in $TORCHDQ_CACHE",
    )
    return found


@cache
def _own_folder() -> Path:
    return Path(tempfile.mkdtemp(prefix="torchdq-"))


def _sweep(folder: Path) -> None:
    """Remove what was used least recently if all is too large; folders of killed builds are among it."""
    found = []
    for entry in folder.iterdir():
        with suppress(OSError):  # another process removed it
            found.append((entry.stat(), entry))
    size = 0
    for status, entry in sorted(found, key=lambda one: -one[0].st_mtime):
        size += status.st_size
        if size > LARGEST:
            with suppress(OSError):
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()


def _digest(key: str, body: bytes) -> bytes:
    return hashlib.sha256(key.encode() + body).digest()


def _intact(path: Path, key: str) -> bool:
    """Whether a file exists, belongs to the user, and has the content that was made."""
    try:
        status = path.lstat()
        if not system.own(status) or not stat.S_ISREG(status.st_mode):
            return False
        data = path.read_bytes()
    except OSError:
        return False
    return len(data) > HASH and _digest(key, data[:-HASH]) == data[-HASH:]


def kept(key: str, suffix: Suffix, name: str, make: Callable[[Path], None]) -> Path:
    """Path of a compiled program, which is made unless the cache has it by its key, a hash of what it depends on.

    `make` writes the program to a path, in a folder where it may also write other files. The file in the cache has a
    hash at the end, which `content` leaves out. Raises `BuildError` if `make` does, or there is no room for the file.
    """
    folder = directory()
    path = folder / f"{key}{suffix}"
    try:
        with _one_at_a_time:
            if not _intact(path, key):
                _sweep(folder)
                with (
                    Progress(f"compiling {name}, once for this machine"),
                    tempfile.TemporaryDirectory(prefix=".build-", dir=folder, ignore_cleanup_errors=True) as building,
                ):
                    new = Path(building) / f"program{suffix}"
                    make(new)
                    body = new.read_bytes()
                    new.write_bytes(body + _digest(key, body))
                    try:
                        new.replace(path)
                    except PermissionError:  # Windows replaces no library that a process has loaded, the same one here
                        if not _intact(path, key):
                            raise
        os.utime(path)  # used now
    except OSError as error:
        raise BuildError(f"the program {name!r} cannot be stored in {folder}: {error}") from error
    return path


def content(path: Path) -> bytes:
    """Compiled program in a file of the cache."""
    return path.read_bytes()[:-HASH]
