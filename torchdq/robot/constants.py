"""The numbers that programs of a robot have built in, as a value: equal robots have equal ones, and share programs."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, NamedTuple

import torch
from torch import Tensor


class Numbers(NamedTuple):
    """A tensor as plain numbers."""

    shape: tuple[int, ...]
    values: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Constants:
    """The fields of a robot with plain numbers in the place of its tensors; equal if their digests are."""

    digest: str
    fields: Mapping[str, Any]

    @classmethod
    def of(cls, fields: Mapping[str, Any], arguments: Mapping[str, int]) -> Constants:
        """Constants of a robot's fields; of tensors that are arguments only so many trailing axes are known."""
        plain = {
            name: _unknown(value, arguments[name]) if name in arguments else _mapped(_numbers, Tensor, value)
            for name, value in fields.items()
        }
        return cls(sha256(repr(plain).encode()).hexdigest(), plain)

    def tensors(self) -> dict[str, Any]:
        """The fields with tensors again, in float64; those that are arguments are NaN."""
        return {name: _mapped(_tensor, Numbers, value) for name, value in self.fields.items()}

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constants) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def _numbers(x: Tensor) -> Numbers:
    # a robot on the device "meta" has no numbers
    return _unknown(x, x.ndim) if x.is_meta else Numbers(tuple(x.shape), tuple(x.detach().flatten().tolist()))


def _unknown(x: Tensor, axes: int) -> Numbers:
    shape = tuple(x.shape[x.ndim - axes :])
    return Numbers(shape, (math.nan,) * math.prod(shape))


def _tensor(x: Numbers) -> Tensor:
    return torch.tensor(x.values, dtype=torch.float64).reshape(x.shape)


def _mapped(function: Callable[[Any], Any], kind: type, x: Any) -> Any:
    """Nested tuples with a function applied to everything of a kind."""
    if isinstance(x, kind):
        return function(x)
    if not isinstance(x, tuple):
        return x
    parts = [_mapped(function, kind, part) for part in x]
    return type(x)(*parts) if hasattr(x, "_fields") else tuple(parts)
