"""Robot at one configuration in the general form: any link frames, dual-quaternion poses, adjoint columns.

It is the reference for the aligned form, and the form that runs for robots whose geometry is an argument.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Inertia
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.dynamics import crba, energy, regressor
from torchdq.dynamics.acceleration import tensor
from torchdq.dynamics.general import kinematics, rnea
from torchdq.dynamics.point_mass import PointMass, on_links, with_outer
from torchdq.dynamics.posed import Exerted, Factors, Point, Row, Seen, factors_by_entries
from torchdq.dynamics.tree import Tree


class General(NamedTuple):
    """Robot at one configuration; implements `dynamics.posed.Posed`."""

    tree: Tree
    X_PB: tuple[Any, ...]  # poses of the links in their parents; None: the frames coincide
    Ad: tuple[Adjoint | None, ...]
    coms: tuple[Pure, ...]  # centres of mass of the moving links
    masses: tuple[PointMass, ...] = ()  # at points of links, of which `tree` has the parts that are rigid bodies

    @classmethod
    def at(cls, tree: Tree, coms: Sequence[Pure], q: Sequence[Any]) -> General:
        """Robot at coordinates of all joints, beginning with the base."""
        X_PB = kinematics.joint_poses(tree, q)
        return cls(tree, X_PB, kinematics.adjoints(X_PB), tuple(coms))

    # --- kinematics ---

    def com(self, i: int) -> Pure:
        """Centre of mass of a link."""
        return self.coms[i - 1]

    def point(self, i: int, X_BF: DualQuaternion) -> Point:
        """Frame on a link."""
        return Point(dq.translation(X_BF), quat.rotation_columns(X_BF[0]))

    def wrench(self, i: int, F_B: Screw) -> Screw:
        """Wrench on a link, unchanged."""
        return F_B

    def position(self, i: int, r: Pure) -> Pure:
        """Position in the world of a point of a link."""
        X = self.poses()[i]
        return quat.add(dq.translation(X), quat.rotate(X[0], r))

    def to_world(self, i: int, v: Pure) -> Pure:
        """Components in world axes of a vector of a link."""
        return quat.rotate(self.poses()[i][0], v)

    def to_link(self, i: int, v: Pure) -> Pure:
        """Components in link axes of a vector of the world."""
        return quat.rotate(quat.conj(self.poses()[i][0]), v)

    def poses(self) -> list[DualQuaternion]:
        """Pose in the world of every link (39)."""
        return list(kinematics.link_poses(self.tree, self.X_PB))

    def twists(self, qd: Row) -> list[Screw]:
        """Twist of every link in its frame (40)."""
        V, _ = rnea.outward(self.tree, self.Ad, qd, None)
        return [v or screw.ZERO for v in V]

    def jacobian(self, i: int, X_BF: DualQuaternion, world: bool) -> list[Screw | None]:
        """Columns of the Jacobian of a frame, in its own or in world axes."""
        columns = kinematics.jacobian(self.tree, self.Ad, i, X_BF)
        if not world:
            return list(columns)
        r = quat.mul(self.poses()[i][0], X_BF[0])
        return [None if c is None else (quat.rotate(r, c[0]), quat.rotate(r, c[1])) for c in columns]

    def seen_from(self, X_WO: DualQuaternion, links: Sequence[int]) -> dict[int, Seen]:
        """Links as seen from a frame O that is not fixed to the robot."""
        found, poses, r_OW = {}, self.poses(), quat.conj(X_WO[0])
        for i in links:
            r_OA = quat.mul(r_OW, poses[i][0])
            apart = quat.sub(dq.translation(poses[i]), dq.translation(X_WO))
            seen = Seen(quat.rotation_columns(r_OA), quat.rotate(r_OW, apart), {})
            own = kinematics.joint_screws(self.tree, self.Ad, i)
            found[i] = seen._replace(columns={k: seen.screw(s) for k, s in own.items()})
        return found

    def acceleration(self, i: int, X_BF: DualQuaternion, qd: Row, qdd: Row | None, world: bool) -> Screw:
        """Angular acceleration of a frame and acceleration of its origin, in its own or in world axes."""
        V, A = rnea.outward(self.without_gravity().tree, self.Ad, qd, qdd)
        V_F, A_F = (screw.ad(screw.inverse(screw.columns(X_BF)), S[i] or screw.ZERO) for S in (V, A))
        found = A_F[0], quat.add(A_F[1], quat.cross(*V_F))
        if not world:
            return found
        r = quat.mul(self.poses()[i][0], X_BF[0])
        return quat.rotate(r, found[0]), quat.rotate(r, found[1])

    # --- dynamics ---

    def torques(self, qd: Row | None, qdd: Row | None, exerted: Exerted | None) -> list[Number | None]:
        """Generalised forces of a motion, by Algorithm 1."""
        return rnea.rnea(self.tree, self.Ad, qd, qdd, exerted)

    def _carried(self, i: int, body: Inertia) -> Inertia:
        x, columns = self.X_PB[i], self.Ad[i]
        return body if x is None or columns is None else body.carried(columns, dq.translation(x))

    def composites(self) -> list:
        """Composite inertias of all links that each joint moves."""
        return crba.composites(self.tree, self._carried)

    def mass_matrix(self) -> Matrix:
        """Mass matrix."""
        M = crba.mass_matrix(self.tree, self.composites(), lambda i, F: kinematics.to_parent(self.Ad[i], F))
        return with_outer(M, self.masses, self._generalised)

    def _generalised(self, i: int, F: Screw) -> list[Number | None]:
        """Generalised forces of a wrench on a link; None: the link does not move with that coordinate."""
        columns = kinematics.joint_screws(self.tree, self.Ad, i)
        return [screw.power(F, columns[k]) if k in columns else None for k in range(self.tree.nv)]

    def factors(self, linear: bool) -> Factors:
        """Factors of the mass matrix, always entry by entry."""
        return factors_by_entries(self.tree.predecessors(), self.mass_matrix())

    def with_armature(self, more: Row) -> General:
        """Posed robot with additional rotor inertia."""
        return self._replace(tree=self.tree.with_armature(more))

    def with_masses(self, masses: Sequence[PointMass]) -> General:
        """Posed robot with masses at points of links, which have no weight."""
        tree = self.tree.with_bodies(on_links(masses, Inertia.from_com))
        return self._replace(tree=tree, masses=(*self.masses, *masses))

    def without_gravity(self) -> General:
        """Posed robot without gravity."""
        return self._replace(tree=self.tree._replace(gravity=None))

    def kinetic_energy(self, qd: Row) -> Number:
        """Kinetic energy."""
        return energy.kinetic_energy(self.tree, self.twists(qd), qd)

    def potential_energy(self) -> Number:
        """Potential energy of gravity."""
        whole = self.composites()[0]
        first = None if whole is None else self._carried(0, whole).first
        return energy.potential_energy(self.tree.gravity, first)

    def regressor(self, qd: Row | None, qdd: Row | None) -> list:
        """Factors of the inertial parameters about the link frames."""
        V, A = rnea.outward(self.tree, self.Ad, qd, qdd)
        screws, u, d = [], [], []
        for i in self.tree.bodies():
            (w, v), (wd, vd) = V[i] or screw.ZERO, A[i] or screw.ZERO
            screws.append(kinematics.joint_screws(self.tree, self.Ad, i))
            u.append(tensor(w, wd))
            d.append(quat.add(vd, quat.cross(w, v)))
        return regressor.regressor(screws, u, d, self.tree.nv)
