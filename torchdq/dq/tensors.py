"""Quaternions, dual quaternions and screws as tensors: the functions of `torchdq.algebra` with checked arguments.

    quaternion        [..., 4]   (w, x, y, z)
    dual quaternion   [..., 8]   primary (w, x, y, z) | dual (w, x, y, z)
    pure quaternion   [..., 3]   a vector
    screw             [..., 6]   primary xyz | dual xyz: line (direction | moment), twist (angular | linear),
                                 wrench (force | moment)

Leading axes are batch axes and broadcast, so the paper's element-wise products (15)-(17) of vectors of screws are
`cross`, `inner` and `double_geodesic` of tensors [..., n, 6]. A matrix of dual quaternions is [..., rows, columns, 8].
The pose of B in A is X_AB = r + (eps/2) p r, and X_AC = mul(X_AB, X_BC). x and -x are the same pose.

Rows are independent: a row that is not finite, or cannot be normalised, gives NaN in its own row only.
"""

from collections.abc import Callable
from operator import index
from types import ModuleType

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion, quaternion, screw
from torchdq.algebra.inertia import Inertia, six
from torchdq.dq.components import checked, require_matrix, split, split_rows, stack, stack_rows
from torchdq.dq.formulas import computed
from torchdq.errors import ArgumentError


def _algebra(x: Tensor) -> ModuleType:
    """Algebra of quaternions [..., 4] or of dual quaternions [..., 8]."""
    return dual_quaternion if x.shape[-1] == 8 else quaternion


def _lower(diagonal: Tensor, below: Tensor) -> Tensor:
    """Block matrix [[diagonal, 0], [below, diagonal]]."""
    return torch.cat([torch.cat([diagonal, torch.zeros_like(diagonal)], -1), torch.cat([below, diagonal], -1)], -2)


# --- products --------------------------------------------------------------------------------------------------------


def mul(x: Tensor, y: Tensor) -> Tensor:
    """Product xy of two quaternions [..., 4] or two dual quaternions [..., 8]; of poses, X_AC = X_AB X_BC.

    >>> mul(torch.tensor([0.0, 1, 0, 0]), torch.tensor([0.0, 0, 1, 0]))  # i j = k
    tensor([0., 0., 0., 1.])
    """
    checked("x", x, 4, 8)
    return computed(_algebra(x).mul, x=x, y=checked("y", y, index(x.shape[-1])))


def conj(x: Tensor) -> Tensor:
    """Conjugate of a quaternion [..., 4], or of both parts of a dual quaternion [..., 8]; inverse if it is a unit one.

    >>> conj(torch.tensor([1.0, 2, 3, 4]))
    tensor([ 1., -2., -3., -4.])
    """
    return computed(_algebra(checked("x", x, 4, 8)).conj, x=x)


def matmul(a: Tensor, b: Tensor) -> Tensor:
    """Product [..., n, m, 8] of dual quaternion matrices [..., n, k, 8] and [..., k, m, 8] (11), (12).

    Args:
        a, b: matrices of dual quaternions; a has as many columns as b has rows.

    >>> one = torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0])
    >>> matmul(one.expand(2, 3, 8), one.expand(3, 1, 8))[..., 0].squeeze()
    tensor([3., 3.])
    """
    require_matrix("a", a)
    require_matrix("b", b)
    if a.shape[-2] != b.shape[-3]:
        raise ArgumentError(f"a has {a.shape[-2]} columns and b has {b.shape[-3]} rows; they must be equal")
    return mul(a.unsqueeze(-2), b.unsqueeze(-4)).sum(-3)


def transpose(a: Tensor) -> Tensor:
    """Transpose [..., m, n, 8] of a dual quaternion matrix [..., n, m, 8] (13).

    >>> transpose(torch.zeros(2, 3, 8)).shape
    torch.Size([3, 2, 8])
    """
    require_matrix("a", a)
    return a.transpose(-2, -3)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product -(ab + ba)/2 of pure quaternions [..., 3] (3).

    >>> dot(torch.tensor([1.0, 2, 3]), torch.tensor([4.0, 5, 6]))
    tensor(32.)
    """
    return computed(quaternion.dot, (), a=checked("a", a, 3), b=checked("b", b, 3))


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product (ab - ba)/2 of pure quaternions [..., 3] (4) or of screws [..., 6] (6).

    >>> cross(torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))
    tensor([0., 0., 1.])
    """
    checked("a", a, 3, 6)
    product = screw.cross if a.shape[-1] == 6 else quaternion.cross
    return computed(product, a=a, b=checked("b", b, index(a.shape[-1])))


def inner(a: Tensor, b: Tensor) -> Tensor:
    """Inner product -(ab + ba)/2 of screws [..., 6], a dual number [..., 2] (16).

    Its dual part is P(a).D(b) + D(a).P(b): the power, if one is a wrench and the other a twist.

    >>> wrench, twist = torch.tensor([1.0, 0, 0, 0, 0, 2]), torch.tensor([0.0, 0, 3, 4, 0, 0])
    >>> inner(wrench, twist)  # the second is the power
    tensor([ 0., 10.])
    """
    return computed(screw.inner, a=checked("a", a, 6), b=checked("b", b, 6))


def double_geodesic(a: Tensor, b: Tensor) -> Tensor:
    """Double geodesic product P(a).P(b) + D(a).D(b) of screws [..., 6] (7).

    It depends on the frame; the power of a wrench on a twist, `power`, does not.

    >>> double_geodesic(torch.tensor([1.0, 0, 0, 0, 0, 2]), torch.tensor([3.0, 0, 0, 0, 0, 4]))
    tensor(11.)
    """
    return computed(screw.double_geodesic, (), a=checked("a", a, 6), b=checked("b", b, 6))


def swap(a: Tensor) -> Tensor:
    """Screw [..., 6] with primary and dual parts exchanged, D(a) + eps P(a).

    >>> swap(torch.tensor([1.0, 2, 3, 4, 5, 6]))
    tensor([4., 5., 6., 1., 2., 3.])
    """
    return computed(screw.swap, a=checked("a", a, 6))


def power(wrench: Tensor, twist: Tensor) -> Tensor:
    """Power f.v + m.w [W] of a wrench on a twist, both [..., 6] in the same frame (48).

    Args:
        wrench: (force [N], moment [N m]), shape [..., 6].
        twist: (angular [rad/s], linear [m/s]), shape [..., 6].

    >>> power(torch.tensor([1.0, 0, 0, 0, 0, 2]), torch.tensor([0.0, 0, 3, 4, 0, 0]))
    tensor(10.)
    """
    return computed(screw.power, (), wrench=checked("wrench", wrench, 6), twist=checked("twist", twist, 6))


def t4(m: Tensor, q: Tensor) -> Tensor:
    """Combination m1 q1 + m2 q2 + m3 q3 + m4 q4 of quaternions m [..., 4 quaternions, 4] by q [..., 4] (20).

    >>> i, j = torch.eye(4)[1], torch.eye(4)[2]
    >>> t4(h_left(i), j)  # i j = k
    tensor([0., 0., 0., 1.])
    """
    return stack(quaternion.t4(split_rows("m", m, 4), split("q", q, 4)))


def t8(n: Tensor, q: Tensor) -> Tensor:
    """Combination of eight dual quaternions n [..., 8 dual quaternions, 8] by the components of q [..., 8] (21).

    >>> one, x = torch.eye(8)[0], torch.arange(8.0)
    >>> t8(h_left(one), x)
    tensor([0., 1., 2., 3., 4., 5., 6., 7.])
    """
    return stack(dual_quaternion.t8(split_rows("n", n, 8), split("q", q, 8)))


def h_left(x: Tensor) -> Tensor:
    """Vector h+(x) = [x, x i, x j, x k] (22), or of a dual quaternion the eight x e_k, x eps e_k (24).

    `t4(h_left(x), y)`, or `t8`, is xy. Shape [..., 4, 4] or [..., 8, 8], one (dual) quaternion per row.

    >>> h_left(torch.eye(4)[1]).int().tolist()  # i, i i = -1, i j = k, i k = -j
    [[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1], [0, 0, -1, 0]]
    """
    return hamilton_left(x).mT


def h_right(x: Tensor) -> Tensor:
    """Vector h-(x) = [x, i x, j x, k x] (22), or of a dual quaternion the eight e_k x, eps e_k x (24).

    `t4(h_right(x), y)`, or `t8`, is yx. Shape [..., 4, 4] or [..., 8, 8], one (dual) quaternion per row.

    >>> h_right(torch.eye(4)[1]).int().tolist()  # i, i i = -1, j i = -k, k i = j
    [[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]]
    """
    return hamilton_right(x).mT


def hamilton_left(x: Tensor) -> Tensor:
    """Hamilton matrix H+(x) with vec(xy) = H+(x) vec(y), [..., 4, 4] (19) or [..., 8, 8].

    >>> x, y = torch.arange(4.0), torch.ones(4)
    >>> torch.equal(hamilton_left(x) @ y, mul(x, y))
    True
    """
    return _hamilton(x, quaternion.hamilton_left_matrix)


def hamilton_right(x: Tensor) -> Tensor:
    """Hamilton matrix H-(x) with vec(yx) = H-(x) vec(y), [..., 4, 4] (19) or [..., 8, 8].

    >>> x, y = torch.arange(4.0), torch.ones(4)
    >>> torch.equal(hamilton_right(x) @ y, mul(y, x))
    True
    """
    return _hamilton(x, quaternion.hamilton_right_matrix)


def _hamilton(x: Tensor, matrix: Callable) -> Tensor:
    parts = split("x", x, 4, 8)
    if x.shape[-1] == 4:
        return stack_rows(matrix(parts))
    return _lower(*(stack_rows(matrix(part)) for part in parts))


# --- norms -----------------------------------------------------------------------------------------------------------


def _moderate(x: Tensor) -> tuple[Tensor, Tensor]:
    """Power of two [...], and x divided by it, so that squares of its primary part do not overflow or underflow."""
    _, exponent = torch.frexp(checked("x", x, 4, 8)[..., :4].detach().abs().amax(-1))
    size = torch.ldexp(torch.ones_like(x[..., 0]), exponent - 1)
    return size, x / size.unsqueeze(-1)


def norm(x: Tensor) -> Tensor:
    """Norm [...] of a quaternion [..., 4], or the dual number [..., 2] (|P|, P.D/|P|) of a dual quaternion [..., 8].

    >>> norm(torch.tensor([1.0, 2, 2, 4]))
    tensor(5.)
    """
    size, x = _moderate(x)
    parts = split("x", x, 4, 8)
    if x.shape[-1] == 4:
        return size * quaternion.norm2(parts).sqrt()
    p2, pd2 = dual_quaternion.norm2(parts)
    p = p2.sqrt()
    return size.unsqueeze(-1) * stack((p, 0.5 * pd2 / p))


def normalize(x: Tensor) -> Tensor:
    """Closest unit quaternion [..., 4] or unit dual quaternion [..., 8] (|P| = 1, P.D = 0).

    A row whose primary part is zero is NaN.

    >>> normalize(torch.tensor([0.0, 3, 0, 4]))
    tensor([0.0000, 0.6000, 0.0000, 0.8000])
    """
    _, x = _moderate(x)
    x = x / quaternion.norm2(x[..., :4].unbind(-1)).sqrt().unsqueeze(-1)
    if x.shape[-1] == 4:
        return x
    p, d = x.split(4, -1)
    return torch.cat([p, d - (p * d).sum(-1, keepdim=True) * p], -1)


# --- change of frame and inertia -------------------------------------------------------------------------------------


def columns(x: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices A_P and A_D [..., 3, 3] of the adjoint of a pose x = X_AB [..., 8] (34), (35).

    A_P is the rotation matrix R_AB, and A_D = [p] R_AB with p the position of B's origin in A.

    >>> from torchdq import dq
    >>> R_AB, _ = columns(dq.from_pose(torch.tensor([0.0, 1, 0, 0]), torch.zeros(3)))  # a half turn about x
    >>> R_AB.diagonal()
    tensor([ 1., -1., -1.])
    """
    a_p, a_d = screw.columns(split("x", x, 8))
    return stack_rows(a_p).mT, stack_rows(a_d).mT


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
    return computed(lambda x, m: screw.ad(screw.columns(x), m), x=checked("x", x, 8), m=checked("m", m, 6))


def ad_matrix(x: Tensor) -> Tensor:
    """Matrix [..., 6, 6] of Ad(x) on screws, [[A_P, 0], [A_D, A_P]].

    >>> from torchdq import dq
    >>> X_AB = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 0, 2]))
    >>> ad_matrix(X_AB) @ torch.tensor([1.0, 1, 1, 0, 0, 0])
    tensor([ 1.,  1.,  1., -2.,  1.,  1.])
    """
    return _lower(*columns(x))


def inertia_transform(mass: Tensor, inertia: Tensor, a: Tensor, com: Tensor | None = None) -> Tensor:
    """Dual quaternion inertia transformation G(a) [..., 6]: the momentum of a body moving with the twist a (30).

        G(w + eps v) = m v + eps I w   about the centre of mass

    Args:
        mass: [kg], shape [...].
        inertia: about the centre of mass [kg m^2], symmetric, shape [..., 3, 3].
        a: twist, or spatial acceleration, shape [..., 6], in the body frame.
        com: centre of mass in the body frame [m], shape [..., 3]; None: the origin.

    >>> mass, inertia = torch.tensor(2.0), torch.eye(3)
    >>> inertia_transform(mass, inertia, torch.tensor([0.0, 0, 1, 3, 0, 0]))
    tensor([6., 0., 0., 0., 0., 1.])
    """
    parts = split("a", a, 6)
    rows = split_rows("inertia", inertia, 3)
    if com is None:
        return stack(Inertia(mass, None, rows).momentum(parts))
    return stack(Inertia.from_com(mass, split("com", com, 3), six(rows)).momentum(parts))
