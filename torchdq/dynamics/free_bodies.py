"""Free rigid bodies beside a robot, and what impedances between two bodies add to their mass matrix.

A free body O moves without joints. Its frame is at its centre of mass, along its principal axes, and its velocities are
its twist V_WO_O. Free bodies are the links after those of the robot; their velocities come before the robot's, so that
the factors of the mass matrix are sparse: branches of a robot that touch one body are eliminated one by one.

An impedance between O and a body A acts on the twist of O relative to A. All impedances of the pair add up to one
matrix K of 6 x 6, given about O's centre and in its axes. With the columns J of the twist of A there,

    M_OO += K,   M_OA -= K J,   M_AA += J^T K J

Columns that several bodies A share, those of an arm with fingers, are multiplied with the sum of their K.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import Moments
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.algebra.structural import add
from torchdq.dynamics import ltdl
from torchdq.dynamics.acceleration import net_wrench, tensor
from torchdq.dynamics.aligned.aba import Articulated
from torchdq.dynamics.joints import Free
from torchdq.dynamics.point_mass import PointMass, on_links
from torchdq.dynamics.posed import Exerted, Factors, Posed, Row, Seen, factors_by_entries

SIX = Free.nv
Pair = tuple[int, int]  # a free body, and the body that acts on it


class FreeBody(NamedTuple):
    """Free rigid body at a pose."""

    X_WO: DualQuaternion
    mass: Number  # [kg]
    moments: Pure  # principal moments of inertia [kg m^2]

    @property
    def inertia(self) -> Moments:
        """Inertia about the centre of mass."""
        x, y, z = self.moments
        return Moments.from_com(self.mass, quat.ZERO, (x, 0.0, y, 0.0, 0.0, z))

    @property
    def axes(self) -> tuple[Pure, ...]:
        """Its axes in the world."""
        return quat.rotation_columns(self.X_WO[0])

    def to_own(self, v: Pure) -> Pure:
        """Components in its axes of a vector of the world."""
        return tuple(quat.dot(e, v) for e in self.axes)


class WithFreeBodies(NamedTuple):
    """Robot and free bodies at one configuration; implements `dynamics.posed.Posed`."""

    robot: Posed
    free: tuple[FreeBody, ...]
    first: int  # link that is the first of the free bodies
    gravity: Pure | None
    seen: Mapping[Pair, Seen]  # bodies as seen from free bodies that they act on
    masses: tuple[PointMass, ...] = ()  # on free bodies

    @classmethod
    def at(
        cls, robot: Posed, free: Sequence[FreeBody], first: int, gravity: Pure | None, pairs: Sequence[Pair]
    ) -> WithFreeBodies:
        """Robot with free bodies, of which some are acted on by links of the robot or by each other."""
        seen: dict[Pair, Seen] = {}
        for o in dict.fromkeys(o for o, _ in pairs):
            others = [a for of, a in pairs if of == o]
            links = robot.seen_from(free[o - first].X_WO, [a for a in others if a < first])
            for a in others:
                seen[o, a] = (
                    links[a]._replace(columns={k + SIX * len(free): s for k, s in links[a].columns.items()})
                    if a < first
                    else _seen(free[o - first], free[a - first], SIX * (a - first))
                )
        return cls(robot, tuple(free), first, gravity, seen)

    def __getattr__(self, name: str) -> Any:
        """Kinematics of the robot's own links."""
        if name not in ("point", "wrench", "poses", "jacobian", "acceleration", "seen_from"):
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self.robot, name)

    @property
    def _nv(self) -> int:
        return SIX * len(self.free)

    # --- kinematics ---

    def com(self, i: int) -> Pure:
        """Centre of mass of a body."""
        return quat.ZERO if i >= self.first else self.robot.com(i)

    def position(self, i: int, r: Pure) -> Pure:
        """Position in the world of a point of a body."""
        if i < self.first:
            return self.robot.position(i, r)
        return quat.add(dq.translation(self.free[i - self.first].X_WO), self.to_world(i, r))

    def to_world(self, i: int, v: Pure) -> Pure:
        """Components in world axes of a vector of a body."""
        return self.robot.to_world(i, v) if i < self.first else screw.columns_times(self.free[i - self.first].axes, v)

    def to_link(self, i: int, v: Pure) -> Pure:
        """Components in the axes of a body of a vector of the world."""
        return self.robot.to_link(i, v) if i < self.first else self.free[i - self.first].to_own(v)

    def twists(self, v: Row) -> list[Screw]:
        """Twist of every body in its frame."""
        return [*self.robot.twists(v[self._nv :]), *self._own(v)]

    def relative(self, pair: Pair, v: Row) -> Screw:
        """Twist of a free body relative to one that acts on it, in the frame of the free body."""
        o, twist = pair[0] - self.first, None
        for k, s in sorted(self.seen[pair].columns.items()):  # from the base on: bodies share the first terms
            twist = add(twist, screw.scale(v[k], s))
        own = self._own(v)[o]
        return own if twist is None else screw.sub(own, twist)

    def reaction(self, pair: Pair, F: Screw) -> Screw:
        """Wrench in the frame of a body of one that is given in the frame of the free body that it acts on."""
        axes, origin, _ = self.seen[pair]
        force, moment = F
        moment = quat.sub(moment, quat.cross(origin, force))
        return tuple(quat.dot(e, force) for e in axes), tuple(quat.dot(e, moment) for e in axes)

    def _own(self, v: Row) -> list[Screw]:
        return [(tuple(v[k : k + 3]), tuple(v[k + 3 : k + SIX])) for k in range(0, self._nv, SIX)]

    # --- dynamics ---

    def torques(self, v: Row | None, vd: Row | None, exerted: Exerted | None) -> list[Number]:
        """Generalised forces of a motion."""
        n, found = self._nv, list[Number]()
        for k, body in enumerate(self.free):
            (w, u), (wd, ud) = ((quat.ZERO, quat.ZERO) if x is None else self._own(x)[k] for x in (v, vd))
            weight = quat.ZERO if self.gravity is None else body.to_own(self.gravity)
            net = net_wrench(body.inertia, tensor(w, wd), quat.sub(quat.add(ud, quat.cross(w, u)), weight))
            acted = None if exerted is None else exerted[self.first + k]
            found += Free().project(add(net, acted) or net)
        own, rate = (None if x is None else x[n:] for x in (v, vd))
        return [*found, *self.robot.torques(own, rate, None if exerted is None else exerted[: self.first])]

    def mass_matrix(self) -> Matrix:
        """Mass matrix, with what impedances between bodies add to it."""
        n, robot = self._nv, self.robot.mass_matrix()
        M: list[list[Number | None]] = [[None] * (n + len(robot)) for _ in range(n + len(robot))]

        def plus(i: int, k: int, x: Number) -> None:
            before = M[i][k]
            M[i][k] = M[k][i] = x if before is None else before + x

        for i, row in enumerate(robot):
            for k, x in enumerate(row[: i + 1]):
                if x is not None:
                    plus(n + i, n + k, x)
        for o, body in enumerate(self.free, self.first):
            first, acting = SIX * (o - self.first), [m for m in self.masses if m.link == o]
            of = {a: _total([m for m in acting if m.against == a]) for a in dict.fromkeys(m.against for m in acting)}
            whole = reduce(Articulated.plus, of.values(), Articulated.rigid(body.inertia))
            for i, own in enumerate(_square(whole)):
                for k, x in enumerate(own[: i + 1]):
                    if not (isinstance(x, float) and x == 0):
                        plus(first + i, first + k, x)
            groups = _groups({a: self.seen[o, a].columns for a in of if a is not None})
            for number, (i, s, bodies) in enumerate(groups):
                F = _sum(of, bodies).response(s)
                for k, x in enumerate(Free().project(F)):
                    plus(i, first + k, -x)
                for k, t, others in groups[: number + 1]:
                    if both := bodies & others:
                        G, along = (F, t) if both == bodies else (_sum(of, both).response(t), s)
                        plus(i, k, screw.power(G, along))
        return tuple(map(tuple, M))

    def factors(self, linear: bool) -> Factors:
        """Factors of the mass matrix, always entry by entry."""
        M = self.mass_matrix()
        return factors_by_entries(ltdl.predecessors(M), M)

    def with_armature(self, more: Row) -> WithFreeBodies:
        """Posed bodies with additional rotor inertia of the robot's joints."""
        return self._replace(robot=self.robot.with_armature(more[self._nv :]))

    def with_masses(self, masses: Sequence[PointMass]) -> WithFreeBodies:
        """Posed bodies with masses at points, which have no weight."""
        own = [m for m in masses if m.link < self.first]
        robot = self.robot.with_masses(own) if own else self.robot
        return self._replace(robot=robot, masses=(*self.masses, *[m for m in masses if m.link >= self.first]))

    def without_gravity(self) -> WithFreeBodies:
        """Posed bodies without gravity."""
        return self._replace(robot=self.robot.without_gravity(), gravity=None)

    def kinetic_energy(self, v: Row) -> Number:
        """Kinetic energy."""
        energy = self.robot.kinetic_energy(v[self._nv :])
        for body, (w, u) in zip(self.free, self._own(v), strict=True):
            turning = sum([i * (x * x) for i, x in zip(body.moments, w, strict=True)], 0.0)
            energy = energy + 0.5 * (turning + body.mass * quat.dot(u, u))
        return energy

    def potential_energy(self) -> Number:
        """Potential energy of gravity."""
        energy, g = self.robot.potential_energy(), self.gravity or quat.ZERO
        for body in self.free:
            energy = energy - body.mass * quat.dot(g, dq.translation(body.X_WO))
        return energy


def _seen(body: FreeBody, other: FreeBody, first: int) -> Seen:
    """Another free body as seen from one, whose velocities begin at `first`."""
    axes = tuple(body.to_own(e) for e in other.axes)
    seen = Seen(axes, body.to_own(quat.sub(dq.translation(other.X_WO), dq.translation(body.X_WO))), {})
    return seen._replace(columns={first + k: seen.screw(s) for k, s in enumerate(Free.columns)})


def _total(masses: Sequence[PointMass]) -> Articulated:
    """Matrix K of all masses at points of one body."""
    (rigid,) = on_links(masses, Moments.from_com).values()
    K = Articulated.rigid(rigid)
    for at in masses:
        if at.normal is not None:
            K = K.with_outer(at.along, at.wrench)
    return K


def _sum(of: Mapping[int | None, Articulated], bodies: Collection[int]) -> Articulated:
    """Sum of the matrices K of some bodies."""
    return reduce(Articulated.plus, [of[a] for a in sorted(bodies)])


def _square(I: Articulated) -> Matrix:
    """Rows of an inertia, angular velocities first."""
    return tuple(tuple(Free().project(I.response(s))) for s in Free.columns)


def _groups(columns: Mapping[int, Mapping[int, Screw]]) -> list[tuple[int, Screw, frozenset[int]]]:
    """Velocities and their columns, each with the bodies that have it, from the base on."""
    found: list[tuple[int, Screw, list[int]]] = []
    for a, own in columns.items():
        for i, s in own.items():
            same = next((bodies for k, t, bodies in found if k == i and t is s), None)
            if same is None:
                found.append((i, s, [a]))
            else:
                same.append(a)
    return [(i, s, frozenset(bodies)) for i, s, bodies in sorted(found, key=lambda x: x[0])]
