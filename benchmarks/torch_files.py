"""Files of torch.export, ONNX and AOTInductor: seconds to make, time per sample, and difference from the C backend.

    python benchmarks/torch_files.py [--quick] [--json FILE] [--page]

A seven-joint arm, its inverse dynamics and a residual network on top of them, on one thread. The calls of one layer
take turns. ONNX files need the packages onnx, onnxscript and onnxruntime, and AOTInductor a C++ compiler.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import report
import torch
from torch import Tensor, nn

import torchdq

VECTORS = {"cpp.enable_tiling_heuristics": False}  # torch's default leaves strided rows without vector instructions
Layer = Callable[..., Tensor]


@dataclass
class Row:
    """A layer, made and called in one way."""

    layer: str
    dtype: str
    way: str
    seconds: float  # to make the file
    one: float  # time of a call with one sample [us]
    many: float  # time per sample in a batch of 4096 [ns]
    difference: float  # largest, relative to the largest torque


def onnx_file(graph: torch.export.ExportedProgram, path: Path) -> Layer:
    """Layer of an ONNX file, called by onnxruntime."""
    import onnxruntime  # here, so that --help needs no more than the other benchmarks

    torch.onnx.export(graph, dynamo=True, verbose=False).save(path)  # type: ignore[union-attr]
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(path, options)
    names = [given.name for given in session.get_inputs()]
    return lambda *x: torch.from_numpy(session.run(None, dict(zip(names, (y.numpy() for y in x), strict=True)))[0])


def package(graph: torch.export.ExportedProgram, path: Path) -> Layer:
    """Layer of an AOTInductor package."""
    torch._inductor.aoti_compile_and_package(graph, package_path=str(path), inductor_configs=VECTORS)
    return torch._inductor.aoti_load_package(str(path))


def rows(name: str, layer: nn.Module, dtype: torch.dtype, n: int, folder: Path, seconds: float) -> list[Row]:
    """The layer in every way."""
    given = tuple(torch.randn(3, 8, n, dtype=dtype))
    batch = torch.export.Dim("batch")

    def eager(*x: Tensor) -> Tensor:
        with torchdq.backend("eager"):
            return layer(*x)

    begin = time.perf_counter()
    graph = torch.export.export(layer, given, dynamic_shapes=({0: batch},) * 3)
    exported = time.perf_counter() - begin
    calls: dict[str, tuple[Layer, float]] = {"C backend": (layer, 0.0), "torch operations": (eager, 0.0)}
    calls["torch.export"] = graph.module(), exported
    for way, make, file in (("ONNX", onnx_file, "layer.onnx"), ("AOTInductor", package, "layer.pt2")):
        begin = time.perf_counter()
        made = make(graph, folder / file)
        calls[way] = made, exported + time.perf_counter() - begin
    times = []
    for size in (1, 4096):
        x = tuple(torch.randn(3, size, n, dtype=dtype))
        ways = {way: (lambda call=call, x=x: call(*x), size) for way, (call, _) in calls.items()}
        times.append(report.least(ways, 5, seconds * len(ways), shortest=0.01).values())
    expected = layer(*x)
    return [
        Row(name, str(dtype).removeprefix("torch."), way, made, one / 1e3, many, float(error))
        for (way, (call, made)), one, many in zip(calls.items(), *times, strict=True)
        for error in [(call(*x) - expected).abs().max() / expected.abs().max()]
    ]


def table(found: list[Row]) -> str:
    """Rows as a table."""
    lines = [
        f"| {row.layer}, {row.dtype} | {row.way} | {row.seconds:.0f} s | {row.one:.0f} us | {row.many:.0f} ns "
        f"| {row.difference:.0e} |"
        for row in found
    ]
    head = "| layer | called by | to make | one sample | per sample of 4096 | difference |\n|---|---|---|---|---|---|"
    return "\n".join([head, *lines])


def main() -> None:
    """Measure and print."""
    arguments = report.parser(__doc__ or "", "two joints, short measurements").parse_args()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    robot = torchdq.robots.load("two_link" if arguments.quick else "panda")
    residual = torchdq.ResidualDynamics(torchdq.DQRNEA(robot, learn="friction"))
    for weights in residual.network.parameters():
        nn.init.normal_(weights, std=0.1)
    found: list[Row] = []
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        for name, layer, dtype in (
            ("inverse dynamics", torchdq.DQRNEA(robot), torch.float64),
            ("inverse dynamics", torchdq.DQRNEA(robot), torch.float32),
            ("with residual network", residual, torch.float32),
        ):
            found += rows(name, layer, dtype, robot.n, Path(folder), 0.2 if arguments.quick else 2.0)
            print(table(found[-5:]))
    facts = report.machine("onnxruntime")
    report.finish(arguments, __file__, table(found), facts, rows=[asdict(row) for row in found])


if __name__ == "__main__":
    main()
