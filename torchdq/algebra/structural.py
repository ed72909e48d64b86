"""Structural zeros: operations that skip absent terms (None), so that these are never multiplied, added or recorded."""

from collections.abc import Callable, Sequence
from functools import wraps

from torchdq.algebra import screw
from torchdq.algebra.screw import Screw


def lift(f: Callable) -> Callable:
    """Function that returns None if one of its arguments is None."""

    @wraps(f)
    def lifted(*args):
        return None if any(a is None for a in args) else f(*args)

    return lifted


def total(terms: Sequence, plus: Callable):
    """Sum of the terms that are present, or None."""
    present = [term for term in terms if term is not None]
    if not present:
        return None
    result = present[0]
    for term in present[1:]:
        result = plus(result, term)
    return result


def add(*terms: Screw | None) -> Screw | None:
    """Sum of the screws that are present, or None."""
    return total(terms, screw.add)


def difference(a: Sequence, b: Sequence) -> list:
    """Difference a - b, entry by entry; where b is None, it is a."""
    return [x if y is None else x - y for x, y in zip(a, b, strict=True)]


cross = lift(screw.cross)
neg = lift(screw.neg)
