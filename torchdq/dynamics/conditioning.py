"""Pivots of an elimination: their inverses, and what they tell of the digits that were lost.

The pivot D_i of a joint is the inertia that it feels when the joints beyond it are free. It would feel M_ii if they
were locked, and D_i is what subtractions leave of that. Where M_ii / D_i is large, digits were cancelled; where D_i is
not positive, the mass matrix is singular to the precision at hand.
"""

from collections.abc import Sequence
from functools import reduce

from torchdq.algebra.quaternion import Number
from torchdq.numbers.functions import maximum, minimum

HUGE = 1e30  # beyond every limit, for a pivot that is not positive


class NoInertiaError(ArithmeticError):
    """The joint of this position moves nothing, whatever the robot's own position."""

    def __init__(self, joint: int):
        super().__init__(joint)
        self.joint = joint


def inverse(joint: int, pivot: Number) -> Number:
    """Inverse of a joint's pivot."""
    if isinstance(pivot, float) and pivot == 0:
        raise NoInertiaError(joint)
    return 1.0 / pivot


def growth(diagonal: Sequence[Number], inverses: Sequence[Number]) -> Number:
    """Largest factor M_ii / D_i, or a huge one if a pivot is not positive; NaN if one is."""
    factors = [m * r for m, r in zip(diagonal, inverses, strict=True)]
    if not factors:
        return 1.0
    return maximum(reduce(maximum, factors), -HUGE * reduce(minimum, factors))
