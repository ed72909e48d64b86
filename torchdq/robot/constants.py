"""Constants of a robot's programs, as a hashable value: robots with equal constants share programs.

A program keeps the numbers that the tensors had. `stored` copies the tensors of a robot into one storage, whose counter
of changes in place tells whether one of them has other numbers now.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from operator import attrgetter
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.program.transforms import with_values, without_values

version = attrgetter("_version")  # number of in-place changes of all tensors in a tensor's storage


class Numbers(NamedTuple):
    """Tensor as plain numbers."""

    shape: tuple[int, ...]
    values: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Constants:
    """Fields of a robot with plain numbers instead of tensors; equal if the digests are equal."""

    digest: str
    fields: Mapping[str, Any]
    without_values: bool  # numbers of tensors without values; found once, since graphs are traced with unknown numbers

    @classmethod
    def of(cls, fields: Mapping[str, Any], arguments: Mapping[str, int]) -> Constants:
        """Constants of the fields of a robot; of arguments of programs only the number of trailing axes given here."""
        plain = {
            name: _unknown(value, arguments[name]) if name in arguments else _mapped(_numbers, Tensor, value)
            for name, value in fields.items()
        }
        without_values = any(map(math.isnan, plain["damping"].values))
        return cls(sha256(repr(plain).encode()).hexdigest(), plain, without_values)

    def tensors(self) -> dict[str, Any]:
        """Fields with tensors again, in float64; tensors that are arguments are NaN."""
        return {name: _mapped(_tensor, Numbers, value) for name, value in self.fields.items()}

    def changed(self, fields: Mapping[str, Any]) -> list[str]:
        """Names of those among the fields whose numbers are no longer those of the constants."""
        return [name for name, value in fields.items() if _mapped(_numbers, Tensor, value) != self.fields[name]]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Constants) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)


def hold(storages: tuple[Tensor, ...], x: Any) -> bool:
    """Whether storages hold a tensor that has values to read."""
    if not isinstance(x, Tensor) or without_values([x]):
        return False
    return any(x.untyped_storage()._cdata == flat.untyped_storage()._cdata for flat in storages)


def stored(fields: Mapping[str, Any]) -> tuple[dict[str, Any], tuple[Tensor, ...]]:
    """Fields with copies of their tensors in a common storage, and the storage, one for each dtype and device.

    Its `_version` is 0 until one of the copies is changed in place. Tensors that require grad stay as they are.
    """
    found: dict[tuple[torch.dtype, torch.device], list[Tensor]] = {}

    def collected(x: Tensor) -> None:
        if not x.requires_grad:
            found.setdefault((x.dtype, x.device), []).append(x)

    with with_values(), torch.inference_mode(False), torch.no_grad():
        for value in fields.values():
            _mapped(collected, Tensor, value)
        flat = {key: torch.cat([x.reshape(-1) for x in xs]) for key, xs in found.items()}
        ends = dict.fromkeys(found, 0)

        def copied(x: Tensor) -> Tensor:
            key = (x.dtype, x.device)
            if x.requires_grad:
                return x
            ends[key] += x.numel()
            return flat[key].narrow(0, ends[key] - x.numel(), x.numel()).view(x.shape)

        copies = {name: _mapped(copied, Tensor, value) for name, value in fields.items()}
    return copies, tuple(flat.values())


def _numbers(x: Tensor) -> Numbers:
    # a tensor on the device "meta" has no values
    return _unknown(x, x.ndim) if x.is_meta else Numbers(tuple(x.shape), tuple(x.detach().flatten().tolist()))


def _unknown(x: Tensor, axes: int) -> Numbers:
    shape = tuple(x.shape[x.ndim - axes :])
    return Numbers(shape, (math.nan,) * math.prod(shape))


def _tensor(x: Numbers) -> Tensor:
    return torch.tensor(x.values, dtype=torch.float64, device="cpu").reshape(x.shape)


def _mapped(function: Callable[[Any], Any], kind: type, x: Any) -> Any:
    """Nested tuples with a function applied to every object of a type."""
    if isinstance(x, kind):
        return function(x)
    if not isinstance(x, tuple):
        return x
    parts = [_mapped(function, kind, part) for part in x]
    return type(x)(*parts) if hasattr(x, "_fields") else tuple(parts)
