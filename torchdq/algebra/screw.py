"""Pure dual quaternions as pairs (primary, dual) of 3-tuples: lines, twists, accelerations, momenta, wrenches.

A twist is (angular, linear) and a wrench (force, moment), both about the origin of the frame they are expressed in.
"""

from collections.abc import Callable

from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure

Screw = tuple[Pure, Pure]  # (14)
Columns = tuple[Pure, ...]  # three, of a 3x3 matrix
Adjoint = tuple[Columns, Columns]  # (A_P, A_D), for A_H of (60)

ZERO: Screw = (quat.ZERO, quat.ZERO)


def add(a: Screw, b: Screw) -> Screw:
    """Sum of two screws."""
    return (quat.add(a[0], b[0]), quat.add(a[1], b[1]))


def sub(a: Screw, b: Screw) -> Screw:
    """Difference of two screws."""
    return (quat.sub(a[0], b[0]), quat.sub(a[1], b[1]))


def neg(a: Screw) -> Screw:
    """Negative of a screw."""
    return (quat.neg(a[0]), quat.neg(a[1]))


def scale(s: Number, a: Screw) -> Screw:
    """Screw times a number."""
    return (quat.scale(s, a[0]), quat.scale(s, a[1]))


def cross(a: Screw, b: Screw) -> Screw:
    """Cross product (ab - ba)/2 = P(a) x P(b) + eps (P(a) x D(b) + D(a) x P(b))."""
    (ap, ad_), (bp, bd) = a, b
    return (quat.cross(ap, bp), quat.add(quat.cross(ap, bd), quat.cross(ad_, bp)))  # (6)


def inner(a: Screw, b: Screw) -> tuple[Number, Number]:
    """Inner product -(ab + ba)/2, a dual number (primary, dual); the dual part of wrench . twist is their power."""
    (ap, ad_), (bp, bd) = a, b
    return (quat.dot(ap, bp), quat.dot(ap, bd) + quat.dot(ad_, bp))  # (16)


def double_geodesic(a: Screw, b: Screw) -> Number:
    """Double geodesic product P(a).P(b) + D(a).D(b), a number."""
    return quat.dot(a[0], b[0]) + quat.dot(a[1], b[1])  # (7)


def swap(a: Screw) -> Screw:
    """Screw with primary and dual parts exchanged, D(a) + eps P(a)."""
    return (a[1], a[0])


def power(wrench: Screw, twist: Screw) -> Number:
    """Power f.v + m.w of a wrench on a twist, both given in the same frame; it does not depend on the frame."""
    return double_geodesic(wrench, swap(twist))  # (48)


# --- change of frame -------------------------------------------------------------------------------------------------


def columns(x: DualQuaternion) -> Adjoint:
    """Columns of the operators A_P, A_D of a pose: A_P = [x_P e x_P*], A_D = [2 Im(x_P e x_D*)] = [p x A_P e]."""
    xp, xd = x
    half = quat.im(quat.mul(xd, quat.conj(xp)))
    p = quat.add(half, half)
    a_p = quat.rotation_columns(xp)  # (34), erratum 34
    a_d = tuple(quat.cross(p, e) for e in a_p)  # (35), erratum 35
    return (a_p, a_d)


IDENTITY: Adjoint = (
    ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    (quat.ZERO, quat.ZERO, quat.ZERO),
)


def columns_times(m: Columns, v: Pure) -> Pure:
    """Product of a 3x3 matrix, given by its columns, and a vector."""
    (m00, m10, m20), (m01, m11, m21), (m02, m12, m22) = m
    x, y, z = v
    return (m00 * x + m01 * y + m02 * z, m10 * x + m11 * y + m12 * z, m20 * x + m21 * y + m22 * z)


def _transpose(m: Columns) -> Columns:
    return tuple(zip(*m, strict=True))


def ad(a: Adjoint, m: Screw) -> Screw:
    """Adjoint Ad(x) m = x m x* from the columns of x = X_AB; it transforms screws from B to A."""
    a_p, a_d = a
    return (columns_times(a_p, m[0]), quat.add(columns_times(a_p, m[1]), columns_times(a_d, m[0])))  # (36)


def inverse(a: Adjoint) -> Adjoint:
    """Columns of x* from those of x = X_AB, by transposing; they transform screws from A to B."""
    return (_transpose(a[0]), _transpose(a[1]))


def compose(a: Adjoint, b: Adjoint) -> Adjoint:
    """Columns of xy from those of x and y: Ad(xy) = Ad(x) Ad(y)."""
    p = tuple(columns_times(a[0], e) for e in b[0])
    d = tuple(quat.add(columns_times(a[0], f), columns_times(a[1], e)) for e, f in zip(b[0], b[1], strict=True))
    return (p, d)


# --- exponential and logarithm ---------------------------------------------------------------------------------------


def exp_revolute(line: Screw, cos: Number, sin: Number) -> DualQuaternion:
    """Rotation cos(t/2) + line sin(t/2) by the angle t about a unit line, from cosine and sine of the half angle."""
    axis, moment = line
    return ((cos, *quat.scale(sin, axis)), (0.0, *quat.scale(sin, moment)))  # (27)


def exp_prismatic(direction: Pure, distance: Number) -> DualQuaternion:
    """Translation 1 + eps (d/2) l by the distance d along a unit direction l."""
    return (quat.ONE, (0.0, *quat.scale(0.5 * distance, direction)))  # (27)


def exp_helical(screw: Screw, angle: Number, cos: Number, sin: Number) -> DualQuaternion:
    """Screw motion cos(t^/2) + line sin(t^/2), t^ = t (1 + eps h), of the screw l + eps (p x l + h l) and angle t."""
    axis, moment = screw
    pitch = quat.dot(axis, moment)
    slide = 0.5 * angle * pitch
    line_moment = quat.sub(moment, quat.scale(pitch, axis))
    dual = quat.add(quat.scale(sin, line_moment), quat.scale(slide * cos, axis))
    return ((cos, *quat.scale(sin, axis)), (-(slide * sin), *dual))  # (27)


def exp(a: Screw, entire: Callable[[Pure], tuple[Number, Number, Number]]) -> DualQuaternion:
    """Exponential of a pure dual quaternion a + eps b.

        exp = C + S a + eps (-S (a.b) + S b + K (a.b) a),   x = a.a

    `entire(a)` returns C = cos(sqrt x), S = sin(sqrt x)/sqrt x and K = (C - S)/x, all entire functions of x, so that
    nothing is singular at the identity; its argument is a and not the rounded x, which has lost digits of |a|.
    Departs from (25), which is not the exponential (erratum 25).
    """
    p, d = a
    c, s, k = entire(p)
    pd = quat.dot(p, d)
    dual = (-(s * pd), *quat.add(quat.scale(s, d), quat.scale(k * pd, p)))
    return ((c, *quat.scale(s, p)), dual)  # (25), (26), erratum 25


def log(x: DualQuaternion, angle: Callable[[Number, Number], tuple[Number, Number]]) -> Screw:
    """Logarithm a + eps b of a unit dual quaternion (w + v) + eps (w' + v'), the inverse of `exp`.

        a = f v,   b = f v' + (g (v.v') - w'/(w^2 + v.v)) v

    `angle(w, n2)` with n2 = v.v returns f = atan2(n, w)/n and g = (w/(w^2 + n2) - f)/n2.
    """
    (w, *v_), (dw, *dv_) = x
    v, dv = tuple(v_), tuple(dv_)
    n2 = quat.norm2(v)
    f, g = angle(w, n2)
    along = g * quat.dot(v, dv) - dw / (w * w + n2)
    return (quat.scale(f, v), quat.add(quat.scale(f, dv), quat.scale(along, v)))
