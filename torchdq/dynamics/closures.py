"""Closed loops: frames A and B of two links that are held together, and accelerations that keep them so.

The gap g of a closure, in the axes of A, is zero where it is closed:

    point   the position of B                                                          3 rows
    hinge   and x and y of B's z axis, about which B may turn                          5 rows
    weld    and the axis of the rotation of B times the sine of its angle              6 rows

With dg/dt = J qd and d2g/dt2 = J qdd + gamma, the multipliers lambda of the closures are forces and torques that B has
from A, and

    M qdd = b + J^T lambda,     J qdd = c,     (J M^-1 J^T) lambda = c - J M^-1 b

Joints that move A and B alike leave the gap as it is, and have no entries in J. A row that others imply, as the third of
a point in a plane, has no multiplier.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure, Quaternion
from torchdq.dynamics import ltdl
from torchdq.dynamics.posed import Factors, Posed, Row, dot
from torchdq.numbers.functions import at_least, select

End = tuple[int, DualQuaternion]  # a frame: its link, and its pose there
# least part of a row's mobility that other rows do not imply, and least mobility of a row among those of a closure
INDEPENDENT, MOBILE = 1e-5, 1e-10
HUGE = 1e30
ROWS = {"point": 3, "hinge": 5, "weld": 6}  # of a gap
DECAY = 50.0  # rate at which gaps close where accelerations are integrated [1/s]


class Gap(NamedTuple):
    """Gap of a closure, and how it changes."""

    values: Row  # g
    columns: Mapping[int, Row]  # of J, by velocities
    rate: Row  # J v; (): at rest
    gamma: Row  # d2g/dt2 without accelerations


class Held(NamedTuple):
    """Condition J a = c on accelerations, which multipliers keep."""

    columns: Mapping[int, Row]  # of J
    accelerations: Row  # c


def gap(at: Posed, kind: str, a: End, b: End, v: Row | None = None) -> Gap:
    """Gap of a closure between frames A and B, and its motion at velocities v."""
    poses = at.poses()
    X_WA, X_WB = (dq.mul(poses[i], X) for i, X in (a, b))
    X_AB = dq.mul(dq.conj(X_WA), X_WB)
    d = dq.translation(X_AB)
    values, rate, bend = _FORMS[kind](d, X_AB[0])
    seen = at.seen_from(X_WA, [a[0], b[0]])
    columns: dict[int, Row] = {}
    for k in sorted(seen[a[0]].columns.keys() | seen[b[0]].columns.keys()):
        of_a, of_b = (seen[i].columns.get(k, screw.ZERO) for i, _ in (a, b))
        if of_a is not of_b:
            w, u = screw.sub(of_b, of_a)
            columns[k] = rate(w, quat.add(u, quat.cross(w, d)))
    if v is None:
        return Gap(values, columns, (), ())
    axes = quat.rotation_columns(X_WA[0])

    def own(x: Pure) -> Pure:
        return tuple(quat.dot(e, x) for e in axes)

    twists = at.twists(v)
    w_a, w_b = (own(at.to_world(i, twists[i][0])) for i, _ in (a, b))
    (wd_a, ud_a), (wd_b, ud_b) = (map(own, at.acceleration(*end, v, None, True)) for end in (a, b))
    speed = tuple(sum([c[i] * v[k] for k, c in columns.items()], 0.0) for i in range(len(values)))
    # the axes of A turn
    w, wd = quat.sub(w_b, w_a), quat.sub(quat.sub(wd_b, wd_a), quat.cross(w_a, quat.sub(w_b, w_a)))
    turning = quat.cross(w_a, quat.add(quat.cross(w_a, d), quat.scale(2.0, speed[:3])))
    ud = quat.sub(quat.sub(ud_b, ud_a), quat.add(quat.cross(wd_a, d), turning))
    return Gap(values, columns, speed, [x + y for x, y in zip(rate(wd, ud), bend(w), strict=True)])


_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
Rate = Callable[[Pure, Pure], Row]  # of a gap, of the angular velocity of B relative to A and the rate of its position
Form = tuple[Row, Rate, Callable[[Pure], Row]]  # gap, its rate, and its acceleration at an angular velocity alone


def _point(d: Pure, r: Quaternion) -> Form:
    return d, lambda w, u: u, lambda w: quat.ZERO


def _hinge(d: Pure, r: Quaternion) -> Form:
    z = quat.rotation_columns(r)[2]
    return (
        (*d, *z[:2]),
        lambda w, u: (*u, *quat.cross(w, z)[:2]),
        lambda w: (*quat.ZERO, *quat.cross(w, quat.cross(w, z))[:2]),
    )


def _weld(d: Pure, r: Quaternion) -> Form:
    e = quat.rotation_columns(r)

    def of_axes(turned: Callable[[Pure], Pure]) -> Pure:
        crossed = [quat.cross(axis, turned(x)) for axis, x in zip(_AXES, e, strict=True)]
        return quat.scale(0.5, quat.add(quat.add(*crossed[:2]), crossed[2]))

    return (
        (*d, *of_axes(lambda x: x)),
        lambda w, u: (*u, *of_axes(lambda x: quat.cross(w, x))),
        lambda w: (*quat.ZERO, *of_axes(lambda x: quat.cross(w, quat.cross(w, x)))),
    )


_FORMS: dict[str, Callable[[Pure, Quaternion], Form]] = {"point": _point, "hinge": _hinge, "weld": _weld}


def solve(factors: Factors, b: Row, held: Sequence[Held]) -> Row:
    """Solution a of M a = b + J^T lambda with J a = c."""
    rows = [(i, part) for part in held for i in range(len(part.accelerations))]
    J = [[part.columns[k][i] if k in part.columns else 0.0 for k in range(len(b))] for i, part in rows]
    A, free = factors.mobility(J), factors.solve(b)
    of = [[A[i][i] for i, (_, other) in enumerate(rows) if other is part] for _, part in rows]
    least = [MOBILE / len(own) * sum(own, 0.0) for own in of]  # what is less is rounding

    def pivot(i: int, left: Number) -> Number:
        independent = at_least(left, INDEPENDENT * A[i][i]) * at_least(A[i][i], least[i])
        return select(independent, left, HUGE)

    before = ltdl.dense(len(rows))
    right = [part.accelerations[i] - dot(row, free) for (i, part), row in zip(rows, J, strict=True)]
    forces = ltdl.solve(before, ltdl.factorise(before, A, pivot), right)
    return factors.solve([x + dot([row[k] for row in J], forces) for k, x in enumerate(b)])


def stabilised(closure: Gap) -> Held:
    """Condition on accelerations under which a gap decays like exp(-DECAY t), critically damped."""
    terms = zip(closure.gamma, closure.rate, closure.values, strict=True)
    return Held(closure.columns, [-(y + 2.0 * DECAY * u + DECAY * DECAY * g) for y, u, g in terms])


def at_end(closure: Gap, h: Number) -> Held:
    """Condition on the mean accelerations of a step h under which the gap is closed at its end, to third order."""
    terms = zip(closure.gamma, closure.rate, closure.values, strict=True)
    return Held(closure.columns, [-(0.5 * y + (u + g / h) / h) for y, u, g in terms])
