"""Arrays of NumPy as tensors, for calls of compiled programs.

Arguments share their memory with the tensor where torch can read it, and are copied where it cannot: read-only ones,
which torch would take for writable, and those with negative strides. Results need memory that can be written to.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdq.errors import ArgumentError

DTYPES = {torch.float32: np.dtype(np.float32), torch.float64: np.dtype(np.float64)}


def argument(name: str, x: Any, dtype: torch.dtype) -> Tensor:
    """Tensor with the numbers of an array."""
    _require_array(name, x, dtype)
    shared = x.flags.writeable and all(stride >= 0 for stride in x.strides)
    return torch.from_numpy(x if shared else x.copy())


def room(name: str, x: Any, dtype: torch.dtype) -> Tensor:
    """Tensor that shares the memory of an array, which is written to."""
    _require_array(name, x, dtype)
    if not x.flags.writeable:
        raise ArgumentError(f"{name} must be writable, found a read-only array; give a copy of it, or np.empty_like")
    if not x.flags.c_contiguous:
        raise ArgumentError(f"{name} must be contiguous, found strides {x.strides} for shape {x.shape}; use np.empty")
    return torch.from_numpy(x)


def _require_array(name: str, x: Any, dtype: torch.dtype) -> None:
    """Raise unless x is a plain array of a dtype."""
    if not isinstance(x, np.ndarray):
        raise ArgumentError(f"{name} must be an array of NumPy as the first argument is, found {type(x).__name__}")
    if isinstance(x, np.ma.MaskedArray):
        raise ArgumentError(f"{name} must be an array without a mask, found a masked array; use {name}.filled(value)")
    if x.dtype != DTYPES[dtype]:
        cure = f"use {name}.astype(np.{DTYPES[dtype]})" if not name.startswith("out") else "use np.empty with its dtype"
        raise ArgumentError(
            f"{name} must be an array of {DTYPES[dtype]} in the byte order of this machine, found {x.dtype.str}; {cure}"
        )
