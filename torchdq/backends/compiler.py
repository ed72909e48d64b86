"""Backends that compile programs, and the C compiler of this machine: its choice, and runs of it with a time limit."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import torch

from torchdq.backends.backend import Backend, DirectKernel, LoopKernel
from torchdq.backends.torch import InterpretedKernel, InterpretedLoop
from torchdq.base import system
from torchdq.base.caches import remembered
from torchdq.base.progress import warn_once
from torchdq.errors import TorchdqError
from torchdq.program.loop import Loop
from torchdq.program.program import Program

ASKED = 5.0  # time in which a compiler must state its version [s]
ZIG = (sys.executable, "-m", "ziglang", "cc")  # compiler of a Python package


class BuildError(TorchdqError, RuntimeError):
    """Failure to find a C compiler, or to compile a program."""


def no_compiler() -> BuildError:
    """Error for a machine without a C compiler."""
    return BuildError(
        "there is no C compiler; install gcc or clang, name one in $CC, or pip install 'torchdq[compiler]', which "
        "brings one"
    )


class Compiled(Backend):
    """Backend that compiles programs and loops, or runs as torch operations those that cannot be compiled."""

    differentiable = False
    or_torch: ClassVar[bool] = False  # whether torch runs what cannot be compiled; otherwise that is an error
    by_torch: ClassVar[type[InterpretedKernel]] = InterpretedKernel  # program that torch runs

    def compiled(self, what: Program | Loop, dtype: torch.dtype, device: torch.device, samples: int) -> Any:
        """Kernel of a program, or of a loop for about so many samples, or the error of its build."""
        raise NotImplementedError

    def kernel(self, program: Program, dtype: torch.dtype, device: torch.device) -> DirectKernel:
        """Compiled program in one precision, built unless the cache on disk has it, or its torch operations."""
        found = self.compiled(program, dtype, device, 0)
        return self._instead(found, self.by_torch, program) if isinstance(found, BuildError) else found

    def loop(self, loop: Loop, dtype: torch.dtype, device: torch.device, samples: int) -> LoopKernel:
        """Compiled loop in one precision, likewise."""
        found = self.compiled(loop, dtype, device, samples)
        return self._instead(found, InterpretedLoop, loop) if isinstance(found, BuildError) else found

    def _instead(self, error: BuildError, by_torch: Any, what: Program | Loop) -> Any:
        """Program or loop for torch to run where a build failed, of which this process is warned once; or raises."""
        if not self.or_torch:
            raise BuildError(f"{error}\n(torchdq.clear_caches() makes this process try again)")
        warn_once("build", f"torchdq runs programs as torch operations, which is slower, since one failed: {error}")
        return by_torch(what)


class Compiler(NamedTuple):
    """C compiler of this machine."""

    command: tuple[str, ...]  # path and arguments
    version: str  # output of --version


@remembered(1)
def compiler() -> Compiler | None:
    """C compiler: `$CC`, which may have arguments, cc, gcc or clang on the path, or ziglang's; None: there is none."""
    stated = os.environ.get("CC")
    installed = shlex.join(ZIG) if PathFinder.find_spec("ziglang") else ""
    for name in filter(None, (stated, *system.COMPILERS, installed)):
        try:
            return _asked(name)
        except (BuildError, ValueError) as error:
            if name is stated:
                warn_once("$CC", f"$CC names {name!r}, which cannot be used, so torchdq looks for another one: {error}")
    return None


def _asked(name: str) -> Compiler:
    """Compiler that states its version."""
    program, *arguments = system.arguments(name) or [name]
    path = shutil.which(program)
    if path is None:
        raise BuildError(f"there is no program {program!r} on the path")
    # zig builds a libc to link with, which takes half a minute, and the process has one; without -O it adds checks
    own = ("-nostdlib", "-fno-sanitize=undefined", *system.ZIG) if "ziglang" in arguments else ()
    return Compiler((path, *arguments, *own), run([[path, *arguments, "--version"]], ASKED))


def run(commands: Sequence[Sequence[str]], limit: float, folder: Path | None = None) -> str:
    """Output of commands that run at the same time, with temporary files in a folder, and end within a limit [s].

    None of their processes outlives the call if one fails, takes too long or is interrupted; then raises `BuildError`.
    """
    program, deadline = commands[0][0], time.monotonic() + limit
    environment = {name: value for name, value in os.environ.items() if name != "CC"}  # which zig would ask
    if folder:
        environment |= dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(folder))
    running: list[subprocess.Popen[bytes]] = []
    output = b""
    try:
        for command in commands:
            running.append(
                subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                    env=environment,
                    start_new_session=True,
                )
            )
        for process in running:
            output += process.communicate(timeout=max(0.0, deadline - time.monotonic()))[0]
            if process.returncode != 0:
                said = output.decode(errors="replace")[-2000:]
                raise BuildError(f"{program} failed with exit status {process.returncode}:\n{said}")
    except OSError as error:
        raise BuildError(f"{program} cannot be run: {error}") from error
    except subprocess.TimeoutExpired as error:
        raise BuildError(f"{program} did not end within {limit:.0f} s") from error
    finally:
        for process in running:
            system.end(process)
            process.stdout.close()  # type: ignore[union-attr]
    return output.decode(errors="replace")
