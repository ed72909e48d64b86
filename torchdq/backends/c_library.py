"""C source compiled into a function, by way of a library that the cache keeps.

A library is kept after it was loaded once. One in memory is unloaded with the last reference to its function.
`$TORCHDQ_CFLAGS` holds further arguments of the compiler: -Og compiles in a third of the time. Neither they nor those
of `$CC` change the arithmetic.
"""

import ctypes
import os
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from torchdq.backends import cache
from torchdq.backends.c_source import pieces_of
from torchdq.backends.compiler import BuildError, compiler, no_compiler, run
from torchdq.base import system
from torchdq.base.caches import remembered
from torchdq.base.machine import features

FLAGS = ("-O3", "-march=native")  # may be overruled
# -ffast-math and each of its parts make sines wrong; -fno-fast-math undoes them all if it comes after them
ARITHMETIC = ("-fno-fast-math", "-ffp-contract=fast", "-fno-math-errno")
# with -ffast-math one of the start files makes subnormal numbers zero in the whole process; none of them is needed
LIBRARY = ("-shared", "-fPIC", "-nostartfiles", "-w")
LIMIT = 600.0  # time in which a program must be compiled [s]
PROCESSES = 4  # processes that compile one program at most


@remembered(1)
def wide() -> bool:
    """Whether the processor has vectors of 64 bytes."""
    return "avx512" in features().lower()


def flags() -> list[str]:
    """Arguments of the compiler."""
    return [*FLAGS, *system.arguments(os.environ.get("TORCHDQ_CFLAGS", "")), *ARITHMETIC, *LIBRARY]


def entry_key(source: str) -> str:
    """Name of the library of a source: hash of everything that it depends on."""
    found = compiler()
    version = "" if found is None else "\n".join([*found.command, found.version])
    return cache.key_of(source, version, *flags(), features())


class Library(NamedTuple):
    """Functions of a loaded library."""

    run: Callable[..., None]  # of the number of samples, the plan or None, and pointers
    parts: tuple[int, ...]  # addresses of the functions that a chain calls; () in the library of a chain


def _opened(path: Path, pointers: int = 0) -> Library:
    """Functions of a library, which is unloaded with the last reference to `run`.

    Libraries of `ctypes.CDLL` stay and their functions refer to themselves, so the function is made from its address.
    """
    try:
        library = ctypes.CDLL(str(path))
        address = ctypes.addressof(ctypes.c_char.in_dll(library, "run"))
    except (OSError, ValueError) as error:
        raise BuildError(f"{path} is not a library with a function 'run': {error}") from error
    function = ctypes.CFUNCTYPE(None, ctypes.c_int64, *(ctypes.c_void_p,) * (1 + pointers))(address)
    weakref.finalize(function, system.unload, library._handle).atexit = False
    try:
        parts = (ctypes.c_int64 * 2).in_dll(library, "parts")
    except ValueError:
        return Library(function, ())
    return Library(function, tuple(parts))


def _compile(library: Path, source: str, name: str) -> None:
    """Compile a source into a library, in the folder of the library."""
    found = compiler()
    if found is None:
        raise no_compiler()
    library.with_suffix(".c").write_text(source, encoding="utf-8")
    pieces = min(pieces_of(source), os.cpu_count() or 1, PROCESSES)
    try:
        _run_compiler([*found.command, *flags()], library, pieces)
        _opened(library)
    except BuildError as error:
        raise BuildError(f"{' '.join(found.command)} could not compile the program {name!r}: {error}") from error


def _run_compiler(command: list[str], library: Path, pieces: int) -> None:
    """Compile a source, in several processes at once if it is long."""
    folder, source = library.parent, str(library.with_suffix(".c"))
    if pieces == 1:
        run([[*command, "-o", str(library), source, system.MATH]], LIMIT, folder)
        return
    objects = [str(folder / f"{k}.o") for k in range(pieces)]
    parts = [f"-DPIECES={pieces}", "-c", source]
    run([[*command, *parts, f"-DPIECE={k}", "-o", to] for k, to in enumerate(objects)], LIMIT, folder)
    run([[*command, "-o", str(library), *objects, system.MATH]], LIMIT, folder)


def load(source: str, name: str, pointers: int) -> Library:
    """Functions of a C source, of which `run` takes so many arrays, compiled unless the cache has it.

    Raises `BuildError` if the program cannot be compiled, or there is no room for it.
    """
    path = cache.kept(entry_key(source), ".so", name, lambda library: _compile(library, source, name))
    return _opened(path, pointers)
