"""Screw operations in which what is absent (None) stays absent, so that it never becomes a zero that costs time."""

from collections.abc import Callable
from functools import wraps

from torchdq.algebra import screw
from torchdq.algebra.matrix import total as _total
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.dynamics.tree import Link


def _lift(f: Callable) -> Callable:
    """f, or None as soon as one of its arguments is None."""

    @wraps(f)
    def lifted(*args):
        return None if any(a is None for a in args) else f(*args)

    return lifted


@_lift
def momentum(link: Link, a: Screw) -> Screw:
    """G_i(a) of a link."""
    return screw.inertia_transform(link.mass, link.first, link.second, a)  # (30)


@_lift
def ad_inverse(a: Adjoint, m: Screw) -> Screw:
    """Ad(x*) m from the columns of x."""
    return screw.ad(screw.inverse(a), m)


ad = _lift(screw.ad)
cross = _lift(screw.cross)
neg = _lift(screw.neg)
power = _lift(screw.power)
scale = _lift(screw.scale)


def total(*terms: Screw | None) -> Screw | None:
    """Sum of the screws that are present, or None."""
    return _total(terms, screw.add)
