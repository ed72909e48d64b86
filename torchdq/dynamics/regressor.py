"""Regressor: generalised forces as a linear function of the inertial parameters of the links.

    tau = Y(q, qd, qdd) pi,   pi_i = (m, m c_x, m c_y, m c_z, I_xx, I_xy, I_yy, I_xz, I_yz, I_zz)

about link i's frame (the order of Pinocchio). Link i adds to tau_k the power of its net wrench on the screw of degree
of freedom k. With d the acceleration of the frame's origin less gravity, and U = [wd] + [w]^2, that wrench is

    force  m d + U h,   moment  h x d + vect(U E),   E = tr(I)/2 1 - I
"""

from collections.abc import Mapping, Sequence

from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.dynamics.acceleration import Matrix3


def link_row(u: Matrix3, d: Pure, s: Screw) -> tuple[Number, ...]:
    """Power of a link's net wrench on the screw s, per unit of each of the ten parameters of the link."""
    s_w, s_v = s
    (x, y, z), ((u00, u01, u02), (u10, u11, u12), (u20, u21, u22)) = s_w, u
    columns = tuple(zip(*u, strict=True))
    h = quat.add(tuple(quat.dot(column, s_v) for column in columns), quat.cross(d, s_w))
    # per unit of the second moments E_xx, E_yy, E_zz and of the products of inertia I_xy = -E_xy, I_xz, I_yz
    xx, yy, zz = u10 * z - u20 * y, u21 * x - u01 * z, u02 * y - u12 * x
    xy = u21 * y - u20 * x - (u11 - u00) * z
    xz = u10 * x - u12 * z - (u00 - u22) * y
    yz = u02 * z - u01 * y - (u22 - u11) * x
    half = 0.5 * (xx + yy + zz)
    return (quat.dot(d, s_v), *h, half - xx, xy, half - yy, xz, yz, half - zz)


def regressor(
    screws: Sequence[Mapping[int, Screw]], u: Sequence[Matrix3], d: Sequence[Pure], nv: int
) -> list[list[tuple[Number, ...] | None]]:
    """Blocks [degree of freedom][link] of ten factors each; None where the joint does not move the link.

    Args:
        screws: for every link, the screws of the degrees of freedom that move it, in the link's frame.
        u, d: U, and acceleration of the origin less gravity, of every link, in its frame.
        nv: number of degrees of freedom.
    """
    Y: list[list[tuple[Number, ...] | None]] = [[None] * len(screws) for _ in range(nv)]
    for i, (moving, u_i, d_i) in enumerate(zip(screws, u, d, strict=True)):
        for k, s in moving.items():
            Y[k][i] = link_row(u_i, d_i, s)
    return Y
