"""NVRTC, the run-time compiler of CUDA: where it lies on this machine, and CUDA C++ compiled for a GPU with it.

NVRTC needs neither a GPU nor a driver. It is two libraries: libnvrtc opens libnvrtc-builtins by its name, which some
packages put where the dynamic loader does not look, so the second one is loaded here.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import torch

from torchdq.backends import cache
from torchdq.backends.compiler import BuildError
from torchdq.base import system
from torchdq.base.caches import remembered
from torchdq.base.progress import warn_once

FLAGS = ("--ptxas-options=-v", "-w")  # registers and memory in the log, no warnings
CALMER = "--ptxas-options=-O1"
FEW, LARGE = 40, 4096  # registers and bytes of a stack frame by which a kernel shows that its values were not allocated
MAJORS = (13, 12)  # versions that are looked for, apart from torch's own
SAID = 20  # lines of a log in an error
ROOT = Path("/")  # where the folders of the system are

# --- search ----------------------------------------------------------------------------------------------------------


@remembered(1)
def found() -> Nvrtc | str:
    """NVRTC of this machine, or the reason why there is none.

    The first that can be used of `$TORCHDQ_NVRTC` (a file or a folder), the dynamic loader's, the packages of this
    Python, conda's and the system's CUDA toolkits. Where torch has CUDA, its version goes before all others.
    """
    if not system.NVRTC:
        return "the GPU backend needs NVRTC, CUDA's run-time compiler, which there is for Linux and Windows only"
    refused: list[str] = []
    if stated := os.environ.get("TORCHDQ_NVRTC"):
        if named := _first(_named(Path(stated)), refused):
            return named
        why = "; ".join(refused) or f"there is no file {system.NVRTC.format('*')}"
        warn_once(
            "$TORCHDQ_NVRTC",
            f"$TORCHDQ_NVRTC names {stated!r}, which cannot be used, so torchdq looks for another NVRTC: {why}",
        )
    if any_other := _first(_candidates(), refused):
        return any_other
    names = " or ".join(map(system.NVRTC.format, _majors()))
    package = "nvidia-cuda-nvrtc-cu12" if _majors()[0] == 12 else "nvidia-cuda-nvrtc"
    return (
        f"there is no NVRTC, CUDA's run-time compiler: no {names} that can be used is known to the dynamic loader, or "
        "lies in the packages of this Python, in $CONDA_PREFIX, $CUDA_HOME, $CUDA_PATH, /usr/local/cuda* or /usr/lib; "
        f"install it by 'pip install {package}', or name its file or folder in $TORCHDQ_NVRTC"
        + "".join(f"\n(not usable: {reason})" for reason in refused)
    )


def _first(paths: Iterable[str], refused: list[str]) -> Nvrtc | None:
    """First library that can be used; why others cannot is added to a list."""
    for path in paths:
        try:
            return Nvrtc(path)
        except BuildError as error:
            if Path(path).is_file():  # else the loader knows no such name
                refused.append(str(error))
    return None


def _majors() -> list[int]:
    """Major versions that are looked for, that of torch first."""
    own = int(torch.version.cuda.partition(".")[0]) if torch.version.cuda else MAJORS[0]
    return [own, *(major for major in MAJORS if major != own)]


def _named(path: Path) -> list[str]:
    """Libraries at a path that is stated: of a file or a folder."""
    if path.is_file():
        return [str(path.absolute())]
    any_version = system.NVRTC.format("*")
    return [str(at.absolute()) for part in ("", "lib", "lib64") for at in sorted((path / part).glob(any_version))]


def _candidates() -> Iterator[str]:
    """Libraries by name, for the dynamic loader, and by path."""
    for major in _majors():
        name = system.NVRTC.format(major)
        yield name
        for folder in dict.fromkeys((*_packages(major), *_toolkits())):
            yield from (str(path) for path in sorted(folder.glob(f"{name}*")))


def _packages(major: int) -> Iterator[Path]:
    """Folders of libraries in the packages of this Python, those beside torch first."""
    for base in (Path(torch.__file__).parents[1], *map(Path, filter(None, sys.path))):
        for part in (f"nvidia/cu{major}/lib", "nvidia/cuda_nvrtc/lib", "torch/lib"):
            yield base / part


def _toolkits() -> Iterator[Path]:
    """Folders of libraries in conda's environments and in toolkits of the system."""
    roots = [os.environ.get(name) for name in ("CONDA_PREFIX", "CUDA_HOME", "CUDA_PATH")]
    bases = [Path(root) for root in (*roots, sys.prefix) if root]
    for base in (*bases, *sorted(ROOT.glob("usr/local/cuda*")), ROOT / "opt/cuda"):
        yield from (base / "lib64", base / "lib", *sorted(base.glob("targets/*/lib")))
    yield from (*sorted(ROOT.glob("usr/lib/*-linux-gnu")), ROOT / "usr/lib64", ROOT / "usr/lib")


# --- compilation -----------------------------------------------------------------------------------------------------


class Usage(NamedTuple):
    """Registers and memory of every thread of a kernel."""

    registers: int
    spilled: int  # read back from memory because registers were too few [bytes]
    stack: int  # stack frame [bytes]


class Compiled(NamedTuple):
    """Compiled kernels; of registers and memory, those of the kernel that needs most, 0 if the code is PTX."""

    code: bytes  # machine code (cubin), or PTX, text that the driver compiles
    registers: int
    spilled: int
    stack: int
    log: str


def usage(log: str) -> dict[str, Usage]:
    """Registers and memory of every kernel, by name, from a log with `--ptxas-options=-v`."""
    kernel = function = ""
    registers: dict[str, int] = {}
    memory: dict[str, tuple[int, int]] = {}
    for line in log.splitlines():
        if begun := re.search(r"Compiling entry function '(\S+)'", line):
            kernel = begun[1]
        elif of := re.search(r"Function properties for (\S+)", line):
            function = of[1]
        elif frame := re.search(r"(\d+) bytes stack frame.* (\d+) bytes spill loads", line):
            memory[function] = int(frame[2]), int(frame[1])
        elif used := re.search(r"Used (\d+) registers", line):
            registers[kernel] = int(used[1])
    return {name: Usage(count, *memory.get(name, (0, 0))) for name, count in registers.items()}


_size, _program = ctypes.POINTER(ctypes.c_size_t), ctypes.c_void_p
_number, _text = ctypes.POINTER(ctypes.c_int), ctypes.c_char_p
PROTOTYPES = {
    "nvrtcVersion": (_number, _number),
    "nvrtcGetNumSupportedArchs": (_number,),
    "nvrtcGetSupportedArchs": (_number,),
    "nvrtcCreateProgram": (ctypes.POINTER(_program), _text, _text, ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p),
    "nvrtcDestroyProgram": (ctypes.POINTER(_program),),
    "nvrtcCompileProgram": (_program, ctypes.c_int, ctypes.POINTER(_text)),
    **{f"nvrtcGet{what}Size": (_program, _size) for what in ("ProgramLog", "CUBIN", "PTX")},
    **{f"nvrtcGet{what}": (_program, _text) for what in ("ProgramLog", "CUBIN", "PTX")},
}


class Nvrtc:
    """The run-time compiler in one library; raises `BuildError` if it or its second library is something else."""

    def __init__(self, path: str):
        self.path = path  # or the library's name, where the dynamic loader knows it
        try:
            self._library = ctypes.CDLL(path)
            for name, arguments in PROTOTYPES.items():
                function = getattr(self._library, name)
                function.argtypes, function.restype = arguments, ctypes.c_int
            self._library.nvrtcGetErrorString.argtypes = (ctypes.c_int,)
            self._library.nvrtcGetErrorString.restype = ctypes.c_char_p
        except (OSError, AttributeError) as error:
            raise BuildError(f"{path} is no NVRTC: {error}") from error
        major, minor = ctypes.c_int(), ctypes.c_int()
        self._require(self._library.nvrtcVersion(major, minor), "state its version")
        self.version = (major.value, minor.value)
        builtins = system.BUILTINS.format(major.value, minor.value)
        try:
            ctypes.CDLL(os.path.join(os.path.dirname(path), builtins), ctypes.RTLD_GLOBAL)
        except OSError as error:
            raise BuildError(f"{path} lacks its second library: {error}") from error

    def __repr__(self) -> str:
        return f"Nvrtc({self.path!r})"

    @cached_property
    def architectures(self) -> tuple[int, ...]:
        """Architectures that it compiles for, 90 for compute capability 9.0."""
        count = ctypes.c_int()
        self._require(self._library.nvrtcGetNumSupportedArchs(count), "state its architectures")
        known = (ctypes.c_int * count.value)()
        self._require(self._library.nvrtcGetSupportedArchs(known), "state its architectures")
        return tuple(sorted(known))

    def target(self, architecture: int) -> str:
        """Name of what is compiled for an architecture: itself, or PTX of the newest one before it that is known."""
        known = self.architectures
        if architecture in known:
            return f"sm_{architecture}"
        older = [one for one in known if one < architecture]
        if not older:
            raise BuildError(
                f"the GPU has compute capability {architecture / 10:.1f}, and NVRTC {_dotted(self.version)} "
                f"({self.path}) compiles for {known[0] / 10:.1f} or newer; name an older NVRTC in $TORCHDQ_NVRTC, or "
                "use backend='eager'"
            )
        return f"compute_{older[-1]}"

    def compile(self, source: str, name: str, architecture: int) -> Compiled:
        """Kernels of a source, compiled for an architecture; raises `BuildError` if they cannot be.

        The assembler gives up allocating registers where too many values are needed at once, and keeps nearly all of
        them in memory. With less optimisation it does not, so such a source is compiled again; what has the smaller
        stack is taken.
        """
        target = self.target(architecture)
        best = self._compile(source, name, target, ())
        if any(used.registers <= FEW and used.stack >= LARGE for used in usage(best.log).values()):
            best = min(best, self._compile(source, name, target, (CALMER,)), key=lambda one: one.stack)
        return best

    def load(self, source: str, name: str, architecture: int) -> bytes:
        """Code of the kernels of a source, compiled as by `compile` unless the cache has it."""

        def make(path: Path) -> None:
            path.write_bytes(self.compile(source, name, architecture).code)

        return cache.content(cache.kept(self.key(source, architecture), ".cubin", name, make))

    def key(self, source: str, architecture: int) -> str:
        """Hash of everything that the code of a source depends on."""
        return cache.key_of(source, f"NVRTC {_dotted(self.version)}", self.target(architecture), *FLAGS, CALMER)

    def _compile(self, source: str, name: str, target: str, options: Sequence[str]) -> Compiled:
        """Kernels of a source, compiled once."""
        library, program = self._library, ctypes.c_void_p()
        what = f"compile the program {name!r} for {target}"
        status = library.nvrtcCreateProgram(program, source.encode(), f"{name}.cu".encode(), 0, None, None)
        self._require(status, what)
        try:
            flags = [flag.encode() for flag in (f"--gpu-architecture={target}", *FLAGS, *options)]
            status = library.nvrtcCompileProgram(program, len(flags), (ctypes.c_char_p * len(flags))(*flags))
            log = self._read(program, "ProgramLog").rstrip(b"\0").decode(errors="replace")
            self._require(status, what, log)
            code = self._read(program, "CUBIN" if target.startswith("sm_") else "PTX")
        finally:
            library.nvrtcDestroyProgram(program)
        most = Usage(*map(max, zip(*usage(log).values(), strict=True))) if usage(log) else Usage(0, 0, 0)
        return Compiled(code, *most, log)

    def _read(self, program: ctypes.c_void_p, what: str) -> bytes:
        """Log or code of a program; text ends with a zero, which the driver needs."""
        size = ctypes.c_size_t()
        self._require(getattr(self._library, f"nvrtcGet{what}Size")(program, size), f"give {what}")
        data = ctypes.create_string_buffer(size.value)
        self._require(getattr(self._library, f"nvrtcGet{what}")(program, data), f"give {what}")
        return data.raw

    def _require(self, status: int, what: str, log: str = "") -> None:
        """Raise an error if a call did not succeed."""
        if status == 0:
            return
        reason = self._library.nvrtcGetErrorString(status).decode(errors="replace")
        lines = log.strip().splitlines()
        more = [f"... ({len(lines) - SAID} more lines)"] if len(lines) > SAID else []
        said = "\n".join([f"NVRTC ({self.path}) could not {what}: {reason}", *lines[:SAID], *more])
        raise BuildError(said)


def _dotted(version: tuple[int, int]) -> str:
    return ".".join(map(str, version))
