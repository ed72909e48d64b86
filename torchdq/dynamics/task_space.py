"""Dynamics of a task: of some components of the twist of a frame, by the inertia Lambda that a force there meets.

    Lambda^-1 = J M^-1 J^T,   F = Lambda (a - a_0),   tau = J^T F + tau_0

tau_0 are torques under which the components accelerate with a_0; tau adds what makes them accelerate with a. No other
torques do so with less of the energy sum of tau^T M^-1 tau, and the projector on the null space is never formed
(Khatib, A unified approach for motion and force control of robot manipulators, 1987).
"""

from __future__ import annotations

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
from torchdq.numbers.functions import maximum

COMPONENTS = ("rx", "ry", "rz", "x", "y", "z")  # of a twist


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
        return ltdl.solve(_dense(len(a)), self.factors, a)

    def matrix(self) -> Matrix:
        """Lambda."""
        m = len(self.J)
        rows = [self.force([float(i == k) for i in range(m)]) for k in range(m)]
        return tuple(tuple(rows[max(i, k)][min(i, k)] for k in range(m)) for i in range(m))


def _dense(m: int) -> tuple[int, ...]:
    return tuple(range(-1, m - 1))


def inertia(at: Posed, task: Task, damping: Number | None, linear: bool = False) -> Inertia:
    """Inertia of a task.

    Args:
        at: the robot.
        task: the components.
        damping: share of the diagonal of Lambda^-1 below which a pivot is increased, to a fourth of it at least; above
            it nothing is changed. None: no pivot is.
        linear: whether the mass matrix is factorised by articulated bodies.
    """
    found, J = at.factors(linear), task.jacobian(at)
    inverse = found.mobility(J)
    diagonal = [inverse[i][i] for i in range(len(J))]

    def pivot(k: int, d: Number) -> Number:
        least = damping * diagonal[k]
        below = maximum(least - d, 0.0)
        return d + below * below / (4.0 * least)

    factors = ltdl.factorise(_dense(len(J)), inverse, None if damping is None else pivot)
    growth = maximum(found.growth, error_growth.growth(diagonal, factors.inverses))
    return Inertia(J, factors, growth)


def torques(J: Matrix, F: Row) -> list[Number]:
    """Generalised forces J^T F of a task force, (moment, force) as the components of the twist are ordered."""
    return [dot(column, F) for column in zip(*J, strict=True)]
