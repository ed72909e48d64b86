"""Closed loops: frames A and B of two links that are held together, and accelerations that keep them so.

The gap g of a closure is zero where it is closed. Its rows are the vector from A's origin to B's, in axes of the base,
and cosines a_i . b_j between axes of A and of B:

    point   the vector                                          3 rows
    hinge   and a_1 . b_3, a_2 . b_3: B turns about its z axis  5 rows
    weld    and the sines (a_3 . b_2 - a_2 . b_3) / 2, ...      6 rows

With dg/dt = J qd and d2g/dt2 = J qdd + gamma, the multipliers lambda of the rows are forces and torques that B has from
A, and

    M qdd = b + J^T lambda,     J qdd = c,     (J M^-1 J^T) lambda = c - J M^-1 b

Joints that move both links alike, those before the loop, leave it as it is: rates are those with these joints at rest.
A row that others imply, as the third of a point in a plane, has no multiplier. In an elastic closure lambda is the
force of a spring and a damper on the gap.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import NamedTuple, cast

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.structural import total
from torchdq.dynamics import ltdl
from torchdq.dynamics.posed import Factors, Posed, Row, dot
from torchdq.numbers.functions import at_least, select

End = tuple[int, DualQuaternion]  # a frame: its link, and its pose there
Cosines = tuple[tuple[float, int, int], ...]  # sum of weights times a_i . b_j

_SINES: tuple[Cosines, ...] = tuple(((0.5, k - 1, k - 2), (-0.5, k - 2, k - 1)) for k in range(3))
COSINES: Mapping[str, tuple[Cosines, ...]] = {
    "point": (),
    "hinge": (((1.0, 0, 2),), ((1.0, 1, 2),)),
    "weld": _SINES,
}
ROWS = {kind: 3 + len(rows) for kind, rows in COSINES.items()}
# least part of the square of a row of J that others do not imply, and least square of a row among those of a closure
INDEPENDENT, MOBILE = 1e-6, 1e-10
HUGE = 1e30
DAMPING = 1e-6  # of least squares, relative to the mean square of the rows of a closure in metres, or of its cosines
FARTHEST = 0.5  # largest change of a step towards closed positions [rad or m]
DECAY = 50.0  # rate at which gaps close where accelerations are integrated [1/s]


class Gap(NamedTuple):
    """Gap of a closure, and how it changes."""

    values: Row  # g
    columns: Mapping[int, Row]  # of J, by joints
    rate: Row  # J qd; (): at rest
    gamma: Row  # d2g/dt2 without accelerations
    cosine: Number = 1.0  # of the angle between the axes that it holds


class Spring(NamedTuple):
    """Spring and damper on a row of a gap g: lambda = -k g - d dg/dt."""

    stiffness: Number  # k
    damping: Number  # d


class Held(NamedTuple):
    """Condition J a + e lambda = c on accelerations, which multipliers lambda keep."""

    columns: Mapping[int, Row]  # of J
    accelerations: Row  # c
    compliances: Row = ()  # e; (): zero


def gap(at: Posed, kind: str, ends: tuple[End, End], moving: Collection[int], qd: Row | None = None) -> Gap:
    """Gap of a closure of a robot on a fixed base, and its motion; `moving` are the joints of the loop."""
    points = [at.point(*end) for end in ends]
    origins = [at.position(i, point.position) for (i, _), point in zip(ends, points, strict=True)]
    of_a, of_b = ([at.to_world(i, e) for e in point.axes] for (i, _), point in zip(ends, points, strict=True))
    rows = COSINES[kind]
    # rate of a sum of cosines: the relative angular velocity times this vector
    across = [total([quat.scale(s, quat.cross(of_b[j], of_a[i])) for s, i, j in terms], quat.add) for terms in rows]
    columns: dict[int, Row] = {}
    for k, (a, b) in enumerate(zip(*(at.jacobian(*end, True) for end in ends), strict=True)):
        if k in moving and (a is not None or b is not None):
            w, u = screw.sub(b or screw.ZERO, a or screw.ZERO)
            columns[k] = (*u, *(quat.dot(m, w) for m in across))
    cosines = [sum((s * quat.dot(of_a[i], of_b[j]) for s, i, j in terms), 0.0) for terms in rows]
    values = (*quat.sub(origins[1], origins[0]), *cosines)
    along = [quat.dot(e, f) for e, f in zip(of_a, of_b, strict=True)]
    cosine = {"point": 1.0, "hinge": along[2], "weld": 0.5 * (along[0] + along[1] + along[2] - 1.0)}[kind]
    if qd is None:
        return Gap(values, columns, (), (), cosine)
    v = [x if k in columns else 0.0 for k, x in enumerate(qd)]
    rate = [sum((c[i] * v[k] for k, c in columns.items()), 0.0) for i in range(len(values))]
    (wd_a, ud_a), (wd_b, ud_b) = (at.acceleration(*end, v, None, True) for end in ends)
    gamma = [*quat.sub(ud_b, ud_a)]
    if rows:
        twists = at.twists(v)
        w_a, w_b = (at.to_world(i, twists[i][0]) for i, _ in ends)
        w, wd = quat.sub(w_b, w_a), quat.sub(wd_b, wd_a)
        for m, terms in zip(across, rows, strict=True):
            turned = [
                quat.scale(s, quat.add(_turned(w_b, of_b[j], of_a[i]), quat.cross(of_b[j], quat.cross(w_a, of_a[i]))))
                for s, i, j in terms
            ]
            gamma.append(quat.dot(m, wd) + quat.dot(total(turned, quat.add), w))
    return Gap(values, columns, rate, gamma)


def _turned(w: Pure, e: Pure, other: Pure) -> Pure:
    """Product (w x e) x other."""
    return quat.cross(quat.cross(w, e), other)


def stabilised(closure: Gap, first: int) -> Held:
    """Condition on accelerations under which a gap decays like exp(-DECAY t), critically damped.

    `first` is the place of the first joint among all velocities.
    """
    terms = zip(closure.gamma, closure.rate, closure.values, strict=True)
    return _held(closure, first, [-(y + 2.0 * DECAY * u + DECAY * DECAY * g) for y, u, g in terms])


def at_end(closure: Gap, first: int, h: Number, springs: Sequence[Spring] = ()) -> Held:
    """Condition on the mean accelerations of a step h under which the gap is closed at its end, to third order.

    With springs, the condition under which the multipliers are their forces at the end.
    """
    terms = [*zip(closure.gamma, closure.rate, closure.values, strict=True)]
    if not springs:
        return _held(closure, first, [-(0.5 * y + (u + g / h) / h) for y, u, g in terms])
    D = [d + h * k for k, d in springs]
    accelerations = [
        -(y * ((d + 0.5 * h * k) / D_i) + (u + g * (k / D_i)) / h)
        for (y, u, g), (k, d), D_i in zip(terms, springs, D, strict=True)
    ]
    return _held(closure, first, accelerations, [1.0 / (h * D_i) for D_i in D])


def torques(closure: Gap, springs: Sequence[Spring]) -> dict[int, Number]:
    """Torques of springs at the joints of a loop."""
    forces = [-(k * g + d * u) for (k, d), g, u in zip(springs, closure.values, closure.rate, strict=True)]
    return {k: dot(column, forces) for k, column in closure.columns.items()}


def _held(closure: Gap, first: int, accelerations: Row, compliances: Row = ()) -> Held:
    return Held({k + first: c for k, c in closure.columns.items()}, accelerations, compliances)


def _still(held: Held, row: int) -> bool:
    """Whether nothing moves a row by structure, as those across the plane of a loop."""
    return all(isinstance(c[row], float) and c[row] == 0 for c in held.columns.values())


def nearest(closed: Sequence[Gap], change: Sequence[Number], n: int) -> list[Number]:
    """Smallest row x of n numbers with J x = change, in the sense of damped least squares."""
    rows = [
        [g.columns[k][i] if k in g.columns else 0.0 for k in range(n)] for g in closed for i in range(len(g.values))
    ]
    A = [[dot(a, b) for b in rows] for a in rows]
    first = 0
    for g in closed:
        for part in (range(first, first + 3), range(first + 3, first + len(g.values))):
            least = sum((A[i][i] for i in part), 0.0) * (DAMPING / max(len(part), 1)) + 1.0 / HUGE
            for i in part:
                A[i][i] = A[i][i] + least
        first += len(g.values)
    before = ltdl.dense(len(rows))
    forces = ltdl.solve(before, ltdl.factorise(before, tuple(map(tuple, A))), change)
    return [dot([row[k] for row in rows], forces) for k in range(n)]


def solve(factors: Factors, b: Row, held: Sequence[Held]) -> Row:
    """Solution a of M a = b + J^T lambda with J a + e lambda = c."""
    rows = [(i, part) for part in held for i in range(len(part.accelerations)) if not _still(part, i)]
    J = [[part.columns[k][i] if k in part.columns else 0.0 for k in range(len(b))] for i, part in rows]
    half, rest = (cast("Callable[[Row], Row]", part) for part in (factors.half, factors.rest))
    A, pushed, halves = factors.mobility(tuple(map(tuple, J))), half(b), list(map(half, J))
    moved = [x * d for x, d in zip(pushed, factors.inverses, strict=True)]
    before, independent = ltdl.dense(len(rows)), _independent([part for _, part in rows], J)
    right = [part.accelerations[i] - dot(x, moved) for (i, part), x in zip(rows, halves, strict=True)]

    def pivot(k: int, left: Number) -> Number:
        i, part = rows[k]
        return left + part.compliances[i] if part.compliances else select(independent[k], left, HUGE)

    forces = ltdl.solve(before, ltdl.factorise(before, A, pivot), right)
    return rest([x + dot([row[k] for row in halves], forces) for k, x in enumerate(pushed)])


def _independent(held: Sequence[Held], J: Sequence[Row]) -> dict[int, Number]:
    """1 for every row of J that those after it do not imply, otherwise 0; whatever the masses are."""
    squares = tuple(tuple(dot(a, b) for b in J) for a in J)
    of = [[squares[k][k] for k, other in enumerate(held) if other is part] for part in held]
    least = [MOBILE / len(own) * sum(own, 0.0) for own in of]  # what is less is rounding
    found: dict[int, Number] = {}

    def pivot(i: int, left: Number) -> Number:
        found[i] = at_least(left, INDEPENDENT * squares[i][i]) * at_least(squares[i][i], least[i])
        return select(found[i], left, HUGE)

    ltdl.factorise(ltdl.dense(len(J)), squares, pivot)
    return found
