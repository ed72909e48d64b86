"""Calls of compiled programs on one sample from Python, and exported functions for batches against the kernels.

    python benchmarks/compiled.py [--quick] [--json FILE] [--page]

Calls are timed one by one. Batches take turns, of 4096 samples on one thread: the kernel that runs from Python, and the
exported C99, built with the flags that its header names. The least time counts, since others only add to it.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import report
import torch

import torchdq
from torchdq.backends.c import COMPILED
from torchdq.scene.controllers import ComputedTorque

FLAGS = ("-std=c99", "-O3", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-shared", "-fPIC")
SAMPLES = 4096
GAIN = torch.ones(7, dtype=torch.float64)
LAW = ComputedTorque(GAIN.expand(1, 7), GAIN.expand(1, 7))  # gains of every sample
CASES = [(what, dtype) for what in ("inverse_dynamics", "forward_dynamics", LAW) for dtype in (64, 32)]


def called(calls: int) -> tuple[float, float]:
    """Median and 99 % of the times of a call on one sample [us]."""
    torques = torchdq.compile(torchdq.robots.load("panda"), "inverse_dynamics")
    rows, tau = list(torch.rand(3, 7, dtype=torch.float64)), torch.empty(7, dtype=torch.float64)
    times = np.empty(calls)
    for _ in range(1000):
        torques(*rows, out=tau)
    for k in range(calls):
        begin = time.perf_counter_ns()
        torques(*rows, out=tau)
        times[k] = time.perf_counter_ns() - begin
    return float(np.median(times)) / 1e3, float(np.percentile(times, 99)) / 1e3


def exported(torques: torchdq.functions.compile.CompiledProgram, compiler: str, folder: Path) -> Callable[..., int]:
    """Exported function for batches, built by a compiler."""
    made = torques.export(folder, "exported", batch=True)
    library = folder / f"{compiler}.so"
    subprocess.run([compiler, *FLAGS, "-I", folder, made.source, "-o", library, "-lm"], check=True)
    return ctypes.CDLL(str(library)).exported_batch


def ratios(what: str | ComputedTorque, bits: int, compilers: list[str], rounds: int) -> dict[str, float]:
    """Times of the exported function by compiler, over that of the kernel."""
    dtype = torch.float64 if bits == 64 else torch.float32
    torques = torchdq.compile(torchdq.robots.load("panda"), what, dtype)
    program = torques.program
    rows = [torch.rand(SAMPLES, a.width, dtype=dtype) for a in program.arguments]
    room = [torch.empty(SAMPLES, 7, dtype=dtype)] + ([torch.empty(SAMPLES, 1, dtype=dtype)] if program.growth else [])
    pointers = [x.data_ptr() for x in (*rows, *room)]
    kernel = COMPILED.kernel(program, dtype, torch.device("cpu"))
    with tempfile.TemporaryDirectory() as folder:
        runs: dict[str, Callable[[], object]] = {"kernel": lambda: kernel.compiled.run(SAMPLES, None, *pointers)}
        for compiler in compilers:
            function = exported(torques, compiler, Path(folder))
            typed = [ctypes.c_size_t(SAMPLES), *map(ctypes.c_void_p, pointers)]
            runs[compiler] = lambda function=function, typed=typed: function(*typed)
        best = dict.fromkeys(runs, float("inf"))
        for _ in range(rounds):
            for key, run in runs.items():
                begin = time.perf_counter()
                run()
                best[key] = min(best[key], time.perf_counter() - begin)
    return {compiler: best[compiler] / best["kernel"] for compiler in compilers}


def main() -> None:
    """Measure, print, and write where the options ask for it."""
    arguments = report.parser(__doc__, "fewer calls and rounds").parse_args()
    torch.set_num_threads(1)
    calls = 10_000 if arguments.quick else 100_000
    median, late = called(calls)
    compilers = [compiler for compiler in ("gcc", "clang") if shutil.which(compiler)]
    found = {
        f"{what if isinstance(what, str) else what.named()}, float{bits}": ratios(
            what, bits, compilers, 20 if arguments.quick else 200
        )
        for what, bits in CASES
    }
    lines = [
        ("call of inverse dynamics from Python, one sample", f"{median:.1f} us"),
        (f"99 % of {calls} calls, over the median", f"{late / median:.1f}"),
    ]
    for what, times in found.items():
        shown = ", ".join(f"{ratio:.2f} ({compiler})" for compiler, ratio in times.items())
        lines.append((f"exported batch of {what}, over the kernel with vectors", shown))
    text = report.table("Compiled programs, Panda", lines)
    print(text)
    report.finish(arguments, __file__, text, report.machine(), calls=[median, late], batches=[found])


if __name__ == "__main__":
    main()
