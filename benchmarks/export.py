"""Exported dynamics in CasADi against those of `pinocchio.casadi`: values, Jacobians, Hessians, and times of building.

    python benchmarks/export.py [--quick] [--json FILE] [--page]

Panda without its fingers, at 20 to 100 knots in one call, as a solver for optimal control makes it. Hessians are
second derivatives of the results, weighted and summed. Pinocchio's wheel has the headers of `pinocchio.casadi` but not
the module, so `export_pinocchio.cpp` is compiled first, which takes minutes and 2 GB of memory, and makes the same
expressions; CasADi maps them over the knots and generates C code. All are called in the same way, by `export_calls.c`
through the interface in C that CasADi itself calls. Contenders take turns; a time is the least of many.
Times of building are processor times.
"""

from __future__ import annotations

import ctypes
import importlib.metadata
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")

import casadi as ca
import numpy as np
import pinocchio as pin
import report

import torchdq

KNOTS = (20, 50, 100)
TASKS = {"inverse_dynamics": "rnea", "forward_dynamics": "aba"}  # names of Pinocchio's
KINDS = ("values", "Jacobian", "Hessian")
OURS, ONE = "torchdq, all knots", "torchdq, knot by knot"
PEER, NATIVE = "pinocchio.casadi, -O2", "pinocchio.casadi, -O3 -march=native"
FLAGS = {
    OURS: ("-O2", "-ftree-vectorize", "-march=native", "-fno-math-errno"),  # as the exported files ask for
    ONE: ("-O2",),
    PEER: ("-O2",),
    NATIVE: ("-O3", "-march=native"),
}
TURNS = 20  # at each of which every contender makes ten calls, twenty times
# Pinocchio has more kinds of joints than boost's lists hold by default
LISTS = (
    "-DBOOST_FUSION_INVOKE_MAX_ARITY=10",
    "-DBOOST_MPL_LIMIT_LIST_SIZE=30",
    "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
)


class Row(NamedTuple):
    """Least times per knot [ns] of a task at a number of knots, and processor time of building [s]."""

    task: str
    knots: int
    side: str
    times: dict[str, float]  # by kind
    build: float


def located(package: str, name: str) -> Path:
    """Path of a file in an installed package."""
    return next(Path(f.locate()) for f in importlib.metadata.files(package) if f.name == name)


def built(source: Path, flags: Sequence[str], library: Path | None = None) -> Path:
    """Shared library of a file."""
    library = library or source.with_suffix(".so")
    subprocess.run(["cc", "-shared", "-fPIC", *flags, source, "-o", library, "-lm"], check=True)
    return library


def panda() -> tuple[torchdq.Robot, pin.Model]:
    """Panda without its fingers, in both."""
    path = located("example-robot-data", "panda.urdf")
    robot = torchdq.Robot.from_urdf(path, on_unphysical="ignore", mimic="independent")
    fingers = [name for name in robot.joint_names if "finger" in name]
    model = pin.buildModelFromUrdf(str(path))
    reduced = pin.buildReducedModel(model, [model.getJointId(name) for name in fingers], pin.neutral(model))
    return robot.lock(dict.fromkeys(fingers, 0.0)), reduced


def expressions(model: pin.Model, folder: Path) -> dict[str, ca.Function]:
    """Pinocchio's torques and accelerations as expressions of CasADi, by the name of the task."""
    print("compiling Pinocchio for CasADi's numbers, some minutes ...", flush=True)
    library, other = Path(ca.__file__).parent, located("libpinocchio", "libpinocchio_default.so").parent
    folders = [f"-I{other.parent / 'include'}", f"-I{library / 'include'}", f"-I{library / 'include' / 'eigen3'}"]
    linked = [f"-L{library}", "-lcasadi", f"-L{other}", "-lpinocchio_default", "-lboost_serialization"]
    source, program = Path(__file__).with_name("export_pinocchio.cpp"), folder / "export_pinocchio"
    paths = f"-Wl,-rpath,{library}:{other}"
    subprocess.run(["c++", "-std=c++17", "-w", *LISTS, *folders, source, "-o", program, *linked, paths], check=True)
    model.saveToXML(str(folder / "model.xml"), "model")
    subprocess.run([program, folder / "model.xml", folder], check=True)
    return {task: ca.Function.load(str(folder / f"{name}.casadi")) for task, name in TASKS.items()}


class Call:
    """Function behind CasADi's interface, with memory for its arguments and results."""

    def __init__(self, library: Path, name: str, inputs: Sequence[np.ndarray], sizes: Sequence[int], calls: int):
        """
        Args:
            library: path of the shared library.
            name: name of the function.
            inputs: arguments at all knots; those after them are not given.
            sizes: numbers of the results at all knots; 0: not wanted.
            calls: number of calls for all knots.
        """
        loaded, pointer = ctypes.CDLL(str(library)), ctypes.POINTER(ctypes.c_double)
        self.function, self.calls = getattr(loaded, name), calls
        work = [ctypes.c_longlong() for _ in range(4)]
        getattr(loaded, f"{name}_work")(*map(ctypes.byref, work))
        arg, res, iw, w = (max(size.value, 1) for size in work)
        self.inputs = [np.asfortranarray(x).ravel(order="F").copy() for x in inputs]
        self.results = [np.zeros(size) for size in sizes]

        def given(arrays: Sequence[np.ndarray], count: int) -> tuple[Any, Any]:
            known = [x.ctypes.data_as(pointer) if x.size else None for x in arrays]
            steps = [x.size // calls for x in arrays]
            rest = count - len(arrays)
            return (pointer * count)(*known, *[None] * rest), (ctypes.c_longlong * count)(*steps, *[0] * rest)

        n_in, n_out = getattr(loaded, f"{name}_n_in")(), getattr(loaded, f"{name}_n_out")()
        self.given = (n_in, *given(self.inputs, n_in), n_out, *given(self.results, n_out))
        self.room = (pointer * arg)(), (pointer * res)(), (ctypes.c_longlong * iw)(), (ctypes.c_double * w)()

    def seconds(self, timer: ctypes.CDLL, turns: int) -> float:
        """Least time of all knots."""
        found = timer.least(self.function, self.calls, *self.given, *self.room, turns)
        if found < 0:
            raise RuntimeError("an evaluation failed")
        return found


class Built(NamedTuple):
    """Shared library with functions, the name of the first, and processor time of making it [s]."""

    file: Path
    name: str
    seconds: float


def processor_time() -> float:
    """Processor time of this process and of the compilers that it ran [s], which other work does not stretch."""
    return sum(os.times()[:4])


def exported(robot: torchdq.Robot, task: str, knots: int, folder: Path) -> Built:
    """Functions that torchdq exports; 0 knots: for one call per knot."""
    begin, name = processor_time(), f"{task}_{knots}"
    made = torchdq.compile(robot, task).export(folder, name, language="casadi", knots=knots)
    library = built(made.source, FLAGS[OURS if knots else ONE])
    return Built(library, name, processor_time() - begin)


def of_torchdq(ours: Built, calls: int, x: Sequence[np.ndarray]) -> dict[str, Call]:
    """Calls of torchdq's functions, by kind; `calls`: number of calls for all knots."""
    function = ca.external(ours.name, str(ours.file))
    n, jacobian, second = function.n_in(), function.jacobian(), function.reverse(1).jacobian()
    # those with respect to seeds are not wanted, as in the Hessian of a Lagrangian
    by_seeds = [name.rpartition("_adj_")[0] not in ("", "jac") for name in second.name_out()]
    wanted = [0 if by_seeds[k] else second.nnz_out(k) * calls for k in range(second.n_out())]
    return {
        "values": Call(ours.file, ours.name, x[:n], [function.nnz_out(0) * calls], calls),
        "Jacobian": Call(ours.file, f"jac_{ours.name}", x[:n], [jacobian.nnz_out(k) * calls for k in range(n)], calls),
        "Hessian": Call(ours.file, f"jac_adj1_{ours.name}", [*x[:n], np.zeros(0), x[n]], wanted, calls),
    }


def of_pinocchio(f: ca.Function, flags: Sequence[str], folder: Path) -> Built:
    """Library of Pinocchio's function, its Jacobian and its Hessian, mapped over the knots."""
    begin = processor_time()
    x = [ca.SX.sym(f"x{k}", f.size1_in(k)) for k in range(f.n_in())]
    weights = ca.SX.sym("weights", f.size1_out(0))
    hessian, _ = ca.hessian(ca.dot(weights, f(*x)), ca.vertcat(*x))
    kinds = f, f.jacobian(), ca.Function(f"hessian_{f.name()}", [*x, weights], [hessian])
    source = folder / f"{f.name()}_with_{len(flags)}_flags.c"  # CasADi wants a name of C
    code = ca.CodeGenerator(source.name)
    for function in kinds:
        for knots in KNOTS:
            code.add(function.map(knots))
    code.generate(f"{folder}/")
    library = built(source, flags)
    return Built(library, f.name(), processor_time() - begin)


def mapped(peer: Built, knots: int, x: Sequence[np.ndarray]) -> dict[str, Call]:
    """Calls of Pinocchio's functions, by kind."""
    names = [f"map{knots}_{kind}{peer.name}" for kind in ("", "jac_", "hessian_")]
    found = {}
    for kind, name in zip(KINDS, names, strict=True):
        function = ca.external(name, str(peer.file))
        sizes = [function.nnz_out(k) for k in range(function.n_out())]
        found[kind] = Call(peer.file, name, x if kind == "Hessian" else x[:-1], sizes, 1)
    return found


def agree(calls: dict[str, dict[str, Call]]) -> None:
    """Check that all sides found the same values, and derivatives of the same size."""
    first = calls[OURS]
    for side, kinds in calls.items():
        for kind in KINDS:
            sums = [sum(float(np.abs(y).sum()) for y in c[kind].results) for c in (first, kinds)]
            assert abs(sums[0] - sums[1]) <= 1e-6 * sums[0], (side, kind, sums)
        worst = np.abs(kinds["values"].results[0] - first["values"].results[0]).max()
        assert worst <= 1e-9 * np.abs(first["values"].results[0]).max(), side


def measured(task: str, robot: torchdq.Robot, f: ca.Function | None, timer: ctypes.CDLL, folder: Path) -> list[Row]:
    """Rows of all sides for a task, whose results agree."""
    rng, rows = np.random.default_rng(0), []
    one = exported(robot, task, 0, folder)
    peers = {side: of_pinocchio(f, FLAGS[side], folder) for side in (PEER, NATIVE)} if f is not None else {}
    for knots in KNOTS:
        x = [rng.uniform(-1, 1, (robot.n, knots)) for _ in range(4)]
        sides = {OURS: exported(robot, task, knots, folder), ONE: one, **peers}
        calls = {OURS: of_torchdq(sides[OURS], 1, x), ONE: of_torchdq(one, knots, x)}
        calls |= {side: mapped(peer, knots, x) for side, peer in peers.items()}
        best: dict[tuple[str, str], float] = {}
        for _ in range(TURNS):
            for side, kinds in calls.items():
                for kind, call in kinds.items():
                    seconds = call.seconds(timer, 20) / knots * 1e9
                    best[side, kind] = min(best.get((side, kind), seconds), seconds)
        agree(calls)
        rows += [Row(task, knots, side, {k: best[side, k] for k in KINDS}, sides[side].seconds) for side in calls]
    return rows


def table(rows: Sequence[Row], title: str) -> str:
    """Times per knot, and how many times as long as ours at all knots they are."""
    lines = [f"| {title} | knots | {' | '.join(KINDS)} | built in |", f"|{'---|' * (3 + len(KINDS))}"]
    for row in rows:
        ours = next(r for r in rows if (r.task, r.knots, r.side) == (row.task, row.knots, OURS))
        times = " | ".join(f"{row.times[k]:.0f} ns ({row.times[k] / ours.times[k]:.1f} x)" for k in KINDS)
        lines.append(f"| {row.task}, {row.side} | {row.knots} | {times} | {row.build:.0f} s |")
    return "\n".join(lines)


def summary(rows: Sequence[Row]) -> str:
    """How much longer the peer takes, over all numbers of knots, in a list; "": it was not measured."""

    def over(side: str, kind: str) -> str:
        found = [
            peer.times[kind] / ours.times[kind]
            for peer in rows
            for ours in rows
            if (peer.side, ours.side) == (PEER, side) and (peer.task, peer.knots) == (ours.task, ours.knots)
        ]
        return f"{kind} {min(found):.1f} to {max(found):.1f}"

    if not any(row.side == PEER for row in rows):
        return ""
    return "\n".join(
        f"* Times of {PEER}, over those of {side}: {', '.join(over(side, kind) for kind in KINDS)}."
        for side in (OURS, ONE)
    )


def main() -> None:
    """The table, and what it comes to."""
    parser = report.parser(__doc__, quick="without Pinocchio, whose headers take minutes to compile")
    arguments = parser.parse_args()
    robot, model = panda()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        timer = ctypes.CDLL(str(built(Path(__file__).with_name("export_calls.c"), ("-O2",), folder / "calls.so")))
        timer.least.restype = ctypes.c_double
        peers = {} if arguments.quick else expressions(model, folder)
        rows = [row for task in TASKS for row in measured(task, robot, peers.get(task), timer, folder)]
    text = f"{table(rows, 'Panda in CasADi, one thread, per knot')}\n\n{summary(rows)}".strip()
    print(f"\n{text}")
    report.finish(arguments, __file__, text, report.machine("casadi"), rows=[row._asdict() for row in rows])


if __name__ == "__main__":
    main()
