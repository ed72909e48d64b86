"""Dynamics of a task: of some components of the twist of a frame, by the inertia Lambda that a force there meets.

    Lambda^-1 = J M^-1 J^T,   F = Lambda (a - a_0),   tau = J^T F + tau_0

tau_0 are torques under which the components accelerate with a_0; tau adds what makes them accelerate with a. No other
torques do so with less of the energy sum of tau^T M^-1 tau, and the projector on the null space is never formed
(Khatib, A unified approach for motion and force control of robot manipulators, 1987).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from operator import mul
from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.dynamics import error_growth, ltdl
from torchdq.dynamics.ltdl import TreeFactors
from torchdq.dynamics.posed import Posed, Row, dot
from torchdq.numbers.functions import below, maximum, select, sqrt

COMPONENTS = ("rx", "ry", "rz", "x", "y", "z")  # of a twist
DAMPED = 2.0**11  # growth of damped rows at least: where a pivot is increased, float32 has too few digits of it
ROUNDED = 2.0**-20  # share of the scale of a pivot that counts beside its own diagonal where digits are lost
AXES = {"pose": COMPONENTS, "orientation": COMPONENTS[:3], "position": COMPONENTS[3:]}


def rows_of(axes: str) -> tuple[int, ...]:
    """Numbers of the components that a choice of axes names."""
    return tuple(COMPONENTS.index(axis) for axis in AXES.get(axes, axes.split()))


class Task(NamedTuple):
    """Components of the twist of a frame, in its own or in world axes."""

    link: int
    X_BF: DualQuaternion
    world: bool
    rows: tuple[int, ...] = tuple(range(6))  # numbers of the components

    def of(self, a: Screw) -> list[Number]:
        """Components of a twist or of its rate."""
        return [(*a[0], *a[1])[r] for r in self.rows]

    def jacobian(self, at: Posed) -> Matrix:
        """Jacobian matrix J, rows of the components."""
        columns = [c or screw.ZERO for c in at.jacobian(self.link, self.X_BF, self.world)]
        return tuple(zip(*map(self.of, columns), strict=True))

    def twist(self, at: Posed, qd: Row) -> Screw:
        """Twist of the frame."""
        total = screw.ZERO
        for c, v in zip(at.jacobian(self.link, self.X_BF, self.world), qd, strict=True):
            total = total if c is None else screw.add(total, screw.scale(v, c))
        return total

    def twist_rate(self, at: Posed, qd: Row, qdd: Row | None) -> Screw:
        """Rate of the components of the twist; of accelerations None it is that of the velocities alone, Jdot qd."""
        wd, d = at.acceleration(self.link, self.X_BF, qd, qdd, self.world)
        return (wd, d) if self.world else (wd, components_rate(d, self.twist(at, qd)))


def components_rate(d: quat.Pure, V: Screw) -> quat.Pure:
    """Rate of the components of the velocity of an origin in axes that turn with it, from its acceleration d."""
    return quat.sub(d, quat.cross(*V))


class Inertia(NamedTuple):
    """Inertia Lambda of a task, by factors of its inverse."""

    J: Matrix
    factors: TreeFactors
    growth: Number  # factor by which a force magnifies rounding errors

    def force(self, a: Row) -> Row:
        """Force Lambda a that accelerates the components by a."""
        return ltdl.solve(ltdl.dense(len(a)), self.factors, a)

    def matrix(self) -> Matrix:
        """Lambda."""
        m = len(self.J)
        rows = [self.force([float(i == k) for i in range(m)]) for k in range(m)]
        return tuple(tuple(rows[max(i, k)][min(i, k)] for k in range(m)) for i in range(m))


def inertia(at: Posed, task: Task, damping: Number | None) -> Inertia:
    """Inertia of a task, damped where the joints hardly move it.

    Whether they do is measured by pivots d of J J^T over their scale s, the mean of the diagonal for components of the
    same kind, so that neither units nor masses count. Where d / s is below the damping b, the pivot of Lambda^-1 is
    increased by (b - d / s)^2 / (4 b) of its own scale: once differentiable, and nothing where it is above.

    Args:
        at: the robot.
        task: the components.
        damping: b; None: no pivot is increased.
    """
    found, whole = at.factors(linear=False), task._replace(rows=tuple(range(6))).jacobian(at)
    J, mobility = tuple(whole[r] for r in task.rows), found.mobility(whole)
    inverse = tuple(tuple(mobility[i][k] for k in task.rows) for i in task.rows)
    scales = _scales(mobility)
    raised = _raised(whole, scales, task.rows, damping)
    factors = ltdl.factorise(ltdl.dense(len(J)), inverse, None if raised is None else lambda k, d: d + raised[k])
    # where a whole row of J vanishes, so does its diagonal, but not the rounding errors of the row
    diagonal = [inverse[i][i] + ROUNDED * scales[r // 3] for i, r in enumerate(task.rows)]
    growths = [found.growth, error_growth.growth(diagonal, factors.inverses), dot(diagonal, _diagonal(factors))]
    if raised is not None:
        growths.append(select(below(0.0, sum(raised)), DAMPED, 1.0))
    return Inertia(J, factors, reduce(maximum, growths))


def _diagonal(factors: TreeFactors) -> list[Number]:
    """Diagonal of Lambda, whose products with that of Lambda^-1 are 1 where rows do not act on each other."""
    m = len(factors.inverses)
    halves = [ltdl.half(ltdl.dense(m), factors, [float(i == k) for i in range(m)]) for k in range(m)]
    return [sum([d * (x * x) for x, d in zip(half, factors.inverses, strict=True)]) for half in halves]


def _raised(J: Matrix, own: Row, rows: Sequence[int], damping: Number | None) -> list[Number] | None:
    """Increases of the pivots of Lambda^-1, whose scales are `own`, row by row; None: there are none."""
    if damping is None:
        return None
    squares = [[dot(a, b) for b in J] for a in J]
    scales = _scales(squares)
    inverses, fourth = {kind: 1.0 / scales[kind] for kind in {r // 3 for r in rows}}, 0.25 / damping
    shares: list[Number] = [0.0] * len(rows)

    def pivot(k: int, d: Number) -> Number:
        kind = rows[k] // 3
        lack = maximum(damping - d * inverses[kind], 0.0)
        shares[k] = fourth * (lack * lack)
        return d + shares[k] * scales[kind]

    ltdl.factorise(ltdl.dense(len(rows)), tuple(tuple(squares[i][k] for k in rows) for i in rows), pivot)
    return [share * own[r // 3] for share, r in zip(shares, rows, strict=True)]


def _scales(A: Sequence[Row]) -> list[Number]:
    """Means of the diagonal for rotations and for displacements."""
    return [(A[k][k] + A[k + 1][k + 1] + A[k + 2][k + 2]) * (1.0 / 3.0) for k in (0, 3)]


def manipulability(at: Posed, task: Task) -> Number:
    """Square root of det J J^T, with the derivative zero where it is zero."""
    J, pivots = task.jacobian(at), []

    def pivot(_: int, d: Number) -> Number:
        moved = below(0.0, d)
        pivots.append(select(moved, d, 0.0))
        return select(moved, d, 1.0)

    ltdl.factorise(ltdl.dense(len(J)), tuple(tuple(dot(a, b) for b in J) for a in J), pivot)
    product = reduce(mul, pivots)
    moved = below(0.0, product)
    return select(moved, sqrt(select(moved, product, 1.0)), 0.0)


def torques(J: Matrix, F: Row) -> list[Number]:
    """Generalised forces J^T F of a task force, (moment, force) as the components of the twist are ordered."""
    return [dot(column, F) for column in zip(*J, strict=True)]
