"""Linear maps from coordinates to joints: mimic joints, motor-coupled wrists, differentials.

    q = S z + s0,   qd = S zd,   qdd = S zdd

z are the independent coordinates and q the joint coordinates; s0 is part of the joints' home. Generalised forces are
mapped by S^T, the mass matrix is S^T M S. The map wraps a posed robot, so no algorithm depends on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import add, mul
from typing import Any, NamedTuple

from torchdq.algebra import matrix, screw
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.algebra.structural import lift, total
from torchdq.dynamics import ltdl
from torchdq.dynamics.point_mass import PointMass
from torchdq.dynamics.posed import Exerted, Factors, Posed, Row, Seen, factors_by_entries

UNMAPPED = ("com", "point", "wrench", "position", "to_world", "to_link", "poses", "composites", "potential_energy")


class Coupling(NamedTuple):
    """Linear map from coordinates to joints."""

    S: Matrix  # joints by coordinates; None: a joint does not depend on a coordinate

    def after(self, count: int) -> Coupling:
        """Map of further coordinates, each of which is a joint of its own, and then of those of this one."""
        own = (tuple(1.0 if i == k else None for i in range(count + len(self.S[0]))) for k in range(count))
        return Coupling((*own, *((None,) * count + tuple(row) for row in self.S)))

    def joints(self, z: Row) -> list[Number]:
        """Displacements S z of the joints; velocities qd of zd, accelerations qdd of zdd."""
        return [present(x) for x in matrix.matvec(self.S, z, mul, add)]

    def forces(self, tau: Sequence[Number | None]) -> list[Number]:
        """Generalised forces on the coordinates from those on the joints."""
        return [present(x) for x in matrix.matvec(matrix.transpose(self.S), tau, mul, add)]


class Coupled(NamedTuple):
    """Posed robot in the coordinates of a map; implements `dynamics.posed.Posed`."""

    robot: Posed
    coupling: Coupling
    armature: Row | None = None  # additional inertia at the coordinates

    def __getattr__(self, name: str) -> Any:
        """Methods of the robot that do not depend on the map."""
        if name not in UNMAPPED:
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.robot, name)

    def without_gravity(self) -> Coupled:
        """Posed robot without gravity."""
        return self._replace(robot=self.robot.without_gravity())

    def with_masses(self, masses: Sequence[PointMass]) -> Coupled:
        """Posed robot with masses at points of links."""
        return self._replace(robot=self.robot.with_masses(masses))

    def twists(self, qd: Row) -> Sequence[Screw]:
        """Twist of every link."""
        return self.robot.twists(self.coupling.joints(qd))

    def kinetic_energy(self, qd: Row) -> Number:
        """Kinetic energy."""
        energy = self.robot.kinetic_energy(self.coupling.joints(qd))
        for J, v in zip(self.armature or (), qd, strict=False):
            energy = energy + 0.5 * J * (v * v)
        return energy

    def jacobian(self, i: int, X_BF: DualQuaternion, world: bool) -> list[Screw | None]:
        """Twist of a frame per velocity of the coordinates."""
        times, columns = lift(screw.scale), self.robot.jacobian(i, X_BF, world)
        return [
            total([times(s, c) for s, c in zip(row, columns, strict=True)], screw.add)
            for row in matrix.transpose(self.coupling.S)
        ]

    def seen_from(self, X_WO: DualQuaternion, links: Sequence[int]) -> dict[int, Seen]:
        """Links as seen from a frame O that is not fixed to the robot."""
        sums: dict[tuple[int, ...], Screw] = {}  # of the columns of joints, which links share

        def column(z: int, own: Mapping[int, Screw]) -> Screw | None:
            parts = [j for j, row in enumerate(self.coupling.S) if row[z] is not None and j in own]
            if parts and (z, *parts) not in sums:
                terms = [screw.scale(self.coupling.S[j][z], own[j]) for j in parts]
                sums[z, *parts] = total(terms, screw.add)
            return sums[z, *parts] if parts else None

        found = {}
        for i, seen in self.robot.seen_from(X_WO, links).items():
            columns = {z: s for z in range(len(self.coupling.S[0])) if (s := column(z, seen.columns)) is not None}
            found[i] = seen._replace(columns=columns)
        return found

    def acceleration(self, i: int, X_BF: DualQuaternion, qd: Row, qdd: Row | None, world: bool) -> Screw:
        """Angular acceleration of a frame and acceleration of its origin."""
        a = None if qdd is None else self.coupling.joints(qdd)
        return self.robot.acceleration(i, X_BF, self.coupling.joints(qd), a, world)

    def torques(self, qd: Row | None, qdd: Row | None, exerted: Exerted | None) -> list[Number]:
        """Generalised forces S^T tau(S zd, S zdd)."""
        v, a = (None if x is None else self.coupling.joints(x) for x in (qd, qdd))
        tau = self.coupling.forces(self.robot.torques(v, a, exerted))
        if self.armature is None or qdd is None:
            return tau
        return [t + J * a for t, J, a in zip(tau, self.armature, qdd, strict=True)]

    def mass_matrix(self) -> Matrix:
        """Mass matrix S^T M S."""
        S = self.coupling.S
        half = matrix.matmul(self.robot.mass_matrix(), S, mul, add)
        M = [list(row) for row in matrix.matmul(matrix.transpose(S), half, mul, add)]
        for k, J in enumerate(self.armature or ()):
            M[k][k] = present(M[k][k]) + J
        # both halves are sums of the same terms in another order
        return tuple(tuple(M[max(i, k)][min(i, k)] for k in range(len(M))) for i in range(len(M)))

    def factors(self, linear: bool) -> Factors:
        """Factors of the mass matrix, entry by entry: coordinates have no tree of their own."""
        M = self.mass_matrix()
        return factors_by_entries(ltdl.predecessors(M), M)

    def with_armature(self, more: Row) -> Coupled:
        """Posed robot with additional inertia at its coordinates."""
        before = self.armature or [0.0] * len(more)
        return self._replace(armature=[a + b for a, b in zip(before, more, strict=True)])

    def regressor(self, qd: Row | None, qdd: Row | None) -> list[list[Row | None]]:
        """Factors of the inertial parameters, [coordinate][body]."""
        v, a = (None if x is None else self.coupling.joints(x) for x in (qd, qdd))
        Y = tuple(map(tuple, self.robot.regressor(v, a)))
        found = matrix.matmul(matrix.transpose(self.coupling.S), Y, quat.scale, quat.add)
        return [list(row) for row in found]


def present(x: Number | None) -> Number:
    """Number, or zero if it is absent."""
    return 0.0 if x is None else x
