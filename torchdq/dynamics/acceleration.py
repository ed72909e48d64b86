"""Accelerations of the particles of a rigid body.

The acceleration of a particle at r is d + U r, with the acceleration d of the frame's origin and

    U = [wd] + [w]^2

of the angular velocity w and its rate. U gives the acceleration of another origin, and with the mass moments of the
body the net wrench

    f = m d + U h,   n = h x d + vect(U E)

The linear part v of the body's twist does not occur: in a frame that moves with the velocity of the origin, the origin
is at rest, and forces are the same (Galilean invariance). G(A) + V x G(V) is the same wrench, computed with v.
"""

from torchdq.algebra import quaternion as quat
from torchdq.algebra.inertia import Moments, square
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw

Matrix3 = tuple[Pure, ...]  # three rows


def tensor(w: Pure, wd: Pure) -> Matrix3:
    """Matrix U = [wd] + [w]^2."""
    x, y, z = w
    dx, dy, dz = wd
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return ((-(yy + zz), xy - dz, xz + dy), (xy + dz, -(xx + zz), yz - dx), (xz - dy, yz + dx, -(xx + yy)))


def apply(u: Matrix3, r: Pure) -> Pure:
    """Product U r."""
    x, y, z = (row[0] * r[0] + row[1] * r[1] + row[2] * r[2] for row in u)
    return (x, y, z)


def net_wrench(body: Moments, u: Matrix3, d: Pure) -> Screw:
    """Net wrench (force, moment) about the origin on an accelerated body."""
    e = square(body.second)

    def ue(i: int, j: int) -> Number:
        return u[i][0] * e[0][j] + u[i][1] * e[1][j] + u[i][2] * e[2][j]

    vect = (ue(2, 1) - ue(1, 2), ue(0, 2) - ue(2, 0), ue(1, 0) - ue(0, 1))
    return (
        quat.add(quat.scale(body.mass, d), apply(u, body.first)),
        quat.add(quat.cross(body.first, d), vect),
    )
