"""Pivots of the elimination of a mass matrix: their inverses, and the growth of rounding errors.

The pivot D_i of a joint is the inertia at the joint if the joints beyond it are free; M_ii is the inertia if they are
locked. D_i is computed from M_ii by subtractions: a large M_ii / D_i means cancellation of digits, and a D_i that is
not positive means that the mass matrix is singular to working precision.
"""

from collections.abc import Sequence
from functools import reduce

from torchdq.algebra.quaternion import Number
from torchdq.numbers.functions import at_least, maximum, minimum, select

HUGE = 1e30  # factor for a pivot that is not positive, above every limit


class NoInertiaError(ArithmeticError):
    """Error for a joint that moves no inertia in any position of the robot."""

    def __init__(self, joint: int):
        super().__init__(joint)
        self.joint = joint


def inverse(joint: int, pivot: Number) -> Number:
    """Inverse of a joint's pivot."""
    if isinstance(pivot, float) and pivot == 0:
        raise NoInertiaError(joint)
    return 1.0 / pivot


def growth(diagonal: Sequence[Number], inverses: Sequence[Number]) -> Number:
    """Largest factor M_ii / D_i; at least 1e30 if a pivot is not positive, NaN if one is NaN."""
    factors = [m * r for m, r in zip(diagonal, inverses, strict=True)]
    if not factors:
        return 1.0
    # M_ii / D_i would be positive where both are negative
    return select(at_least(0.0, reduce(minimum, inverses)), HUGE, reduce(maximum, factors))
