"""Conversion between tensors and the tuples of components of the algebra, with checks of dtype and shape."""

from collections.abc import Callable, Sequence
from operator import index
from typing import Any

import torch
from torch import Tensor

from torchdq.base.checks import floating, tensor_in
from torchdq.errors import ArgumentError
from torchdq.program.transforms import without_values

UNIT = 1e-4  # error of a norm that is taken for 1: finite differences, and logs printed with six digits, stay below
UNIT_ROWS = {  # what rows of that many components must do, and the cure
    3: ("be a unit vector", "divide it by its length"),
    4: ("hold unit quaternions", "normalize that part by torchdq.dq.normalize"),
    8: ("be unit dual quaternions", "see torchdq.dq.normalize"),
}


def require_square(name: str, x: Tensor, size: int) -> None:
    """Raise unless x is a matrix [..., size, size]."""
    if floating(name, x).shape[-2:] != (size, size):
        raise ArgumentError(f"{name} must have the shape [..., {size}, {size}], found {tuple(x.shape)}")


def checked(name: str, x: Tensor, *sizes: int) -> Tensor:
    """Floating tensor x, or that of a pose; raises unless its last axis has one of these sizes."""
    x = tensor_in(x)
    # in a graph of unknown sizes this one becomes a number
    if floating(name, x).ndim == 0 or index(x.shape[-1]) not in sizes:
        expected = " or ".join(str(s) for s in sizes)
        raise ArgumentError(f"{name} must end with an axis of {expected} components, found shape {tuple(x.shape)}")
    return x


def unit(name: str, x: Tensor) -> Tensor:
    """Vectors, quaternions or dual quaternions x; raises unless they are unit ones, those with NaN apart."""
    found = _first(x, lambda x: ~(is_unit(x, _close(x)) | x.isnan().any(-1)))
    if found:
        expected, cure = UNIT_ROWS[len(found)]
        raise ArgumentError(f"{name} must {expected}, found {found}; {cure if any(found) else 'zero is none'}")
    return x


def is_unit(x: Tensor, slack: float) -> Tensor:
    """Mask of unit vectors [..., 3], quaternions [..., 4] or dual quaternions [..., 8], whose errors are in a slack."""
    r, d = x.double().tensor_split((4,), -1)
    size = (r.norm(dim=-1) - 1).abs() <= slack
    return size & ((r * d).sum(-1).abs() <= slack * (1 + d.norm(dim=-1))) if d.shape[-1] else size


def require_rotation(name: str, matrix: Tensor) -> None:
    """Raise unless matrices [..., 3, 3] are those of rotations, those with NaN apart."""

    def stretched(x: Tensor) -> Tensor:  # the product is off by 4 d where the norm of a quaternion is off by d
        return (x @ x.mT - torch.eye(3, dtype=x.dtype, device=x.device)).abs().amax((-2, -1)) > 4 * _close(x)

    def mirrored(x: Tensor) -> Tensor:
        return (torch.linalg.cross(x[..., 0, :], x[..., 1, :]) * x[..., 2, :]).sum(-1) < 0

    for wrong, fault in ((stretched, "rows of length 1 at right angles"), (mirrored, "the determinant 1, not -1")):
        if found := _first(matrix, wrong):
            raise ArgumentError(f"{name} must be a rotation, with {fault}, found {found}")


def require_last_row(name: str, matrix: Tensor) -> None:
    """Raise unless matrices [..., 4, 4] end with the row 0, 0, 0, 1, those with NaN apart."""
    row = matrix[..., 3, :]
    found = _first(row, lambda x: (x - torch.eye(4, dtype=x.dtype, device=x.device)[3]).abs().amax(-1) > _close(x))
    if found:
        cure = "" if found[3] != 1 else "; with the translation in the last row, transpose it by .mT"
        raise ArgumentError(f"{name} must end with the row 0, 0, 0, 1, found {found}{cure}")


def _close(x: Tensor) -> float:
    return max(UNIT, 8 * torch.finfo(x.dtype).eps)


def _first(x: Tensor, wrong: Callable[[Tensor], Tensor]) -> list[Any]:
    """First of the rows that are wrong, as numbers; empty where there is none, or values cannot be read."""
    if not x.numel() or without_values((x,)):
        return []
    x = x.detach()
    rows = wrong(x).nonzero()
    return x[tuple(rows[0].tolist())].tolist() if len(rows) else []


def form(x: Sequence[Any]) -> tuple:
    """Components in the form of the algebra: 3 or 4 numbers, or a pair of 3 or 4 for 6 or 8."""
    half = {6: 3, 8: 4}.get(len(x))
    return tuple(x) if half is None else (tuple(x[:half]), tuple(x[half:]))


def stack(components) -> Tensor:
    """Tensor [..., k] of k components that broadcast, or [..., 2 k] of a pair of rows; numbers become constants."""
    flat = [*components[0], *components[1]] if isinstance(components[0], tuple) else list(components)
    like = next(c for c in flat if isinstance(c, Tensor))
    flat = [c if isinstance(c, Tensor) else torch.full_like(like, c) for c in flat]
    return torch.stack(torch.broadcast_tensors(*flat), -1)
