"""Samples a second against the size of the batch, beside other packages: a picture, and a table of some sizes.

    python benchmarks/batches.py [--quick] [--json FILE] [--page] [--again]

Inverse and forward dynamics of a Panda without its fingers, the same URDF for all, in float64 on one thread. Every
package is called from Python in its quickest way: Pinocchio's `rnea` and `aba` sample by sample, or its loops in C++
where these are faster; `mj_inverse` and `mj_forward` of MuJoCo sample by sample; frax, if it is installed, under `jit`
and `vmap`, after the others, which its threads would slow down. Results are compared first. Packages take turns, and
the least processor time counts; of frax, which works in threads of its own, the least time by the clock. `--again`
measures nothing, and draws the results again.
"""

from __future__ import annotations

import json
import os
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import front_page
import mujoco
import numpy as np
import pinocchio as pin
import report
import torch
from pages.pictures import SMALL, Curve, Picture, svg
from pages.text import table
from peers import bare, urdf

import torchdq

TASKS = ("inverse_dynamics", "forward_dynamics")
SIZES = tuple(4**k for k in range(9))
SHOWN = (1, 16, 256, 4096, 65536)  # of the table
FUNCTION, COMPILED, PARALLEL = "torchdq, function", "torchdq, compiled object", "Pinocchio, loop in C++"
LOOKS = {  # of the lines, words, and their places
    COMPILED: (("blue", "--"), ("torchdq,\ncompiled object", 1.2, 2e7)),
    FUNCTION: (("blue", "-"), ("torchdq,\nfunction", 100, 6e6)),
    "Pinocchio": (("ink", "-"), ("Pinocchio", 600, 1.5e6)),
    "MuJoCo": (("orange", "-"), ("MuJoCo", 1.5, 2.4e5)),
    "frax": (("grey", "-"), ("frax", 15, 1.1e5)),
}
JAX = {  # settings that frax asks for on a processor
    "JAX_ENABLE_X64": "1",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false --xla_cpu_scheduler_type=CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED",
}
TURN = 2e-3  # shortest time of a package's turn [s]
PICTURE = report.ROOT / "docs/pictures/batches.svg"

Calls = dict[str, Callable[[], Any]]


def arm(folder: Path) -> Path:
    """URDF of the arm, with fixed fingers, without damping and shapes."""
    root = bare(urdf("example-robot-data", "panda.urdf"))
    for joint in root.findall("joint"):
        for part in (*joint.findall("dynamics"), *joint.findall("mimic")):
            joint.remove(part)
        if "finger" in joint.get("name", ""):
            joint.set("type", "fixed")
    path = folder / "panda.urdf"
    path.write_bytes(ET.tostring(root))
    return path


def states(size: int, n: int) -> np.ndarray:
    """Positions, velocities, and accelerations or torques, shape [3, size, n]."""
    return np.random.default_rng(0).uniform(-1.0, 1.0, (3, size, n))


class Arm:
    """The arm in torchdq, Pinocchio and MuJoCo."""

    def __init__(self, path: Path):
        self.robot = torchdq.Robot.from_urdf(path, on_unphysical="ignore")
        self.programs = {task: torchdq.compile(self.robot, task) for task in TASKS}
        self.model = pin.buildModelFromUrdf(str(path))
        self.pool = pin.ModelPool(self.model, 1)
        self.mujoco = mujoco.MjModel.from_xml_path(str(path))
        self.mujoco.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT  # limits

    def calls(self, task: str, size: int) -> Calls:
        """Calls for a batch, which return its results [size, n]."""
        x = states(size, self.robot.n)
        function, rows = getattr(torchdq, task), [torch.tensor(y if size > 1 else y[0]) for y in x]
        return {
            FUNCTION: lambda: function(self.robot, *rows),
            COMPILED: lambda: self.programs[task](*rows),
            "Pinocchio": self._one_by_one(
                getattr(pin, {"inverse_dynamics": "rnea", "forward_dynamics": "aba"}[task]), x
            ),
            PARALLEL: self._in_parallel(task, x),
            "MuJoCo": self._mujoco(task, x),
        }

    def _one_by_one(self, of: Callable[..., np.ndarray], x: np.ndarray) -> Callable[[], Any]:
        data, rows = self.model.createData(), list(zip(*x, strict=True))
        return lambda: [of(self.model, data, *row) for row in rows]

    def _in_parallel(self, task: str, x: np.ndarray) -> Callable[[], Any]:
        of = {"inverse_dynamics": pin.rneaInParallel, "forward_dynamics": pin.abaInParallel}[task]
        columns, out = [np.asfortranarray(y.T) for y in x], np.asfortranarray(np.zeros(x[0].T.shape))

        def call() -> np.ndarray:
            of(1, self.pool, *columns, out)
            return out.T

        return call

    def _mujoco(self, task: str, x: np.ndarray) -> Callable[[], Any]:
        model, data, rows = self.mujoco, mujoco.MjData(self.mujoco), list(zip(*x, strict=True))
        of, given, wanted = {
            "inverse_dynamics": (mujoco.mj_inverse, data.qacc, data.qfrc_inverse),
            "forward_dynamics": (mujoco.mj_forward, data.qfrc_applied, data.qacc),
        }[task]
        q, qd, out = data.qpos, data.qvel, np.empty_like(x[0])

        def call() -> np.ndarray:
            for k, row in enumerate(rows):
                q[:], qd[:], given[:] = row
                of(model, data)
                out[k] = wanted
            return out

        return call


class Frax:
    """The arm in frax."""

    def __init__(self, path: Path):
        os.environ.update(JAX)
        import frax
        import jax

        model = frax.Robot(str(path))
        up = np.array([0.0, 0.0, 9.81, 0.0, 0.0, 0.0])  # as if the base accelerated upwards [m/s^2]
        laws: dict[str, Callable[..., Any]] = {
            "inverse_dynamics": lambda q, v, a: model.rnea(q, v, a, up, None),
            "forward_dynamics": lambda q, v, u: model.forward_dynamics(q, v, u, None),
        }
        self.n, self.given = model.nv, jax.numpy.asarray
        self.laws = {task: jax.jit(jax.vmap(law)) for task, law in laws.items()}

    def calls(self, task: str, size: int) -> Calls:
        """Call for a batch, which returns its results [size, n]."""
        x = [self.given(y) for y in states(size, self.n)]
        return {"frax": lambda: self.laws[task](*x).block_until_ready()}


def agree(calls: Calls, expected: np.ndarray) -> None:
    """Check that all packages found the same."""
    for name, call in calls.items():
        worst = np.abs(np.asarray(call()).reshape(expected.shape) - expected).max()
        assert worst <= 1e-8 * np.abs(expected).max(), f"{name} is off by {worst:.1e}"


def measured(quick: bool) -> dict[str, dict[str, list[float]]]:
    """Times of a sample [ns] by task and package, of all sizes."""
    found: dict[str, dict[str, list[float]]] = {task: {} for task in TASKS}
    with tempfile.TemporaryDirectory() as folder:
        path = arm(Path(folder))
        ours = Arm(path)
        # the threads of jax slow all others down, so that it comes last
        for package in (lambda: ours, *((lambda: Frax(path),) if find_spec("frax") else ())):
            model = package()
            for task, size in product(TASKS, SIZES):
                calls = model.calls(task, size)
                x = torch.tensor(states(size, ours.robot.n))
                agree(calls, getattr(torchdq, task)(ours.robot, *x).numpy())
                timed = {name: (call, size) for name, call in calls.items()}
                clock = time.process_time if model is ours else time.perf_counter
                best = report.least(timed, 5, 1.0 if quick else 4.0, TURN, clock)
                if in_parallel := best.pop(PARALLEL, None):
                    best["Pinocchio"] = min(best["Pinocchio"], in_parallel)
                for name, least in best.items():
                    found[task].setdefault(name, []).append(least)
    return found


def picture(times: dict[str, list[float]]) -> str:
    """Samples a second over the size of the batch, as SVG."""
    curves = {
        name: Curve(SIZES, [1e9 / t for t in row], look=look, marker="o", label=label)
        for name, row in times.items()
        for look, label in [LOOKS[name]]
    }
    return svg(Picture("batch size", "inverse dynamics per second", curves, "xy", SMALL))


def rows(times: dict[str, dict[str, list[float]]]) -> str:
    """Times of a sample at some sizes, as a table."""
    head = ("Panda, time of a sample", *(f"batch {size}" for size in SHOWN))
    return table(
        head,
        [
            (f"{task.replace('_', ' ')}, {name}", *(f"{row[SIZES.index(size)]:.0f} ns" for size in SHOWN))
            for task, packages in times.items()
            for name, row in packages.items()
        ],
    )


def main() -> None:
    """Measure or read, print, and write where the options ask for it."""
    parser = report.parser(__doc__, "fewer turns")
    parser.add_argument("--again", action="store_true", help="measure nothing; take the results of the JSON file")
    parser.set_defaults(json=front_page.BATCHES)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.again:
        found = json.loads(arguments.json.read_text("utf-8"))
        times, facts = found["times"], found["machine"]
    else:
        packages = ("mujoco", *(name for name in ("frax", "jax") if find_spec(name)))
        times, facts = measured(arguments.quick), report.machine(*packages)
    text = rows(times)
    print(text)
    PICTURE.write_text(picture(times["inverse_dynamics"]), encoding="utf-8")
    report.finish(arguments, __file__, text, facts, sizes=SIZES, times=times)
    front_page.follow(arguments)


if __name__ == "__main__":
    main()
