"""Motion of a free base over a step, on its group: X exp(xi/2) for a displacement xi, so that no pose is special.

A method of higher order integrates the displacement from the start of the step. Its rate at a twist V is

    xi' = V + [xi, V]/2 + [xi, [xi, V]]/12 - ...

with the factors B_k/k! of Bernoulli's numbers, of which these terms are enough up to order 4 (E. Hairer, C. Lubich,
G. Wanner, Geometric Numerical Integration, 2006, section IV.7). A method of higher order takes more of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.dq.explog import entire
from torchdq.dynamics.joints import Free
from torchdq.dynamics.posed import Row
from torchdq.functions.posed import as_screw

_BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798, 174611 / 330)
ORDER_4 = (1.0 / 12.0,)
EXACT = tuple(b / math.factorial(2 * k) for k, b in enumerate(_BERNOULLI, 1))  # up to rounding, below a radian
POSE, TWIST = Free.nq, Free.nv  # numbers of a pose and of a twist


def _exp(a: Screw) -> DualQuaternion:
    return screw.exp(a, lambda v: entire(v, None))


def moved(X: Row, h: Number, rate: Row) -> tuple[Number, ...]:
    """Pose after a time h at a constant rate of the displacement."""
    return Free().moved(X, rate, h, _exp)


def rate(displacement: Row, V: Row, series: Sequence[float] = ORDER_4) -> tuple[Number, ...]:
    """Rate of a displacement at a twist, of which `series` has the terms from the second commutator on."""
    xi, twist = as_screw(displacement), as_screw(V)
    once = screw.cross(xi, twist)
    angular, linear = screw.cross(xi, once)
    c: Number = series[-1]
    slope: Number | None = None
    if len(series) > 1:
        # the series is one in the dual number xi . xi, as it would be in a real one for rotations alone
        square, dual, slope = quat.dot(xi[0], xi[0]), 2.0 * quat.dot(*xi), 0.0
        for term in series[-2::-1]:
            slope, c = slope * square + c, c * square + term
        slope = dual * slope
    linear = quat.scale(c, linear) if slope is None else quat.add(quat.scale(c, linear), quat.scale(slope, angular))
    more = (quat.scale(c, angular), linear)
    w, v = screw.add(twist, screw.add(screw.scale(0.5, once), more))
    return (*w, *v)


def unit(X: Row) -> tuple[Number, ...]:
    """Pose without the rounding errors of a step, which would add up: a unit dual quaternion to first order in them."""
    r, d = tuple(X[:4]), tuple(X[4:])
    scale = 1.5 - 0.5 * quat.norm2(r)
    along = sum((a * b for a, b in zip(r, d, strict=True)), 0.0)
    return (*(scale * a for a in r), *(scale * (b - a * along) for a, b in zip(r, d, strict=True)))
