"""Inverse dynamics of an aligned mechanism: the recursion of Algorithm 1 in the frames and numbers that cost least.

It is `rnea` with the linear part of the twist left out (only the classical acceleration d = vd + w x v of each frame's
origin is needed) and every change of axes made by planar turns. The paper's recursion stays the reference; the two
agree to rounding.
"""

from collections.abc import Sequence

from torchdq.algebra import quaternion as quat
from torchdq.algebra.matrix import total
from torchdq.algebra.quaternion import Number, Pure
from torchdq.dynamics.aligned.tree import Aligned, AlignedLink, Body, Step, to_link, to_parent
from torchdq.dynamics.tree import BASE

Matrix = tuple[Pure, ...]  # three rows
ZERO: Pure = (0.0, 0.0, 0.0)


def tensor(w: Pure, wd: Pure) -> Matrix:
    """U = [wd] + [w]^2: the acceleration of a particle r of the body, relative to the origin, is U r."""
    x, y, z = w
    dx, dy, dz = wd
    xx, yy, zz, xy, xz, yz = x * x, y * y, z * z, x * y, x * z, y * z
    return ((-(yy + zz), xy - dz, xz + dy), (xy + dz, -(xx + zz), yz - dx), (xz - dy, yz + dx, -(xx + yy)))


def apply(u: Matrix, r: Pure) -> Pure:
    """U r."""
    x, y, z = (row[0] * r[0] + row[1] * r[1] + row[2] * r[2] for row in u)
    return (x, y, z)


def net_wrench(body: Body, u: Matrix, d: Pure) -> tuple[Pure, Pure]:
    """Force and moment that accelerate a body: f = m d + U h, n = h x d + vect(U E)."""
    m, h, (xx, xy, yy, xz, yz, zz) = body
    e = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))

    def ue(i: int, j: int) -> Number:
        return u[i][0] * e[0][j] + u[i][1] * e[1][j] + u[i][2] * e[2][j]

    vect = (ue(2, 1) - ue(1, 2), ue(0, 2) - ue(2, 0), ue(1, 0) - ue(0, 1))
    return quat.add(quat.scale(m, d), apply(u, h)), quat.add(quat.cross(h, d), vect)


def outward_link(
    link: AlignedLink, step: Step, parent: tuple[Pure, Pure, Pure, Matrix], qd: Number, qdd: Number
) -> tuple[Pure, Pure, Pure, Matrix]:
    """Angular velocity, angular acceleration, acceleration of the origin, and U, of a link from its parent's."""
    w_P, wd_P, d_P, u_P = parent
    w, wd = to_link(link, step, w_P), to_link(link, step, wd_P)
    d = to_link(link, step, quat.add(d_P, apply(u_P, step.p)))
    if link.kind != "revolute":
        rate, acceleration = (qd, qdd) if link.kind == "prismatic" else (link.pitch * qd, link.pitch * qdd)
        d = quat.add(d, ((w[1] + w[1]) * rate, -((w[0] + w[0]) * rate), acceleration))
    if link.kind != "prismatic":
        wd = (wd[0] + w[1] * qd, wd[1] - w[0] * qd, wd[2] + qdd)
        w = (w[0], w[1], w[2] + qd)
    return w, wd, d, tensor(w, wd)


def inverse_dynamics(
    aligned: Aligned,
    steps: Sequence[Step],
    qd: Sequence[Number] | None,
    qdd: Sequence[Number] | None,
    exerted: Sequence[tuple[Pure, Pure] | None] | None = None,
) -> list[Number]:
    """Joint torques; `exerted` are the wrenches the links exert on the environment, in aligned link frames."""
    links = aligned.links
    rest = [0.0] * len(links)
    qd, qdd = qd or rest, qdd or rest
    g = ZERO if aligned.gravity is None else quat.neg(aligned.gravity)
    base = (ZERO, ZERO, g, (ZERO, ZERO, ZERO))
    motion: list[tuple[Pure, Pure, Pure, Matrix]] = []
    net: list[tuple[Pure, Pure]] = []  # taken at once: six numbers to keep until the way back, instead of twelve
    for link, step, qd_i, qdd_i in zip(links, steps, qd, qdd, strict=True):
        parent = base if link.parent == BASE else motion[link.parent]
        motion.append(outward_link(link, step, parent, qd_i, qdd_i))
        net.append(net_wrench(link.body, motion[-1][3], motion[-1][2]))
    tau: list[Number] = [0.0] * len(links)
    passed_on: list[list[tuple[Pure, Pure]]] = [[] for _ in links]
    for i in reversed(range(len(links))):
        link, step = links[i], steps[i]
        f, n = total([net[i], None if exerted is None else exerted[i], *passed_on[i]], _add)
        force, moment = f[2], n[2]
        along = force if link.kind == "prismatic" else moment
        along = along + link.pitch * force if link.kind == "helical" else along
        tau[i] = along if link.armature is None else along + link.armature * qdd[i]
        if link.parent != BASE:
            f = to_parent(link, step, f)
            passed_on[link.parent].append((f, quat.add(to_parent(link, step, n), quat.cross(step.p, f))))
    return tau


def _add(a: tuple[Pure, Pure], b: tuple[Pure, Pure]) -> tuple[Pure, Pure]:
    return quat.add(a[0], b[0]), quat.add(a[1], b[1])
