"""Motion of a floating base over a step: its centre of mass on a straight line, its axes on the group of rotations.

B is the frame of the base, C the one with its axes at its centre of mass c, and S, which stands still, the place of C
at the start of the step. Integrators integrate the pose X_SC, which begins with 1, the angular velocity w of C in its
own axes, and the velocity u of its origin in those of S:

    X_SC' = T(h u) X_SC exp(h w/2),   T(p) = 1 + eps p/2

A body without forces has a constant u, so that every integrator keeps its linear momentum. Of the twist V_WB_B that is
not so: its linear velocity is in axes that turn.

A method of higher order integrates the displacement (theta, p) from the start of the step. Its rate at (w, u) is

    theta' = w + theta x w / 2 + theta x (theta x w) / 12 + ...,   p' = u

with the factors B_k/k! of Bernoulli's numbers, of which these terms are enough up to order 4 (E. Hairer, C. Lubich,
G. Wanner, Geometric Numerical Integration, 2006, section IV.7). A method of higher order takes more of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Symmetric
from torchdq.algebra.quaternion import Number, Pure
from torchdq.dq.explog import entire
from torchdq.dynamics.joints import Free
from torchdq.dynamics.posed import Row
from torchdq.functions.posed import as_screw
from torchdq.numbers.functions import polynomial

_BERNOULLI = (1 / 6, 1 / 30, 1 / 42, 1 / 30, 5 / 66, 691 / 2730, 7 / 6, 3617 / 510, 43867 / 798, 174611 / 330)
ORDER_4 = (1.0 / 12.0,)
EXACT = tuple(b / math.factorial(2 * k) for k, b in enumerate(_BERNOULLI, 1))  # up to rounding, below a radian
POSE, TWIST = Free.nq, Free.nv  # numbers of a pose and of a twist
START = (1.0, *(0.0,) * (POSE - 1))  # X_SC at the start of a step


def moved(X: Row, h: Number, rate: Row) -> tuple[Number, ...]:
    """Pose X_SC after a time h at a constant rate of the displacement."""
    w, u = as_screw(rate)
    turn = screw.exp((quat.scale(0.5 * h, w), quat.ZERO), lambda v: entire(v, None))
    r, d = dq.mul(dq.from_pose(quat.ONE, quat.scale(h, u)), dq.mul(as_pose(X), turn))
    return (*r, *d)


def rate(displacement: Row, v: Row, series: Sequence[float] = ORDER_4) -> tuple[Number, ...]:
    """Rate of a displacement at velocities v, of which `series` has the terms from the second cross product on."""
    (theta, _), (w, u) = as_screw(displacement), as_screw(v)
    once = quat.cross(theta, w)
    factor = polynomial(series, quat.norm2(theta))
    more = quat.scale(factor, quat.cross(theta, once))
    return (*quat.add(w, quat.add(quat.scale(0.5, once), more)), *u)


def torque_midway(w: Pure, inertia: Symmetric, h: Number) -> Pure:
    """Inertial torque w x I w in the middle of a step of a body without other torques, less that at its start.

    The angular velocity is w + y there, I y + h/2 (w + y) x I (w + y) = 0, by two iterations of Newton's method. That
    torque changes neither the energy nor the size of the angular momentum. As both iterations take the matrix of the
    first, what remains of an error takes some away, for any inertia and up to 1.5 rad in a step.
    """
    half, momentum = 0.5 * h, tuple(quat.dot(row, w) for row in inertia)
    v, turned = quat.scale(half, w), quat.scale(half, momentum)
    a, b, c = zip(
        *(
            quat.add(row, quat.sub(quat.cross(v, row), quat.cross(turned, e)))
            for row, e in zip(inertia, quat.UNITS, strict=True)
        ),
        strict=True,
    )  # rows of I + [v] I - [I v], v = h/2 w
    solved = _elimination(a, b, c)
    now = quat.cross(v, momentum)
    y = quat.neg(solved(now))
    own = quat.cross(y, tuple(quat.dot(row, y) for row in inertia))
    torque = quat.add(now, quat.scale(half, own))
    y = quat.neg(solved(torque))
    along = tuple(quat.dot(row, y) for row in inertia)
    # (w + y) x I (w + y) - w x I w, of which the equation has all but y x I y
    return quat.sub(quat.cross(y, along), quat.scale(1.0 / half, quat.add(along, torque)))


def _elimination(a: Pure, b: Pure, c: Pure) -> Callable[[Pure], Pure]:
    """Solution of linear equations with three rows, of which the diagonal dominates."""
    p = 1.0 / a[0]
    f, g = p * b[0], p * c[0]
    b1, b2 = b[1] - f * a[1], b[2] - f * a[2]
    c1, c2 = c[1] - g * a[1], c[2] - g * a[2]
    q = 1.0 / b1
    k = q * c1
    r = 1.0 / (c2 - k * b2)

    def solved(x: Pure) -> Pure:
        second = x[1] - f * x[0]
        z = r * (x[2] - g * x[0] - k * second)
        y = q * (second - b2 * z)
        return p * (x[0] - a[1] * y - a[2] * z), y, z

    return solved


# --- between the frames ----------------------------------------------------------------------------------------------


def at_centre(X: Row, V: Row, c: Pure) -> tuple[Number, ...]:
    """Velocities (w, u) of C at X_SC, of the twist V of B; also their rates, of the rate of a twist with u = 0."""
    w, v = as_screw(V)
    return (*w, *quat.rotate(as_pose(X)[0], quat.add(v, quat.cross(w, c))))


def twist(X: Row, v: Row, c: Pure) -> tuple[Number, ...]:
    """Twist V_WB_B of velocities (w, u) of C at X_SC."""
    w, u = as_screw(v)
    return (*w, *quat.sub(quat.rotate(quat.conj(as_pose(X)[0]), u), quat.cross(w, c)))


def placed(X_WB: Row, X: Row, c: Pure) -> DualQuaternion:
    """Pose X_WB at X_SC, of that at the start of the step."""
    r, d = as_pose(X)
    lever = quat.cross(c, quat.im(r))  # T(c) r T(-c) = r + eps c x r
    return dq.mul(as_pose(X_WB), (r, quat.add(d, (0.0, *lever))))


def unit(X: DualQuaternion) -> tuple[Number, ...]:
    """Pose without the rounding errors of a step, which would add up: a unit dual quaternion to first order in them."""
    r, d = X
    scale = 1.5 - 0.5 * quat.norm2(r)
    along = sum((a * b for a, b in zip(r, d, strict=True)), 0.0)
    return (*(scale * a for a in r), *(scale * (b - a * along) for a, b in zip(r, d, strict=True)))


def rates_of(X: Row, xi: Row) -> Row:
    """Rates X xi/2 of poses X as they are displaced to X exp(xi/2)."""
    found: list[Number] = []
    for x, d in _bodies(X, POSE, xi, TWIST):
        w, v = as_screw([0.5 * y for y in d])
        r, moved = dq.mul(as_pose(x), ((0.0, *w), (0.0, *v)))
        found += [*r, *moved]
    return found


def displacements(X: Row, rates: Row) -> list[Number]:
    """Displacements xi = 2 im(X* X') of poses X, of their rates X' = X xi/2."""
    found: list[Number] = []
    for x, rate in _bodies(X, POSE, rates, POSE):
        r, d = dq.mul(dq.conj(as_pose(x)), as_pose(rate))
        found += [2.0 * y for y in (*r[1:], *d[1:])]
    return found


def _bodies(x: Row, size: int, y: Row, other: int) -> Iterator[tuple[Row, Row]]:
    """Numbers of every body in two rows."""
    return ((x[size * k : size * (k + 1)], y[other * k : other * (k + 1)]) for k in range(len(x) // size))


def as_pose(X: Row) -> DualQuaternion:
    """Eight components as a pose."""
    return tuple(X[:4]), tuple(X[4:])
