"""What an effect is: a small frozen object that belongs to one slot of a scene and says what it contributes.

An effect's parameters are numbers or tensors. A number becomes a constant of the scene's program. A tensor becomes an
argument of it, so that it may require gradients, change between steps, or differ from sample to sample (leading batch
axes) without recording anything anew. A parameter that is None is the one of the robot's description.

The methods of an effect are written for any kind of number: while a scene is recorded, its tensors are rows of
recorded numbers.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Any, ClassVar, Self

import torch
from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.robot import Robot
from torchdq.robot.robot import arguments

Parameter = Any  # a number, a sequence of numbers, a tensor, or None: as described; while recording: a row of numbers
Shapes = Mapping[str, tuple[int | str, ...]]  # trailing axes by name, "n" being the number of joints


class Varying:
    """Stands in the blueprint of a scene for a tensor, which is an argument of its programs."""

    def __repr__(self) -> str:
        return "varying"

    def __reduce__(self) -> str:
        return "VARYING"  # a copy is the same one, so that copies of scenes share their programs


VARYING = Varying()


@dataclass(frozen=True)
class Parametric:
    """Something with parameters that are constants or arguments of a scene's programs."""

    SHAPES: ClassVar[Shapes] = {}  # trailing axes of each parameter
    SIGNED: ClassVar[frozenset[str]] = frozenset()  # those that may be negative
    UNBOUNDED: ClassVar[frozenset[str]] = frozenset()  # those that may be infinite
    DIVIDING: ClassVar[frozenset[str]] = frozenset()  # those that must not be zero
    DESCRIBED: ClassVar[Mapping[str, str]] = {}  # what of a robot those are that are None

    def described(self, robot: Robot) -> Self:
        """The same with what is None taken from the robot's description."""
        missing = [name for name in self.DESCRIBED if getattr(self, name) is None]
        return replace(self, **{name: owned(robot, attrgetter(self.DESCRIBED[name])(robot)) for name in missing})

    def resolved(self, robot: Robot) -> Self:
        """The same for a robot: described, checked, every parameter a tuple of floats, a float, or a tensor."""
        whole = self.described(robot)
        return replace(whole, **{name: self._checked(name, getattr(whole, name), robot) for name in self.SHAPES})

    def _checked(self, name: str, value: Any, robot: Robot) -> Any:
        what = f"{name} of {type(self).__name__}"
        shape = tuple(robot.n if axis == "n" else int(axis) for axis in self.SHAPES[name])
        size = math.prod(shape)
        if value is None:
            raise ArgumentError(f"{what} must be given: the description of robot {robot.name!r} has none")
        if isinstance(value, Tensor):
            if not value.is_floating_point():
                raise ArgumentError(f"{what} must be a floating-point tensor, found {value.dtype}")
            if value.ndim < len(shape):
                value = value.expand(shape)
            if shape and value.shape[-1] not in (1, size):
                raise ArgumentError(f"{what} must have the shape [..., {size}], found {tuple(value.shape)}")
            return value.expand((*value.shape[: value.ndim - len(shape)], *shape))
        try:
            numbers = [float(x) for x in value] if isinstance(value, Sequence) else [float(value)] * size
        except (TypeError, ValueError) as error:
            raise ArgumentError(f"{what} must be a number, {size} numbers or a tensor, found {value!r}") from error
        if len(numbers) != size:
            raise ArgumentError(f"{what} must be one number or {size}, found {len(numbers)}")
        for x in numbers:
            if math.isnan(x) or (math.isinf(x) and name not in self.UNBOUNDED):
                raise ArgumentError(f"{what} must be finite, found {x}")
            if x < 0 and name not in self.SIGNED:
                raise ArgumentError(f"{what} must not be negative, found {x}")
            if x == 0 and name in self.DIVIDING:
                raise ArgumentError(f"{what} must be positive, found 0; it divides")
        return tuple(numbers) if shape else numbers[0]

    def tensors(self) -> dict[str, Tensor]:
        """Parameters that are arguments of the programs."""
        return {name: getattr(self, name) for name in self.SHAPES if isinstance(getattr(self, name), Tensor)}

    def blueprint(self) -> Self:
        """The same without its tensors: what a program depends on."""
        return replace(self, **dict.fromkeys(self.tensors(), VARYING))

    def bound(self, rows: Mapping[str, Sequence[Number]]) -> Self:
        """The same with rows of recorded numbers in the place of its tensors."""
        return replace(self, **{name: tuple(row) if self.SHAPES[name] else row[0] for name, row in rows.items()})


@dataclass(frozen=True)
class Effect(Parametric):
    """One thing that a scene simulates."""

    SLOT: ClassVar[str]  # "model", "joint", "body", "actuator" or "sensor"

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of what is given to it at a step."""
        return {}

    def needs(self, n: int) -> tuple[str, ...]:
        """Names of those inputs that have to be given at every step."""
        return tuple(self.inputs(n))

    def noises(self, n: int) -> int:
        """How many random numbers, uniform in (0, 1), it consumes at a step."""
        return 0

    def memory(self, n: int) -> int:
        """How many numbers it remembers from step to step."""
        return 0

    def start(self, q: Sequence[Number], qd: Sequence[Number]) -> Sequence[Number]:
        """What it remembers at the beginning."""
        return (0.0,) * self.memory(len(q))


@dataclass(frozen=True)
class Late(Effect):
    """An effect that hands a row of numbers on a whole number of steps late.

    Args:
        steps: at least 1.
    """

    PER_JOINT: ClassVar[int]  # numbers in a row for each joint
    steps: int

    def described(self, robot: Robot) -> Self:
        """The same, once its number of steps is known to be a positive whole one."""
        if not isinstance(self.steps, int) or self.steps < 1:
            raise ArgumentError(f"steps of {type(self).__name__} must be a whole number from 1, found {self.steps!r}")
        return self

    def memory(self, n: int) -> int:
        """The rows that are on their way."""
        return self.steps * self.PER_JOINT * n

    def passed(self, row: Sequence[Number], memory: Sequence[Number]) -> tuple[Sequence[Number], Sequence[Number]]:
        """The row that arrives, and what is on its way after it."""
        return memory[: len(row)], (*memory[len(row) :], *row)


def owned(robot: Robot, x: Tensor | None) -> Tensor | tuple[float, ...] | None:
    """A tensor of a robot's description as a parameter: numbers if it is a constant, or else the tensor itself."""
    if x is None:
        return None
    replaced = any(x is getattr(robot, name) for name in arguments(robot))
    if replaced or x.requires_grad or x.ndim > 1:
        return x
    return tuple(x.to(torch.float64).tolist())


def unbounded(x: Number) -> bool:
    """Whether a parameter is an infinite constant: no limit, which costs nothing."""
    return isinstance(x, float) and math.isinf(x)


def on_a_link(effect: Any, robot: Robot) -> Any:
    """The effect with its frame named, None being the end effector; the frame must be on a moving link."""
    frame = robot.end_effector() if effect.frame is None else robot.frame(effect.frame)
    if frame.link == BASE:
        raise ArgumentError(f"frame of {type(effect).__name__} is {frame.name!r}, which is fixed to the base")
    return replace(effect, frame=frame.name)
