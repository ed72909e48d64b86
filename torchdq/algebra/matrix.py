"""Vectors and matrices of dual quaternions, of screws, and of adjoint operators, as nested tuples.

A matrix is a tuple of rows. An entry that is zero by structure is `None`: it is never multiplied or added.
"""

from collections.abc import Callable, Sequence

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import screw
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.algebra.structural import total

Matrix = tuple[tuple, ...]  # (8), (12)


def elementwise(f: Callable, *vectors: Sequence) -> tuple:
    """Vector of f(entries) of vectors of equal length; None where an entry is None.

    With f = `screw.cross` it is the product (15), with `screw.inner` (16), with `screw.double_geodesic` (17).
    """
    return tuple(None if any(e is None for e in entries) else f(*entries) for entries in zip(*vectors, strict=True))


def transpose(q: Matrix) -> Matrix:
    """Transpose of a matrix, whatever its entries are."""
    return tuple(zip(*q, strict=True))  # (9), (13)


def conj(q: Matrix) -> Matrix:
    """Entry-wise conjugate of a matrix of dual quaternions, without transposing."""
    return tuple(tuple(None if x is None else dq.conj(x) for x in row) for row in q)  # (9), (13)


def add(a: Matrix, b: Matrix, plus: Callable = dq.add) -> Matrix:
    """Sum of two matrices of the same shape, None counting as zero."""
    return tuple(tuple(total(pair, plus) for pair in zip(x, y, strict=True)) for x, y in zip(a, b, strict=True))  # (10)


def matmul(a: Matrix, b: Matrix, times: Callable = dq.mul, plus: Callable = dq.add) -> Matrix:
    """Matrix product, by default of dual quaternion matrices; None entries are skipped."""
    return tuple(
        tuple(total(elementwise(times, row, column), plus) for column in transpose(b)) for row in a
    )  # (11), (12)


def matvec(a: Matrix, v: Sequence, times: Callable, plus: Callable) -> tuple:
    """Matrix times vector; None entries are skipped."""
    return tuple(total(elementwise(times, row, v), plus) for row in a)


def act(operators: Matrix, v: Sequence[Screw | None]) -> tuple[Screw | None, ...]:
    """Matrix of adjoint operators applied to a vector of screws."""
    return matvec(operators, v, screw.ad, screw.add)


def act_on_matrix(operators: Matrix, m: Matrix) -> Matrix:
    """Matrix of adjoint operators times a matrix of screws."""
    return matmul(operators, m, screw.ad, screw.add)


def combine(m: Matrix, numbers: Sequence[Number]) -> tuple[Screw | None, ...]:
    """Matrix of screws times a vector of numbers."""
    return matvec(m, numbers, lambda s, x: screw.scale(x, s), screw.add)


def hermitian(operators: Matrix) -> Matrix:
    """Conjugate transpose L^H of a matrix of adjoint operators: the transpose, with every operator inverted.

    The paper writes L*; by its own (13) that would leave out the transposition (erratum T1.4).
    """
    return tuple(elementwise(screw.inverse, row) for row in transpose(operators))
