"""Base of all effects: a small frozen object that belongs to one slot of a scene and defines its contribution.

Parameters that are numbers become constants of the scene's program. Parameters that are tensors become arguments: they
may require gradients, change between steps, or differ from sample to sample (leading batch axes) without recompilation.
Parameters that are None are taken from the robot's description.

The methods of an effect are written for any kind of number: while a scene is recorded, tensors are rows of recorded
numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import is_number, require_count, require_tensor
from torchdq.dynamics.posed import Row
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError
from torchdq.program.transforms import without_values
from torchdq.robot import Robot
from torchdq.robot.fields import trailing
from torchdq.robot.robot import arguments

Inputs = Mapping[str, Row]  # inputs of a step by name
Parameter = Any  # number, sequence, tensor, or None: from the description; while recording: a row of numbers
Shapes = Mapping[str, tuple[int | str, ...]]  # trailing axes by name, see `Robot.sizes`


MOST_LATE = 500  # steps of a delay; the compile time of its program is then half a minute


class _Placeholder:
    """Placeholder for a tensor in the specification of a scene."""

    def __repr__(self) -> str:
        return "tensor"

    def __reduce__(self) -> str:
        return "TENSOR"  # a copy is the same object, so that copies of scenes share their programs


TENSOR = _Placeholder()


@dataclass(frozen=True)
class Parametric:
    """Base of objects whose parameters are constants or arguments of a scene's programs."""

    SHAPES: ClassVar[Shapes] = {}  # trailing axes of each parameter
    SIGNED: ClassVar[frozenset[str]] = frozenset()  # parameters that may be negative
    UNBOUNDED: ClassVar[frozenset[str]] = frozenset()  # parameters that may be infinite
    DIVIDING: ClassVar[frozenset[str]] = frozenset()  # parameters that must not be zero
    DESCRIBED: ClassVar[Mapping[str, str]] = {}  # attribute of the robot that replaces None

    def missing(self) -> dict[str, str]:
        """Parameters that are None, with the attributes of the robot that replace them."""
        return {name: source for name, source in self.DESCRIBED.items() if getattr(self, name) is None}

    def simulates(self) -> Collection[str]:
        """Attributes of the robot that stand for something it simulates."""
        return self.DESCRIBED.values()

    def described(self, robot: Robot) -> Self:
        """Copy with the values of the robot's description instead of None."""
        found = {name: owned(robot, attrgetter(source)(robot)) for name, source in self.missing().items()}
        return replace(self, **found)

    def resolved(self, robot: Robot) -> Self:
        """Copy for a robot: described and checked, every parameter a tuple of floats, a float, or a tensor."""
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name not in self.SHAPES and isinstance(value, dict | list | set | np.ndarray | Tensor):
                raise ArgumentError(
                    f"{entry.name} of {type(self).__name__} is a {type(value).__name__}, which can change after it was "
                    "recorded; use a number or a tuple, or name a tensor in SHAPES"
                )
        whole = self.described(robot)
        return replace(whole, **{name: self._checked(name, getattr(whole, name), robot) for name in self.SHAPES})

    def _checked(self, name: str, value: Any, robot: Robot) -> Any:
        what = f"{name} of {type(self).__name__}"
        axes = self.SHAPES[name]
        shape = trailing(axes, robot.sizes)
        size = math.prod(shape)
        if value is None:
            raise ArgumentError(f"{what} must be given: the description of robot {robot.name!r} has none")
        single = value.ndim == 0 if isinstance(value, Tensor) else is_number(value) and value != 0
        per_joint = any(isinstance(axis, str) for axis in axes)
        if single and axes and not per_joint:  # one number for all joints is meaningful, one for all components is not
            raise ArgumentError(f"{what} must have {size} components, found the number {float(value):g}")
        if isinstance(value, Tensor):
            require_tensor(what, value)
            if not value.is_floating_point():
                raise ArgumentError(f"{what} must be a floating-point tensor, found {value.dtype}")
            if value.ndim < len(shape):
                value = value.expand(shape)
            if shape and value.shape[-1] not in ((1, size) if per_joint else (size,)):
                raise ArgumentError(f"{what} must have the shape [..., {size}], found {tuple(value.shape)}")
            if value.numel() and not without_values((value,)):
                self._check_values(name, torch.stack(value.detach().aminmax()).tolist())
            return value.expand((*value.shape[: value.ndim - len(shape)], *shape))
        given = value if isinstance(value, Sequence) and not isinstance(value, str | bytes) else [value] * size
        if not all(map(is_number, given)):  # float() would accept strings and booleans, and detach tensors
            raise ArgumentError(f"{what} must be a number, {size} numbers or a tensor, found {value!r}")
        if len(given) != size:
            raise ArgumentError(f"{what} must be one number or {size}, found {len(given)}")
        numbers = [float(x) for x in given]
        self._check_values(name, numbers)
        return tuple(numbers) if shape else numbers[0]

    def _check_values(self, name: str, numbers: Sequence[float]) -> None:
        """Raise unless these values are allowed for a parameter; the extreme values of a tensor suffice."""
        what = f"{name} of {type(self).__name__}"
        for x in numbers:
            if math.isnan(x) or (math.isinf(x) and name not in self.UNBOUNDED):
                raise ArgumentError(f"{what} must be finite, found {x}")
            if x < 0 and name not in self.SIGNED:
                raise ArgumentError(f"{what} must not be negative, found {x}")
            if x == 0 and name in self.DIVIDING:
                raise ArgumentError(f"{what} must be positive, found 0; the law divides by it")

    def idle(self) -> tuple[str, ...]:
        """Parameters from the description, if all are constants without effect: zeros, or absent limits."""

        def none(name: str, row: Any) -> bool:
            return isinstance(row, tuple) and all(math.isinf(x) if name in self.UNBOUNDED else x == 0 for x in row)

        return tuple(self.DESCRIBED) if all(none(name, getattr(self, name)) for name in self.DESCRIBED) else ()

    def tensors(self) -> dict[str, Tensor]:
        """Parameters that are arguments of the programs."""
        return {name: getattr(self, name) for name in self.SHAPES if isinstance(getattr(self, name), Tensor)}

    def template(self) -> Self:
        """Copy with `TENSOR` instead of each tensor: everything that a program depends on."""
        return replace(self, **dict.fromkeys(self.tensors(), TENSOR))

    def bound(self, rows: Mapping[str, Row]) -> Self:
        """Copy with rows of recorded numbers instead of its tensors."""
        return replace(self, **{name: tuple(row) if self.SHAPES[name] else row[0] for name, row in rows.items()})


@dataclass(frozen=True)
class Effect(Parametric):
    """One physical effect of a scene."""

    SLOT: ClassVar[str]  # "model", "joint", "body", "actuator" or "sensor"
    ONCE: ClassVar[str] = ""  # reason why a scene has it at most once; "": it may be repeated
    SOLE: ClassVar[Mapping[str, str]] = {}  # attributes of the description reserved for this effect, and why
    SHARED: ClassVar[frozenset[str]] = frozenset()  # inputs that it shares with others
    SCALES: ClassVar[tuple[str, ...]] = ()  # parameters that friction randomisation scales together
    IMPLICIT: ClassVar[str] = ""  # reason why only linearly implicit steps hold it; "": all do

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
    steps: int

    def described(self, robot: Robot) -> Self:
        """The effect; raises unless the number of steps is a positive integer."""
        require_count(f"steps of {type(self).__name__}", self.steps)
        if self.steps > MOST_LATE:  # every step is a row in the program
            raise ArgumentError(
                f"steps of {type(self).__name__} must be at most {MOST_LATE}, found {self.steps}; a longer delay needs "
                "longer time steps, or a buffer outside the scene"
            )
        return self

    def memory(self, n: int) -> int:
        """Length of the delayed rows."""
        return self.steps * self.PER_JOINT * n

    def passed(self, row: Row, memory: Row) -> tuple[Row, Row]:
        """Row that arrives, and the remaining delayed rows."""
        return memory[: len(row)], (*memory[len(row) :], *row)


def undefined(part: Any, method: str) -> NotImplementedError:
    """Error for a method that a subclass must define."""
    return NotImplementedError(f"{type(part).__name__} must define the method {method}")


def owned(robot: Robot, x: Tensor | None) -> Tensor | tuple[float, ...] | None:
    """Attribute of a robot as a parameter: numbers if it is a constant, the tensor itself if it is an argument."""
    if x is None:
        return None
    replaced = any(x is getattr(robot, name) for name in arguments(robot))
    if replaced or x.requires_grad or x.ndim > 1:
        return x
    return tuple(x.to(torch.float64).tolist())


def unbounded(x: Number) -> bool:
    """True for an infinite constant: an absent limit."""
    return isinstance(x, float) and math.isinf(x)


def on_a_link(effect: Any, robot: Robot) -> Any:
    """Effect with the name of its frame, by default the end effector; the frame must be on a moving link."""
    frame = robot.end_effector() if effect.frame is None else robot.frame(effect.frame)
    if frame.link == BASE and not robot.floating:
        raise ArgumentError(f"frame of {type(effect).__name__} is {frame.name!r}, which is fixed to the base")
    return replace(effect, frame=frame.name)
