"""Elementary screws: rotation about and translation along one axis of the frame, by a dual angle.

    exp(k theta^/2),   theta^ = theta + eps d: rotation by theta about the axis k, translation by d along it

Their adjoint is a planar rotation of both parts of a screw, 4 multiplications each, and a shift of the dual part:

    Ad(m) = R P(m) + eps (R D(m) + d k x R P(m))
"""

from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw

X, Y, Z = 0, 1, 2  # axes of a frame
Angle = tuple[Number, Number]  # cosine and sine

UNTURNED: Angle = (1.0, 0.0)


class DualAngle(NamedTuple):
    """Dual angle of an elementary screw: cosine and sine of the angle, and the translation [m]."""

    turn: Angle
    shift: Number


def back(angle: Angle) -> Angle:
    """Opposite angle."""
    return (angle[0], -angle[1])


def together(a: Angle, b: Angle) -> Angle:
    """Sum of two angles."""
    c, s, _ = turn(Z, a, (b[0], b[1], 0.0))
    return (c, s)


def turn(axis: int, angle: Angle, v: Pure) -> Pure:
    """Vector R v for the rotation R about an axis."""
    c, s = angle
    i, j = (axis + 1) % 3, (axis + 2) % 3
    result = list(v)
    result[i], result[j] = c * v[i] - s * v[j], s * v[i] + c * v[j]
    return tuple(result)


def unit(axis: int, length: Number = 1.0) -> Pure:
    """Vector along an axis, of a given length."""
    x: list[Number] = [0.0] * 3
    x[axis] = length
    return tuple(x)


def shift(p: Pure, m: Screw) -> Screw:
    """Adjoint of a translation by p: p x P(m) is added to the dual part."""
    return (m[0], quat.add(m[1], quat.cross(p, m[0])))


def ad(axis: int, angle: DualAngle, m: Screw) -> Screw:
    """Adjoint Ad(exp(k theta^/2)) m of an elementary screw."""
    turned = (turn(axis, angle.turn, m[0]), turn(axis, angle.turn, m[1]))
    return shift(unit(axis, angle.shift), turned)  # (33) with x of (27)


def times(x: DualQuaternion, axis: int, half: Angle, d: Number) -> DualQuaternion:
    """Product x exp(k theta^/2) of a pose and an elementary screw, from half of the angle and the translation d [m]."""
    p, e = x
    r = (half[0], *unit(axis, half[1]))
    moved = quat.add(e, quat.mul(p, (0.0, *unit(axis, 0.5 * d))))
    return (quat.mul(p, r), quat.mul(moved, r))  # (27), (28)
