"""Arrays and names of a robot description, checked."""

import reprlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdq import dq
from torchdq.base.checks import tensor_in
from torchdq.dq.components import is_unit
from torchdq.errors import ArgumentError, DescriptionError
from torchdq.findings import Finding

UNIT = 1e-9  # largest distance from 0 or 1 of a number that is taken as 0 or 1
UNIT_SINGLE = 1e-5  # the same for numbers in single precision
MOST = 1e50  # largest number of a description: the products of three that dynamics form still do not overflow
SIX = [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]  # rows and columns of xx xy yy xz yz zz in a symmetric matrix

# error of a value: that of a description that is read, or of an argument to a method of a robot that exists
Fault = type[DescriptionError] | type[ArgumentError]


def double(values: Any) -> Tensor:
    """Float64 tensor of numbers."""
    return torch.tensor(values, dtype=torch.float64, device="cpu")


IDENTITY = double([1.0, 0, 0, 0, 0, 0, 0, 0])  # pose


def numbers(name: str, value: Any, error: Fault = DescriptionError) -> Tensor:
    """Value as a float64 tensor."""
    try:
        x = value if isinstance(value, Tensor) else torch.as_tensor(np.array(value), device="cpu")
        if x.is_complex():
            raise TypeError("found complex numbers")
        return x.to(torch.float64)
    except (TypeError, ValueError, RuntimeError) as cause:  # words, or rows of different lengths
        raise error(f"{name} must be an array of numbers: {cause}") from cause


def finite(name: str, value: Any, error: Fault = DescriptionError) -> Tensor:
    """Value as a finite float64 tensor."""
    x = numbers(name, value, error)
    if not bool(x.isfinite().all()):
        raise error(f"{name} must be finite, found {x.tolist()}")
    return x


def table(name: str, value: Any, *shape: int, error: Fault = DescriptionError) -> Tensor:
    """Value as a finite float64 tensor of that shape."""
    x = numbers(name, value, error)
    if tuple(x.shape) != shape:
        raise error(f"{name} must have the shape {shape}, found {tuple(x.shape)}")
    x = finite(name, x, error)
    if bool((x.abs() > MOST).any()):
        raise error(f"{name} must not exceed {MOST:g} in size, found {float(x.abs().max()):g}")
    return x


def indices(name: str, value: Any) -> tuple[int, ...]:
    """Value as a row of whole numbers."""
    x = numbers(name, value)
    if x.ndim != 1 or not bool((x == x.round()).all() and x.isfinite().all()):
        raise DescriptionError(f"{name} must be a row of whole numbers, found {reprlib.repr(value)}")
    return tuple(map(int, x.tolist()))


def poses(name: str, value: Any, *shape: int, error: Fault = DescriptionError) -> Tensor:
    """Value, which must be unit dual quaternions of that shape, with the rounding of its dtype removed."""
    value = tensor_in(value)
    x = table(name, value, *shape, error=error)
    if fault := not_unit(name, x.detach(), slack(value)):
        raise error(str(fault))
    return dq.normalize(x)


def slack(x: Any) -> float:
    """Largest distance from 0 or 1 of a number that is taken as 0 or 1, in the dtype of an array."""
    return UNIT if "float" not in (dtype := str(getattr(x, "dtype", ""))) or "float64" in dtype else UNIT_SINGLE


def not_unit(name: str, x: Tensor, slack: float, subject: str = "") -> Finding | None:
    """Fault of poses [..., 8] that are not unit dual quaternions; None: there is none."""
    fits = is_unit(x, slack)
    if bool(fits.all()):
        return None
    at, found = first(x, ~fits)
    expected = f"{name} must be unit dual quaternions (see torchdq.dq.normalize)"
    return Finding("pose.unit", subject, expected, f"{found} at {at}" if at else f"{found}", severity="error")


def first(x: Tensor, mask: Tensor) -> tuple[tuple[int, ...], Any]:
    """Place and value of the first row of x where a mask is true."""
    at = tuple(mask.nonzero()[0].tolist())
    return at, x.detach()[at].tolist()


def inertias(value: Any, n: int) -> Tensor:
    """Inertias [n, 6] in the order xx xy yy xz yz zz, from those or from matrices [n, 3, 3]."""
    x = numbers("inertia", value)
    if tuple(x.shape) == (n, 3, 3):
        # R I R^T is symmetric up to rounding only
        if bool(((x - x.mT).abs() > UNIT * x.abs().amax()).any()):
            raise DescriptionError(f"inertia matrices must be symmetric, found {x.tolist()}")
        x = x[:, *SIX]
    return table("inertia", x, n, 6)


def matrices(inertia: Tensor) -> Tensor:
    """Matrices [..., 3, 3] of inertias [..., 6] in the order xx xy yy xz yz zz."""
    return inertia[..., [[0, 1, 3], [1, 2, 4], [3, 4, 5]]]


def second_moments(inertia: Tensor) -> Tensor:
    """Second moments tr(I)/2 1 - I, [..., 3, 3], of inertias I [..., 6] in the order xx xy yy xz yz zz."""
    I = matrices(inertia)
    half = I.diagonal(dim1=-2, dim2=-1).sum(-1) / 2
    return torch.diag_embed(half.unsqueeze(-1).expand(*half.shape, 3)) - I


def words(
    name: str, value: Any, n: int, which: str = "", error: Fault = DescriptionError, distinct: bool = False
) -> tuple[str, ...]:
    """Value as n strings, all different if they are to be `distinct`; `which` says more of them."""
    found = tuple(value) if isinstance(value, Sequence) and not isinstance(value, str | bytes) else ()
    wrong = len(found) != n or not all(isinstance(word, str) for word in found)
    if wrong or (distinct and len(set(found)) != n):
        entries = "1 entry" if n == 1 else f"{n} {'different ' if distinct else ''}entries"
        raise error(f"{name} must have {entries}{which}, found {reprlib.repr(value)}")
    return found


def equal(a: Any, b: Any) -> bool:
    """Whether two values of a field are equal; a tensor that requires grad equals only itself."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return a is b or (not (a.requires_grad or b.requires_grad or a.dtype != b.dtype) and torch.equal(a, b))
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(equal, a, b))
    return type(a) is type(b) and bool(a == b)


def distinct(kind: str, names: Sequence[str] | None, n: int) -> tuple[str, ...]:
    """Names, n different ones; without any, joint1, joint2, ... for the kind "joint"."""
    if names is None:
        return tuple(f"{kind}{i + 1}" for i in range(n))
    return words(f"{kind}_names", names, n, distinct=True)


def unused(name: str, taken: set[str]) -> str:
    """Name, lengthened until it is not among those that are taken, and added to them."""
    while name in taken:
        name += "_"
    taken.add(name)
    return name
