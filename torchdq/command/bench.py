"""Command `bench`: speed of a robot's functions on this machine."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from torchdq.base import machine
from torchdq.command.command import Dtype, RobotCommand
from torchdq.command.outcome import Grid, Outcome
from torchdq.command.reports.speed import BATCHES, speeds
from torchdq.errors import ArgumentError


@dataclass(kw_only=True)
class BenchCommand(RobotCommand):
    """Nanoseconds per sample of the main functions: one call, and batches.

    Example: torchdq bench panda --batches 1 4096 --threads 1
    """

    batches: tuple[int, ...] = BATCHES
    """Samples in a call."""
    dtype: Dtype = "float64"
    """Dtype of the samples."""
    threads: int | None = None
    """Threads of large batches; by default as many as torch uses."""
    seconds: float = 0.2
    """Time of measuring each function at each batch."""

    def outcome(self) -> Outcome:
        """Table of times."""
        if not self.batches or min(self.batches) < 1:
            raise ArgumentError(f"batches must be whole numbers from 1, found {list(self.batches)}")
        if self.threads is not None and self.threads < 1:
            raise ArgumentError(f"threads must be a whole number from 1, found {self.threads}")
        robot, before = self.load().robot, torch.get_num_threads()
        threads = before if self.threads is None else self.threads
        torch.set_num_threads(threads)
        try:
            found = speeds(robot, self.batches, self.dtype, self.seconds)
        finally:
            torch.set_num_threads(before)
        cells = {(one.function, one.batch): f"{one.nanoseconds:.1f} +- {one.spread:.1f}" for one in found}
        names = list(dict.fromkeys(one.function for one in found))
        header = ("function", *("one call" if batch == 1 else f"{batch} samples" for batch in self.batches))
        on = f"{self.dtype}, {threads} thread{'s' * (threads != 1)}; {machine.words()}"
        text = (
            f"{robot.name}: time per sample [ns], median and half of the middle half of the measurements",
            Grid(header, [(name, *(cells[name, batch] for batch in self.batches)) for name in names]),
            on,
        )
        data = {
            "robot": robot.name,
            "machine": machine.words(),
            "threads": threads,
            "dtype": self.dtype,
            "unit": "ns per sample",
            "speeds": [one._asdict() for one in found],
        }
        return Outcome(text, data)
