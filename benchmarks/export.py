"""Exported dynamics in CasADi against those of `pinocchio.casadi`: times of functions and Jacobians, times of building.

    python benchmarks/export.py [--quick] [--json FILE]

Pinocchio's wheel has the headers of `pinocchio.casadi` but not the module, so `export_pinocchio.cpp` is compiled first,
which takes minutes and 2 GB of memory, and makes the same expressions. Pinocchio's run as C code, compiled with the
same flags as ours, and in CasADi's virtual machine, as they do without code generation. Contenders take turns; a time
is the least of many turns, per sample of a map.
"""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import casadi as ca
import numpy as np
import pinocchio as pin
import report

import torchdq

PEER = "pinocchio.casadi"
SAMPLES = 100  # few samples per map, so that a turn is short
TASKS = {"inverse_dynamics": "rnea", "forward_dynamics": "aba"}  # names of Pinocchio's
# Pinocchio has more kinds of joints than boost's lists hold by default
LISTS = (
    "-DBOOST_FUSION_INVOKE_MAX_ARITY=10",
    "-DBOOST_MPL_LIMIT_LIST_SIZE=30",
    "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
)


class Row(NamedTuple):
    """Least time per sample [ns] and time of building [s] of a function and its Jacobian."""

    task: str
    side: str
    function: float
    jacobian: float
    build: float


def located(package: str, name: str) -> Path:
    """Path of a file in an installed package."""
    return next(Path(f.locate()) for f in importlib.metadata.files(package) if f.name == name)


def compile_source(source: Path) -> None:
    """Compile a file as the exported ones ask for."""
    subprocess.run(["cc", "-shared", "-fPIC", "-O2", source, "-o", source.with_suffix(".so"), "-lm"], check=True)


def expressions(arm: Path, folder: Path) -> dict[str, ca.Function]:
    """Pinocchio's torques and accelerations as expressions of CasADi, by the name of the task."""
    print("compiling Pinocchio for CasADi's numbers, some minutes ...", flush=True)
    library, other = Path(ca.__file__).parent, located("libpinocchio", "libpinocchio_default.so").parent
    folders = [f"-I{other.parent / 'include'}", f"-I{library / 'include'}", f"-I{library / 'include' / 'eigen3'}"]
    linked = [f"-L{library}", "-lcasadi", f"-L{other}", "-lpinocchio_default", "-lboost_serialization"]
    source, program = Path(__file__).with_name("export_pinocchio.cpp"), folder / "export_pinocchio"
    paths = f"-Wl,-rpath,{library}:{other}"
    subprocess.run(["c++", "-std=c++17", "-w", *LISTS, *folders, source, "-o", program, *linked, paths], check=True)
    pin.buildModelFromUrdf(str(arm)).saveToXML(str(folder / "model.xml"), "model")
    subprocess.run([program, folder / "model.xml", folder], check=True)
    return {task: ca.Function.load(str(folder / f"{name}.casadi")) for task, name in TASKS.items()}


def least(calls: dict[str, Callable[[], object]], seconds: float) -> dict[str, float]:
    """Least time of every call per sample [ns]: what else the machine does only adds to it."""
    found = dict.fromkeys(calls, float("inf"))
    end = time.perf_counter() + seconds * len(calls)
    while time.perf_counter() < end:
        for name, call in calls.items():
            begin = time.perf_counter()
            call()
            found[name] = min(found[name], (time.perf_counter() - begin) / SAMPLES * 1e9)
    return found


def measured(task: str, robot: torchdq.Robot, peer: ca.Function | None, folder: Path, seconds: float) -> list[Row]:
    """Rows of all sides for a task, whose results agree."""
    begin = time.perf_counter()
    made = torchdq.compile(robot, task).export(folder, task, language="casadi")
    compile_source(made.source)
    built = {"torchdq": time.perf_counter() - begin}
    functions = {"torchdq": ca.external(task, str(made.source.with_suffix(".so")))}
    if peer is not None:
        begin, source = time.perf_counter(), folder / f"{peer.name()}.c"
        code = ca.CodeGenerator(source.name)
        code.add(peer)
        code.add(peer.jacobian())
        code.generate(f"{folder}/")
        compile_source(source)
        built |= {PEER: 0.0, f"{PEER}, -O2": time.perf_counter() - begin}
        functions |= {PEER: peer, f"{PEER}, -O2": ca.external(peer.name(), str(source.with_suffix(".so")))}
    rng = np.random.default_rng(0)
    x = [ca.DM(rng.uniform(-1, 1, (robot.n, SAMPLES))) for _ in range(3)]
    calls: dict[str, Callable[[], object]] = {}
    for side, function in functions.items():
        values, derivatives = function.map(SAMPLES), function.jacobian().map(SAMPLES)
        assert np.abs(values(*x).full() - functions["torchdq"].map(SAMPLES)(*x).full()).max() < 1e-9, side
        calls[side] = lambda values=values: values(*x)
        calls[f"{side}, Jacobian"] = lambda derivatives=derivatives: derivatives(*x, 0)
    times = least(calls, seconds)
    return [Row(task, side, times[side], times[f"{side}, Jacobian"], built[side]) for side in functions]


def main() -> None:
    parser = report.parser(__doc__, quick="without Pinocchio, whose headers take minutes to compile", readme=False)
    arguments = parser.parse_args()
    arm = located("example-robot-data", "xarm7.urdf")
    robot = torchdq.Robot.from_urdf(arm, on_unphysical="ignore")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        peers = {} if arguments.quick else expressions(arm, folder)
        rows = [row for task in TASKS for row in measured(task, robot, peers.get(task), folder, 2.0)]
    print(f"\n| {robot.name}, one thread | function | Jacobian | built in |\n|---|---|---|---|")
    for row in rows:
        ours = next(r for r in rows if r.task == row.task)
        ratios = f"{row.function / ours.function:.1f} x", f"{row.jacobian / ours.jacobian:.1f} x"
        shown = f"{row.function:.0f} ns ({ratios[0]}) | {row.jacobian:.0f} ns ({ratios[1]})"
        print(f"| {row.task}, {row.side} | {shown} | {f'{row.build:.1f} s' if row.build else '-'} |")
    facts = report.machine("casadi")
    print(f"\n{report.words(facts)}")
    report.into_json(arguments.json, machine=facts, rows=[row._asdict() for row in rows])


if __name__ == "__main__":
    main()
