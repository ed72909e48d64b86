"""Fields of functions, layers, control laws and effects: everything that a caller can pass, declared once as a value.

Checks, shapes in error messages, arguments of programs and generated tests follow from them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import NOT_NEGATIVE, REAL, Check, Interval
from torchdq.robot.fields import Axes

Kind = Literal["input", "shared", "parameter", "option"]


class Field(NamedTuple):
    """Something that a caller can pass."""

    name: str
    axes: Axes = ()  # trailing axes of a tensor
    optional: bool = False  # whether it may be absent
    # a row per sample; one row for all samples; one row for all or per sample, or one number; or what the program
    # depends on, which is not a tensor
    kind: Kind = "input"
    check: Check = REAL
    described: str = ""  # attribute of the robot that replaces None
    default: Any = None  # of an option

    def wrong(self, good: Tensor | None = None) -> Iterator[tuple[str, Any]]:
        """Values that are refused in its place, each with a word for what is wrong; `good` is a tensor that fits."""
        if self.kind != "option":
            yield from ((repr(x), x) for x in ("1", b"1", 1j, [True], ["1"], [[1.0], [2.0, 3.0]], {"joint1": 1.0}))
            x = torch.ones(3, 2, dtype=torch.float64) if good is None else good
            yield from ((str(dtype), x.to(dtype)) for dtype in (torch.bool, torch.complex128))
            sizes = (0, 1, 5, 9) if self.kind == "input" else (0, 5, 9)  # one number of a parameter is that of all
            yield from ((f"{k} numbers", x[..., :1].expand(*x.shape[:-1], k)) for k in sizes if self.axes)
        if self.kind in ("input", "shared"):
            yield from ((type(x).__name__, x) for x in (1.0, x.tolist(), x.numpy()))
            yield from ((str(dtype), x.to(dtype)) for dtype in (torch.int64, torch.float16, torch.bfloat16))
            yield from [("no axes", x.new_tensor(1.0)), ("an axis less", x[..., 0])][: min(len(self.axes), 2)]
        else:
            yield from ((repr(x), x) for x in self.check.wrong())


def joints(*names: str, optional: bool = False) -> tuple[Field, ...]:
    """Inputs with a number per coordinate."""
    return tuple(Field(name, ("n",), optional) for name in names)


def parameter(
    *axes: int | str, check: Interval = NOT_NEGATIVE, described: str = "", optional: bool = False
) -> Mapping[Any, Field]:
    """Metadata of a dataclass's field for a parameter: numbers, or a tensor with these trailing axes.

    Args:
        axes: the trailing axes, numbers or names of `Robot.sizes`.
        check: what each of its numbers may be.
        described: attribute of the robot that replaces None.
        optional: whether it may be None or False, absent.
    """
    return {Field: Field("", axes, optional, "parameter", check, described)}


def option(check: Check) -> Mapping[Any, Field]:
    """Metadata of a dataclass's field for what is not a tensor, on which the program depends."""
    return {Field: Field("", (), False, "option", check)}


def declared(kind: type) -> dict[str, Field]:
    """Parameters and options that a class declares itself, by name."""
    own = {name: x.metadata.get(Field) for name, x in vars(kind).items() if isinstance(x, dataclasses.Field)}
    return {name: entry._replace(name=name) for name, entry in own.items() if entry is not None}
