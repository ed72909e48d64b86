"""Operators of the paper as they are printed, where this package needs fewer operations for the same result."""

from collections.abc import Sequence

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Inertia
from torchdq.algebra.quaternion import Number, Pure, Quaternion
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.dynamics.joints import Coordinate
from torchdq.dynamics.tree import Tree

Row = Sequence[Number]
QuaternionColumns = list[Quaternion]
UNITS = (quat.I, quat.J, quat.K)


def columns(x: DualQuaternion) -> tuple[QuaternionColumns, QuaternionColumns]:
    """Columns A_P, A_D of a pose as whole quaternions, by two quaternion products a column, and a doubling."""
    xp, xd = x
    rotated = [quat.mul(xp, e) for e in UNITS]
    a_p = [quat.mul(t, quat.conj(xp)) for t in rotated]  # (34), erratum 34
    a_d = [quat.scale(2.0, quat.mul(t, quat.conj(xd))) for t in rotated]  # (35), erratum 35
    return a_p, a_d


def vectors(a: tuple[QuaternionColumns, QuaternionColumns]) -> Adjoint:
    """Columns A_P, A_D without their real parts."""
    a_p, a_d = (tuple(quat.im(e) for e in part) for part in a)
    return a_p, a_d


def ad(x: DualQuaternion, m: Screw) -> Screw:
    """Adjoint x m x* by two dual quaternion products (33)."""
    p, d = dq.mul(dq.mul(x, (quat.pure(m[0]), quat.pure(m[1]))), dq.conj(x))
    return quat.im(p), quat.im(d)


def cross(a: Pure, b: Pure) -> Pure:
    """Cross product (ab - ba)/2 (4)."""
    x, y = quat.pure(a), quat.pure(b)
    return quat.im(quat.scale(0.5, quat.sub(quat.mul(x, y), quat.mul(y, x))))


def hamilton(x: DualQuaternion, y: DualQuaternion) -> DualQuaternion:
    """Product h+(x) y with the columns x i, x j, x k formed first (23), (24)."""

    def applied(a: Quaternion, b: Quaternion) -> Quaternion:
        return quat.t4((a, *(quat.mul(a, e) for e in UNITS)), b)

    (xp, xd), (yp, yd) = x, y
    return applied(xp, yp), quat.add(applied(xp, yd), applied(xd, yp))


def denavit_hartenberg(
    half: tuple[Number, Number],
    alpha: tuple[Number, Number],
    a: Number,
    d: Number,
    zero: Number = 0.0,
    one: Number = 1.0,
) -> DualQuaternion:
    """Standard transform of a joint by three products, Rot_z(theta) . Trans_z(d) Trans_x(a) . Rot_x(alpha).

    Args:
        half, alpha: cosine and sine of half the joint's angle and of half the twist.
        a, d: half the length and half the offset.
        zero, one: numbers for zeros and ones.
    """
    nothing = (zero,) * 4
    about_z = ((half[0], zero, zero, half[1]), nothing)
    along_z = ((one, zero, zero, zero), (zero, zero, zero, d))
    along_x = ((one, zero, zero, zero), (zero, a, zero, zero))
    about_x = ((alpha[0], alpha[1], zero, zero), nothing)
    return dq.mul(dq.mul(dq.mul(about_z, along_z), along_x), about_x)


def accelerated(a: Screw, qd: Number, qdd: Number, x: Adjoint, twist: Screw, acceleration: Screw) -> Screw:
    """Acceleration a qdd + Ad(x) wd + (w x a) qd of a link, from that of its parent (44)."""
    return screw.add(screw.add(screw.scale(qdd, a), screw.ad(x, acceleration)), screw.scale(qd, screw.cross(twist, a)))


def net_wrench(body: Inertia, twist: Screw, acceleration: Screw) -> Screw:
    """Net wrench w x G(w) + G(wd) on a body (45)."""
    return screw.add(screw.cross(twist, body.momentum(twist)), body.momentum(acceleration))


def rnea(
    tree: Tree,
    q: Sequence[Coordinate | None],
    qd: Row,
    qdd: Row,
    tip: Adjoint | None = None,
    f_tip: Screw | None = None,
    still: Screw = screw.ZERO,
) -> list[Number]:
    """Algorithm 1 line by line, corrected, on a chain with frames at the centres of mass; no line is shortened.

    Args:
        tip: columns of the end effector's pose on the last link.
        f_tip: wrench the end effector exerts on the environment.
        still: twist of the base, zero.
    """
    w: Screw = still
    wd: Screw = (still[0], quat.neg(tree.gravity or still[1]))
    kept = []
    for link, q_i, qd_i, qdd_i in zip(tree.links[1:], q[1:], qd, qdd, strict=True):
        a = link.joint.screw
        x = dq.mul(link.placement, link.joint.motion(q_i))  # (38), erratum 38
        back = screw.inverse(vectors(columns(x)))
        w = screw.add(screw.scale(qd_i, a), screw.ad(back, w))  # (40), erratum 40
        wd = accelerated(a, qd_i, qdd_i, back, w, wd)  # (44), erratum 40
        kept.append((screw.inverse(back), net_wrench(link.inertia, w, wd)))  # (45)
    f = None if f_tip is None or tip is None else screw.ad(tip, f_tip)
    tau: list[Number] = [0.0] * len(kept)
    for i in reversed(range(len(kept))):
        Ad, f_R = kept[i]
        f = f_R if f is None else screw.add(f_R, f)  # (47), errata 46 and 47
        tau[i] = screw.power(f, tree.links[i + 1].joint.screw)  # (48), erratum A1
        f = screw.ad(Ad, f) if i else f
    return tau
