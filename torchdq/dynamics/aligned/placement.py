"""Aligned frames: the axis of every joint is the z axis of its link's frame.

The pose of a link frame in its parent is a translation and elementary screws,

    X_PL = (1 + eps p/2) exp(z gamma/2) exp(x alpha/2) exp(z theta^/2),   theta^ = q + offset + eps (slide + shift)

With gamma = 0 and p along x this is the modified Denavit-Hartenberg convention, with dual angles alpha^ and theta^. A
change of frame is a sequence of planar rotations with 4 multiplications each; a product with a rotation matrix has 9,
besides those for the matrix.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import elementary
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.elementary import Angle, DualAngle, X, Z, back, turn
from torchdq.algebra.inertia import Moments, Six, six, square
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw


class Placement(NamedTuple):
    """Constant part of the pose of an aligned frame in its parent's; angles are cosines and sines."""

    p: Pure  # [m]
    gamma: Angle
    alpha: Angle
    shift: Number  # along z [m]


class Alignment(NamedTuple):
    """Constants of a link in aligned frames: the pose of its frame L in the parent's, and in the link's own frame B."""

    placement: Placement
    half: Placement  # `placement` with half of the angles
    offset: float  # added to the joint's angle [rad]
    turn: Angle  # cosine and sine of the offset
    R_BL: tuple[Pure, ...]  # rows
    p_BL: Pure  # [m]
    joint_W: Any  # the joint, with its screw in the base frame at home
    X_LB: DualQuaternion  # pose of the link frame in the aligned frame
    X_WB_home: DualQuaternion  # pose of the link frame in the base frame at home

    def vector_from_own(self, v: Pure) -> Pure:
        """Components in L of a vector of B."""
        return tuple(quat.dot(e, v) for e in zip(*self.R_BL, strict=True))

    def vector_to_own(self, v: Pure) -> Pure:
        """Components in B of a vector of L."""
        return tuple(quat.dot(row, v) for row in self.R_BL)

    def wrench_from_own(self, F: Screw) -> Screw:
        """Wrench in L of a wrench in B, each about the origin of its frame."""
        force, moment = F
        return self.vector_from_own(force), self.vector_from_own(quat.sub(moment, quat.cross(self.p_BL, force)))

    def inertia_from_own(self, about_com: Six) -> Six:
        """Rotational inertia about the centre of mass in the axes of L, given in the axes of B."""
        columns, rows = tuple(zip(*self.R_BL, strict=True)), square(about_com)
        half = [tuple(quat.dot(row, e) for row in rows) for e in columns]  # I e
        return six(tuple(tuple(quat.dot(e, v) for v in half) for e in columns))

    def point_from_own(self, r: Pure) -> Pure:
        """Position in L of a point of B."""
        return self.vector_from_own(quat.sub(r, self.p_BL))


class Step(NamedTuple):
    """Pose of a link's frame in its parent's, as elementary screws."""

    placement: Placement
    theta: DualAngle

    def vector_to_parent(self, v: Pure) -> Pure:
        """Components in the parent's axes."""
        at = self.placement
        return turn(Z, at.gamma, turn(X, at.alpha, turn(Z, self.theta.turn, v)))

    def vector_to_link(self, v: Pure) -> Pure:
        """Components in the link's axes."""
        at = self.placement
        return turn(Z, back(self.theta.turn), turn(X, back(at.alpha), turn(Z, back(at.gamma), v)))

    def to_parent(self, m: Screw) -> Screw:
        """Adjoint Ad(X_PL) m of a screw in the link's frame."""
        at = self.placement
        m = elementary.ad(Z, self.theta, m)
        m = elementary.ad(Z, DualAngle(at.gamma, 0.0), elementary.ad(X, DualAngle(at.alpha, 0.0), m))
        return elementary.shift(at.p, m)

    def to_link(self, m: Screw) -> Screw:
        """Adjoint Ad(X_PL*) m of a screw in the parent's frame."""
        w, v = elementary.shift(quat.neg(self.placement.p), m)
        turned = (self.vector_to_link(w), self.vector_to_link(v))
        return elementary.shift(elementary.unit(Z, -self.theta.shift), turned)

    def point_to_parent(self, r: Pure) -> Pure:
        """Position in the parent's frame of a point of the link."""
        x, y, z = r
        return quat.add(self.placement.p, self.vector_to_parent((x, y, z + self.theta.shift)))

    def inertia_to_parent(self, body: Moments) -> Moments:
        """Inertia in the parent's frame of a body of the link."""
        at = self.placement
        body = body.turned(Z, self.theta.turn).shifted(elementary.unit(Z, self.theta.shift))
        return body.turned(X, at.alpha).turned(Z, at.gamma).shifted(at.p)

    def pose_in(self, x: DualQuaternion, half: Placement, half_turn: Angle) -> DualQuaternion:
        """Product x X_PL with a pose x, from the cosines and sines of half of all angles."""
        x = dq.mul(x, dq.from_pose(quat.ONE, self.placement.p))
        x = elementary.times(elementary.times(x, Z, half.gamma, 0.0), X, half.alpha, 0.0)
        return elementary.times(x, Z, half_turn, self.theta.shift)


Steps = Sequence[Any]  # a `Step` for every link; None: the base
