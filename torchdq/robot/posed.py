"""A robot as numbers to record: constants where its tensors are known, arguments where they are learned or varied."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.matrix import Rows
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.dynamics import conditioning as pivots
from torchdq.dynamics import ltdl as forward
from torchdq.dynamics.aligned import aba as articulated
from torchdq.dynamics.aligned import crba as composite
from torchdq.dynamics.aligned import rnea as newton_euler
from torchdq.dynamics.aligned import tree as aligned
from torchdq.dynamics.aligned.tree import Aligned, AlignedLink, Body, Step, Turn
from torchdq.dynamics.paper import crba, energy, kinematics, rnea
from torchdq.dynamics.tree import Coordinate, Mechanism, mechanism
from torchdq.errors import SingularInertiaError
from torchdq.numbers.functions import note_growth
from torchdq.robot import mdh as frames
from torchdq.robot.robot import SHAPES, Robot

# flat components of the robot's tensors that are arguments, or otherwise not its own; None: there is none
Given = Mapping[str, Sequence[Number] | None]

GEOMETRY = ("X_PB_home", "screw")
INERTIAL = ("mass", "com", "inertia")


def field(robot: Robot, name: str, given: Given):
    """A tensor of the robot as nested tuples of numbers, or None if the robot has none."""
    if name in given:
        row, shape = given[name], SHAPES[name]
        if row is None:
            return None
        flat = tuple(row)
        if len(shape) == 1:
            return flat
        return tuple(flat[k : k + shape[1]] for k in range(0, len(flat), shape[1]))
    value = getattr(robot, name)
    if value is None:
        return None
    rows = value.tolist()
    return tuple(tuple(row) if isinstance(row, list) else row for row in rows)


def general(robot: Robot, given: Given) -> Mechanism:
    """The robot in its own link frames, as the paper has it."""
    return mechanism(
        robot.parents,
        robot.kinds,
        **{
            name: field(robot, name, given)
            for name in ("X_PB_home", "screw", "mass", "com", "inertia", "gravity", "armature")
        },
    )


def displacements(robot: Robot, q: Sequence[Number], given: Given) -> list[Number]:
    """Joint positions relative to home."""
    home = field(robot, "home", given)
    return list(q) if home is None else [x - h for x, h in zip(q, home, strict=True)]


def coordinates(robot: Robot, q: Sequence[Number], given: Given) -> list[Coordinate]:
    """Joint displacements with cosine and sine of their halves."""
    halves = [(x, 0.5 * x) for x in displacements(robot, q, given)]
    return [Coordinate(x, half.cos(), half.sin()) for x, half in halves]


class Factorised(NamedTuple):
    """A mass matrix taken apart."""

    diagonal: Sequence[Number]
    inverses: Sequence[Number]  # of its pivots
    solve: Callable[[Sequence[Number]], Sequence[Number]]  # x of M x = b

    @property
    def growth(self) -> Number:
        """Factor by which a solution magnifies rounding errors."""
        return pivots.growth(self.diagonal, self.inverses)


# --- aligned frames ---------------------------------------------------------------------------------------------------


class AlignedModel(NamedTuple):
    """A robot in a position, in the frames that cost least; its geometry must be constant."""

    robot: Robot
    placements: tuple[frames.Placement, ...]
    aligned: Aligned
    steps: tuple[Step, ...]

    @classmethod
    def of(cls, robot: Robot, q: Sequence[Number], given: Given, group: bool) -> AlignedModel:
        """The robot at q; `group` moves inertia towards the base, which pays unless it varies from sample to sample."""
        placements = frames.align(robot)
        armature = field(robot, "armature", given) or (None,) * robot.n
        bodies = _bodies(robot, placements, given)
        links = tuple(
            AlignedLink(parent, kind, at.pitch, at.gamma, at.alpha, at.p, body, rotor)
            for parent, kind, at, body, rotor in zip(
                robot.parents, robot.kinds, placements, bodies, armature, strict=True
            )
        )
        tree = Aligned(links, field(robot, "gravity", given))
        if group:
            tree = aligned.grouped(tree)
        x = displacements(robot, q, given)
        turns = [_turn(at, kind, x_i) for at, kind, x_i in zip(placements, robot.kinds, x, strict=True)]
        return cls(robot, placements, tree, aligned.steps(tree.links, x, turns))

    @property
    def links(self) -> tuple[AlignedLink, ...]:
        """Links of the tree."""
        return self.aligned.links

    def torques(
        self,
        qd: Sequence[Number] | None,
        qdd: Sequence[Number] | None,
        exerted: Sequence[Screw | None] | None,
    ) -> Sequence[Number]:
        """Inverse dynamics; `exerted` are the wrenches of the links on the environment, in link frames."""
        in_aligned = (
            None
            if exerted is None
            else [None if f is None else _into(at, f) for at, f in zip(self.placements, exerted, strict=True)]
        )
        return newton_euler.inverse_dynamics(self.aligned, self.steps, qd, qdd, in_aligned)

    def mass_matrix(self) -> Rows:
        """Mass matrix."""
        return composite.mass_matrix(self.aligned, self.steps)

    def with_rotors(self, inertia: Sequence[Number]) -> AlignedModel:
        """The same with more inertia at the joints, on the diagonal of the mass matrix."""
        return self._replace(aligned=self.aligned._replace(links=_with_rotors(self.links, inertia)))

    def factorised(self, linear: bool) -> Factorised:
        """The mass matrix taken apart; `linear` in the number of joints, by articulated bodies, or entry by entry."""
        if not linear:
            return _by_entries(self)
        factors = articulated.factorise(self.aligned, self.steps)
        diagonal = composite.diagonal(self.aligned, self.steps)
        return Factorised(diagonal, factors.inverses, partial(articulated.solve, self.aligned, self.steps, factors))


def _turn(at: frames.Placement, kind: str, x: Number) -> Turn:
    """Cosine and sine of the joint's turn."""
    offset = frames.turn(at.offset)
    if kind == "prismatic":
        return offset
    if abs(offset[0]) in (0.0, 1.0):
        c, s, _ = aligned.turn_z(offset, (x.cos(), x.sin(), 0.0))
        return c, s
    angle = x + at.offset
    return angle.cos(), angle.sin()


def _bodies(robot: Robot, placements: Sequence[frames.Placement], given: Given) -> list[Body]:
    """Mass distribution of every link about its aligned frame."""
    bodies = []
    for at, m, com, inertia in zip(placements, *(field(robot, name, given) for name in INERTIAL), strict=True):
        columns = tuple(zip(*at.R_BL, strict=True))
        shifted = quat.sub(com, at.p_BL)
        c = tuple(quat.dot(e, shifted) for e in columns)
        xx, xy, yy, xz, yz, zz = inertia
        rows = ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))
        half = tuple(tuple(quat.dot(row, e) for row in rows) for e in columns)  # I e
        turned = tuple(tuple(quat.dot(e, v) for v in half) for e in columns)
        bodies.append(Body(m, quat.scale(m, c), aligned.second_moments(c, m, turned)))
    return bodies


def _into(at: frames.Placement, f: Screw) -> Screw:
    """A wrench of the link frame, in the aligned frame."""
    columns = tuple(zip(*at.R_BL, strict=True))
    force, moment = f
    moment = quat.sub(moment, quat.cross(at.p_BL, force))
    return tuple(quat.dot(e, force) for e in columns), tuple(quat.dot(e, moment) for e in columns)


# --- the paper's frames -----------------------------------------------------------------------------------------------


class PaperModel(NamedTuple):
    """A robot in a position, in its own link frames, by the paper's recursion; anything about it may vary."""

    robot: Robot
    mechanism: Mechanism
    X_PB: tuple[DualQuaternion, ...]
    Ad: tuple

    @classmethod
    def of(cls, robot: Robot, q: Sequence[Number], given: Given) -> PaperModel:
        """The robot at q."""
        m = general(robot, given)
        X_PB = kinematics.joint_poses(m, coordinates(robot, q, given))
        return cls(robot, m, X_PB, kinematics.adjoints(X_PB))

    @property
    def links(self):
        """Links of the tree."""
        return self.mechanism.links

    def poses(self) -> tuple[DualQuaternion, ...]:
        """Pose X_WB of every link in the base frame."""
        return kinematics.link_poses(self.mechanism, self.X_PB)

    def twists(self, qd: Sequence[Number]) -> list[Screw]:
        """Twist V_WB_B of every link, in its frame."""
        V, _ = rnea.outward(self.mechanism, self.Ad, qd, [None] * len(qd), rnea.Base(None, None))
        return V

    def kinetic_energy(self, qd: Sequence[Number]) -> Number:
        """Kinetic energy, rotors included."""
        return energy.kinetic_energy(self.mechanism, self.twists(qd), qd)

    def potential_energy(self) -> Number:
        """Potential energy of gravity."""
        return energy.potential_energy(self.mechanism, self.poses())

    def torques(
        self,
        qd: Sequence[Number] | None,
        qdd: Sequence[Number] | None,
        exerted: Sequence[Screw | None] | None,
    ) -> Sequence[Number | None]:
        """Inverse dynamics; `exerted` are the wrenches of the links on the environment, in link frames."""
        return rnea.rnea(self.mechanism, self.Ad, qd, qdd, exerted)

    def mass_matrix(self) -> Rows:
        """Mass matrix."""
        return crba.mass_matrix(self.mechanism, self.X_PB, self.Ad)

    def with_rotors(self, inertia: Sequence[Number]) -> PaperModel:
        """The same with more inertia at the joints, on the diagonal of the mass matrix."""
        return self._replace(mechanism=self.mechanism._replace(links=_with_rotors(self.links, inertia)))

    def factorised(self, linear: bool) -> Factorised:
        """The mass matrix taken apart, entry by entry."""
        return _by_entries(self)


def _with_rotors(links, inertia: Sequence[Number]):
    return tuple(
        link._replace(armature=x if link.armature is None else link.armature + x)
        for link, x in zip(links, inertia, strict=True)
    )


def constant_pose(x) -> DualQuaternion:
    """Pose tensor as numbers."""
    components = tuple(x.tolist())
    return components[:4], components[4:]


def model(robot: Robot, q: Sequence[Number], given: Given, varied: Sequence[str]) -> AlignedModel | PaperModel:
    """The robot at q, in the frames that cost least for what is constant about it.

    `varied` names the tensors of the robot that differ from sample to sample.
    """
    if any(name in given for name in GEOMETRY):
        return PaperModel.of(robot, q, given)
    return AlignedModel.of(robot, q, given, group=not any(name in varied for name in INERTIAL))


def _by_entries(m: AlignedModel | PaperModel) -> Factorised:
    """The mass matrix of a model taken apart entry by entry."""
    M = m.mass_matrix()
    factors = forward.factorise(m.links, M)
    return Factorised([M[i][i] for i in range(len(M))], factors.inverses, partial(forward.solve, m.links, factors))


def factorised(m: AlignedModel | PaperModel, linear: bool) -> Factorised:
    """The mass matrix of a model taken apart."""
    try:
        return m.factorised(linear)
    except pivots.NoInertiaError as error:
        raise SingularInertiaError(
            f"joint {m.robot.joint_names[error.joint]!r} of robot {m.robot.name!r} moves no inertia, so its "
            f"acceleration is undefined; give the links beyond it mass, or the joint armature"
        ) from error


def solve(m: AlignedModel | PaperModel, b: Sequence[Number], linear: bool) -> Sequence[Number]:
    """Solution x of M x = b; a recorder is told how far it magnifies rounding errors."""
    parts = factorised(m, linear)
    x = parts.solve(b)
    note_growth(x, parts.growth)
    return x


def as_screw(x: Sequence[Number]) -> Screw:
    """Six components as a screw."""
    a: Pure = (x[0], x[1], x[2])
    b: Pure = (x[3], x[4], x[5])
    return a, b
