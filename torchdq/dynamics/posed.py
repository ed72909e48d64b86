"""Interface of a robot at one configuration: kinematics and dynamics of its bodies.

It is implemented by `aligned.posed`, the form that runs, and by `general.posed`, the reference and the form for robots
whose geometry is an argument. Each form chooses a frame for every link, fixed to the link. Points, twists and wrenches
of links are in these frames; frames of the robot's description are arguments, as poses in its link frames.

Links are those of a `Tree`: link 0 is the base.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple, Protocol, cast

from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw, columns_times
from torchdq.dynamics import error_growth, ltdl
from torchdq.dynamics.point_mass import PointMass

Row = Sequence[Number]
Exerted = Sequence[Screw | None]  # wrench (force, moment) that each link exerts on the environment; None: none


class Factors(NamedTuple):
    """Factors of a mass matrix."""

    diagonal: Row
    inverses: Row  # inverse pivots
    solve: Callable[[Row], Row]  # x of M x = b
    half: Callable[[Row], Row] | None = None  # L^-T b of M = L^T D L; None: by articulated bodies
    rest: Callable[[Row], Row] | None = None  # x of D L x = b, what is left of M x = L^T b

    @property
    def growth(self) -> Number:
        """Factor by which a solution magnifies rounding errors."""
        return error_growth.growth(self.diagonal, self.inverses)

    def mobility(self, J: Matrix) -> Matrix:
        """Symmetric matrix J M^-1 J^T of rows J, by factors of the entries of M."""
        right = list(map(cast("Callable[[Row], Row]", self.half), J))
        left = [[x * d for x, d in zip(row, self.inverses, strict=True)] for row in right]
        found = [[dot(a, b) for b in right[: i + 1]] for i, a in enumerate(left)]
        return tuple(tuple(found[max(i, k)][min(i, k)] for k in range(len(J))) for i in range(len(J)))


def dot(a: Row, b: Row) -> Number:
    """Sum of the products of the numbers of two rows."""
    return sum([x * y for x, y in zip(a, b, strict=True)], 0.0)


def factors_by_entries(before: Sequence[int], M: Matrix) -> Factors:
    """Factors L^T D L of a mass matrix; `before` as in `ltdl.factorise`."""
    found = ltdl.factorise(before, M)
    solve, half, rest = (partial(part, before, found) for part in (ltdl.solve, ltdl.half, ltdl.rest))
    return Factors([M[i][i] for i in range(len(M))], found.inverses, solve, half, rest)


class Point(NamedTuple):
    """Origin and axes of a frame fixed to a link, in the frame that the posed robot chose for the link."""

    position: Pure
    axes: tuple[Pure, ...]


class Seen(NamedTuple):
    """A body A as seen from a frame O that moves on its own."""

    axes: tuple[Pure, ...]  # of A's frame, in O
    origin: Pure  # of A's frame, in O [m]
    columns: Mapping[int, Screw]  # of A's twist, in O and about its origin, by velocities; those of bodies that share
    # a joint are one object

    def point(self, r: Pure) -> Pure:
        """Position in O of a point of A."""
        return quat.add(self.origin, columns_times(self.axes, r))

    def screw(self, s: Screw) -> Screw:
        """Twist in O of one in A's frame."""
        w, v = (columns_times(self.axes, x) for x in s)
        return w, quat.add(v, quat.cross(self.origin, w))


class Posed(Protocol):
    """Interface of a robot at one configuration."""

    # --- kinematics ---

    def com(self, i: int) -> Pure:
        """Centre of mass of a link [m]."""

    def point(self, i: int, X_BF: DualQuaternion) -> Point:
        """Frame F on a link, given by its pose in the link frame of the description."""

    def wrench(self, i: int, F_B: Screw) -> Screw:
        """Wrench on a link, given in the link frame of the description."""

    def position(self, i: int, r: Pure) -> Pure:
        """Position in the world of a point of a link [m]."""

    def to_world(self, i: int, v: Pure) -> Pure:
        """Components in world axes of a vector of a link."""

    def to_link(self, i: int, v: Pure) -> Pure:
        """Components in link axes of a vector of the world."""

    def poses(self) -> Sequence[DualQuaternion]:
        """Pose in the world of the link frames of the description (39)."""

    def twists(self, qd: Row) -> Sequence[Screw]:
        """Twist of every link relative to the world (40)."""

    def jacobian(self, i: int, X_BF: DualQuaternion, world: bool) -> Sequence[Screw | None]:
        """Columns of the Jacobian of a frame, in its own or in world axes; None: the velocity does not move it."""

    def seen_from(self, X_WO: DualQuaternion, links: Sequence[int]) -> Mapping[int, Seen]:
        """Links as seen from a frame O that is not fixed to the robot."""

    def acceleration(self, i: int, X_BF: DualQuaternion, qd: Row, qdd: Row | None, world: bool) -> Screw:
        """Angular acceleration of a frame and acceleration of its origin, in its own or in world axes."""

    # --- dynamics ---

    def composites(self) -> Sequence:
        """Composite inertias of all links that each joint moves, the base's first; None: no body."""

    def torques(self, qd: Row | None, qdd: Row | None, exerted: Exerted | None) -> Row:
        """Generalised forces of a motion; absent arguments are zero."""

    def mass_matrix(self) -> Matrix:
        """Mass matrix; entries that are zero by structure are None."""

    def factors(self, linear: bool) -> Factors:
        """Factors of the mass matrix, entry by entry or, if `linear`, by an O(n) algorithm."""

    def with_armature(self, more: Row) -> Posed:
        """Posed robot with additional rotor inertia, on the diagonal of the mass matrix."""

    def with_masses(self, masses: Sequence[PointMass]) -> Posed:
        """Posed robot with masses at points of links in the mass matrix; its other results have no meaning."""

    def without_gravity(self) -> Posed:
        """Posed robot without gravity."""

    def kinetic_energy(self, qd: Row) -> Number:
        """Kinetic energy, rotors included [J]."""

    def potential_energy(self) -> Number:
        """Potential energy of gravity [J]."""

    def regressor(self, qd: Row | None, qdd: Row | None) -> Sequence[Sequence[Row | None]]:
        """Factors of the inertial parameters about the link frames of the description, [degree of freedom][body].

        The bodies are a floating base, if there is one, and the links.
        """


def closed_form(posed: Posed, qd: Row) -> tuple[Matrix, Row, Row]:
    """Terms M, c, g of tau = M qdd + c + g (63), each computed directly and not as a difference."""
    c = posed.without_gravity().torques(qd, None, None)
    return posed.mass_matrix(), c, posed.torques(None, None, None)
