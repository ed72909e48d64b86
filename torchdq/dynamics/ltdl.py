"""Forward dynamics: joint accelerations from torques, by the mass matrix and its tree-sparse factors.

M = L^T D L, eliminated from the leaves to the base, so that an entry that is zero because two joints lie on different
branches stays absent in the factors (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.5).
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from torchdq.algebra.matrix import Rows
from torchdq.algebra.quaternion import Number
from torchdq.dynamics.conditioning import inverse
from torchdq.dynamics.tree import BASE, path

Links = Sequence[Any]  # of a mechanism or an aligned one; only their parents are read


class Factors(NamedTuple):
    """M = L^T D L: the inverses of D, and L's entries below its unit diagonal as (row, column) -> number."""

    inverses: tuple[Number, ...]
    lower: dict[tuple[int, int], Number]


def factorise(links: Links, M: Rows) -> Factors:
    """Factors of a mass matrix; a D that is not positive means a position without inertia."""
    H = {(i, j): M[i][j] for i in range(len(links)) for j in path(links, i)}
    lower = {}
    inverses: list[Number] = [0.0] * len(links)
    for k in reversed(range(len(links))):
        inverses[k] = inverse(k, H[k, k])
        for i in path(links, links[k].parent):
            ratio = H[k, i] * inverses[k]
            for j in path(links, i):
                H[i, j] = H[i, j] - ratio * H[k, j]
            lower[k, i] = ratio
    return Factors(tuple(inverses), lower)


def solve(links: Links, factors: Factors, b: Sequence[Number]) -> tuple[Number, ...]:
    """Solution x of M x = b."""
    x = list(b)
    for i in reversed(range(len(links))):
        for j in path(links, links[i].parent):
            x[j] = x[j] - factors.lower[i, j] * x[i]
    x = [x_i * d for x_i, d in zip(x, factors.inverses, strict=True)]
    for i, link in enumerate(links):
        if link.parent != BASE:
            for j in path(links, link.parent):
                x[i] = x[i] - factors.lower[i, j] * x[j]
    return tuple(x)
