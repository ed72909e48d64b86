"""Checks of tensors that every public function shares."""

from typing import Any

from torch import Tensor

from torchdq.errors import ArgumentError, DtypeError


def require_tensor(name: str, x: Any) -> None:
    """Raise unless x is a tensor."""
    if not isinstance(x, Tensor):
        raise ArgumentError(f"{name} must be a tensor, found {type(x).__name__}; use torch.as_tensor")


def floating(name: str, x: Any) -> Tensor:
    """Tensor x; raises unless it is one of floating-point numbers."""
    require_tensor(name, x)
    if not x.dtype.is_floating_point:
        raise DtypeError(f"{name} must be a floating tensor, found {x.dtype}; convert it, e.g. {name}.double()")
    return x
