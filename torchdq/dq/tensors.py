"""Products, norms and changes of frame of quaternions, dual quaternions and screws, as tensors with checked arguments.

    quaternion        [..., 4]   (w, x, y, z)
    dual quaternion   [..., 8]   primary (w, x, y, z) | dual (w, x, y, z)
    screw             [..., 6]   primary xyz | dual xyz: line (direction | moment), twist (angular | linear),
                                 wrench (force | moment)

Leading axes are batch axes and broadcast. The pose of B in A is X_AB = r + (eps/2) p r, and X_AC = mul(X_AB, X_BC).
x and -x are the same pose. Rows are independent: a row that is not finite, or cannot be normalised, gives NaN in its
own row only.
"""

from collections.abc import Sequence
from operator import index
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion, quaternion, screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.screw import Screw
from torchdq.dq.components import checked
from torchdq.dq.formulas import computed


def _algebra(x: Tensor) -> ModuleType:
    """Algebra of quaternions [..., 4] or of dual quaternions [..., 8]."""
    return dual_quaternion if x.shape[-1] == 8 else quaternion


# --- products --------------------------------------------------------------------------------------------------------


def mul(x: Tensor, y: Tensor) -> Tensor:
    """Product xy of two quaternions [..., 4] or two dual quaternions [..., 8]; of poses, X_AC = X_AB X_BC.

    >>> mul(torch.tensor([0.0, 1, 0, 0]), torch.tensor([0.0, 0, 1, 0]))  # i j = k
    tensor([0., 0., 0., 1.])
    """
    x = checked("x", x, 4, 8)
    return computed(_algebra(x).mul, x=x, y=checked("y", y, index(x.shape[-1])))


def conj(x: Tensor) -> Tensor:
    """Conjugate of a quaternion [..., 4], or of both parts of a dual quaternion [..., 8]; inverse if it is a unit one.

    >>> conj(torch.tensor([1.0, 2, 3, 4]))
    tensor([ 1., -2., -3., -4.])
    """
    x = checked("x", x, 4, 8)
    return computed(_algebra(x).conj, x=x)


# --- norms -----------------------------------------------------------------------------------------------------------


def moderate(x: Tensor) -> tuple[Tensor, Tensor]:
    """Power of two [...], and x divided by it, so that squares of its primary part do not overflow or underflow."""
    x = checked("x", x, 4, 8)
    _, exponent = torch.frexp(x[..., :4].detach().abs().amax(-1))
    size = torch.ldexp(torch.ones_like(x[..., 0]), exponent - 1)
    return size, x / size.unsqueeze(-1)


def normalize(x: Tensor) -> Tensor:
    """Closest unit quaternion [..., 4] or unit dual quaternion [..., 8] (|P| = 1, P.D = 0).

    A row whose primary part is zero is NaN.

    >>> normalize(torch.tensor([0.0, 3, 0, 4]))
    tensor([0.0000, 0.6000, 0.0000, 0.8000])
    """
    _, x = moderate(x)
    x = x / quaternion.norm2(x[..., :4].unbind(-1)).sqrt().unsqueeze(-1)
    if x.shape[-1] == 4:
        return x
    p, d = x.split(4, -1)
    return torch.cat([p, d - (p * d).sum(-1, keepdim=True) * p], -1)


# --- change of frame -------------------------------------------------------------------------------------------------


def ad(x: Tensor, m: Tensor) -> Tensor:
    """Adjoint Ad(x) m = x m x* [..., 6]: the screw m, given in B, expressed in A, for the pose x = X_AB (33), (36).

    It applies to twists, accelerations, momenta and wrenches alike. `ad(conj(x), m)` transforms from A to B.

    Args:
        x: pose X_AB, shape [..., 8].
        m: screw in B, shape [..., 6].

    >>> from torchdq import dq
    >>> X_AB = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 0, 2]))
    >>> ad(X_AB, torch.tensor([1.0, 1, 1, 0, 0, 0]))
    tensor([ 1.,  1.,  1., -2.,  1.,  1.])
    """
    return computed(_ad, x=checked("x", x, 8), m=checked("m", m, 6))


def ad_matrix(x: Tensor) -> Tensor:
    """Matrix [..., 6, 6] of Ad(x) on screws, [[A_P, 0], [A_D, A_P]].

    >>> from torchdq import dq
    >>> X_AB = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 0, 2]))
    >>> ad_matrix(X_AB) @ torch.tensor([1.0, 1, 1, 0, 0, 0])
    tensor([ 1.,  1.,  1., -2.,  1.,  1.])
    """
    return computed(_ad_rows, (6, 6), x=checked("x", x, 8))


def _ad(x: DualQuaternion, m: Screw) -> Screw:
    return screw.ad(screw.columns(x), m)


def _ad_rows(x: DualQuaternion) -> tuple[tuple, ...]:
    return block_lower(*[tuple(zip(*columns, strict=True)) for columns in screw.columns(x)])


def block_lower(diagonal: Sequence[Any], below: Sequence[Any]) -> tuple[tuple, ...]:
    """Rows of the block matrix [[diagonal, 0], [below, diagonal]]."""
    none = (0.0,) * len(diagonal)
    return (*[(*d, *none) for d in diagonal], *[(*b, *d) for b, d in zip(below, diagonal, strict=True)])
