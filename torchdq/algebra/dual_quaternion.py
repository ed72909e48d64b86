"""Dual quaternions as pairs (primary, dual) of quaternions; a pose is r + (eps/2) p r, and `mul` composes poses."""

from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number, Pure, Quaternion

DualQuaternion = tuple[Quaternion, Quaternion]

ZERO: Quaternion = (0.0, 0.0, 0.0, 0.0)
ONE: DualQuaternion = (quat.ONE, ZERO)


def primary(x: DualQuaternion) -> Quaternion:
    """Primary part P(x)."""
    return x[0]  # (5)


def dual(x: DualQuaternion) -> Quaternion:
    """Dual part D(x)."""
    return x[1]  # (5)


def add(x: DualQuaternion, y: DualQuaternion) -> DualQuaternion:
    """Sum of two dual quaternions."""
    return (quat.add(x[0], y[0]), quat.add(x[1], y[1]))


def scale(s: Number, x: DualQuaternion) -> DualQuaternion:
    """Dual quaternion times a number."""
    return (quat.scale(s, x[0]), quat.scale(s, x[1]))


def mul(x: DualQuaternion, y: DualQuaternion) -> DualQuaternion:
    """Product xy with eps^2 = 0: the composition of poses, X_AC = X_AB X_BC."""
    (xp, xd), (yp, yd) = x, y
    return (quat.mul(xp, yp), quat.add(quat.mul(xp, yd), quat.mul(xd, yp)))


def conj(x: DualQuaternion) -> DualQuaternion:
    """Quaternion conjugate of both parts; the inverse of a unit dual quaternion."""
    return (quat.conj(x[0]), quat.conj(x[1]))


def norm2(x: DualQuaternion) -> tuple[Number, Number]:
    """Squared norm x x*, a dual number (primary, dual)."""
    p, d = x
    pd = p[0] * d[0] + p[1] * d[1] + p[2] * d[2] + p[3] * d[3]
    return (quat.norm2(p), pd + pd)


def hamilton_left(x: DualQuaternion) -> tuple[tuple[Quaternion, ...], tuple[Quaternion, ...]]:
    """Dual Hamilton operator h+(x) = h+(P) + eps h+(D)."""
    return (quat.hamilton_left(x[0]), quat.hamilton_left(x[1]))  # (24)


def hamilton_right(x: DualQuaternion) -> tuple[tuple[Quaternion, ...], tuple[Quaternion, ...]]:
    """Dual Hamilton operator h-(x) = h-(P) + eps h-(D)."""
    return (quat.hamilton_right(x[0]), quat.hamilton_right(x[1]))  # (24)


def apply(h: tuple[tuple[Quaternion, ...], tuple[Quaternion, ...]], y: DualQuaternion) -> DualQuaternion:
    """Dual Hamilton operator applied to y: h+(x) y = xy, h-(x) y = yx."""
    hp, hd = h
    return (quat.t4(hp, y[0]), quat.add(quat.t4(hp, y[1]), quat.t4(hd, y[0])))  # (24)


def t8(n: tuple[DualQuaternion, ...], q: DualQuaternion) -> DualQuaternion:
    """Combination n1 q1 + ... + n8 q8 of eight dual quaternions by the components of q."""
    components = (*q[0], *q[1])
    total = scale(components[0], n[0])
    for column, component in zip(n[1:], components[1:], strict=True):
        total = add(total, scale(component, column))
    return total  # (21)


def from_pose(r: Quaternion, p: Pure) -> DualQuaternion:
    """Pose X_AB = r + (eps/2) p r of rotation r and position p of B's origin in A."""
    return (r, quat.scale(0.5, quat.mul(quat.pure(p), r)))  # (28)


def translation(x: DualQuaternion) -> Pure:
    """Position p = 2 D(x) P(x)* of B's origin, in A, of the pose x = X_AB."""
    half = quat.im(quat.mul(x[1], quat.conj(x[0])))
    return quat.add(half, half)  # (28)


def translation_body(x: DualQuaternion) -> Pure:
    """Position p^b = 2 P(x)* D(x) of B's origin, in B's own axes, of the pose x = X_AB."""
    half = quat.im(quat.mul(quat.conj(x[0]), x[1]))
    return quat.add(half, half)  # (28)
