"""Speed of the compiled functions of a robot on this machine, for one sample and for batches."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import dtype_of, require_count, require_number
from torchdq.base.progress import Progress
from torchdq.base.timing import measure
from torchdq.errors import SingularInertiaError
from torchdq.functions.catalogue import FLOATING
from torchdq.functions.compile import CompiledProgram, compile
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot

# names of the functions, and of a derivative of one
MEASURED = ("inverse_dynamics", "forward_dynamics", "mass_matrix", "regressor")
GRADIENT = "gradient of inverse_dynamics"
BATCHES = (1, 64, 4096)
POSE = "X_WB"


class Speed(NamedTuple):
    """Time of a function per sample."""

    function: str
    batch: int  # samples in a call; 1: rows without batch axes
    nanoseconds: float  # median
    spread: float  # half of the range of the middle half of the measurements [ns]


def speeds(
    robot: Robot,
    batches: Sequence[int] = BATCHES,
    dtype: torch.dtype | str = torch.float64,
    seconds: float = 0.2,
) -> list[Speed]:
    """Times of the main functions, compiled for a robot, on torch's present number of threads.

    Forward dynamics of a robot with a joint that moves no inertia is left out.

    Args:
        robot: the robot.
        batches: samples in a call.
        dtype: dtype of the samples.
        seconds: time of measuring each function at each batch [s].

    >>> import torchdq
    >>> found = speeds(torchdq.robots.load("two_link"), batches=(64,), seconds=0.0)
    >>> found[0].function, found[0].batch, found[0].nanoseconds > 0
    ('inverse_dynamics', 64, True)
    """
    require_robot(robot)
    for batch in batches:
        require_count("batches", batch)
    require_number("seconds", seconds, least=0)
    dtype = dtype_of("dtype", dtype)
    with Progress(f"measuring the speed of {robot.name!r}") as progress:
        programs = _programs(robot.bake(), dtype, progress.at)
        found = []
        for batch in batches:
            progress.at(f"{batch} samples in a call")
            calls: dict[str, Callable[[], object]] = {
                name: partial(program, *_inputs(program, batch)) for name, program in programs.items()
            }
            for name, times in measure(calls, batch, seconds).items():
                lower, middle, upper = statistics.quantiles(times, n=4, method="inclusive")
                found.append(Speed(name, batch, middle, (upper - lower) / 2))
    return found


def _programs(robot: Robot, dtype: torch.dtype, say: Callable[[str], None]) -> dict[str, CompiledProgram]:
    """Compiled programs by name."""
    programs = {}
    for name in MEASURED:
        say(f"compiling {name}")
        try:
            programs[name] = compile(robot, f"{FLOATING}{name}" if robot.floating else name, dtype)
        except SingularInertiaError:
            continue
    say("compiling the gradient")
    programs[GRADIENT] = programs[MEASURED[0]].vjp()
    return programs


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
