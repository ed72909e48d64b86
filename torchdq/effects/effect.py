"""Base of all effects: a small frozen object that belongs to one slot of a scene and defines its contribution.

Its parameters are those of `Parametric`. The methods of an effect are written for any kind of number: while a scene is
recorded, tensors are rows of recorded numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import Interval
from torchdq.dynamics.posed import Row
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import Parameter, Parametric
from torchdq.functions.signature import option
from torchdq.objects import Object
from torchdq.robot import Robot

Inputs = Mapping[str, Row]  # inputs of a step by name
BUFFER = "a longer delay needs longer time steps, or a buffer outside the scene"
MOST_LATE = 500  # steps of a delay, each a row in the program; its compile time is then half a minute


@dataclass(frozen=True)
class Effect(Parametric):
    """One physical effect of a scene."""

    SLOT: ClassVar[str]  # "model", "joint", "body", "actuator" or "sensor"
    ONCE: ClassVar[str] = ""  # reason why a scene has it at most once; "": it may be repeated
    SOLE: ClassVar[Mapping[str, str]] = {}  # attributes of the description reserved for this effect, and why
    SHARED: ClassVar[frozenset[str]] = frozenset()  # inputs that it shares with others
    SCALES: ClassVar[tuple[str, ...]] = ()  # parameters that friction randomisation scales together
    IMPLICIT: ClassVar[str] = ""  # reason why only linearly implicit steps hold it; "": all do

    def label(self) -> str:
        """Name in descriptions."""
        return type(self).__name__

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of its inputs at a step."""
        return {}

    def needs(self, n: int) -> tuple[str, ...]:
        """Names of the inputs that are required at every step."""
        return tuple(self.inputs(n))

    def computed(self, n: int) -> dict[str, int]:
        """Names and widths of the rows that the scene computes for it before a step."""
        return {}

    def noises(self, n: int) -> int:
        """Number of random numbers, uniform in (0, 1), that it uses at a step."""
        return 0

    def memory(self, n: int) -> int:
        """Number of its states."""
        return 0

    def among(self, robot: Robot, objects: Sequence[Object]) -> Self:
        """Copy for a scene of a robot and these objects."""
        return self

    def of_objects(self, objects: Sequence[Object]) -> Self:
        """Copy while it is recorded, beside these objects, all of whose parameters are numbers."""
        return self

    def of_rows(self, chosen: Callable[[Tensor, int], Tensor]) -> Self:
        """Copy with some rows of its tensors that are not parameters; `chosen` takes one and its trailing axes."""
        return self

    def free_range(self) -> tuple[Parameter, Parameter] | None:
        """Positions [n] below and above which it acts as a limit; None: it is not a limit."""
        return None

    def start(self, q: Row, qd: Row) -> Row:
        """Memory in the initial state."""
        return (0.0,) * self.memory(len(q))

    def outside(self) -> str:
        """Description of computations outside the program of a step; "": none."""
        return ""


@dataclass(frozen=True)
class Late(Effect):
    """Delay of a row of numbers by a whole number of steps.

    Args:
        steps: from 1 to 500.
    """

    PER_JOINT: ClassVar[int]  # numbers in a row for each joint
    steps: int = field(metadata=option(Interval(1, below=MOST_LATE + 1, whole=True, cure=BUFFER)))

    def memory(self, n: int) -> int:
        """Length of the delayed rows."""
        return self.steps * self.PER_JOINT * n

    def passed(self, row: Row, memory: Row) -> tuple[Row, Row]:
        """Row that arrives, and the remaining delayed rows."""
        return memory[: len(row)], (*memory[len(row) :], *row)


def unbounded(x: Number) -> bool:
    """True for an infinite constant: an absent limit."""
    return isinstance(x, float) and math.isinf(x)


def on_a_link(effect: Any, robot: Robot) -> Any:
    """Effect with the name of its frame, by default the end effector; the frame must be on a moving link."""
    frame = robot.end_effector() if effect.frame is None else robot.frame(effect.frame)
    if frame.link == BASE and not robot.floating:
        raise ArgumentError(f"frame of {type(effect).__name__} is {frame.name!r}, which is fixed to the base")
    return replace(effect, frame=frame.name)
