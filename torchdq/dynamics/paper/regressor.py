"""The regressor: joint torques are linear in the inertial parameters of the links.

    tau = Y(q, qd, qdd) pi,   pi_i = (m, m c_x, m c_y, m c_z, I_xx, I_xy, I_yy, I_xz, I_yz, I_zz)

about link i's frame (the order of Pinocchio). Link i adds to tau_j the power of its net wrench on joint j's screw,
and that wrench is linear in pi_i:

    force  m d + wd x h + w x (w x h),   moment  I wd + w x I w + h x d,   d = vd + w x v
"""

from collections.abc import Sequence

from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.dynamics.paper.kinematics import joint_screws
from torchdq.dynamics.tree import Mechanism


def link_row(V: Screw, A: Screw, s: Screw) -> tuple[Number, ...]:
    """Power on the screw s of a link's net wrench, per unit of each of its ten parameters."""
    (w, v), (wd, vd), (s_w, s_v) = V, A, s
    d = quat.add(vd, quat.cross(w, v))
    u = quat.cross(s_w, w)
    along = quat.sub(quat.scale(quat.dot(w, s_v), w), quat.scale(quat.norm2(w), s_v))
    h = quat.add(quat.add(quat.cross(s_v, wd), along), quat.cross(d, s_w))

    def second(i: int, j: int) -> Number:
        e = s_w[i] * wd[j] + u[i] * w[j]
        return e if i == j else e + s_w[j] * wd[i] + u[j] * w[i]

    return (quat.dot(d, s_v), *h, second(0, 0), second(0, 1), second(1, 1), second(0, 2), second(1, 2), second(2, 2))


def regressor(
    mechanism: Mechanism, Ad: Sequence[Adjoint], V: Sequence[Screw], A: Sequence[Screw]
) -> list[list[tuple[Number, ...] | None]]:
    """Blocks [joint][link] of ten factors each; None where the link is not beyond the joint."""
    n = len(mechanism.links)
    Y: list[list[tuple[Number, ...] | None]] = [[None] * n for _ in range(n)]
    for i in range(n):
        for j, s in joint_screws(mechanism, Ad, i).items():
            Y[j][i] = link_row(V[i], A[i], s)
    return Y
