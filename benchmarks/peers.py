"""Speed beside the field's tools, in one run: medians and spreads per sample, and ratios.

    python benchmarks/peers.py [--quick] [--json FILE] [--threads N]

Every contender gets ordinary inputs in the layout it likes best, prepared beforehand, and is warmed up; compile and
recording time is a column of its own. The contenders of one row take turns, so that a noisy machine is noisy to all.
Peers that are not installed are left out, and said to be.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import pinocchio as pin
import torch

import torchdq

SECONDS = 1.0  # of measuring per contender


@dataclass
class Row:
    """One contender's time for one task."""

    robot: str
    joints: int
    task: str
    dtype: str
    batch: int
    threads: int
    system: str
    nanoseconds: float  # per sample, median
    low: float  # 10 % and 90 % of the repeats
    high: float
    first_call: float | None  # [s], recording and compiling included


def measure(contenders: dict[str, Callable[[], object]], batch: int, seconds: float) -> dict[str, list[float]]:
    """Times per sample [ns] of contenders that take turns."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    inner = {}
    for name, call in contenders.items():
        call()
        start = time.perf_counter()
        call()
        # short calls are repeated, so that the clock does not matter
        inner[name] = max(1, int(2e-3 / max(time.perf_counter() - start, 1e-7)))
    end = time.perf_counter() + seconds * len(contenders)
    while time.perf_counter() < end or min(map(len, times.values())) < 5:
        for name, call in contenders.items():
            start = time.perf_counter()
            for _ in range(inner[name]):
                call()
            times[name].append((time.perf_counter() - start) / inner[name] / batch * 1e9)
    return times


def urdf(package: str, name: str) -> Path:
    """Path of a URDF file in an installed package."""
    return next(Path(f.locate()) for f in importlib.metadata.files(package) if f.name == name)


class Task:
    """The contenders for one robot, batch and precision."""

    def __init__(self, path: Path, batch: int, dtype: torch.dtype, threads: int):
        self.path, self.batch, self.threads = path, batch, threads
        self.robot = torchdq.Robot.from_urdf(path, on_unphysical="ignore")
        self.model = pin.buildModelFromUrdf(str(path))
        n = self.robot.n
        rng = np.random.default_rng(0)
        self.arrays = [rng.uniform(-1.0, 1.0, (batch, n)) for _ in range(4)]
        self.q, self.qd, self.qdd, self.u = (torch.tensor(x, dtype=dtype) for x in self.arrays)
        self.columns = [np.asfortranarray(x.T) for x in self.arrays]
        self.out = np.asfortranarray(np.zeros((n, batch)))
        self.pool = pin.ModelPool(self.model, threads)

    def same_coordinates(self) -> bool:
        """Whether Pinocchio takes the same vectors; it does not with continuous joints."""
        return self.model.nq == self.model.nv == self.robot.n

    def pinocchio(self, task: str) -> dict[str, Callable]:
        """Pinocchio's C++, batched where it has that, else called in a loop from Python."""
        if not self.same_coordinates():
            return {}
        q, qd, qdd, _ = self.columns
        data = self.model.createData()

        def loop(function: Callable) -> Callable:
            def call() -> None:
                for k in range(self.batch):
                    function(self.model, data, *(x[k] for x in self.arrays[:3]))

            return call

        if task == "inverse dynamics":
            return {"pinocchio": lambda: pin.rneaInParallel(self.threads, self.pool, q, qd, qdd, self.out)}
        if task == "forward dynamics":
            return {"pinocchio": lambda: pin.abaInParallel(self.threads, self.pool, q, qd, qdd, self.out)}
        if task in ("inverse dynamics, forward + backward", "dynamics jacobian"):
            return {"pinocchio derivatives (loop)": loop(pin.computeRNEADerivatives)}
        if task == "forward dynamics, forward + backward":
            return {"pinocchio derivatives (loop)": loop(pin.computeABADerivatives)}
        return {}

    def torchdq(self, task: str, backend: str) -> Callable:
        """torchdq through its public modules and functions."""
        inverse = torchdq.DQRNEA(self.robot, backend=backend)
        direct = torchdq.ForwardDynamics(self.robot, backend=backend)

        def both(layer: Callable, x: torch.Tensor) -> Callable:
            inputs = [t.clone().requires_grad_() for t in (self.q, self.qd, x)]

            def call() -> None:
                for t in inputs:
                    t.grad = None
                layer(*inputs).backward(self.u)

            return call

        calls = {
            "inverse dynamics": lambda: inverse(self.q, self.qd, self.qdd),
            "forward dynamics": lambda: direct(self.q, self.qd, self.qdd),
            "inverse dynamics, forward + backward": both(inverse, self.qdd),
            "forward dynamics, forward + backward": both(direct, self.qdd),
            "dynamics jacobian": lambda: torchdq.dynamics_jacobian(
                self.robot, self.q, self.qd, self.qdd, backend=backend
            ),
            "forward kinematics": lambda: torchdq.forward_kinematics(
                self.robot, self.q, self.robot.frame_names[-1], backend=backend
            ),
            "mass matrix": lambda: torchdq.mass_matrix(self.robot, self.q, backend=backend),
        }
        return calls[task]

    def pytorch_kinematics(self, task: str) -> dict[str, Callable]:
        """pytorch_kinematics, which has no dynamics."""
        if task != "forward kinematics" or importlib.util.find_spec("pytorch_kinematics") is None:
            return {}
        import pytorch_kinematics as pk

        chain = pk.build_serial_chain_from_urdf(self.path.read_bytes(), self.robot.frame_names[-1])
        chain = chain.to(dtype=self.q.dtype)
        return {"pytorch_kinematics": lambda: chain.forward_kinematics(self.q)}

    def differentiable_robot_model(self, task: str) -> dict[str, Callable]:
        """differentiable-robot-model, single precision only."""
        if self.q.dtype != torch.float32 or importlib.util.find_spec("differentiable_robot_model") is None:
            return {}
        from differentiable_robot_model.robot_model import DifferentiableRobotModel

        model = DifferentiableRobotModel(str(self.path))
        calls = {
            "inverse dynamics": lambda: model.compute_inverse_dynamics(self.q, self.qd, self.qdd, True),
            "forward dynamics": lambda: model.compute_forward_dynamics(self.q, self.qd, self.qdd, True),
        }
        return {"differentiable-robot-model": calls[task]} if task in calls else {}

    def adam(self, task: str) -> dict[str, Callable]:
        """adam-robotics, torch batched: it has the mass matrix, no inverse dynamics with accelerations."""
        if task != "mass matrix" or importlib.util.find_spec("adam") is None:
            return {}
        from adam.pytorch import KinDynComputationsBatch

        model = KinDynComputationsBatch(str(self.path), list(self.robot.joint_names))
        base = torch.eye(4, dtype=self.q.dtype).expand(self.batch, 4, 4)
        return {"adam-robotics": lambda: model.mass_matrix(base, self.q)}

    def mujoco(self, task: str) -> dict[str, Callable]:
        """MuJoCo's C, one sample after another from Python."""
        if task != "inverse dynamics" or importlib.util.find_spec("mujoco") is None:
            return {}
        import xml.etree.ElementTree as ET

        import mujoco

        root = ET.fromstring(self.path.read_bytes())
        for link in root.findall("link"):
            for tag in ("visual", "collision"):
                for element in link.findall(tag):
                    link.remove(element)
        model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
        data = mujoco.MjData(model)
        q, qd, qdd, _ = self.arrays

        def call() -> None:
            for k in range(self.batch):
                data.qpos[:], data.qvel[:], data.qacc[:] = q[k], qd[k], qdd[k]
                mujoco.mj_inverse(model, data)

        return {"mujoco mj_inverse (loop)": call} if model.nq == self.robot.n else {}

    def rows(self, task: str, seconds: float, backends: tuple[str, ...]) -> list[Row]:
        """Rows of all contenders for a task."""
        contenders: dict[str, Callable] = {}
        first: dict[str, float] = {}
        for backend in backends:
            call = self.torchdq(task, backend)
            start = time.perf_counter()
            call()
            first[f"torchdq {backend}"] = time.perf_counter() - start
            contenders[f"torchdq {backend}"] = call
        peers = (
            self.pinocchio,
            self.mujoco,
            self.pytorch_kinematics,
            self.differentiable_robot_model,
            self.adam,
        )
        for peer in peers:
            contenders.update(peer(task))
        rows = []
        for name, times in measure(contenders, self.batch, seconds).items():
            low, _, high = statistics.quantiles(times, n=10)[0], None, statistics.quantiles(times, n=10)[-1]
            rows.append(
                Row(
                    self.robot.name,
                    self.robot.n,
                    task,
                    str(self.q.dtype).removeprefix("torch."),
                    self.batch,
                    self.threads,
                    name,
                    statistics.median(times),
                    low,
                    high,
                    first.get(name),
                )
            )
        return rows


def cold_start(path: Path, gradient: bool, recipe: str = "DQRNEA") -> tuple[float, float]:
    """First call [s] in a fresh process, with an empty cache and with a full one, imports excluded."""
    code = f"""
import sys, time, torch, torchdq
robot = torchdq.Robot.from_urdf({str(path)!r}, on_unphysical="ignore")
x = [torch.zeros(4, robot.n, dtype=torch.float64, requires_grad={gradient}) for _ in range(3)]
start = time.perf_counter()
y = torchdq.{recipe}(robot)(*x)
if {gradient}: y.sum().backward()
print(time.perf_counter() - start)
"""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "TORCHDQ_CACHE": folder}
        times = [
            float(
                subprocess.run(
                    [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
                ).stdout
            )
            for _ in range(2)
        ]
    return times[0], times[1]


def machine() -> dict[str, str]:
    """What was measured on."""
    model = next(
        (
            line.split(":", 1)[1].strip()
            for line in Path("/proc/cpuinfo").read_text().splitlines()
            if "model name" in line
        ),
        platform.processor(),
    )
    compiler = shutil.which(os.environ.get("CC", "cc"))
    version = (
        subprocess.run([compiler, "--version"], capture_output=True, text=True).stdout.splitlines()[0]
        if compiler
        else "none"
    )
    return {
        "processor": model,
        "cores": str(os.cpu_count()),
        "compiler": version,
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in ("torch", "pin", "numpy")},
    }


def table(rows: list[Row]) -> str:
    """Rows as text, with the ratio of every contender to compiled torchdq."""
    lines = ["| robot | task | precision | batch | threads | system | ns per sample | 10-90 % | against torchdq c |"]
    lines.append("|" + "---|" * 9)
    for row in rows:
        same = [
            r
            for r in rows
            if (r.robot, r.task, r.dtype, r.batch, r.threads)
            == (row.robot, row.task, row.dtype, row.batch, row.threads)
        ]
        ours = next((r.nanoseconds for r in same if r.system == "torchdq c"), None)
        ratio = f"{row.nanoseconds / ours:.1f} x" if ours else ""
        lines.append(
            f"| {row.robot} ({row.joints}) | {row.task} | {row.dtype} | {row.batch} | {row.threads} | {row.system} | "
            f"{row.nanoseconds:.1f} | {row.low:.1f} - {row.high:.1f} | {ratio} |"
        )
    return "\n".join(lines)


TASKS = (
    "inverse dynamics",
    "forward dynamics",
    "inverse dynamics, forward + backward",
    "forward dynamics, forward + backward",
    "dynamics jacobian",
    "mass matrix",
    "forward kinematics",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one robot, two batches")
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    arm = urdf("example-robot-data", "xarm7.urdf")
    robots = [arm] if arguments.quick else [arm, urdf("example-robot-data", "ur5_robot.urdf")]
    batches = [1, 4096] if arguments.quick else [1, 64, 4096, 65536]
    seconds = 0.4 if arguments.quick else SECONDS
    rows: list[Row] = []
    for path in robots:
        for dtype in (torch.float64, torch.float32):
            for batch in batches:
                case = Task(path, batch, dtype, arguments.threads)
                for task in TASKS:
                    rows += case.rows(task, seconds, ("c", "eager") if batch <= 4096 else ("c",))
    starts = {
        "inverse dynamics": cold_start(arm, False),
        "inverse dynamics with gradient": cold_start(arm, True),
        "forward dynamics with gradient": cold_start(arm, True, "ForwardDynamics"),
    }
    print(table(rows))
    print()
    for name, (cold, warm) in starts.items():
        print(f"first call, {name}: {cold:.2f} s with an empty cache, {1e3 * warm:.0f} ms with a full one")
    print("\n" + ", ".join(f"{k} {v}" for k, v in machine().items()))
    if arguments.json:
        arguments.json.write_text(
            json.dumps({"machine": machine(), "rows": [asdict(r) for r in rows], "first_call": starts}, indent=1)
        )


if __name__ == "__main__":
    main()
