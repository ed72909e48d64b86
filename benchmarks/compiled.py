"""Calls from Python for few samples, and exported functions for batches against the kernels.

    python benchmarks/compiled.py [--quick] [--json FILE] [--page]

Calls of all kinds take turns, and the least processor time of a call counts. Batches take turns, of 4096 samples on one
thread: the kernel that runs from Python, and the exported C99, built with the flags that its header names. The least
time counts, since others only add to it.
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
import pinocchio as pin
import report
import torch
from pages.text import table
from peers import urdf

import torchdq
from torchdq.backends.c import COMPILED
from torchdq.envs import RobotVectorEnv
from torchdq.scene.controllers import ComputedTorque

FLAGS = ("-std=c99", "-O3", "-march=native", "-fno-math-errno", "-ffp-contract=fast", "-shared", "-fPIC")
SAMPLES, ROWS = 4096, (1, 16, 64, 256)
GAIN = torch.ones(7, dtype=torch.float64)
LAW = ComputedTorque(GAIN.expand(1, 7), GAIN.expand(1, 7))  # gains of every sample
CASES = [(what, dtype) for what in ("inverse_dynamics", "forward_dynamics", LAW) for dtype in (64, 32)]


def calls_by_rows(rounds: int) -> dict[str, list[float]]:
    """Least times of calls by the number of rows in `ROWS` [us]; of Pinocchio with one."""
    path = urdf("example-robot-data", "xarm7.urdf")
    robot = torchdq.Robot.from_urdf(path, on_unphysical="ignore")
    torques, layer = torchdq.compile(robot, "inverse_dynamics"), torchdq.DQRNEA(robot)
    scene = torchdq.Scene(robot, (torchdq.effects.Gravity(), torchdq.effects.Viscous(0.1)), dt=0.002)
    model = pin.buildModelFromUrdf(str(path))
    data = model.createData()
    found: dict[str, list[float]] = {}
    for rows in ROWS:
        x = list(torch.rand(3, *([rows] if rows > 1 else []), 7, dtype=torch.float64))
        learned, weight = [y.clone().requires_grad_() for y in x], torch.rand_like(x[0])
        state = scene.start(x[0], x[1])
        numbers = [y.reshape(-1, 7)[0].numpy() for y in x]
        pose = torchdq.forward_kinematics(robot, x[0], robot.tip)
        envs, action = RobotVectorEnv(rows, "reach", "panda", max_episode_steps=None), torch.zeros(rows, 7)
        envs.reset(seed=0)
        kinds: dict[str, Callable[[], object]] = {
            "pinocchio.rnea": lambda numbers=numbers: pin.rnea(model, data, *numbers),
            "torchdq.inverse_dynamics": lambda x=x: torchdq.inverse_dynamics(robot, *x),
            "torchdq.compile(...)": lambda x=x: torques(*x),
            "torchdq.DQRNEA": lambda x=x: layer(*x),
            "torchdq.forward_dynamics": lambda x=x: torchdq.forward_dynamics(robot, *x),
            "Scene.step": lambda state=state, x=x: scene.step(state, x[2]),
            "inverse_dynamics, forward and backward": lambda x=learned, weight=weight: torch.autograd.grad(
                torchdq.inverse_dynamics(robot, *x), x, weight
            ),
            "inverse_kinematics, from 0.02 rad away": lambda x=x, pose=pose: torchdq.inverse_kinematics(
                robot, pose, start=x[0] + 0.02
            ),
            "RobotVectorEnv.step, Reach, Panda, float32": lambda envs=envs, action=action: envs.step(action),
        }
        for key, nanoseconds in report.least(
            {k: (call, 1) for k, call in kinds.items()}, rounds, shortest=5e-3
        ).items():
            found.setdefault(key, []).append(nanoseconds / 1e3)
    found["pinocchio.rnea"] = found["pinocchio.rnea"][:1]
    return found


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
        best = report.least({key: (run, SAMPLES) for key, run in runs.items()}, rounds)
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
    by_rows = calls_by_rows(20 if arguments.quick else 100)
    header = ("call from Python, xArm7, float64 [us]", *(f"{n} row{'s' * (n > 1)}" for n in ROWS))
    cells = [(name, *(f"{t:.1f}" for t in times), *["-"] * (len(ROWS) - len(times))) for name, times in by_rows.items()]
    text = "\n\n".join([table(header, cells), report.table("Compiled programs, Panda", lines)])
    print(text)
    report.finish(arguments, __file__, text, report.machine(), calls=[median, late], rows=[by_rows], batches=[found])


if __name__ == "__main__":
    main()
