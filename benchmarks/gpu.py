"""Speed on a GPU: samples per second of functions and environment steps, beside the bound that the machine sets.

    python benchmarks/gpu.py [--quick] [--json FILE] [--page] [--device cuda]

With a GPU: measured times over batch sizes, of compiled programs, of torch operations, of CUDA graphs and of other
packages (`gpu_peers`), against the bound that follows from a copy measured in the same run. Without one: bounds
computed from the compiled kernels, for an H200. The bound is the least of two: memory that must be moved over the speed
of a copy, and machine instructions over the speed at which they are issued. Instructions are counted in the disassembly
(`pip install nvidia-cuda-nvdisasm`).
"""

from __future__ import annotations

import re
import shutil
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import gpu_peers
import report
import torch
from accuracy.scenes import chain

import torchdq
from torchdq.backends import nvrtc
from torchdq.backends.cuda_source import source
from torchdq.base.timing import measure
from torchdq.envs import RobotVectorEnv
from torchdq.envs.tasks import Checked
from torchdq.program.autograd import vjp
from torchdq.program.program import Program

# NVIDIA H200 SXM: bytes per second of a copy, multiprocessors, lanes of each, clock [Hz]; data sheet and its whitepaper
COPY, MULTIPROCESSORS, LANES, CLOCK = 4.26e12, 132, 128, 1.98e9
ARCHITECTURE = 90
RARE = "if(!(x<=LARGEST&&x>=-LARGEST))y=rare(x);"  # angles beyond 4000 rad (1e5 in float64)
TAIL = "samples-first<BLOCK?(int)(samples-first):BLOCK"  # threads of the last block


def programs() -> dict[str, list[Program]]:
    """Programs by task; those of a task run one after the other."""
    panda = torchdq.robots.load("panda")
    dynamics, forward = (torchdq.compile(panda, f).program for f in ("inverse_dynamics", "forward_dynamics"))
    envs = RobotVectorEnv(2, "reach", "panda", action="torque")
    step = envs.scene.program("torque", *envs.task.inputs(envs.scene.n), task=Checked(envs.task))
    return {
        "inverse dynamics": [dynamics],
        "its forward + backward": [dynamics, vjp(dynamics, (0, 1, 2))],
        "forward dynamics": [forward],
        "forward dynamics, forward + backward": [forward, vjp(forward, (0, 1, 2))],
        "dynamics jacobian": [torchdq.compile(panda, "inverse_dynamics_jacobian").program],
        "Reach step": [step],
        "inverse dynamics, 32 joints": [torchdq.compile(chain(32), "inverse_dynamics").program],
    }


# --- without a GPU ---------------------------------------------------------------------------------------------------


def width(program: Program) -> int:
    """Numbers that a sample reads and writes."""
    return sum(a.width for a in program.arguments if not a.uniform) + sum(len(r.values) for r in program.results)


def disassembler() -> str | None:
    """Path of nvdisasm, from its wheel or a toolkit."""
    here = [path for folder in sys.path for path in Path(folder).glob("nvidia/*/bin/nvdisasm")]
    return next(map(str, here), None) or shutil.which("nvdisasm")


def instructions(code: bytes, tool: str) -> tuple[int, int]:
    """Machine instructions of a full block's thread, up to the first exit, and those among them in double precision."""
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(code)
        file.flush()
        listing = subprocess.run([tool, "-c", file.name], capture_output=True, text=True, check=True).stdout
    found = re.findall(r"/\*[0-9a-f]{4,}\*/\s+(@!?U?P\w+\s+)?([A-Z0-9_.]+)", listing)
    last = next(k for k, (guard, name) in enumerate(found) if name == "EXIT" and not guard)
    path = [name for _, name in found[: last + 1] if name != "NOP"]
    return len(path), sum(name.startswith(("DFMA", "DADD", "DMUL", "DSETP")) for name in path)


@dataclass
class Computed:
    """Compiled kernels of a task, and the bound they set."""

    task: str
    dtype: str
    registers: list[int]
    spilled: list[int]  # bytes
    instructions: list[int]
    bytes: int
    bound: float  # samples per second
    limit: str


def computed(task: str, several: list[Program], single: bool, compiler: nvrtc.Nvrtc, tool: str | None) -> Computed:
    """Bound of the programs of a task, compiled without a GPU."""
    size, time, slowest = 4 if single else 8, 0.0, ""
    registers, spilled, counts = [], [], []
    for program in several:
        text = source(program, single)
        built = compiler.compile(text, program.name, ARCHITECTURE)
        registers.append(built.registers)
        spilled.append(built.spilled)
        times = {"memory": size * width(program) / COPY}
        if tool is not None:
            full = text.replace(RARE, "").replace(TAIL, "BLOCK")
            path, doubles = instructions(compiler.compile(full, program.name, ARCHITECTURE).code, tool)
            counts.append(path)
            issued = MULTIPROCESSORS * LANES * CLOCK
            times |= {"instructions": path / issued, "double precision": 2 * doubles / issued}
        slowest = max(times, key=times.__getitem__)
        time += times[slowest]
    moved = size * sum(map(width, several))
    return Computed(task, "float32" if single else "float64", registers, spilled, counts, moved, 1 / time, slowest)


def computed_table(quick: bool) -> tuple[str, list[Computed]]:
    """Bounds of all tasks as a table."""
    compiler, tool = nvrtc.found(), disassembler()
    if isinstance(compiler, str):
        raise SystemExit(compiler)
    rows = []
    for task, several in programs().items():
        for single in (True,) if quick else (True, False):
            rows.append(computed(task, several, single, compiler, tool))
            print(rows[-1], flush=True)
    lines = [
        "| H200, computed, not yet measured | precision | registers | spilled [B] | instructions | at most [1e9/s] |",
        "|" + "---|" * 6,
    ]
    for row in rows:
        numbers = (" + ".join(map(str, x)) or "-" for x in (row.registers, row.spilled, row.instructions))
        lines.append(f"| {row.task} | {row.dtype} | {' | '.join(numbers)} | {row.bound / 1e9:.1f} ({row.limit}) |")
    return "\n".join(lines), rows


# --- with a GPU ------------------------------------------------------------------------------------------------------


@dataclass
class Measured:
    """Times of one task."""

    task: str
    dtype: str
    batch: int
    backend: str
    nanoseconds: float  # per sample, median
    low: float  # 10 % and 90 % of the repeats
    high: float


def waited(call: Callable[[], object], device: torch.device, repeats: int) -> Callable[[], object]:
    """Call that is repeated and ends when the device has finished."""

    def run() -> None:
        for _ in range(repeats):
            call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    return run


def calls(batch: int, dtype: torch.dtype, device: torch.device, backend: str) -> dict[str, Callable[[], object]]:
    """Tasks as calls."""
    panda, long = torchdq.robots.load("panda").to(device), chain(32).to(device)
    x = torch.randn(3, batch, 7, dtype=dtype, device=device)
    y = torch.randn(3, batch, 32, dtype=dtype, device=device)
    with_gradient = [v.clone().requires_grad_() for v in x]

    def both(function: Callable) -> Callable[[], object]:
        def run() -> object:
            return torch.autograd.grad(function(panda, *with_gradient, backend=backend).sum(), with_gradient)

        return run

    found: dict[str, Callable[[], object]] = {
        "inverse dynamics": lambda: torchdq.inverse_dynamics(panda, *x, backend=backend),
        "its forward + backward": both(torchdq.inverse_dynamics),
        "forward dynamics": lambda: torchdq.forward_dynamics(panda, *x, backend=backend),
        "forward dynamics, forward + backward": both(torchdq.forward_dynamics),
        "dynamics jacobian": lambda: torchdq.dynamics_jacobian(panda, *x, backend=backend),
        "inverse dynamics, 32 joints": lambda: torchdq.inverse_dynamics(long, *y, backend=backend),
    }
    envs = RobotVectorEnv(batch, "reach", "panda", action="torque", dtype=dtype, device=device, output="torch")
    envs.reset(seed=0)
    actions = torch.zeros(batch, 7, dtype=dtype, device=device)

    def step() -> object:
        with torchdq.backend(backend):  # type: ignore[arg-type]
            return envs.step(actions)

    found["Reach environment step"] = step
    if device.type == "cuda" and backend != "eager":
        for task in ("inverse dynamics", "Reach environment step"):
            found[task + ", in a graph"] = in_a_graph(found[task])
    return found


def in_a_graph(call: Callable[[], object]) -> Callable[[], object]:
    """Call as a CUDA graph that repeats it."""
    call()  # compiles
    torch.cuda.synchronize()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        call()
    return graph.replay


def measured(device: torch.device, quick: bool) -> list[Measured]:
    """Times of all tasks over batch sizes."""
    rows = []
    batches = (4096, 65536) if quick else (1, 64, 4096, 65536, 1_000_000, 4_000_000)
    compiled = "cuda" if device.type == "cuda" else "c"
    for dtype in (torch.float32, torch.float64):
        for batch in batches:
            for backend in (compiled, "eager") if batch <= 65536 else (compiled,):
                for task, call in calls(batch, dtype, device, backend).items():
                    repeats = 20 if batch <= 65536 else 3
                    times = measure({task: waited(call, device, repeats)}, batch * repeats, 0.2)[task]
                    middle, low, high = report.spread(times)
                    rows.append(Measured(task, str(dtype), batch, backend, middle, low, high))
                    print(rows[-1], flush=True)
    return rows


def measured_peers(device: torch.device, quick: bool) -> list[Measured]:
    """Times of other packages, in float32."""
    rows = []
    for batch in (4096, 65536) if quick else (4096, 65536, 1_000_000):
        for package, tasks in gpu_peers.calls(batch, device).items():
            for task, call in tasks.items():
                # an own stream of theirs, so the whole device is waited for
                times = measure({task: waited(call, device, 20)}, batch * 20, 0.2)[task]
                rows.append(Measured(task, "torch.float32", batch, package, *report.spread(times)))
                print(rows[-1], flush=True)
    return rows


def copy_speed(device: torch.device) -> float:
    """Bytes per second that a copy reads and writes."""
    x = torch.empty(2**28, dtype=torch.uint8, device=device)
    y = torch.empty_like(x)
    times = measure({"copy": waited(lambda: y.copy_(x), device, 5)}, 5, 1.0)["copy"]
    return 2 * x.numel() / (statistics.median(times) * 1e-9)


def measured_table(rows: list[Measured], copy: float, name: str) -> str:
    """Largest speeds of all tasks as a table."""
    lines = [f"| {name}, copy {copy / 1e12:.2f} TB/s | precision | batch | 1e9 samples/s |"]
    lines.append("|" + "---|" * 4)
    for task, dtype in dict.fromkeys((row.task, row.dtype) for row in rows):
        best = min(
            (r for r in rows if (r.task, r.dtype) == (task, dtype) and r.backend != "eager"),
            key=lambda r: r.nanoseconds,
        )
        lines.append(f"| {task} | {dtype[6:]} | {best.batch} | {1 / best.nanoseconds:.3g} |")
    return "\n".join(lines)


def main() -> None:
    parser = report.parser(__doc__, quick="bounds in float32 alone; fewer batch sizes")
    parser.add_argument("--device", help="device of the measurements; without a GPU, bounds are computed instead")
    arguments = parser.parse_args()
    facts, how = report.machine(), "Measured on"
    if arguments.device is None and not torch.cuda.is_available():
        text, rows = computed_table(arguments.quick)
        version = ".".join(map(str, nvrtc.found().version))  # type: ignore[union-attr]
        facts, how = {"compiler": f"NVRTC {version}", "architecture": f"sm_{ARCHITECTURE}"}, "Computed with"
        print(text)
    else:
        device = torch.device(arguments.device or "cuda")
        name = torch.cuda.get_device_name(device) if device.type == "cuda" else str(device)
        facts = {"device": name, **facts}
        rows = measured(device, arguments.quick)  # type: ignore[assignment]
        text = measured_table(rows, copy_speed(device), name)  # type: ignore[arg-type]
        if device.type == "cuda":
            peers = measured_peers(device, arguments.quick)
            rows += peers  # type: ignore[arg-type]
            best = (f"{p.backend}, {p.task}, batch {p.batch}: {1 / p.nanoseconds:.3g}e9/s" for p in peers)
            text = "\n\n".join([text, "\n".join([*map(gpu_peers.present, gpu_peers.PACKAGES), *best])])
        print(text)
    report.finish(arguments, __file__, text, facts, how, rows=[asdict(row) for row in rows])


if __name__ == "__main__":
    main()
