"""Operators of sections 2 to 4 of the paper on tensors, for its readers.

They are formulas of `torchdq.algebra` with checked arguments: of quaternions [..., 4] and pure ones [..., 3], dual
quaternions [..., 8] and screws [..., 6]. Leading axes broadcast, so that the element-wise products (15)-(17) of vectors
of screws are `cross`, `inner` and `double_geodesic` of [..., n, 6]. The Hamilton vectors h+(x), h-(x) are the rows of
`hamilton_left(x).mT` and `hamilton_right(x).mT`, which T4 and T8 combine as matrices do.

>>> wrench, twist = torch.tensor([1.0, 0, 0, 0, 0, 2]), torch.tensor([0.0, 0, 3, 4, 0, 0])
>>> inner(wrench, twist), power(wrench, twist), double_geodesic(wrench, swap(twist))
(tensor([ 0., 10.]), tensor(10.), tensor(10.))
"""

import inspect
from collections.abc import Callable
from functools import wraps
from operator import index
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion, quaternion, screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Inertia, six
from torchdq.dq.components import checked, form, require_square, stack
from torchdq.dq.formulas import computed
from torchdq.dq.poses import log_shortest
from torchdq.dq.tensors import ad_matrix, block_lower, moderate


def on_tensors(formula: Callable[..., Any], *sizes: int, shape: tuple[int, ...] | None = None) -> Callable[..., Tensor]:
    """Formula of the algebra on tensors whose last axes have these sizes; `shape` is the trailing axes of its result.

    >>> on_tensors(quaternion.cross, 3, 3)(torch.eye(3)[0], torch.eye(3)[1])
    tensor([0., 0., 1.])
    """
    signature = inspect.signature(formula)

    @wraps(formula)
    def function(*given: Tensor, **named: Tensor) -> Tensor:
        arguments = zip(signature.bind(*given, **named).arguments.items(), sizes, strict=True)
        return computed(formula, shape, **{name: checked(name, x, size) for (name, x), size in arguments})

    return function


dot = on_tensors(quaternion.dot, 3, 3, shape=())
inner = on_tensors(screw.inner, 6, 6)
double_geodesic = on_tensors(screw.double_geodesic, 6, 6, shape=())
power = on_tensors(screw.power, 6, 6, shape=())
swap = on_tensors(screw.swap, 6)
translation_body = on_tensors(dual_quaternion.translation_body, 8)


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product (ab - ba)/2 of pure quaternions [..., 3] (4) or of screws [..., 6] (6)."""
    product = screw.cross if checked("a", a, 3, 6).shape[-1] == 6 else quaternion.cross
    return computed(product, a=a, b=checked("b", b, index(a.shape[-1])))


def norm(x: Tensor) -> Tensor:
    """Norm [...] of a quaternion [..., 4], or the dual number [..., 2] (|P|, P.D/|P|) of a dual quaternion [..., 8]."""
    size, x = moderate(x)
    parts = form(x.unbind(-1))
    if x.shape[-1] == 4:
        return size * quaternion.norm2(parts).sqrt()
    p2, pd2 = dual_quaternion.norm2(parts)
    p = p2.sqrt()
    return size.unsqueeze(-1) * stack((p, 0.5 * pd2 / p))


def hamilton_left(x: Tensor) -> Tensor:
    """Hamilton matrix H+(x) with vec(xy) = H+(x) vec(y), [..., 4, 4] (19) or [..., 8, 8]."""
    return _matrix(x, quaternion.hamilton_left_matrix, _dual_left)


def hamilton_right(x: Tensor) -> Tensor:
    """Hamilton matrix H-(x) with vec(yx) = H-(x) vec(y), [..., 4, 4] (19) or [..., 8, 8]."""
    return _matrix(x, quaternion.hamilton_right_matrix, _dual_right)


def _matrix(x: Tensor, of_quaternion: Callable, of_dual: Callable) -> Tensor:
    x = checked("x", x, 4, 8)
    size = index(x.shape[-1])
    return computed(of_dual if size == 8 else of_quaternion, (size, size), x=x)


def _dual_left(x: DualQuaternion) -> tuple[tuple, ...]:
    return block_lower(*map(quaternion.hamilton_left_matrix, x))


def _dual_right(x: DualQuaternion) -> tuple[tuple, ...]:
    return block_lower(*map(quaternion.hamilton_right_matrix, x))


def columns(x: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices A_P = R_AB and A_D = [p] R_AB [..., 3, 3] of the adjoint of a pose x = X_AB [..., 8] (34), (35)."""
    adjoint = ad_matrix(x)
    return adjoint[..., :3, :3], adjoint[..., 3:, :3]


def inertia_transform(mass: Tensor, inertia: Tensor, a: Tensor, com: Tensor | None = None) -> Tensor:
    """Inertia transformation G(w + eps v) = m v + eps I w [..., 6] about the centre of mass: momentum of a twist (30).

    Args:
        mass: [kg], shape [...].
        inertia: about the centre of mass [kg m^2], symmetric, shape [..., 3, 3].
        a: twist, or spatial acceleration, shape [..., 6], in the body frame.
        com: centre of mass in the body frame [m], shape [..., 3]; None: the origin.
    """
    require_square("inertia", inertia, 3)
    parts, rows = form(checked("a", a, 6).unbind(-1)), tuple([row.unbind(-1) for row in inertia.unbind(-2)])
    if com is None:
        return stack(Inertia(mass, None, rows).momentum(parts))
    return stack(Inertia.from_com(mass, checked("com", com, 3).unbind(-1), six(rows)).momentum(parts))


class ScrewParameters(NamedTuple):
    """Screw motion: a turn by `angle` about a line with a translation by `slide` along it."""

    axis: Tensor  # unit direction of the line [1], [..., 3]; along the displacement if there is no rotation
    moment: Tensor  # moment of the line about the origin [m], [..., 3]; zero if there is no rotation
    angle: Tensor  # [rad], [...], in [0, pi]
    slide: Tensor  # [m], [...]; the pitch slide/angle is infinite for a pure translation


def screw_params(x: Tensor) -> ScrewParameters:
    """Axis, moment, angle and slide of the shorter screw motion to the pose x [..., 8] (27)."""
    p, d = log_shortest(x).split(3, -1)
    half = torch.linalg.vector_norm(p, dim=-1, keepdim=True)
    length = torch.linalg.vector_norm(d, dim=-1, keepdim=True)
    still = torch.eye(3, dtype=p.dtype, device=p.device)[0]
    axis = _divided(p, half, _divided(d, length, still))
    slide = (axis * d).sum(-1, keepdim=True)
    moment = _divided(d - slide * axis, half, 0.0)
    return ScrewParameters(axis, moment, 2.0 * half.squeeze(-1), 2.0 * slide.squeeze(-1))


def _divided(x: Tensor, length: Tensor, otherwise: Tensor | float) -> Tensor:
    """Quotient x / length; another value where the length is zero, and NaN where it is NaN."""
    present = length != 0
    return torch.where(present, x / torch.where(present, length, 1.0), otherwise)
