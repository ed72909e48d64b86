"""The closed form (57)-(72): M, c, g and J^T from dual-quaternion matrices.

    tau = M qdd + c + g + J^T f_tip   (63)

L holds the adjoint from link j to link i wherever j lies on the path from i to the base; on a chain it is the full
lower triangle (62). The mass matrix is assembled directly, never by subtracting a bias.
"""

from __future__ import annotations  # torch.compile cannot evaluate those of local functions

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra import matrix, screw
from torchdq.algebra.matrix import Rows
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.dynamics.absent import ad_inverse, momentum, total
from torchdq.dynamics.paper.rnea import Base, base_at_rest
from torchdq.dynamics.tree import BASE, Mechanism, path


class ClosedForm(NamedTuple):
    """The terms of (63); an entry that is zero by structure is None."""

    M: Rows
    c: tuple[Number | None, ...]
    g: tuple[Number | None, ...]
    Jt: tuple[Screw | None, ...] | None


def propagation(mechanism: Mechanism, Ad: Sequence[Adjoint]) -> Rows:
    """Matrix L = (I - Q)^-1 of operators A_H(x_j^i), by the recursion of its rows rather than by an inverse."""
    n = len(mechanism.links)
    rows: list[list] = []  # of Adjoint, or None
    for i, link in enumerate(mechanism.links):
        row: list = [None] * n
        row[i] = screw.IDENTITY
        if link.parent != BASE:
            step = screw.inverse(Ad[i])  # A_H(x_{i-1}^i) of (61), erratum 61
            row[link.parent] = step
            for j in path(mechanism.links, mechanism.links[link.parent].parent):
                row[j] = screw.compose(step, rows[link.parent][j])
        rows.append(row)
    return tuple(tuple(row) for row in rows)  # (62), erratum 61


def on_base_links(mechanism: Mechanism, Ad: Sequence[Adjoint], m: Screw | None) -> tuple[Screw | None, ...]:
    """Vector with a screw of the base, carried into each link that hangs on the base: W_BASE, Wdot_BASE."""
    return tuple(
        ad_inverse(Ad_i, m) if link.parent == BASE else None for link, Ad_i in zip(mechanism.links, Ad, strict=True)
    )


def closed_form(
    mechanism: Mechanism,
    Ad: Sequence[Adjoint],
    qd: Sequence[Number],
    tip: tuple[int, Adjoint] | None = None,
    base: Base | None = None,
) -> ClosedForm:
    """The mass matrix, Coriolis, gravity and tip-wrench terms of (63)."""
    links = mechanism.links
    V_W, A_W = base or base_at_rest(mechanism)
    W_base, Wd_base = on_base_links(mechanism, Ad, V_W), on_base_links(mechanism, Ad, A_W)

    def geodesic(screws: Sequence[Screw | None]) -> tuple[Number | None, ...]:
        return matrix.elementwise(screw.double_geodesic, A_S, screws)  # (17), (64)

    def inertia(v: Sequence[Screw | None]) -> tuple[Screw | None, ...]:
        return tuple(momentum(link, entry) for link, entry in zip(links, v, strict=True))  # (32)

    def inertia_rows(m: Rows) -> Rows:
        return tuple(tuple(momentum(link, entry) for entry in row) for link, row in zip(links, m, strict=True))

    A = matrix.diagonal([link.screw for link in links])  # (57)
    A_S = [screw.swap(link.screw) for link in links]  # (57), erratum 57
    L = propagation(mechanism, Ad)  # (62)
    L_H = matrix.hermitian(L)  # L*, erratum T1.4
    W = tuple(
        total(*pair) for pair in zip(matrix.act(L, matrix.combine(A, qd)), matrix.act(L, W_base), strict=True)
    )  # Table 1, row 1
    C = matrix.diagonal(matrix.elementwise(screw.cross, W, [link.screw for link in links]))  # (58)

    G_LA = inertia_rows(matrix.act_on_matrix(L, A))
    G_LC = inertia_rows(matrix.act_on_matrix(L, C))
    M = matrix.transpose(
        tuple(geodesic(column) for column in matrix.transpose(matrix.act_on_matrix(L_H, G_LA)))
    )  # (69)
    gyroscopic = matrix.elementwise(
        screw.cross,
        W,
        tuple(total(*pair) for pair in zip(matrix.combine(G_LA, qd), inertia(matrix.act(L, W_base)), strict=True)),
    )
    coriolis = matrix.combine(matrix.act_on_matrix(L_H, G_LC), qd)
    c = geodesic(
        tuple(total(*pair) for pair in zip(matrix.act(L_H, gyroscopic), coriolis, strict=True))
    )  # (70), errata 68 and 70
    g = geodesic(matrix.act(L_H, inertia(matrix.act(L, Wd_base))))  # (71), erratum 71
    Jt = None if tip is None else tip_jacobian_transpose(mechanism, L_H, *tip)
    return ClosedForm(_with_armature(mechanism, M), c, g, Jt)


def tip_jacobian_transpose(mechanism: Mechanism, L_H: Rows, i: int, Ad_BE: Adjoint) -> tuple[Screw | None, ...]:
    """Rows of J^T = A_S (*) L^H Ad(x_{n+1}^n), each the six factors of the components of f_tip."""
    rows: list[Screw | None] = []
    for link, operators in zip(mechanism.links, L_H, strict=True):
        to_link = operators[i]
        # f (.) swap(a) is the same in every frame, so the operator on f becomes its inverse on a
        rows.append(
            None if to_link is None else screw.swap(screw.ad(screw.inverse(screw.compose(to_link, Ad_BE)), link.screw))
        )
    return tuple(rows)  # (72)


def _with_armature(mechanism: Mechanism, M: Rows) -> Rows:
    """M with the rotors' inertia on its diagonal."""
    return tuple(
        tuple(m if i != j or link.armature is None else m + link.armature for j, m in enumerate(row))
        for i, (link, row) in enumerate(zip(mechanism.links, M, strict=True))
    )
