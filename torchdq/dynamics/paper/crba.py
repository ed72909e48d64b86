"""The mass matrix by composite rigid bodies."""

from collections.abc import Sequence

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.matrix import Rows
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Adjoint, Symmetric
from torchdq.dynamics.tree import BASE, Mechanism


def composites(
    mechanism: Mechanism, X_PB: Sequence[DualQuaternion], Ad: Sequence[Adjoint]
) -> list[tuple[Number, Pure | None, Symmetric]]:
    """Mass, first and second moment, about link i's frame, of everything that joint i carries."""
    links = mechanism.links
    composite = [(link.mass, link.first, link.second) for link in links]
    for i in reversed(range(len(links))):
        parent = links[i].parent
        if parent != BASE:
            mass, first, second = screw.carry_inertia(Ad[i], dq.translation(X_PB[i]), *composite[i])
            m, h, (x, y, z) = composite[parent]
            composite[parent] = (
                m + mass,
                first if h is None else quat.add(h, first),
                (quat.add(x, second[0]), quat.add(y, second[1]), quat.add(z, second[2])),
            )
    return composite


def mass_matrix(mechanism: Mechanism, X_PB: Sequence[DualQuaternion], Ad: Sequence[Adjoint]) -> Rows:
    """Mass matrix M(q); entries of joints that are on no common path are None.

    The inertia of everything beyond joint i is summed into one composite body; the momentum of that body under a
    unit rate of joint i, carried down the path to joint j, gives M_ij. Both triangles hold the same numbers.
    """
    links = mechanism.links
    n = len(links)
    composite = composites(mechanism, X_PB, Ad)
    M: list[list[Number | None]] = [[None] * n for _ in range(n)]
    for i, link in enumerate(links):
        momentum = screw.inertia_transform(*composite[i], link.screw)
        diagonal = screw.power(momentum, link.screw)
        M[i][i] = diagonal if link.armature is None else diagonal + link.armature
        j = i
        while links[j].parent != BASE:
            momentum = screw.ad(Ad[j], momentum)
            j = links[j].parent
            M[i][j] = M[j][i] = screw.power(momentum, links[j].screw)
    return tuple(tuple(row) for row in M)
