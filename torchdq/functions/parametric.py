"""Parameters of effects and of control laws: numbers are constants of a program, tensors are its arguments.

Tensors may require gradients, change between steps, or differ from sample to sample (leading batch axes) without
recompilation. Parameters that are None are taken from the robot's description. While a program is recorded, tensors are
rows of recorded numbers.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from operator import attrgetter
from typing import Any, ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import Interval, is_number, require, require_all, require_tensor
from torchdq.dynamics.posed import Row
from torchdq.errors import ArgumentError
from torchdq.functions.signature import Field, declared
from torchdq.program.transforms import without_values
from torchdq.robot import Robot
from torchdq.robot.fields import trailing
from torchdq.robot.robot import arguments

Parameter = Any  # number, sequence, tensor, or None: from the description; while recording: a row of numbers
Shapes = Mapping[str, tuple[int | str, ...]]  # trailing axes by name, see `Robot.sizes`


class _Placeholder:
    """Placeholder for a tensor in the specification of a scene."""

    def __repr__(self) -> str:
        return "tensor"

    def __reduce__(self) -> str:
        return "TENSOR"  # a copy is the same object, so that copies of scenes share their programs


TENSOR = _Placeholder()


@dataclass(frozen=True)
class Parametric:
    """Base of objects whose parameters are constants or arguments of programs."""

    PARAMETERS: ClassVar[Mapping[str, Field]] = {}  # those that the class declares, by name
    OPTIONS: ClassVar[Mapping[str, Field]] = {}
    SHAPES: ClassVar[Shapes] = {}  # trailing axes of each parameter
    DESCRIBED: ClassVar[Mapping[str, str]] = {}  # attribute of the robot that replaces None

    def __init_subclass__(cls, **more: Any) -> None:
        super().__init_subclass__(**more)
        own = declared(cls)
        whole = {**own, **{name: x for name, x in {**cls.PARAMETERS, **cls.OPTIONS}.items() if name not in own}}
        cls.PARAMETERS = {name: field for name, field in whole.items() if field.kind == "parameter"}
        cls.OPTIONS = {name: field for name, field in whole.items() if field.kind == "option"}
        cls.DESCRIBED = {name: field.described for name, field in cls.PARAMETERS.items() if field.described}
        if not isinstance(cls.SHAPES, property):  # which depends on what is given
            cls.SHAPES = {name: field.axes for name, field in cls.PARAMETERS.items()}

    def present(self) -> Shapes:
        """Trailing axes of each parameter that is not absent: `SHAPES` of a class that may be without one."""
        absent = {name for name, x in self.PARAMETERS.items() if x.optional and _absent(getattr(self, name))}
        return {name: x.axes for name, x in self.PARAMETERS.items() if name not in absent}

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
        self.require_options()
        whole = self.described(robot)
        for entry in fields(whole):
            value = getattr(whole, entry.name)
            if entry.name not in whole.SHAPES and isinstance(value, dict | list | set | np.ndarray | Tensor):
                raise ArgumentError(
                    f"{entry.name} of {type(self).__name__} is a {type(value).__name__}, which can change after it was "
                    "recorded; use a number or a tuple, or declare it by `parameter`"
                )
        return replace(whole, **{name: whole._checked(name, getattr(whole, name), robot) for name in whole.SHAPES})

    @classmethod
    def interval(cls, name: str) -> Interval:
        """Interval of the numbers of a parameter."""
        found: Any = cls.PARAMETERS[name].check
        return found

    def require_options(self) -> None:
        """Raise unless the options are what they may be."""
        for name, field in self.OPTIONS.items():
            require(f"{name} of {type(self).__name__}", getattr(self, name), field.check)

    def _checked(self, name: str, value: Any, robot: Robot) -> Any:
        what, check = f"{name} of {type(self).__name__}", self.interval(name)
        axes = self.SHAPES[name]
        shape = trailing(axes, robot.sizes)
        size = math.prod(shape)
        if value is None:
            reason = f": the description of robot {robot.name!r} has none" if name in self.DESCRIBED else ", found None"
            raise ArgumentError(f"{what} must be given{reason}")
        single = value.ndim == 0 if isinstance(value, Tensor) else is_number(value) and value != 0
        per_joint = any(isinstance(axis, str) for axis in axes)
        if single and axes and not per_joint:  # one number for all joints is meaningful, one for all components is not
            raise ArgumentError(f"{what} must have {size} components, found the number {float(value):g}")
        if isinstance(value, Tensor):
            require_tensor(what, value)
            if value.is_complex() or value.dtype == torch.bool:
                raise ArgumentError(f"{what} must be a tensor of real numbers, found {value.dtype}")
            value = value if value.is_floating_point() else value.double()
            if value.ndim < len(shape):
                value = value.expand(shape)
            if shape and value.shape[-1] not in ((1, size) if per_joint else (size,)):
                raise ArgumentError(f"{what} must have the shape [..., {size}], found {tuple(value.shape)}")
            if not without_values((value,)):
                require_all(what, value, check)
            return value.expand((*value.shape[: value.ndim - len(shape)], *shape))
        value = value.tolist() if isinstance(value, np.ndarray) else value
        given = value if isinstance(value, Sequence) and not isinstance(value, str | bytes) else [value] * size
        if not all(map(is_number, given)):  # float() would accept strings and booleans, and detach tensors
            raise ArgumentError(f"{what} must be a number, {size} numbers or a tensor, found {value!r}")
        if len(given) != size:
            expected = (
                f"be one number or {size}" if per_joint else f"have {size} components" if axes else "be one number"
            )
            raise ArgumentError(f"{what} must {expected}, found {len(given)}")
        for x in given:
            require(what, float(x), check)
        return tuple(map(float, given)) if shape else float(given[0])

    def idle(self) -> tuple[str, ...]:
        """Parameters from the description, if all are constants without effect: zeros, or absent limits."""

        def none(name: str, row: Any) -> bool:
            limit = self.interval(name).infinite
            return isinstance(row, tuple) and all(math.isinf(x) if limit else x == 0 for x in row)

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


def _absent(x: Any) -> bool:
    return x is None or x is False


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
