"""Pushes: wrenches on a robot at random times, as inputs of an `effects.Push`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import is_number
from torchdq.dynamics.posed import Row
from torchdq.envs.rng import ranged
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import at_least, select

DRAWS = 7  # random numbers of a push
WIDTH = 8  # numbers of a push: its wrench, and the times at which it begins and ends, or after which it does


@dataclass(frozen=True)
class Pushes:
    """Pushes of random wrenches at random times, each as long as the others.

    Args:
        wrench: largest force and moment along each axis [N, N m], 6 numbers; each component is drawn evenly from minus
            to plus that.
        every: shortest and longest time from the start of the episode, or the end of a push, to the next one [s].
        duration: of a push [s].

    >>> from torchdq import effects
    >>> from torchdq.envs import RobotVectorEnv, Pushes
    >>> pushed = {"push": Pushes((20.0, 20.0, 0.0, 0.0, 0.0, 0.0), every=(0.5, 2.0))}
    >>> envs = RobotVectorEnv(
    ...     64, "reach", "panda", effects=(effects.Gravity(), effects.Push()), pushes=pushed
    ... )
    """

    wrench: Sequence[float]
    every: tuple[float, float] = (3.0, 8.0)
    duration: float = 0.1

    def __post_init__(self) -> None:
        rows = {"wrench": (self.wrench, 6), "every": (self.every, 2), "duration": ((self.duration,), 1)}
        for name, (row, width) in rows.items():
            if not (isinstance(row, Sequence) and len(row) == width and all(is_number(x) and x >= 0 for x in row)):
                raise ArgumentError(f"{name} of Pushes must be {width} numbers from 0, found {getattr(self, name)!r}")
        if not (self.every[0] <= self.every[1] and self.duration > 0):
            raise ArgumentError(f"every of Pushes must be (shortest, longest), and duration above 0, found {self}")

    def drawn(self, u: Tensor) -> Tensor:
        """Wrench of a push, and times to its begin and end [k, 8], of random numbers [k, 7]."""
        push = ranged(u, [*((-size, size) for size in self.wrench), self.every])
        return torch.cat([push, push[:, 6:] + self.duration], 1)


def pushed(time: Number, push: Row, following: Row) -> tuple[Row, Row, Number]:
    """Wrench at a time, next push, and whether that is `following`, which is then taken."""
    over = at_least(time, push[7])
    taken = [*following[:6], *(x + time for x in following[6:])]
    push = [select(over, a, b) for a, b in zip(taken, push, strict=True)]
    acts = at_least(time, push[6])
    return [select(acts, x, 0.0) for x in push[:6]], push, over
