"""Masses at points of links, which differ by direction: what the impedances of points add to M in an implicit step.

    m 1 + e n n^T,   m >= 0, m + e >= 0

is a point mass m, which is a body like others, and a mass e that is moved along n alone. The wrench of a unit force
along n on the point, s = n + eps p x n, has the generalised force g = J^T s, and the second part adds e g g^T to the
mass matrix, and e s s^T to an articulated-body inertia: a matrix of masses costs a rigid body and a product of screws.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.numbers.functions import maximum


class PointMass(NamedTuple):
    """Matrix m 1 + e n n^T of masses at a point of a link, in the frame of the link."""

    link: int
    point: Pure
    mass: Number  # m [kg]
    normal: Pure | None = None  # n; None: e is zero
    along: Number = 0.0  # e [kg]
    spin: Number = 0.0  # rotational inertia of the point, the same about all axes [kg m^2]
    against: int | None = None  # body whose relative motion it resists; None: the world

    @property
    def beyond(self) -> PointMass:
        """Mass that is the same in all directions, and with m nowhere smaller than the matrix."""
        return PointMass(self.link, self.point, maximum(self.along, 0.0))

    @property
    def wrench(self) -> Screw:
        """Wrench (force, moment) of a unit force along the normal."""
        n = self.normal or quat.ZERO
        return n, quat.cross(self.point, n)


def on_links(masses: Iterable[PointMass], body: Callable[[Number, Pure, tuple[Number, ...]], object]) -> dict:
    """Bodies by link of the parts that are the same in all directions.

    Args:
        body: takes mass, centre of mass and inertia about it, returns a body that has `plus`.
    """
    found: dict = {}
    for at in masses:
        one = body(at.mass, at.point, (at.spin, 0.0, at.spin, 0.0, 0.0, at.spin))
        found[at.link] = found[at.link].plus(one) if at.link in found else one
    return found


def with_outer(
    M: Matrix, masses: Sequence[PointMass], forces: Callable[[int, Screw], Sequence[Number | None]]
) -> Matrix:
    """Mass matrix with e g g^T of every mass; `forces` takes a link and a wrench on it, and returns g."""
    rows = [list(row) for row in M]
    for at in masses:
        if at.normal is None:
            continue
        g = forces(at.link, at.wrench)
        moved = [k for k, x in enumerate(g) if x is not None]
        for k in moved:
            scaled = at.along * g[k]
            for l in moved:
                if l <= k:
                    entry = rows[k][l]
                    rows[k][l] = rows[l][k] = scaled * g[l] if entry is None else entry + scaled * g[l]
    return tuple(map(tuple, rows))
