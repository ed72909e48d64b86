"""Speed beside the field's tools, in one run: least processor times per sample, and ratios.

    python benchmarks/peers.py [--quick] [--json FILE] [--page] [--threads N]

Every contender gets ordinary inputs in the layout it likes best, prepared beforehand, and is warmed up; compile and
recording time is a column of its own. The contenders of one row take turns, so that a noisy machine is noisy to all.
Peers that are not installed are left out, and said to be.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import front_page
import numpy as np
import pinocchio as pin
import report
import torch
from accuracy.scenes import chain

import torchdq

SECONDS = 1.0  # time of measuring per contender
TURN = 0.01  # time of one's turn, long enough that the others' traces in the caches do not matter [s]


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
    nanoseconds: float  # per sample
    first_call: float | None  # [s], recording and compiling included


def urdf(package: str, name: str) -> Path:
    """Path of a URDF file in an installed package."""
    return next(Path(f.locate()) for f in importlib.metadata.files(package) if f.name == name)


def bare(path: Path) -> ET.Element:
    """URDF of a file without shapes, whose meshes MuJoCo would open."""
    root = ET.fromstring(path.read_bytes())
    for link in root.findall("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)
    return root


def timed(
    calls: dict[str, Callable], batch: int, seconds: float, clock: Callable[[], float] = time.process_time
) -> dict[str, float]:
    """Least time of every call per sample [ns], after so many seconds per call."""
    return report.least({k: (call, batch) for k, call in calls.items()}, 5, seconds * len(calls), TURN, clock)


class Task:
    """The contenders for one robot, batch and precision."""

    def __init__(self, path: Path, batch: int, dtype: torch.dtype, threads: int):
        self.path, self.batch, self.threads = path, batch, threads
        self.robot = torchdq.Robot.from_urdf(path, on_unphysical="ignore", mimic="independent")
        self.model = pin.buildModelFromUrdf(str(path))
        n = self.robot.n
        rng = np.random.default_rng(0)
        self.arrays = [rng.uniform(-1.0, 1.0, (batch, n)) for _ in range(4)]
        self.q, self.qd, self.qdd, self.u = (torch.tensor(x, dtype=dtype) for x in self.arrays)
        self.columns = [np.asfortranarray(x.T) for x in self.arrays]
        self.out = np.asfortranarray(np.zeros((n, batch)))
        self.pool = pin.ModelPool(self.model, threads)

    def same_coordinates(self) -> bool:
        """True if Pinocchio takes the same vectors; it does not with continuous joints."""
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
            return {"Pinocchio": lambda: pin.rneaInParallel(self.threads, self.pool, q, qd, qdd, self.out)}
        if task == "forward dynamics":
            return {"Pinocchio": lambda: pin.abaInParallel(self.threads, self.pool, q, qd, qdd, self.out)}
        if task in ("inverse dynamics, forward + backward", "dynamics jacobian"):
            return {"Pinocchio, called in a loop": loop(pin.computeRNEADerivatives)}
        if task == "forward dynamics, forward + backward":
            return {"Pinocchio, called in a loop": loop(pin.computeABADerivatives)}
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
        import mujoco

        model = mujoco.MjModel.from_xml_string(ET.tostring(bare(self.path), encoding="unicode"))
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
            for name, call in peer(task).items():
                try:
                    call()
                except Exception as error:
                    print(f"{name} cannot do {task} on {self.robot.name}, batch {self.batch}: {error}", file=sys.stderr)
                    continue
                contenders[name] = call
        rows = []
        dtype = str(self.q.dtype).removeprefix("torch.")
        for name, time_of_one in timed(contenders, self.batch, seconds).items():
            case = (self.robot.name, self.robot.n, task, dtype, self.batch, self.threads)
            rows.append(Row(*case, name, time_of_one, first.get(name)))
        return rows


# --- summary ---------------------------------------------------------------------------------------------------------

FRESH = """
import time, torch, torchdq
torch.set_num_threads(1)
{setup}
start = time.perf_counter()
{work}
print(time.perf_counter() - start)
"""
# peak of the resident memory over what it was before the inputs, the kernels being loaded already
MEMORY = """
def resident(key):
    return int(next(l for l in open("/proc/self/status") if l.startswith(key)).split()[1]) / 1024
def work(batch):
    x = [torch.ones(batch, 7, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    y = torchdq.DQRNEA(robot)(*x)
    y.backward(torch.ones_like(y))
work(10)
open("/proc/self/clear_refs", "w").write("5")
before = resident("VmRSS")
work({batch})
print(resident("VmHWM") - before)
"""
CHAIN = f"""
import sys
sys.path.append({str(Path(__file__).parent)!r})
from accuracy.scenes import chain
robot = chain(36)
"""


def fresh(setup: str, work: str, cache: str) -> float:
    """Number that a process of its own prints last: by default the seconds of the work, after its set-up."""
    code = FRESH.format(setup=setup, work=work)
    environment = {**os.environ, "TORCHDQ_CACHE": cache}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[0])


def first_calls(setup: str, gradient: bool, modules: Sequence[str] = ("DQRNEA",)) -> tuple[float, float]:
    """First call [s] in a fresh process, with an empty cache and with a full one; imports and loading excluded."""
    setup += f"\nx = [torch.zeros(4, robot.n, dtype=torch.float64, requires_grad={gradient}) for _ in range(3)]"
    backward = ".sum().backward()" if gradient else ""
    work = "\n".join(f"torchdq.{module}(robot)(*x){backward}" for module in modules)
    with tempfile.TemporaryDirectory() as cache:
        return fresh(setup, work, cache), fresh(setup, work, cache)


COMPARED = (
    ("inverse dynamics", Task.pinocchio),
    ("inverse dynamics, forward + backward", Task.pinocchio),
    ("forward dynamics", Task.pinocchio),
    ("dynamics jacobian", Task.pinocchio),
    ("forward kinematics", Task.pytorch_kinematics),
)


def comparisons(arm: Path, seconds: float) -> list[report.Comparison]:
    """Rows of the page on prices with other packages: one thread, batch 4096, seven joints, float64."""
    case = Task(arm, 4096, torch.float64, 1)
    rows = []
    for task, peers in COMPARED:
        for package, other in peers(case, task).items():
            times = timed({"ours": case.torchdq(task, "c"), package: other}, 4096, seconds)
            rows.append(report.Comparison(task, times["ours"], times[package], package))
    return rows


def summary(arm: Path, seconds: float) -> list[report.Line]:
    """Rows of the page on prices without other packages: batch 4096, seven joints, float64 unless stated."""
    case = Task(arm, 4096, torch.float64, 1)
    single = Task(arm, 4096, torch.float32, 1)
    lines: list[report.Line] = []

    for task in ("inverse dynamics", "forward dynamics"):
        calls = {"double": case.torchdq(task, "c"), "single": single.torchdq(task, "c")}
        times = timed(calls, 4096, seconds)
        lines.append((f"{task}, float32 against float64", f"{times['double'] / times['single']:.2f} x"))

    large = Task(arm, 65536, torch.float64, 1)
    call = large.torchdq("inverse dynamics", "c")

    def with_threads(number: int) -> Callable:
        def run() -> None:
            torch.set_num_threads(number)
            call()

        return run

    # least times by the clock: where another program has the second core, both threads share the first
    times = timed({"one": with_threads(1), "two": with_threads(2)}, 65536, 4 * seconds, time.perf_counter)
    torch.set_num_threads(1)
    lines.append(("inverse dynamics, two threads against one, batch 65536", f"{times['one'] / times['two']:.2f} x"))

    per_joint = {}
    for n in (7, 14, 28, 42):
        layer = torchdq.DQRNEA(chain(n))
        x = torch.randn(3, 4096, n, dtype=torch.float64)
        per_joint[n] = timed({"ours": lambda layer=layer, x=x: layer(*x)}, 4096, 0.5 * seconds)["ours"] / n
    shown = ", ".join(f"{t:.1f} ns at n = {n}" for n, t in per_joint.items())
    spread = max(per_joint.values()) / min(per_joint.values())
    lines.append(
        ("inverse dynamics of a general chain, time per joint, longest over shortest", f"{spread:.2f} x ({shown})")
    )

    load = f"robot = torchdq.Robot.from_urdf({str(arm)!r}, on_unphysical='ignore')"
    plain, warm = first_calls(load, False)
    both, warm_both = first_calls(load, True)
    long, _ = first_calls(CHAIN, True, ("DQRNEA", "ForwardDynamics"))
    lines.append(("first call, empty cache, inverse dynamics", f"{plain:.2f} s"))
    lines.append(("first call, empty cache, inverse dynamics with gradient", f"{both:.2f} s"))
    lines.append(("first call, empty cache, 36-joint chain, both dynamics with gradients", f"{long:.1f} s"))
    lines.append(("first call, full cache", f"{1e3 * warm:.0f} ms, with gradient {1e3 * warm_both:.0f} ms"))

    batch = 1_000_000
    with tempfile.TemporaryDirectory() as cache:
        peak = fresh(load + MEMORY.format(batch=batch), "", cache)
    needed = (3 + 1 + 1 + 3) * 7 * 8 * batch / 2**20
    lines.append(
        (
            "memory of forward + backward, batch 1e6",
            f"{peak:.0f} MB, of which inputs, output and gradients {needed:.0f} MB",
        )
    )
    return lines


def table(rows: list[Row]) -> str:
    """Rows as text, with the ratio of every contender to compiled torchdq."""
    lines = ["| robot | task | precision | batch | threads | system | ns per sample | against torchdq c |"]
    lines.append("|" + "---|" * 8)
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
            f"{row.nanoseconds:.1f} | {ratio} |"
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
    parser = report.parser(__doc__, quick="only the table of the page")
    parser.add_argument("--threads", type=int, default=1, help="for the rows of all contenders")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    arm = urdf("example-robot-data", "xarm7.urdf")
    seconds = 0.5 if arguments.quick else SECONDS
    compared, lines = comparisons(arm, seconds), summary(arm, seconds)
    text = report.comparison("xArm7", compared)
    text += "\n\n" + report.table("torchdq alone", lines)
    print(text)
    rows: list[Row] = []
    if not arguments.quick:
        torch.set_num_threads(arguments.threads)
        for path in (arm, urdf("example-robot-data", "ur5_robot.urdf")):
            for dtype in (torch.float64, torch.float32):
                for batch in (1, 64, 4096, 65536):
                    case = Task(path, batch, dtype, arguments.threads)
                    for task in TASKS:
                        rows += case.rows(task, 0.3, ("c", "eager") if batch <= 4096 else ("c",))
        print("\n" + table(rows))
    report.finish(
        arguments, __file__, text, report.machine(), compared=compared, lines=lines, rows=[asdict(row) for row in rows]
    )
    front_page.follow(arguments)


if __name__ == "__main__":
    main()
