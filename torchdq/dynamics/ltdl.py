"""Sparse factors of a mass matrix, and the solution of M x = b with them.

M = L^T D L, eliminated from the leaves to the base: entries that are zero because two joints lie on different branches
are zero in the factors too (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 6.5).
"""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number
from torchdq.dynamics.error_growth import inverse


class TreeFactors(NamedTuple):
    """Factors of M = L^T D L: the inverses of D, and the entries of L below its unit diagonal by (row, column)."""

    inverses: tuple[Number, ...]
    lower: dict[tuple[int, int], Number]


def _path(before: Sequence[int], i: int) -> Iterator[int]:
    """Degrees of freedom on the path from i to the base, i first."""
    while i >= 0:
        yield i
        i = before[i]


def predecessors(M: Matrix) -> tuple[int, ...]:
    """Elimination tree of a mass matrix whose zeros are None: the factors are zero off its paths to the root.

    Row k of L has entries where M has, and where a row that was eliminated before it left some (Davis, Direct Methods
    for Sparse Linear Systems, 2006, section 4.1).
    """
    before: list[int] = []
    left: list[set[int]] = [{j for j in range(i) if M[i][j] is not None} for i in range(len(M))]
    for k in reversed(range(len(M))):
        parent = max(left[k], default=-1)
        if parent >= 0:
            left[parent] |= left[k] - {parent}
        before.insert(0, parent)
    return tuple(before)


def dense(m: int) -> tuple[int, ...]:
    """Predecessors of a matrix without zeros."""
    return tuple(range(-1, m - 1))


def factorise(before: Sequence[int], M: Matrix, pivot: Callable[[int, Number], Number] | None = None) -> TreeFactors:
    """Factors of a mass matrix, or of another symmetric one.

    Args:
        before: for every degree of freedom, the one before it on the path from the base; -1: none.
        M: mass matrix; entries of degrees of freedom on different branches are not read.
        pivot: pivot that takes the place of one, by its number; None: itself.
    """
    n = len(before)
    H: dict[tuple[int, int], Number] = {}
    for i in range(n):
        for j in _path(before, i):
            entry = M[i][j]
            H[i, j] = 0.0 if entry is None else entry
    lower = {}
    inverses: list[Number] = [0.0] * n
    for k in reversed(range(n)):
        inverses[k] = inverse(k, H[k, k] if pivot is None else pivot(k, H[k, k]))
        for i in _path(before, before[k]):
            ratio = H[k, i] * inverses[k]
            for j in _path(before, i):
                H[i, j] = H[i, j] - ratio * H[k, j]
            lower[k, i] = ratio
    return TreeFactors(tuple(inverses), lower)


def half(before: Sequence[int], factors: TreeFactors, b: Sequence[Number]) -> list[Number]:
    """Product L^-T b; b^T M^-1 b is the sum of its squares over the pivots D."""
    x = list(b)
    for i in reversed(range(len(x))):
        for j in _path(before, before[i]):
            x[j] = x[j] - factors.lower[i, j] * x[i]
    return x


def solve(before: Sequence[int], factors: TreeFactors, b: Sequence[Number]) -> tuple[Number, ...]:
    """Solution x of M x = b."""
    return rest(before, factors, half(before, factors, b))


def rest(before: Sequence[int], factors: TreeFactors, b: Sequence[Number]) -> tuple[Number, ...]:
    """Solution x of D L x = b: of M x = L^T b, the product `half` being b."""
    x = [x_i * d for x_i, d in zip(b, factors.inverses, strict=True)]
    for i in range(len(x)):
        for j in _path(before, before[i]):
            x[i] = x[i] - factors.lower[i, j] * x[j]
    return tuple(x)
