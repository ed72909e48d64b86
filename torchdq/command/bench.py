"""Command `bench`: speed of a robot's compiled functions on this machine, for one sample and for batches."""

import statistics
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from torchdq.base import machine
from torchdq.base.checks import require_count, require_number
from torchdq.base.progress import Progress
from torchdq.base.timing import duration, measure
from torchdq.command.command import Dtype, RobotCommand
from torchdq.command.outcome import Grid, Outcome
from torchdq.errors import SingularInertiaError
from torchdq.functions.catalogue import FLOATING
from torchdq.functions.compile import CompiledProgram, compile
from torchdq.robot import Robot

# names of the functions, and of a derivative of one
MEASURED = ("inverse_dynamics", "forward_dynamics", "mass_matrix", "regressor")
GRADIENT = "gradient of inverse_dynamics"
POSE = "X_WB"
NOISY = (
    "noisy: half of the interquartile range exceeds half of the time; other programs run here, or --seconds is short"
)


@dataclass(kw_only=True)
class BenchCommand(RobotCommand):
    """Nanoseconds per sample of the main functions: one call, and batches.

    Example: torchdq bench panda --batches 1 4096 --threads 1
    """

    batches: tuple[int, ...] = (1, 64, 4096)
    """Samples in a call."""
    dtype: Dtype = "float64"
    """Dtype of the samples."""
    threads: int | None = None
    """Threads of large batches; by default as many as torch uses."""
    seconds: float = 0.2
    """Time of measuring each function at each batch."""

    def outcome(self) -> Outcome:
        """Table of times."""
        before = torch.get_num_threads()
        threads = before if self.threads is None else self.threads
        for name, count in (*(("batches", batch) for batch in self.batches), ("threads", threads)):
            require_count(name, count)
        require_number("seconds", self.seconds, least=0)
        robot = self.load().robot
        torch.set_num_threads(threads)
        try:
            found = self._measured(robot)
        finally:
            torch.set_num_threads(before)
        header = ("function", *("one call" if batch == 1 else f"{batch} samples" for batch in self.batches))
        rows = {name: [name] for name, *_ in found}
        for name, _, middle, spread in found:
            rows[name].append(duration(middle, spread))
        text = (
            f"{robot.name}: time per sample, median +- half of the interquartile range",
            Grid(header, [*rows.values()]),
            *((NOISY,) if any(cell.endswith("noisy") for row in rows.values() for cell in row) else ()),
            f"{self.dtype}, {threads} thread{'s' * (threads != 1)}; {machine.words()}",
        )
        data = {
            "robot": robot.name,
            "machine": machine.words(),
            "threads": threads,
            "dtype": self.dtype,
            "unit": "ns per sample",
            "speeds": [dict(zip(("function", "batch", "nanoseconds", "spread"), row, strict=True)) for row in found],
        }
        return Outcome(text, data)

    def _measured(self, robot: Robot) -> list[tuple[str, int, float, float]]:
        """Function, batch, median time per sample and half of the range of the middle half [ns]."""
        with Progress(f"measuring the speed of {robot.name!r}") as progress:
            programs = {}
            for name in MEASURED:
                progress.at(f"compiling {name}")
                try:
                    programs[name] = compile(robot.bake(), FLOATING + name if robot.floating else name, self.dtype)
                except SingularInertiaError:  # a joint moves no inertia
                    continue
            progress.at("compiling the gradient")
            programs[GRADIENT] = programs[MEASURED[0]].vjp()
            found = []
            for batch in self.batches:
                progress.at(f"{batch} samples in a call")
                calls: dict[str, Callable[[], object]] = {
                    name: partial(program, *_inputs(program, batch)) for name, program in programs.items()
                }
                for name, times in measure(calls, batch, self.seconds).items():
                    lower, middle, upper = statistics.quantiles(times, n=4, method="inclusive")
                    found.append((name, batch, middle, (upper - lower) / 2))
        return found


def _inputs(program: CompiledProgram, batch: int) -> list[Tensor]:
    """Random arguments of a program; poses are at the origin."""
    generator = torch.Generator().manual_seed(0)
    found = []
    for argument in program.program.arguments:
        shape = (argument.width,) if batch == 1 else (batch, argument.width)
        x = torch.rand(shape, generator=generator, dtype=program.dtype)
        if argument.name == POSE:
            x = torch.eye(1, argument.width, dtype=program.dtype)[0].expand(shape).contiguous()
        found.append(x)
    return found
