"""Poses and motions as unit dual quaternions: exponential and logarithm, interpolation, conversions.

Rows are independent: a row that is not finite gives NaN in its own row only.
"""

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion, quaternion
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Pure, Quaternion
from torchdq.base.checks import require_number
from torchdq.dq import explog, pose_error
from torchdq.dq.components import (
    checked,
    require_last_row,
    require_rotation,
    require_square,
    unit,
)
from torchdq.dq.formulas import computed
from torchdq.dq.tensors import conj, mul

# --- exponential and logarithm ---------------------------------------------------------------------------------------


def exp(a: Tensor) -> Tensor:
    """Unit dual quaternion exp(a) [..., 8] of any pure dual quaternion a [..., 6] (25)-(27).

    `exp(line * angle / 2)` is the rotation by `angle` [rad] about a unit line, and `exp(twist * dt / 2)` the motion
    with a constant body twist during dt. Accurate to rounding, with first and second derivatives, at every angle.
    The printed (25) is not the exponential unless the line meets the origin (erratum 25).

    Args:
        a: pure dual quaternion: half of a line times its angle, or half of a displacement, shape [..., 6].

    >>> translation(exp(torch.tensor([0.0, 0, 0, 1, 2, 3])))  # half of the translation
    tensor([2., 4., 6.])
    """
    return explog.mapped(explog.EXP, checked("a", a, 6))


def log(x: Tensor) -> Tensor:
    """Logarithm a [..., 6] of a unit dual quaternion x [..., 8], exp(a) = x, smooth up to a full turn.

    2 log(x) is the constant body twist that reaches x in one second; `2 * log_shortest(mul(conj(x), y))` is the one
    from a pose x to a pose y, the error of x in its own axes. 2 |P(a)| is the angle in [0, 2 pi] of the motion; x and
    -x are the same pose but different motions, of which `log_shortest` takes the shorter one. At P(x) = -1, a full
    turn, the axis is not unique: it is the line along the displacement, or along x if there is no displacement.

    >>> log(exp(torch.tensor([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))).mul(10).round().int().tolist()
    [1, 2, 3, 10, 20, 30]
    """
    return explog.mapped(explog.LOG, checked("x", x, 8))


def log_shortest(x: Tensor) -> Tensor:
    """Logarithm [..., 6] of x or -x, the one that turns by at most pi.

    Both signs of a pose give the same result, except where the angle is exactly pi (w = 0): there both turns are as
    long, and that of x is taken, so that -x gives the opposite turn. The gradient is discontinuous there.

    >>> x = exp(torch.tensor([0.0, 0, 0.5, 0, 0, 1]))
    >>> torch.allclose(log_shortest(-x), log(x))
    True
    """
    x = checked("x", x, 8)
    return log(torch.where(x[..., :1] < 0, -x, x))


def log_jacobian(x: Tensor) -> Tensor:
    """Jacobian J [..., 6, 6] of e = 2 log_shortest(x) of a pose x [..., 8], on twists xi from the left: e' = J xi.

    xi [..., 6] is the twist (angular, linear) of x' = xi x / 2. For x = conj(X) X_des, the error of a pose X, and a
    goal at rest, it is minus the twist V of X in its own axes: e' = -J V. J is regular up to half a turn.
    Source: the inverse of the left Jacobian of SE(3), Barfoot, State Estimation for Robotics, 2017, section 7.1.5.

    >>> torch.equal(log_jacobian(torch.eye(8)[0]), torch.eye(6))
    True
    """
    return computed(pose_error.jacobian, (6, 6), x=checked("x", x, 8))


def sclerp(x: Tensor, y: Tensor, t: Tensor | float) -> Tensor:
    """Pose x exp(t log(x* y)) [..., 8] on the shorter screw motion from x (t = 0) to y (t = 1).

    Args:
        x, y: poses, shape [..., 8].
        t: fraction [1], shape [...] or a number; outside [0, 1] it extrapolates.

    >>> one = torch.tensor([1.0, 0, 0, 0])
    >>> x, y = from_pose(one, torch.zeros(3)), from_pose(one, torch.tensor([2.0, 4, 6]))
    >>> translation(sclerp(x, y, 0.5))
    tensor([1., 2., 3.])
    """
    x, y = checked("x", x, 8), checked("y", y, 8)
    if not isinstance(t, Tensor):
        require_number("t", t)
    t = torch.as_tensor(t, dtype=x.dtype, device=x.device)
    return mul(x, exp(t.unsqueeze(-1) * log_shortest(mul(conj(x), y))))


def screw_path(
    x: Tensor, y: Tensor, s: Tensor | float, sd: Tensor | float, sdd: Tensor | float
) -> tuple[Tensor, Tensor, Tensor]:
    """Pose X [..., 8] on the shorter screw motion from x to y, with its twist V and the rate A [..., 6], in its axes.

        X = x exp(s a),   V = 2 sd a,   A = 2 sdd a,   a = log_shortest(x* y)

    Args:
        x, y: poses, shape [..., 8].
        s, sd, sdd: fraction of the way [1] and its derivatives [1/s, 1/s^2], shape [...] or numbers.

    >>> x = torch.eye(8)[0]
    >>> X, V, A = screw_path(x, exp(torch.tensor([0.0, 0, 0, 1, 2, 3])), 0.5, 0.25, 0.0)
    >>> translation(X), V  # 2 m along x in four seconds
    (tensor([1., 2., 3.]), tensor([0.0000, 0.0000, 0.0000, 0.5000, 1.0000, 1.5000]))
    """
    for name, k in (("s", s), ("sd", sd), ("sdd", sdd)):
        if not isinstance(k, Tensor):
            require_number(name, k)
    X, a = sclerp(x, y, s), 2.0 * log_shortest(mul(conj(x), y))
    V, A = (torch.as_tensor(k, dtype=x.dtype, device=x.device).unsqueeze(-1) * a for k in (sd, sdd))
    return X, V, A


def _rotation_rows(r: Quaternion) -> tuple[Pure, ...]:
    return tuple(zip(*quaternion.rotation_columns(r), strict=True))


def _homogeneous(x: DualQuaternion) -> tuple:
    p = dual_quaternion.translation(x)
    return *((*row, at) for row, at in zip(_rotation_rows(x[0]), p, strict=True)), (0.0, 0.0, 0.0, 1.0)


# --- poses -----------------------------------------------------------------------------------------------------------


def from_pose(rotation: Tensor, position: Tensor) -> Tensor:
    """Pose X_AB = r + (eps/2) p r [..., 8] (28).

    Args:
        rotation: unit quaternion (w, x, y, z) that turns B components into A components, shape [..., 4].
        position: position of B's origin in A [m], shape [..., 3].
    Raises:
        ArgumentError: a rotation has another norm than 1, where values can be read: not in transforms of functions.

    >>> translation(from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3])))
    tensor([1., 2., 3.])
    """
    checked("rotation", rotation, 4)
    checked("position", position, 3)
    return computed(dual_quaternion.from_pose, rotation=unit("rotation", rotation), position=position)


def rotation(x: Tensor) -> Tensor:
    """Unit quaternion r [..., 4] of the pose x [..., 8], the primary part.

    >>> rotation(from_pose(torch.tensor([0.0, 0, 0, 1]), torch.tensor([1.0, 2, 3])))
    tensor([0., 0., 0., 1.])
    """
    return checked("x", x, 8)[..., :4]


def translation(x: Tensor) -> Tensor:
    """Position p = 2 D P* [..., 3] of B's origin in A [m], of the pose x = X_AB [..., 8].

    >>> translation(torch.tensor([1.0, 0, 0, 0, 0, 0.5, 1, 1.5]))
    tensor([1., 2., 3.])
    """
    return computed(dual_quaternion.translation, x=checked("x", x, 8))


def rotate(r: Tensor, v: Tensor) -> Tensor:
    """Vector r v r* [..., 3]: v rotated by the unit quaternion r [..., 4].

    >>> r = torch.tensor([0.0, 0, 0, 1])  # a half turn about z
    >>> rotate(r, torch.tensor([1.0, 2, 3]))
    tensor([-1., -2.,  3.])
    """
    return computed(quaternion.rotate, r=checked("r", r, 4), v=checked("v", v, 3))


def to_rotation_matrix(r: Tensor) -> Tensor:
    """Rotation matrix [..., 3, 3] of a unit quaternion [..., 4].

    >>> r = torch.tensor([0.0, 0, 0, 1])  # a half turn about z
    >>> to_rotation_matrix(r)
    tensor([[-1.,  0.,  0.],
            [ 0., -1.,  0.],
            [ 0.,  0.,  1.]])
    """
    return computed(_rotation_rows, (3, 3), r=checked("r", r, 4))


def from_rotation_matrix(matrix: Tensor) -> Tensor:
    """Unit quaternion [..., 4] with w >= 0 of a rotation matrix [..., 3, 3].

    The largest of the four components is computed from the diagonal, and the others by a division by it, so that no
    rotation is close to a singularity.

    Raises:
        ArgumentError: a matrix is not a rotation, where values can be read: not in transforms of functions.

    >>> from_rotation_matrix(torch.diag(torch.tensor([-1.0, -1, 1])))  # a half turn about z
    tensor([0., 0., 0., 1.])
    """
    require_square("matrix", matrix, 3)
    require_rotation("matrix", matrix)
    rows = quaternion.from_rotation_rows(tuple([row.unbind(-1) for row in matrix.unbind(-2)]))
    candidates = torch.stack([torch.stack(row, -1) for row in rows], -2)
    squares = candidates.diagonal(dim1=-2, dim2=-1)
    largest = squares.argmax(-1, keepdim=True)
    q = candidates.gather(-2, largest.unsqueeze(-1).expand(*largest.shape, 4)).squeeze(-2)
    q = q / (2.0 * squares.gather(-1, largest).sqrt())
    return torch.where(q[..., :1] < 0, -q, q)


def to_rotation_6d(r: Tensor) -> Tensor:
    """First two columns [..., 6] of the rotation matrix of a unit quaternion [..., 4], one after the other.

    A continuous representation, for the outputs of networks. Source: Zhou et al., On the continuity of rotation
    representations in neural networks, 2019.

    >>> to_rotation_6d(torch.tensor([0.0, 0, 0, 1]))  # a half turn about z
    tensor([-1.,  0.,  0.,  0., -1.,  0.])
    """
    return to_rotation_matrix(r)[..., :2].mT.flatten(-2)


def from_rotation_6d(columns: Tensor) -> Tensor:
    """Unit quaternion [..., 4] with w >= 0 of two columns [..., 6] of any lengths, the second made orthogonal.

    Where both are parallel, up to rounding, the second is the axis in which the first is shortest instead, and the
    gradient in the second is zero. Rows of which a column is zero are NaN, since it has no direction.

    >>> from_rotation_6d(torch.tensor([-2.0, 0, 0, 1, -3, 0]))
    tensor([0., 0., 0., 1.])
    """
    x, y = (_direction(v) for v in checked("columns", columns, 6).split(3, -1))
    others = (x.detach().abs().argmin(-1, keepdim=True) == torch.arange(3, device=x.device)).to(x)
    apart = torch.linalg.cross(x, y, dim=-1).detach().abs().amax(-1, keepdim=True)
    y = torch.where(apart <= 4 * torch.finfo(x.dtype).eps, others, y)
    z = _direction(torch.linalg.cross(x, y, dim=-1))
    return from_rotation_matrix(torch.stack([x, torch.linalg.cross(z, x, dim=-1), z], -1))


def _direction(v: Tensor) -> Tensor:
    """Unit vector [..., 3] along a vector of any length, whose square may overflow or underflow."""
    v = v / v.detach().abs().amax(-1, keepdim=True)
    return v / torch.linalg.vector_norm(v, dim=-1, keepdim=True)


def to_matrix(x: Tensor) -> Tensor:
    """Homogeneous matrix [..., 4, 4] of the pose x [..., 8].

    >>> to_matrix(from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3])))[:3, 3]
    tensor([1., 2., 3.])
    """
    return computed(_homogeneous, (4, 4), x=checked("x", x, 8))


def from_matrix(matrix: Tensor) -> Tensor:
    """Pose [..., 8] of a homogeneous matrix [..., 4, 4], with w >= 0.

    Raises:
        ArgumentError: its rotation is none, or its last row is not 0, 0, 0, 1, where values can be read.

    >>> x = exp(torch.tensor([0.1, 0.2, 0.3, 1.0, 2.0, 3.0]))
    >>> torch.allclose(from_matrix(to_matrix(x)), x)
    True
    """
    require_square("matrix", matrix, 4)
    require_last_row("matrix", matrix)
    return from_pose(from_rotation_matrix(matrix[..., :3, :3]), matrix[..., :3, 3])
