"""Forward dynamics: joint accelerations from torques, by the mass matrix and its tree-sparse factors.

M = L^T D L, eliminated from the leaves to the base, so that an entry that is zero because two joints lie on different
branches stays absent in the factors (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.5).
"""

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra.matrix import Rows
from torchdq.algebra.quaternion import Number
from torchdq.dynamics.mechanism import BASE, Mechanism, path


class Factors(NamedTuple):
    """M = L^T D L: pivots D, and L's entries below its unit diagonal as (row, column) -> number."""

    pivots: tuple[Number, ...]
    lower: dict[tuple[int, int], Number]


def factorise(mechanism: Mechanism, M: Rows) -> Factors:
    """Factors of a mass matrix; a pivot that is not positive means a configuration without inertia."""
    links = mechanism.links
    H = {(i, j): M[i][j] for i in range(len(links)) for j in path(links, i)}
    lower = {}
    for k in reversed(range(len(links))):
        for i in path(links, links[k].parent):
            ratio = H[k, i] / H[k, k]
            for j in path(links, i):
                H[i, j] = H[i, j] - ratio * H[k, j]
            lower[k, i] = ratio
    return Factors(tuple(H[k, k] for k in range(len(links))), lower)


def solve(mechanism: Mechanism, factors: Factors, b: Sequence[Number]) -> tuple[Number, ...]:
    """Solution x of M x = b."""
    links, x = mechanism.links, list(b)
    for i in reversed(range(len(links))):
        for j in path(links, links[i].parent):
            x[j] = x[j] - factors.lower[i, j] * x[i]
    x = [x_i / d for x_i, d in zip(x, factors.pivots, strict=True)]
    for i, link in enumerate(links):
        if link.parent != BASE:
            for j in path(links, link.parent):
                x[i] = x[i] - factors.lower[i, j] * x[j]
    return tuple(x)


def forward_dynamics(
    mechanism: Mechanism, M: Rows, bias: Sequence[Number | None], tau: Sequence[Number]
) -> tuple[Number, ...]:
    """Accelerations qdd = M^-1 (tau - bias), bias being the inverse dynamics at qdd = 0."""
    net = [t if b is None else t - b for t, b in zip(tau, bias, strict=True)]
    return solve(mechanism, factorise(mechanism, M), net)  # (63) solved for qdd
