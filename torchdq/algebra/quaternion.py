"""Quaternions as component tuples (w, x, y, z); pure quaternions, the paper's vectors, as (x, y, z)."""

from typing import Any

Number = Any  # whatever has + - * /
# lengths are not in the types: a type checker cannot follow them through zip and unbind
Pure = tuple[Number, ...]  # (x, y, z)
Quaternion = tuple[Number, ...]  # (w, x, y, z)

ONE: Quaternion = (1.0, 0.0, 0.0, 0.0)
I: Quaternion = (0.0, 1.0, 0.0, 0.0)
J: Quaternion = (0.0, 0.0, 1.0, 0.0)
K: Quaternion = (0.0, 0.0, 0.0, 1.0)
ZERO: Pure = (0.0, 0.0, 0.0)
UNITS: tuple[Pure, Pure, Pure] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def add(a, b):
    """Sum of two component tuples of the same length."""
    return tuple(x + y for x, y in zip(a, b, strict=True))


def sub(a, b):
    """Difference of two component tuples of the same length."""
    return tuple(x - y for x, y in zip(a, b, strict=True))


def neg(a):
    """Negative of a component tuple."""
    return tuple(-x for x in a)


def scale(s: Number, a):
    """Component tuple times a number."""
    return tuple(s * x for x in a)


def mul(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product ab."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )  # (1)


def conj(q: Quaternion) -> Quaternion:
    """Conjugate Re(q) - Im(q)."""
    w, x, y, z = q
    return (w, -x, -y, -z)


def norm2(q) -> Number:
    """Squared norm q q*, also the squared length of a pure quaternion."""
    total = q[0] * q[0]
    for x in q[1:]:
        total = total + x * x
    return total


def im(q: Quaternion) -> Pure:
    """Imaginary component of a quaternion, a pure quaternion."""
    return q[1:]


def pure(v: Pure) -> Quaternion:
    """Pure quaternion with the imaginary component v."""
    return (0.0, *v)  # (2)


def dot(a: Pure, b: Pure) -> Number:
    """Inner product -(ab + ba)/2 of pure quaternions."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]  # (3)


def cross(a: Pure, b: Pure) -> Pure:
    """Cross product (ab - ba)/2 of pure quaternions."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])  # (4)


def rotate(r: Quaternion, v: Pure) -> Pure:
    """Adjoint r v r* = v + w t + u x t, t = 2 u x v, of a pure quaternion v by a unit quaternion r = w + u."""
    w, u = r[0], r[1:]
    t = cross(u, v)
    t = add(t, t)
    return add(v, add(scale(w, t), cross(u, t)))


def rotation_columns(r: Quaternion) -> tuple[Pure, Pure, Pure]:
    """Columns r i r*, r j r*, r k r* of the rotation matrix of a unit quaternion."""
    w, x, y, z = r
    x2, y2, z2 = x + x, y + y, z + z
    wx, wy, wz = w * x2, w * y2, w * z2
    xx, xy, xz = x * x2, x * y2, x * z2
    yy, yz, zz = y * y2, y * z2, z * z2
    return (
        (1.0 - (yy + zz), xy + wz, xz - wy),
        (xy - wz, 1.0 - (xx + zz), yz + wx),
        (xz + wy, yz - wx, 1.0 - (xx + yy)),
    )


def from_rotation_rows(rows: tuple[Pure, ...]) -> tuple[Quaternion, ...]:
    """Rows of 4 r r^T for the unit quaternions r and -r of a rotation matrix: each row is one of them, scaled.

    The row with the largest diagonal entry is the one to normalise: no rotation is close to a singularity of it.
    """
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = rows
    return (
        (1.0 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1.0 + xx - yy - zz, yx + xy, xz + zx),
        (xz - zx, yx + xy, 1.0 - xx + yy - zz, zy + yz),
        (yx - xy, xz + zx, zy + yz, 1.0 - xx - yy + zz),
    )


def hamilton_left_matrix(x: Quaternion) -> tuple[Quaternion, ...]:
    """Rows of the Hamilton operator H+(x): vec(x y) = H+(x) vec(y)."""
    w, i, j, k = x
    return ((w, -i, -j, -k), (i, w, -k, j), (j, k, w, -i), (k, -j, i, w))  # (19)


def hamilton_right_matrix(x: Quaternion) -> tuple[Quaternion, ...]:
    """Rows of the Hamilton operator H-(x): vec(y x) = H-(x) vec(y)."""
    w, i, j, k = x
    return ((w, -i, -j, -k), (i, w, k, -j), (j, -k, w, i), (k, j, -i, w))  # (19)


def t4(m: tuple[Quaternion, ...], q: Quaternion) -> Quaternion:
    """Combination m1 q1 + m2 q2 + m3 q3 + m4 q4 of four quaternions by the components of q."""
    total = scale(q[0], m[0])
    for column, component in zip(m[1:], q[1:], strict=True):
        total = add(total, scale(component, column))
    return total  # (20)


def hamilton_left(x: Quaternion) -> tuple[Quaternion, ...]:
    """Quaternion vector h+(x) = [x, x i, x j, x k]: t4(h+(x), y) = x y."""
    w, i, j, k = x
    return (x, (-i, w, k, -j), (-j, -k, w, i), (-k, j, -i, w))  # (22), erratum 22


def hamilton_right(x: Quaternion) -> tuple[Quaternion, ...]:
    """Quaternion vector h-(x) = [x, i x, j x, k x]: t4(h-(x), y) = y x."""
    w, i, j, k = x
    return (x, (-i, w, -k, j), (-j, k, w, -i), (-k, -j, i, w))  # (22), erratum 22
