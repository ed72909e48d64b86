"""Robot at one configuration in aligned frames: the form that runs."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import islice
from typing import NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.elementary import DualAngle, together
from torchdq.algebra.inertia import Moments
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.dynamics import crba, energy, regressor
from torchdq.dynamics.aligned import aba, kinematics, rnea
from torchdq.dynamics.aligned.placement import Alignment, Step, Steps
from torchdq.dynamics.joints import Along, Coordinate
from torchdq.dynamics.point_mass import PointMass, on_links, with_outer
from torchdq.dynamics.posed import Exerted, Factors, Point, Row, Seen, factors_by_entries
from torchdq.dynamics.tree import Tree
from torchdq.numbers.functions import cos, sin


class Aligned(NamedTuple):
    """Robot at one configuration; implements `dynamics.posed.Posed`."""

    tree: Tree
    steps: Steps
    X_WB: DualQuaternion | None  # pose of a floating base; None: a fixed one
    alignments: tuple[Alignment, ...]  # constants of the moving links
    coms: tuple[Pure, ...]  # centres of mass of the moving links, in their aligned frames
    x: tuple[Number, ...]  # displacements of the joints from home
    masses: tuple[PointMass, ...] = ()  # at points of links, of which `tree` has the parts that are rigid bodies

    @classmethod
    def at(
        cls,
        tree: Tree,
        alignments: Sequence[Alignment],
        coms: Sequence[Pure],
        x: Row,
        X_WB: DualQuaternion | None = None,
    ) -> Aligned:
        """Robot at displacements x of its joints from home.

        Args:
            tree: in aligned frames.
            alignments: of the moving links.
            coms: centres of mass of the moving links, in their link frames.
            x: displacements of the joints of the moving links.
            X_WB: pose of a floating base in the world; None: a fixed one.
        """
        moving = zip(tree.links[1:], alignments, x, strict=True)
        steps = [Step(at.placement, _dual_angle(link.joint, at, x_i)) for link, at, x_i in moving]
        centres = [at.point_from_own(c) for at, c in zip(alignments, coms, strict=True)]
        return cls(tree, (None, *steps), X_WB, tuple(alignments), tuple(centres), tuple(x))

    # --- kinematics ---

    def com(self, i: int) -> Pure:
        """Centre of mass of a link, in its aligned frame."""
        return self.coms[i - 1]

    def point(self, i: int, X_BF: DualQuaternion) -> Point:
        """Frame on a link, in its aligned frame."""
        p, axes = dq.translation(X_BF), quat.rotation_columns(X_BF[0])
        if i == 0:
            return Point(p, axes)
        at = self.alignments[i - 1]
        return Point(at.point_from_own(p), tuple(at.vector_from_own(e) for e in axes))

    def wrench(self, i: int, F_B: Screw) -> Screw:
        """Wrench on a link, in its aligned frame."""
        return self.alignments[i - 1].wrench_from_own(F_B) if i else F_B

    def position(self, i: int, r: Pure) -> Pure:
        """Position in the world of a point of a link."""
        p = kinematics.position(self.tree, self.steps, i, r)
        if self.X_WB is None:
            return p
        return quat.add(screw.columns_times(quat.rotation_columns(self.X_WB[0]), p), dq.translation(self.X_WB))

    def to_world(self, i: int, v: Pure) -> Pure:
        """Components in world axes of a vector of a link."""
        v = kinematics.to_base(self.tree, self.steps, i, v)
        return v if self.X_WB is None else screw.columns_times(quat.rotation_columns(self.X_WB[0]), v)

    def to_link(self, i: int, v: Pure) -> Pure:
        """Components in link axes of a vector of the world."""
        v = v if self.X_WB is None else screw.columns_times(quat.rotation_columns(quat.conj(self.X_WB[0])), v)
        return kinematics.to_link(self.tree, self.steps, i, v)

    def poses(self) -> list[DualQuaternion]:
        """Pose in the world of the link frames of the description."""
        return [dq.mul(motion, home) for motion, home in self.poses_from_base()]

    def poses_in_chain(self) -> list[DualQuaternion]:
        """Pose in the world of the link frames of the description, by elementary screws one after the other."""
        moving = zip(self.tree.links[1:], self.alignments, self.x, strict=True)
        halves = [0.5 * (link.joint.angle(x) + at.offset) for link, at, x in moving]
        turns = [(cos(half), sin(half)) for half in halves]
        return kinematics.poses(self.tree, self.steps, self.alignments, turns, self.X_WB or dq.ONE)

    def poses_from_base(self) -> list[kinematics.FromBase]:
        """Poses of the link frames as motions from their home poses, by joint screws in the base frame."""
        halves = [(x, 0.5 * x) for x in self.x]
        q = [Coordinate(x, cos(half), sin(half)) for x, half in halves]
        return kinematics.poses_from_base(self.tree, self.alignments, q, self.X_WB or dq.ONE)

    def twists(self, qd: Row) -> list[Screw]:
        """Twist of every link in its aligned frame."""
        return rnea.twists(self.tree, self.steps, qd)

    def jacobian(self, i: int, X_BF: DualQuaternion, world: bool) -> list[Screw | None]:
        """Columns of the Jacobian of a frame, in its own or in world axes."""
        point = self.point(i, X_BF)
        if world:
            found = kinematics.joint_screws_in_base(self.tree, self.steps, i, point.position)
            if self.X_WB is not None:
                r = self.X_WB[0]
                found = {k: (quat.rotate(r, w), quat.rotate(r, v)) for k, (w, v) in found.items()}
        else:
            found = kinematics.joint_screws(self.tree, self.steps, i, point)
        return [found.get(k) for k in range(self.tree.nv)]

    def seen_from(self, X_WO: DualQuaternion, links: Sequence[int]) -> dict[int, Seen]:
        """Links as seen from a frame O that is not fixed to the robot."""
        axes, p = quat.rotation_columns(X_WO[0]), dq.translation(X_WO)
        if self.X_WB is not None:
            p = quat.rotate(quat.conj(self.X_WB[0]), quat.sub(p, dq.translation(self.X_WB)))
            axes = quat.rotation_columns(quat.mul(quat.conj(self.X_WB[0]), X_WO[0]))
        return kinematics.seen_from(self.tree, self.steps, axes, p, links)

    def acceleration(self, i: int, X_BF: DualQuaternion, qd: Row, qdd: Row | None, world: bool) -> Screw:
        """Angular acceleration of a frame and acceleration of its origin, in its own or in world axes."""
        *_, motion = islice(rnea.outward(self.without_gravity().tree, self.steps, self.X_WB, qd, qdd), i + 1)
        point, (wd, d) = self.point(i, X_BF), motion.A
        d = quat.add(d, rnea.apply(motion.u, point.position))
        if world:
            return self.to_world(i, wd), self.to_world(i, d)
        return tuple(quat.dot(e, wd) for e in point.axes), tuple(quat.dot(e, d) for e in point.axes)

    # --- dynamics ---

    def torques(self, qd: Row | None, qdd: Row | None, exerted: Exerted | None) -> list[Number]:
        """Generalised forces of a motion."""
        return rnea.inverse_dynamics(self.tree, self.steps, self.X_WB, qd, qdd, exerted)

    def composites(self) -> list:
        """Composite inertias of all links that each joint moves."""
        return crba.composites(self.tree, lambda i, body: self.steps[i].inertia_to_parent(body))

    def mass_matrix(self) -> Matrix:
        """Mass matrix."""
        M = crba.mass_matrix(self.tree, self.composites(), lambda i, F: self.steps[i].to_parent(F))
        return with_outer(M, self.masses, lambda i, F: rnea.generalised(self.tree, self.steps, i, F))

    def factors(self, linear: bool) -> Factors:
        """Factors of the mass matrix, entry by entry or by articulated bodies."""
        if not linear:
            return factors_by_entries(self.tree.predecessors(), self.mass_matrix())
        outer = [(at.link, at.along, at.wrench) for at in self.masses if at.normal is not None]
        found = aba.factorise(self.tree, self.steps, outer)
        bound = self.tree.with_bodies(on_links([at.beyond for at in self.masses], Moments.from_com))
        diagonal = crba.diagonal(bound, self._replace(tree=bound).composites())
        return Factors(diagonal, found.inverses, partial(aba.solve, self.tree, self.steps, found))

    def with_armature(self, more: Row) -> Aligned:
        """Posed robot with additional rotor inertia."""
        return self._replace(tree=self.tree.with_armature(more))

    def with_masses(self, masses: Sequence[PointMass]) -> Aligned:
        """Posed robot with masses at points of links, which have no weight."""
        tree = self.tree.with_bodies(on_links(masses, Moments.from_com))
        return self._replace(tree=tree, masses=(*self.masses, *masses))

    def without_gravity(self) -> Aligned:
        """Posed robot without gravity."""
        return self._replace(tree=self.tree._replace(gravity=None))

    def kinetic_energy(self, qd: Row) -> Number:
        """Kinetic energy."""
        return energy.kinetic_energy(self.tree, self.twists(qd), qd)

    def potential_energy(self) -> Number:
        """Potential energy of gravity."""
        whole = self.composites()[0]
        if whole is None or self.X_WB is None:
            return energy.potential_energy(self.tree.gravity, None if whole is None else whole.first)
        first = quat.add(quat.rotate(self.X_WB[0], whole.first), quat.scale(whole.mass, dq.translation(self.X_WB)))
        return energy.potential_energy(self.tree.gravity, first)

    def regressor(self, qd: Row | None, qdd: Row | None) -> list:
        """Factors of the inertial parameters about the link frames of the description."""
        base, *motion = rnea.outward(self.tree, self.steps, self.X_WB, qd, qdd)
        screws, u, d = [], [], []
        if self.X_WB is not None:
            screws.append(kinematics.joint_screws(self.tree, self.steps, 0, Point(quat.ZERO, quat.UNITS)))
            u.append(base.u)
            d.append(base.A[1])
        for i, (at, m) in enumerate(zip(self.alignments, motion, strict=True), 1):
            # origin of the link frame in the aligned frame; its axes there are the rows of R_BL
            origin = at.point_from_own(quat.ZERO)
            screws.append(kinematics.joint_screws(self.tree, self.steps, i, Point(origin, at.R_BL)))
            w, wd = at.vector_to_own(m.w), at.vector_to_own(m.A[0])
            u.append(rnea.tensor(w, wd))
            d.append(at.vector_to_own(quat.add(m.A[1], rnea.apply(m.u, origin))))
        return regressor.regressor(screws, u, d, self.tree.nv)


def _dual_angle(joint: Along, at: Alignment, x: Number) -> DualAngle:
    """Dual angle of a joint at a displacement, offset and shift included."""
    angle, shift = joint.angle(x), joint.slide(x) + at.placement.shift
    if isinstance(angle, float) or abs(at.turn[0]) in (0.0, 1.0):
        return DualAngle(together(at.turn, (cos(angle), sin(angle))), shift)
    whole = angle + at.offset
    return DualAngle((cos(whole), sin(whole)), shift)
