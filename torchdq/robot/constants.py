"""Constants of a robot's programs, as a hashable value: robots with equal constants share programs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, NamedTuple

import torch
from torch import Tensor


class Numbers(NamedTuple):
    """Tensor as plain numbers."""

    shape: tuple[int, ...]
    values: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Constants:
    """Fields of a robot with plain numbers in place of tensors; equal if the digests are equal."""

    digest: str
    fields: Mapping[str, Any]

    @classmethod
    def of(cls, fields: Mapping[str, Any], arguments: Mapping[str, int]) -> Constants:
        """Constants of a robot.

        Args:
            fields: the fields of the robot, by name.
            arguments: names of the tensors that are arguments of programs, with the number of their trailing axes; only
                these axes enter the constants.
        """
        plain = {
            name: _unknown(value, arguments[name]) if name in arguments else _mapped(_numbers, Tensor, value)
            for name, value in fields.items()
        }
        return cls(sha256(repr(plain).encode()).hexdigest(), plain)

    def tensors(self) -> dict[str, Any]:
        """Fields with tensors again, in float64; tensors that are arguments are NaN."""
        return {name: _mapped(_tensor, Numbers, value) for name, value in self.fields.items()}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constants) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def _numbers(x: Tensor) -> Numbers:
    # a tensor on the device "meta" has no values
    return _unknown(x, x.ndim) if x.is_meta else Numbers(tuple(x.shape), tuple(x.detach().flatten().tolist()))


def _unknown(x: Tensor, axes: int) -> Numbers:
    shape = tuple(x.shape[x.ndim - axes :])
    return Numbers(shape, (math.nan,) * math.prod(shape))


def _tensor(x: Numbers) -> Tensor:
    return torch.tensor(x.values, dtype=torch.float64).reshape(x.shape)


def _mapped(function: Callable[[Any], Any], kind: type, x: Any) -> Any:
    """Nested tuples with a function applied to every object of a type."""
    if isinstance(x, kind):
        return function(x)
    if not isinstance(x, tuple):
        return x
    parts = [_mapped(function, kind, part) for part in x]
    return type(x)(*parts) if hasattr(x, "_fields") else tuple(parts)
