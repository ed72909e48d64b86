"""Closed form (57)-(72): M, c, g and J^T from dual-quaternion matrices.

    tau = M qdd + c + g + J^T f_tip   (63)

L contains the adjoint from link j to link i if j lies on the path from i to the base; on a chain it is the full lower
triangle (62). Rows are links and columns degrees of freedom: a moving base is a link with six of them, so that W_BASE
is part of A qd, and Wd_BASE is the acceleration that stands for gravity. The mass matrix is computed directly, not as a
difference of torques.
"""

from __future__ import annotations  # torch.compile cannot evaluate those of local functions

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra import matrix, screw
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.algebra.structural import add, cross
from torchdq.dynamics.general.kinematics import momentum, to_link
from torchdq.dynamics.general.rnea import world_acceleration
from torchdq.dynamics.tree import WORLD, Tree, path


class Terms(NamedTuple):
    """Terms of (63); entries that are zero by structure are None."""

    M: Matrix
    c: tuple[Number | None, ...]
    g: tuple[Number | None, ...]
    Jt: tuple[Screw | None, ...] | None


def propagation(tree: Tree, Ad: Sequence[Adjoint | None]) -> Matrix:
    """Matrix L = (I - Q)^-1 of operators A_H(x_j^i), by a recursion over its rows instead of an inverse."""
    rows: list[list] = []  # entries are `Adjoint` or None
    for i, link in enumerate(tree.links):
        row: list = [None] * len(tree.links)
        row[i] = screw.IDENTITY
        step = Ad[i]
        if link.parent != WORLD:
            to_i = screw.IDENTITY if step is None else screw.inverse(step)  # A_H(x_{i-1}^i) of (61), erratum 61
            row[link.parent] = to_i
            for j in list(path(tree.links, link.parent))[1:]:
                row[j] = screw.compose(to_i, rows[link.parent][j])
        rows.append(row)
    return tuple(tuple(row) for row in rows)  # (62), erratum 61


def closed_form(
    tree: Tree,
    Ad: Sequence[Adjoint | None],
    qd: Sequence[Number],
    tip: tuple[int, Adjoint] | None = None,
) -> Terms:
    """Mass matrix, Coriolis, gravity and tip-wrench terms of (63)."""
    links, freedoms = tree.links, tree.columns()
    Wd_base: list[Screw | None] = [None] * len(links)
    Wd_base[0] = to_link(Ad[0], world_acceleration(tree))

    def geodesic(screws: Sequence[Screw | None]) -> tuple[Number | None, ...]:
        return matrix.elementwise(screw.double_geodesic, A_S, [screws[i] for i, _ in freedoms])  # (17), (64)

    def inertia(v: Sequence[Screw | None]) -> tuple[Screw | None, ...]:
        return tuple(momentum(link, entry) for link, entry in zip(links, v, strict=True))  # (32)

    def inertia_rows(m: Matrix) -> Matrix:
        return tuple(tuple(momentum(link, entry) for entry in row) for link, row in zip(links, m, strict=True))

    def of_links(entries: Sequence[Screw | None]) -> Matrix:
        return tuple(
            tuple(s if i == j else None for (j, _), s in zip(freedoms, entries, strict=True)) for i in range(len(links))
        )

    A = of_links([a for _, a in freedoms])  # (57)
    A_S = [screw.swap(a) for _, a in freedoms]  # (57), erratum 57
    L = propagation(tree, Ad)  # (62)
    L_H = matrix.hermitian(L)  # L*, erratum T1.4
    W = matrix.act(L, matrix.combine(A, qd))  # Table 1, row 1
    C = of_links([cross(W[i], a) for i, a in freedoms])  # (58)

    G_LA = inertia_rows(matrix.act_on_matrix(L, A))
    G_LC = inertia_rows(matrix.act_on_matrix(L, C))
    M = matrix.transpose(
        tuple(geodesic(column) for column in matrix.transpose(matrix.act_on_matrix(L_H, G_LA)))
    )  # (69)
    gyroscopic = [cross(w, p) for w, p in zip(W, matrix.combine(G_LA, qd), strict=True)]
    coriolis = matrix.combine(matrix.act_on_matrix(L_H, G_LC), qd)
    c = geodesic(
        tuple(add(*pair) for pair in zip(matrix.act(L_H, gyroscopic), coriolis, strict=True))
    )  # (70), errata 68 and 70
    g = geodesic(matrix.act(L_H, inertia(matrix.act(L, Wd_base))))  # (71), erratum 71
    Jt = None if tip is None else tip_jacobian_transpose(tree, L_H, *tip)
    return Terms(with_rotors(tree, M), c, g, Jt)


def tip_jacobian_transpose(tree: Tree, L_H: Matrix, i: int, Ad_BE: Adjoint) -> tuple[Screw | None, ...]:
    """Rows of J^T = A_S (*) L^H Ad(x_{n+1}^n), each the six factors of the components of f_tip."""
    rows: list[Screw | None] = []
    for j, a in tree.columns():
        to_link = L_H[j][i]
        # f (.) swap(a) does not depend on the frame, so the operator on f becomes its inverse on a
        rows.append(None if to_link is None else screw.swap(screw.ad(screw.inverse(screw.compose(to_link, Ad_BE)), a)))
    return tuple(rows)  # (72)


def with_rotors(tree: Tree, M: Matrix) -> Matrix:
    """Mass matrix with the inertia of the rotors on its diagonal."""
    rotors = {link.v.start: link.armature for link in tree.links if link.armature is not None}
    return tuple(
        tuple(m + rotors[i] if i == j and i in rotors else m for j, m in enumerate(row)) for i, row in enumerate(M)
    )
