"""C source compiled into a function, by way of a library that the cache keeps.

A library is kept after it was loaded once. One in memory is unloaded with the last reference to its function.
`$TORCHDQ_CFLAGS` holds further arguments of the compiler: -Og compiles in a third of the time. Neither they nor those
of `$CC` change the arithmetic.
"""

import _ctypes
import ctypes
import os
import platform
import shlex
import sys
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from torchdq.backends import cache
from torchdq.backends.c_source import pieces_of
from torchdq.backends.compiler import BuildError, compiler, no_compiler, run
from torchdq.base.caches import remembered

FLAGS = ("-O3", "-march=native")  # may be overruled
# -ffast-math and each of its parts make sines wrong; -fno-fast-math undoes them all if it comes after them
ARITHMETIC = ("-fno-fast-math", "-ffp-contract=fast", "-fno-math-errno")
# with -ffast-math one of the start files makes subnormal numbers zero in the whole process; none of them is needed
LIBRARY = ("-shared", "-fPIC", "-nostartfiles", "-w")
LIMIT = 600.0  # time in which a program must be compiled [s]
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


@remembered(1)
def wide() -> bool:
    """Whether the processor has vectors of 64 bytes."""
    return "avx512f" in _processor()


def flags() -> list[str]:
    """Arguments of the compiler."""
    found = compiler()
    own = () if found is None else found.own
    return [*FLAGS, *shlex.split(os.environ.get("TORCHDQ_CFLAGS", "")), *ARITHMETIC, *LIBRARY, *own]


def entry_key(source: str) -> str:
    """Name of the library of a source: hash of everything that it depends on."""
    found = compiler()
    version = "" if found is None else "\n".join([*found.command, found.version])
    return cache.key_of(source, version, *flags(), _processor())


class Library(NamedTuple):
    """Functions of a loaded library."""

    run: Callable[..., None]  # of the number of samples, the plan or None, and pointers
    parts: tuple[int, ...]  # addresses of the functions that a chain calls; () in the library of a chain


def _opened(path: Path, pointers: int = 0) -> Library:
    """Functions of a library, which is unloaded with the last reference to `run`.

    Functions of `ctypes.CDLL` refer to themselves and its libraries stay, so the function is made from its address.
    """
    try:
        library = _ctypes.dlopen(str(path), ctypes.DEFAULT_MODE)
        address = _ctypes.dlsym(library, "run")
    except OSError as error:
        raise BuildError(f"{path} is not a library with a function 'run': {error}") from error
    function = ctypes.CFUNCTYPE(None, ctypes.c_long, *(ctypes.c_void_p,) * (1 + pointers))(address)
    weakref.finalize(function, _ctypes.dlclose, library).atexit = False
    try:
        parts = (ctypes.c_long * 2).from_address(_ctypes.dlsym(library, "parts"))
    except OSError:
        return Library(function, ())
    return Library(function, tuple(parts))


def _compile(library: Path, source: str, name: str) -> None:
    """Compile a source into a library, in the folder of the library."""
    found = compiler()
    if found is None:
        raise no_compiler()
    library.with_suffix(".c").write_text(source)
    pieces = min(pieces_of(source), os.cpu_count() or 1, PROCESSES)
    try:
        _run_compiler([*found.command, *flags()], library, pieces)
        _opened(library)
    except BuildError as error:
        raise BuildError(f"{found.command[0]} could not compile the program {name!r}: {error}") from error


def _run_compiler(command: list[str], library: Path, pieces: int) -> None:
    """Compile a source, in several processes at once if it is long."""
    folder, source = library.parent, str(library.with_suffix(".c"))
    if pieces == 1:
        run([[*command, "-o", str(library), source, "-lm"]], LIMIT, folder)
        return
    objects = [str(folder / f"{k}.o") for k in range(pieces)]
    parts = [f"-DPIECES={pieces}", "-c", source]
    run([[*command, *parts, f"-DPIECE={k}", "-o", to] for k, to in enumerate(objects)], LIMIT, folder)
    run([[*command, "-o", str(library), *objects, "-lm"]], LIMIT, folder)


def load(source: str, name: str, pointers: int) -> Library:
    """Functions of a C source, of which `run` takes so many arrays, compiled unless the cache has it.

    Raises `BuildError` if the program cannot be compiled, or there is no room for it.
    """
    path = cache.kept(entry_key(source), ".so", name, lambda library: _compile(library, source, name))
    return _opened(path, pointers)
