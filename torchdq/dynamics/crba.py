"""The mass matrix by composite rigid bodies."""

from collections.abc import Sequence

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.matrix import Rows
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Adjoint
from torchdq.dynamics.mechanism import BASE, Mechanism


def mass_matrix(mechanism: Mechanism, X_PB: Sequence[DualQuaternion], Ad: Sequence[Adjoint]) -> Rows:
    """Mass matrix M(q); entries of joints that are on no common path are None.

    The inertia of everything beyond joint i is summed into one composite body; the momentum of that body under a
    unit rate of joint i, carried down the path to joint j, gives M_ij. Both triangles hold the same numbers.
    """
    links = mechanism.links
    n = len(links)
    composite = [(link.mass, link.first, link.second) for link in links]
    M: list[list[Number | None]] = [[None] * n for _ in range(n)]
    for i in reversed(range(n)):
        link = links[i]
        momentum = screw.inertia_transform(*composite[i], link.screw)
        diagonal = screw.power(momentum, link.screw)
        M[i][i] = diagonal if link.armature is None else diagonal + link.armature
        j = i
        while links[j].parent != BASE:
            momentum = screw.ad(Ad[j], momentum)
            j = links[j].parent
            M[i][j] = M[j][i] = screw.power(momentum, links[j].screw)
        if link.parent != BASE:
            mass, first, second = screw.carry_inertia(Ad[i], dq.translation(X_PB[i]), *composite[i])
            m, h, inertia = composite[link.parent]
            composite[link.parent] = (
                m + mass,
                first if h is None else quat.add(h, first),
                tuple(quat.add(a, b) for a, b in zip(inertia, second, strict=True)),
            )
    return tuple(tuple(row) for row in M)
