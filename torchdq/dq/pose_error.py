"""Error of a pose as a screw, e = 2 log x, and its motion: which twist gives which rate of e, to second order.

For x' = xi x / 2, with a twist xi on the left of x,

    xi  = J(e) e',   J(e) u = u + c1 e x u + c2 e x (e x u)
    xi' = J(e) e'' + J'(e; e') e'

c1 = (1 - cos t)/t^2 and c2 = (t - sin t)/t^3 are entire functions of t^2 = e.e. All numbers are dual, so that the same
formulas hold for rotations and for poses. The series are accurate up to t = pi, the largest error of `log_shortest`.
Source: the left Jacobian of SE(3) as in Barfoot, State Estimation for Robotics, 2017, section 7.1.5, over dual numbers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.dq.explog import angle
from torchdq.numbers.functions import below, polynomial, select

_TERMS = 15  # at t = pi the next one is below 1e-17
_C1 = [(-1) ** k / math.factorial(2 * k + 2) for k in range(_TERMS + 2)]
_C2 = [(-1) ** k / math.factorial(2 * k + 3) for k in range(_TERMS + 2)]


def _derived(coefficients: list[float]) -> list[float]:
    return [k * c for k, c in enumerate(coefficients)][1:]


class _Dual(NamedTuple):
    """Dual number."""

    p: Number
    d: Number


def _times(s: _Dual, a: Screw) -> Screw:
    return quat.scale(s.p, a[0]), quat.add(quat.scale(s.p, a[1]), quat.scale(s.d, a[0]))


def _series(coefficients: list[float], x: _Dual) -> _Dual:
    return _Dual(polynomial(coefficients, x.p), x.d * polynomial(_derived(coefficients), x.p))


def error(x: DualQuaternion) -> Screw:
    """Error 2 log x or 2 log -x, the one that turns by at most pi."""
    negative = below(x[0][0], 0.0)
    p, d = (tuple([select(negative, -c, c) for c in part]) for part in x)
    a = screw.log((p, d), lambda w, n2: angle(w, n2, single=False))
    return screw.add(a, a)


def error_rate(e: Screw, xi: Screw) -> Screw:
    """Rate e' of an error, J(e)^-1 xi."""
    t2 = _Dual(*screw.inner(e, e))
    c1, slope = _series(_C1, t2), _series(_derived(_C1), t2)
    ratio = slope.p / c1.p  # J^-1 = 1 - 1/2 e x - (c1'/c1) e x (e x), a quotient of dual numbers
    c3 = _Dual(-ratio, (ratio * c1.d - slope.d) / c1.p)
    across = screw.cross(e, xi)
    return screw.add(screw.sub(xi, screw.scale(0.5, across)), _times(c3, screw.cross(e, across)))


def jacobian(x: DualQuaternion) -> tuple[tuple[Number, ...], ...]:
    """Matrix J(e)^-1 of the error e = 2 log_shortest x of a pose x, row by row."""
    e, units = error(x), [tuple([float(i == k) for i in range(6)]) for k in range(6)]
    columns = [error_rate(e, (u[:3], u[3:])) for u in units]
    return tuple(zip(*[(*p, *d) for p, d in columns], strict=True))


def twist_rate(e: Screw, rate: Screw, change: Screw) -> Screw:
    """Rate xi' of the twist under which an error with the rate e' has the second derivative `change`."""
    t2, inner = _Dual(*screw.inner(e, e)), screw.inner(e, rate)
    growth = _Dual(inner[0] + inner[0], inner[1] + inner[1])  # of t^2
    c1, c2 = _series(_C1, t2), _series(_C2, t2)
    d1, d2 = (_product(_series(_derived(c), t2), growth) for c in (_C1, _C2))
    across, turned = screw.cross(e, change), screw.cross(e, rate)
    found = screw.add(change, screw.add(_times(c1, across), _times(c2, screw.cross(e, screw.cross(e, change)))))
    found = screw.add(found, screw.add(_times(d1, turned), _times(d2, screw.cross(e, turned))))
    return screw.add(found, _times(c2, screw.cross(rate, turned)))


def _product(a: _Dual, b: _Dual) -> _Dual:
    return _Dual(a.p * b.p, a.p * b.d + a.d * b.p)
