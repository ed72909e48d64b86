"""Quaternions, dual quaternions and screws as tensors: the public face of `torchdq.algebra`.

    quaternion        [..., 4]   (w, x, y, z)
    dual quaternion   [..., 8]   primary (w, x, y, z) | dual (w, x, y, z)
    pure quaternion   [..., 3]   a vector
    screw             [..., 6]   primary xyz | dual xyz: line (direction | moment), twist (angular | linear),
                                 wrench (force | moment)

Leading axes are batch axes and broadcast, so the paper's element-wise products (15)-(17) of vectors of screws are
`cross`, `inner` and `double_geodesic` of tensors [..., n, 6]. A matrix of dual quaternions is [..., rows, columns, 8].
The pose of B in A is X_AB = r + (eps/2) p r, and X_AC = mul(X_AB, X_BC). x and -x are the same pose.

Rows never mix: a row that is not finite, or that has no direction to normalise, is NaN in its own row only.
"""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion, quaternion, screw
from torchdq.algebra.inertia import Inertia, six
from torchdq.dq import explog
from torchdq.errors import ArgumentError, DtypeError

# --- components and tensors ------------------------------------------------------------------------------------------


def _floating(name: str, x: Tensor) -> None:
    if not isinstance(x, Tensor):
        raise ArgumentError(f"{name} must be a tensor, found {type(x).__name__}")
    if not x.dtype.is_floating_point:
        raise DtypeError(f"{name} must be a floating tensor, found {x.dtype}; convert it, e.g. {name}.double()")


def _square(name: str, x: Tensor, size: int) -> None:
    """Check that x is a matrix [..., size, size]."""
    _floating(name, x)
    if x.shape[-2:] != (size, size):
        raise ArgumentError(f"{name} must have the shape [..., {size}, {size}], found {tuple(x.shape)}")


def _matrix(name: str, x: Tensor) -> None:
    """Check that x is a matrix of dual quaternions [..., rows, columns, 8]."""
    _split(name, x, 8)
    if x.ndim < 3:
        raise ArgumentError(f"{name} must be a matrix [..., rows, columns, 8], found shape {tuple(x.shape)}")


def _split(name: str, x: Tensor, *sizes: int) -> tuple:
    """Components of x as the algebra wants them, after checking the last axis."""
    _floating(name, x)
    if x.ndim == 0 or x.shape[-1] not in sizes:
        expected = " or ".join(str(s) for s in sizes)
        raise ArgumentError(f"{name} must end with an axis of {expected} components, found shape {tuple(x.shape)}")
    parts = x.unbind(-1)
    half = {6: 3, 8: 4}.get(len(parts))
    return parts if half is None else (parts[:half], parts[half:])


def stack(components) -> Tensor:
    """Tensor [..., k] of k components, or [..., 2 k] of a pair; Python numbers become constants."""
    flat = [*components[0], *components[1]] if isinstance(components[0], tuple) else list(components)
    like = next(c for c in flat if isinstance(c, Tensor))
    flat = [c if isinstance(c, Tensor) else torch.full_like(like, c) for c in flat]
    return torch.stack(torch.broadcast_tensors(*flat), -1)


def _stack_rows(rows) -> Tensor:
    """Tensor [..., rows, k] of equally long rows of components."""
    return torch.stack(torch.broadcast_tensors(*[stack(row) for row in rows]), -2)


def _by_size(x: Tensor, four: Callable, eight: Callable) -> Callable:
    return eight if x.shape[-1] == 8 else four


# --- products --------------------------------------------------------------------------------------------------------


def mul(x: Tensor, y: Tensor) -> Tensor:
    """Product xy of two quaternions [..., 4] or two dual quaternions [..., 8]; of poses, X_AC = X_AB X_BC.

    >>> mul(torch.tensor([0.0, 1, 0, 0]), torch.tensor([0.0, 0, 1, 0]))  # i j = k
    tensor([0., 0., 0., 1.])
    """
    a, b = _split("x", x, 4, 8), _split("y", y, x.shape[-1])
    return stack(_by_size(x, quaternion.mul, dual_quaternion.mul)(a, b))


def conj(x: Tensor) -> Tensor:
    """Conjugate of a quaternion [..., 4], or of both parts of a dual quaternion [..., 8]; the inverse of a unit one.

    >>> conj(torch.tensor([1.0, 2, 3, 4]))
    tensor([ 1., -2., -3., -4.])
    """
    parts = _split("x", x, 4, 8)
    return stack(_by_size(x, quaternion.conj, dual_quaternion.conj)(parts))


def matmul(a: Tensor, b: Tensor) -> Tensor:
    """Product [..., n, m, 8] of dual quaternion matrices [..., n, k, 8] and [..., k, m, 8] (11), (12).

    >>> one = torch.tensor([1.0, 0, 0, 0, 0, 0, 0, 0])
    >>> matmul(one.expand(2, 3, 8), one.expand(3, 1, 8))[..., 0].squeeze()
    tensor([3., 3.])
    """
    _matrix("a", a)
    _matrix("b", b)
    if a.shape[-2] != b.shape[-3]:
        raise ArgumentError(f"a has {a.shape[-2]} columns and b has {b.shape[-3]} rows; they must be equal")
    return mul(a.unsqueeze(-2), b.unsqueeze(-4)).sum(-3)


def transpose(a: Tensor) -> Tensor:
    """Transpose [..., m, n, 8] of a dual quaternion matrix [..., n, m, 8] (13)."""
    _matrix("a", a)
    return a.transpose(-2, -3)


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner product -(ab + ba)/2 of pure quaternions [..., 3] (3)."""
    return quaternion.dot(_split("a", a, 3), _split("b", b, 3))


def cross(a: Tensor, b: Tensor) -> Tensor:
    """Cross product (ab - ba)/2 of pure quaternions [..., 3] (4) or of screws [..., 6] (6).

    >>> cross(torch.tensor([1.0, 0, 0]), torch.tensor([0.0, 1, 0]))
    tensor([0., 0., 1.])
    """
    parts = _split("a", a, 3, 6), _split("b", b, a.shape[-1])
    return stack((screw.cross if a.shape[-1] == 6 else quaternion.cross)(*parts))


def inner(a: Tensor, b: Tensor) -> Tensor:
    """Inner product -(ab + ba)/2 of screws [..., 6], a dual number [..., 2] (16).

    Its dual part is P(a).D(b) + D(a).P(b): the power, if one is a wrench and the other a twist.
    """
    return stack(screw.inner(_split("a", a, 6), _split("b", b, 6)))


def double_geodesic(a: Tensor, b: Tensor) -> Tensor:
    """Double geodesic product P(a).P(b) + D(a).D(b) of screws [..., 6] (7).

    It depends on the frame; the power of a wrench on a twist, `power`, does not.
    """
    return screw.double_geodesic(_split("a", a, 6), _split("b", b, 6))


def swap(a: Tensor) -> Tensor:
    """Screw [..., 6] with primary and dual parts exchanged, D(a) + eps P(a)."""
    return stack(screw.swap(_split("a", a, 6)))


def power(wrench: Tensor, twist: Tensor) -> Tensor:
    """Power f.v + m.w [W] of a wrench on a twist, both [..., 6] in the same frame (48).

    >>> power(torch.tensor([1.0, 0, 0, 0, 0, 2]), torch.tensor([0.0, 0, 3, 4, 0, 0]))
    tensor(10.)
    """
    return screw.power(_split("wrench", wrench, 6), _split("twist", twist, 6))


def t4(m: Tensor, q: Tensor) -> Tensor:
    """Combination m1 q1 + m2 q2 + m3 q3 + m4 q4 of quaternions m [..., 4 quaternions, 4] by q [..., 4] (20)."""
    _square("m", m, 4)
    return stack(quaternion.t4(tuple(_split("m", row, 4) for row in m.unbind(-2)), _split("q", q, 4)))


def t8(n: Tensor, q: Tensor) -> Tensor:
    """Combination of eight dual quaternions n [..., 8 dual quaternions, 8] by the components of q [..., 8] (21)."""
    _square("n", n, 8)
    return stack(dual_quaternion.t8(tuple(_split("n", row, 8) for row in n.unbind(-2)), _split("q", q, 8)))


def h_left(x: Tensor) -> Tensor:
    """Vector h+(x) = [x, x i, x j, x k] (22), or of a dual quaternion the eight x e_k, x eps e_k (24).

    `t4(h_left(x), y)`, or `t8`, is xy. Shape [..., 4, 4] or [..., 8, 8], one (dual) quaternion per row.
    """
    return hamilton_left(x).mT


def h_right(x: Tensor) -> Tensor:
    """Vector h-(x) = [x, i x, j x, k x] (22), or of a dual quaternion the eight e_k x, eps e_k x (24).

    `t4(h_right(x), y)`, or `t8`, is yx. Shape [..., 4, 4] or [..., 8, 8], one (dual) quaternion per row.
    """
    return hamilton_right(x).mT


def hamilton_left(x: Tensor) -> Tensor:
    """Hamilton matrix H+(x) with vec(xy) = H+(x) vec(y), [..., 4, 4] (19) or [..., 8, 8]."""
    return _hamilton(x, quaternion.hamilton_left_matrix)


def hamilton_right(x: Tensor) -> Tensor:
    """Hamilton matrix H-(x) with vec(yx) = H-(x) vec(y), [..., 4, 4] (19) or [..., 8, 8]."""
    return _hamilton(x, quaternion.hamilton_right_matrix)


def _hamilton(x: Tensor, matrix: Callable) -> Tensor:
    parts = _split("x", x, 4, 8)
    if x.shape[-1] == 4:
        return _stack_rows(matrix(parts))
    p, d = (_stack_rows(matrix(part)) for part in parts)
    return torch.cat([torch.cat([p, torch.zeros_like(p)], -1), torch.cat([d, p], -1)], -2)


# --- norms -----------------------------------------------------------------------------------------------------------


def _moderate(x: Tensor) -> tuple[Tensor, Tensor]:
    """A power of two [...], and x divided by it, so that the squares of its primary part can be written."""
    _split("x", x, 4, 8)
    _, exponent = torch.frexp(x[..., :4].detach().abs().amax(-1))
    size = torch.ldexp(torch.ones_like(x[..., 0]), exponent - 1)
    return size, x / size.unsqueeze(-1)


def norm(x: Tensor) -> Tensor:
    """Norm [...] of a quaternion [..., 4], or the dual number [..., 2] (|P|, P.D/|P|) of a dual quaternion [..., 8].

    >>> norm(torch.tensor([1.0, 2, 2, 4]))
    tensor(5.)
    """
    size, x = _moderate(x)
    parts = _split("x", x, 4, 8)
    if x.shape[-1] == 4:
        return size * quaternion.norm2(parts).sqrt()
    p2, pd2 = dual_quaternion.norm2(parts)
    p = p2.sqrt()
    return size.unsqueeze(-1) * stack((p, 0.5 * pd2 / p))


def normalize(x: Tensor) -> Tensor:
    """Closest unit quaternion [..., 4] or unit dual quaternion [..., 8] (|P| = 1, P.D = 0).

    A zero primary part has no direction: that row is NaN.
    """
    _, x = _moderate(x)
    parts = _split("x", x, 4, 8)
    if x.shape[-1] == 4:
        return x / quaternion.norm2(parts).sqrt().unsqueeze(-1)
    length = quaternion.norm2(parts[0]).sqrt().unsqueeze(-1)
    p, d = x[..., :4] / length, x[..., 4:] / length
    return torch.cat([p, d - (p * d).sum(-1, keepdim=True) * p], -1)


# --- change of frame and inertia -------------------------------------------------------------------------------------


def columns(x: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices A_P and A_D [..., 3, 3] of a pose x = X_AB [..., 8] (34), (35).

    A_P is the rotation matrix R_AB, and A_D = [p] R_AB with p the position of B's origin in A.
    """
    a_p, a_d = screw.columns(_split("x", x, 8))
    return _stack_rows(a_p).mT, _stack_rows(a_d).mT


def ad(x: Tensor, m: Tensor) -> Tensor:
    """Adjoint Ad(x) m = x m x* [..., 6]: the screw m, given in B, expressed in A, for the pose x = X_AB (33), (36).

    The same for twists, accelerations, momenta and wrenches. `ad(conj(x), m)` goes from A to B.

    >>> X_AB = from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([0.0, 0, 2]))
    >>> ad(X_AB, torch.tensor([1.0, 0, 0, 0, 0, 0]))
    tensor([1., 0., 0., 0., 2., 0.])
    """
    return stack(screw.ad(screw.columns(_split("x", x, 8)), _split("m", m, 6)))


def ad_matrix(x: Tensor) -> Tensor:
    """Matrix [..., 6, 6] of Ad(x) on screws, [[A_P, 0], [A_D, A_P]]."""
    a_p, a_d = columns(x)
    return torch.cat([torch.cat([a_p, torch.zeros_like(a_p)], -1), torch.cat([a_d, a_p], -1)], -2)


def inertia_transform(mass: Tensor, inertia: Tensor, a: Tensor, com: Tensor | None = None) -> Tensor:
    """Dual quaternion inertia transformation G(a) [..., 6]: the momentum of a body moving with the twist a (30).

        G(w + eps v) = m v + eps I w   about the centre of mass

    Args:
        mass: [kg], shape [...].
        inertia: about the centre of mass [kg m^2], symmetric, shape [..., 3, 3].
        a: twist, or spatial acceleration, shape [..., 6], in the body frame.
        com: centre of mass in the body frame [m], shape [..., 3]; None: it is the origin.
    """
    parts = _split("a", a, 6)
    _square("inertia", inertia, 3)
    i_x, i_y, i_z = (_split("inertia", row, 3) for row in inertia.unbind(-2))
    rows = (i_x, i_y, i_z)
    if com is None:
        return stack(Inertia(mass, None, rows).momentum(parts))
    return stack(Inertia.from_com(mass, _split("com", com, 3), six(rows)).momentum(parts))


# --- exponential and logarithm ---------------------------------------------------------------------------------------


def exp(a: Tensor) -> Tensor:
    """Unit dual quaternion exp(a) [..., 8] of any pure dual quaternion a [..., 6] (25)-(27).

    `exp(line * angle / 2)` is the rotation by `angle` [rad] about a unit line, and `exp(twist * dt / 2)` the motion
    with a constant body twist during dt. Accurate to rounding, with first and second derivatives, at every angle.
    The printed (25) is not the exponential unless the line meets the origin (erratum 25).

    >>> translation(exp(torch.tensor([0.0, 0, 0, 0, 0, 1])))  # half a translation by 2 m
    tensor([0., 0., 2.])
    """
    _split("a", a, 6)
    return explog.mapped(explog.exp, a)


def log(x: Tensor) -> Tensor:
    """Logarithm a [..., 6] of a unit dual quaternion x [..., 8], exp(a) = x, smooth up to a full turn.

    2 |P(a)| is the angle in [0, 2 pi] of the motion x describes with its own sign; x and -x are the same pose but
    different motions. `log_shortest` takes the shorter one. At P(x) = -1, a full turn, where every line through the
    displacement would do, the line along the displacement is taken (along x if there is none).

    >>> log(exp(torch.tensor([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))).mul(10).round().int().tolist()
    [1, 2, 3, 10, 20, 30]
    """
    _split("x", x, 8)
    return explog.mapped(explog.log, x)


def log_shortest(x: Tensor) -> Tensor:
    """Logarithm of x or -x [..., 6], whichever is the motion of less than half a turn.

    Both signs of a pose give the same result, except at exactly half a turn (w = 0): there both ways are equally
    long and x itself is taken, so that -x gives the opposite turn. The gradient jumps where the angle is pi.
    """
    _split("x", x, 8)
    return log(torch.where(x[..., :1] < 0, -x, x))


def sclerp(x: Tensor, y: Tensor, t: Tensor | float) -> Tensor:
    """Pose x exp(t log(x* y)) [..., 8]: the screw motion from x (t = 0) to y (t = 1) by the shorter way.

    Args:
        x, y: poses, shape [..., 8].
        t: fraction [1], shape [...] or a number; outside [0, 1] it extrapolates.
    """
    _split("x", x, 8)
    _split("y", y, 8)
    t = torch.as_tensor(t, dtype=x.dtype, device=x.device)
    return mul(x, exp(t.unsqueeze(-1) * log_shortest(mul(conj(x), y))))


class ScrewParameters(NamedTuple):
    """A motion as a screw: turn by `angle` about a line while sliding by `slide` along it."""

    axis: Tensor  # unit direction of the line [1], [..., 3]; along the displacement if there is no rotation
    moment: Tensor  # of the line about the origin [m], [..., 3]; zero if there is no rotation
    angle: Tensor  # [rad], [...], in [0, pi]
    slide: Tensor  # [m], [...]; the pitch slide/angle is infinite for a pure translation


def screw_params(x: Tensor) -> ScrewParameters:
    """Screw axis, moment, angle and slide of the pose x [..., 8], by the shorter way.

    >>> screw_params(exp_line := exp(torch.tensor([0.0, 0, 0.5, 0, 0, 1]))).slide
    tensor(2.)
    """
    p, d = log_shortest(x).split(3, -1)
    half = torch.linalg.vector_norm(p, dim=-1, keepdim=True)
    turns = half != 0  # also where it is NaN, which is then passed on
    length = torch.linalg.vector_norm(d, dim=-1, keepdim=True)
    moves = length != 0
    still = torch.eye(3, dtype=x.dtype, device=x.device)[0]
    axis = torch.where(
        turns, p / torch.where(turns, half, 1.0), torch.where(moves, d / torch.where(moves, length, 1.0), still)
    )
    slide = (axis * d).sum(-1, keepdim=True)
    moment = torch.where(turns, (d - slide * axis) / torch.where(turns, half, 1.0), 0.0)
    return ScrewParameters(axis, moment, 2.0 * half.squeeze(-1), 2.0 * slide.squeeze(-1))


# --- poses -----------------------------------------------------------------------------------------------------------


def from_pose(rotation: Tensor, position: Tensor) -> Tensor:
    """Pose X_AB = r + (eps/2) p r [..., 8] (28).

    Args:
        rotation: unit quaternion (w, x, y, z) that turns B components into A components, shape [..., 4].
        position: of B's origin in A [m], shape [..., 3].
    """
    return stack(dual_quaternion.from_pose(_split("rotation", rotation, 4), _split("position", position, 3)))


def rotation(x: Tensor) -> Tensor:
    """Unit quaternion r [..., 4] of the pose x [..., 8], the primary part."""
    _split("x", x, 8)
    return x[..., :4]


def translation(x: Tensor) -> Tensor:
    """Position p = 2 D P* [..., 3] of B's origin in A [m], of the pose x = X_AB [..., 8]."""
    return stack(dual_quaternion.translation(_split("x", x, 8)))


def translation_body(x: Tensor) -> Tensor:
    """Position p^b = 2 P* D [..., 3] of B's origin in B's own axes [m], of the pose x = X_AB [..., 8] (28)."""
    return stack(dual_quaternion.translation_body(_split("x", x, 8)))


def rotate(r: Tensor, v: Tensor) -> Tensor:
    """Vector r v r* [..., 3], v turned by the unit quaternion r [..., 4]."""
    return stack(quaternion.rotate(_split("r", r, 4), _split("v", v, 3)))


def to_rotation_matrix(r: Tensor) -> Tensor:
    """Rotation matrix [..., 3, 3] of a unit quaternion [..., 4]."""
    return _stack_rows(quaternion.rotation_columns(_split("r", r, 4))).mT


def from_rotation_matrix(matrix: Tensor) -> Tensor:
    """Unit quaternion [..., 4] with w >= 0 of a rotation matrix [..., 3, 3].

    The largest of the four components is taken from the diagonal and the others are divided by it, so that no
    rotation is close to a singular case.
    """
    _square("matrix", matrix, 3)
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = (row.unbind(-1) for row in matrix.unbind(-2))
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz], -1)
    sw, sx, sy, sz = squares.unbind(-1)
    candidates = torch.stack(
        [
            torch.stack([sw, zy - yz, xz - zx, yx - xy], -1),
            torch.stack([zy - yz, sx, yx + xy, xz + zx], -1),
            torch.stack([xz - zx, yx + xy, sy, zy + yz], -1),
            torch.stack([yx - xy, xz + zx, zy + yz, sz], -1),
        ],
        -2,
    )
    largest = squares.argmax(-1, keepdim=True)
    q = candidates.gather(-2, largest.unsqueeze(-1).expand(*largest.shape, 4)).squeeze(-2)
    q = q / (2.0 * squares.gather(-1, largest).sqrt())
    return torch.where(q[..., :1] < 0, -q, q)


def to_matrix(x: Tensor) -> Tensor:
    """Homogeneous matrix [..., 4, 4] of the pose x [..., 8].

    >>> to_matrix(from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3])))[:3, 3]
    tensor([1., 2., 3.])
    """
    top = torch.cat([to_rotation_matrix(rotation(x)), translation(x).unsqueeze(-1)], -1)
    bottom = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=x.dtype, device=x.device)
    return torch.cat([top, bottom.expand(*top.shape[:-2], 1, 4)], -2)


def from_matrix(matrix: Tensor) -> Tensor:
    """Pose [..., 8] of a homogeneous matrix [..., 4, 4], with w >= 0."""
    _square("matrix", matrix, 4)
    return from_pose(from_rotation_matrix(matrix[..., :3, :3]), matrix[..., :3, 3])
