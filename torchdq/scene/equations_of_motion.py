"""Equations of motion of a scene, which integrators integrate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import add as plus
from operator import mul
from typing import Any, NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import matrix
from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.algebra.structural import add, difference, neg
from torchdq.dynamics.closures import Gap, Held, Spring, at_end, stabilised, torques
from torchdq.dynamics.free_bodies import Pair
from torchdq.dynamics.posed import Posed, Row
from torchdq.effects.body import Bodies, BodyEffect, PointImpedance
from torchdq.effects.closures import Closures
from torchdq.effects.effect import Effect
from torchdq.effects.joint import Impedance, JointEffect, load_size, total
from torchdq.effects.transmission import Transmission
from torchdq.functions.inverse_kinematics import ranges, start
from torchdq.functions.posed import gaps, posed, solve
from torchdq.numbers.record import Recorded
from torchdq.program import autodiff as derive
from torchdq.program.program import GROWTH, Argument, record, replay
from torchdq.scene import effect_checks, free_base
from torchdq.scene.free_base import TWIST
from torchdq.scene.integrators import System
from torchdq.scene.spec import RecordedScene, Rows


class _Forces(NamedTuple):
    """Forces of the joints."""

    passed: Row  # torques that the transmission passes on [N m or N]
    damping: list[Number]  # [N m s/rad or N s/m]
    torques: list[Number]  # all that acts on the joints [N m or N]


class _Acting(NamedTuple):
    """Wrenches and impedances that act on the bodies of a robot."""

    bodies: Bodies
    exerted: (
        list[Screw | None] | None
    )  # wrenches of the links on the environment, the base's first; None: there are none
    points: list[PointImpedance]


@dataclass(frozen=True)
class SceneSystem(System):
    """Joints, and rotors behind them, under actuator torques u that are constant over a step."""

    scene: RecordedScene
    u: Row
    watch: Callable[[Number], object]  # receives the factor by which a solution magnifies rounding errors

    # --- mechanics ---

    def moved(self, x: Row, h: Number, rate: Row) -> list[Number]:
        """Positions at a displacement: joints and rotors along straight lines, free bodies as in `free_base`."""
        n = self._moving
        joints = super().moved(x[:n], h, rate[:n])
        return [*joints, *[y for X, V, _ in self.scene.free_of(x, rate) for y in free_base.moved(X, h, V)]]

    def rates(self, h: Number, rate: Row, v: Row) -> Row:
        """Rates of the displacement: the velocities, up to terms of the displacements of free bodies."""
        first, found = len(v) - len(self._free), [*v]
        series = free_base.EXACT if self.scene.spec.integrator.order > 4 else free_base.ORDER_4
        for k in range(first, len(v), TWIST):
            displacement = [h * x for x in rate[k : k + TWIST]]
            found[k : k + TWIST] = free_base.rate(displacement, v[k : k + TWIST], series)
        return found

    def sizes(self, x: Row) -> Row:
        """Sizes of the positions of joints and rotors; 1 for the twists of free bodies, and for memory."""
        n, others = self._moving, self.scene.spec.inner + len(self._free)
        return [*super().sizes(x[:n]), *[1.0] * others]

    def _at(self, x: Row) -> Any:  # a `Posed`, in a scene with objects `WithFreeBodies`
        return self.scene.posed(x[: self._n], *self.scene.poses_of(x))

    def _motion(self, x: Row, v: Row) -> Row:
        """Twists of free bodies and velocities of the coordinates, in the order of the dynamics."""
        return [*[y for X, V, c in self.scene.free_of(x, v) for y in free_base.twist(X, V, c)], *v[: self._n]]

    def _still(self, x: Row, v: Row) -> Row:
        """Motion in frames that move with the centres of mass of free bodies, where the forces are the same."""
        still = [y for _, V, _ in self.scene.free_of(x, v) for y in (*V[:3], 0.0, 0.0, 0.0)]
        return self._motion(x, [*v[: len(v) - len(still)], *still])

    def _acting(self, at: Any, x: Row, v: Row, h: Number = 0.0) -> _Acting:
        """Wrenches and impedances on bodies over a step h."""
        effects, bodies = self.scene.spec.of(BodyEffect), self.scene.bodies(at)
        if not effects:
            return _Acting(bodies, None, [])
        bodies = bodies.moving(self._motion(x, v))
        links, inputs = len(bodies.robot.link_names) + len(bodies.objects), self.scene.inputs
        exerted: list[Screw | None] = [None] * (links + 1)
        points: list[PointImpedance] = []
        between: dict[Pair, Any] = {}
        for (_, effect), memory in zip(effects, self._remembered(v, BodyEffect), strict=True):
            for i, wrench in effect_checks.wrenches(effect, effect.wrenches(bodies, inputs), links).items():
                exerted[i] = add(exerted[i], neg(wrench))
            found = effect_checks.points(effect, effect.impedances(bodies, inputs, memory, h), links)
            for point in found:
                exerted[point.link] = add(exerted[point.link], neg(point.wrench))
                if point.against is not None:
                    pair = (point.link, point.against)
                    between[pair] = add(between.get(pair), point.wrench)
            points += found
        for pair, wrench in between.items():
            exerted[pair[1]] = add(exerted[pair[1]], bodies.posed.reaction(pair, wrench))
        return _Acting(bodies, exerted, points)

    def _solved(self, at: Posed, b: Row, held: Sequence[Held] = ()) -> Sequence[Number]:
        """Solution of M a = b, as closures hold it."""
        a, growth = solve(self.scene.spec.robot, at, b, self.scene.linear, held)
        self.watch(growth)
        return a

    def _closures(self, x: Row, v: Row) -> list[tuple[Gap, Sequence[Spring]]]:
        """Gaps of the closures of the robot, each with its springs; (): it is rigid."""
        n, robot = self._n, self.scene.spec.robot
        found = gaps(robot, self.scene.posed(x[:n]), v[:n]) if robot.closures else []
        springs = [effect.springs(robot) for _, effect in self.scene.spec.of(Closures)]
        return [*zip(found, *(springs or [[()] * len(found)]), strict=True)]

    def _parts(self, x: Row, a: Sequence[Number]) -> tuple[Sequence[Number], Sequence[Number]]:
        """Accelerations of the joints, and those that free bodies are integrated with."""
        split = len(a) - self._n
        return a[split:], [y for X, A, c in self.scene.free_of(x, a[:split]) for y in free_base.at_centre(X, A, c)]

    def _net(self, at: Posed, forces: Row, x: Row, v: Row, exerted: list[Screw | None] | None) -> list[Number]:
        """Forces on free bodies and on the joints, less those of velocities, gravity and wrenches."""
        return difference([*self._free, *forces], at.torques(self._still(x, v), None, exerted))

    def _midway(self, v: Row, net: Row, h: Number) -> Row:
        """Net forces with the inertial torques on free bodies as they are in the middle of a step.

        The inertia of a robot is that of the whole of it with its joints in the middle of their limits: constants,
        which are near enough to take the greater part of the error of explicit inertial torques away.
        """
        found, scene, origin = [*net], self.scene, dq.ONE
        for k, body in enumerate((*scene.spec.objects, *[None] * scene.spec.robot.floating)):
            if body is not None and body.isotropic:
                continue
            at = slice(TWIST * k, TWIST * k + 3)
            if body is None:
                inertia = scene.posed(start(0, ranges(scene.spec.robot)), origin).composites()[0]
            else:
                inertia = body.posed(origin).inertia
            w = tuple(v[len(v) - len(self._free) :][at])
            found[at] = quat.sub(tuple(found[at]), free_base.torque_midway(w, inertia.about_com, h))
        return found

    # --- forces at the joints ---

    @property
    def _n(self) -> int:
        return self.scene.spec.robot.n

    @property
    def _moving(self) -> int:
        """Number of joints and of rotors behind them."""
        return self._n + self._transmission.memory(self._n) // 2

    @property
    def _free(self) -> Row:
        """Zeros for the twists of free bodies."""
        return (0.0,) * (TWIST * self.scene.spec.free)

    @property
    def _transmission(self) -> Transmission:
        return self.scene.spec.transmission[1]

    def _remembered(self, v: Row, kind: type[Effect]) -> list[Row]:
        """Memory of each effect of a kind, of those whose memory is integrated."""
        result, at = [], self._moving
        for _, effect in self.scene.spec.integrated:
            size = effect.memory(self._n)
            if isinstance(effect, kind):
                result.append(v[at : at + size])
            at += size
        return result

    def _inner(self, v: Row) -> list[tuple[JointEffect, Row]]:
        """Effects at the joints, each with what it remembers."""
        effects = self.scene.spec.of(JointEffect)
        return [(effect, row) for (_, effect), row in zip(effects, self._remembered(v, JointEffect), strict=True)]

    def _impedances(self, q: Row, v: Row, h: Number = 0.0) -> list[list[Impedance]]:
        """Impedances of every joint, at the end of a step."""
        qd, found = v[: self._n], []
        for effect, memory in self._inner(v):
            row = effect.impedances_at_end(q, qd, self.scene.inputs, memory, h)
            found.append(effect_checks.impedances(effect, row, len(q)))
        return [list(joint) for joint in zip(*found, strict=True)] if found else [[] for _ in q]

    def _inner_rates(self, q: Row, v: Row, ends: Row, h: Number = 0.0) -> list[Number]:
        """Mean rates, over a step, of what effects at the joints remember; `ends` are the velocities at its end."""
        qd, inputs = v[: self._n], self.scene.inputs
        return [
            rate for effect, memory in self._inner(v) for rate in effect.memory_rates(q, qd, inputs, memory, ends, h)
        ]

    def frozen(self, x: Row, v: Row) -> Rows:
        """Mass matrix M, damping D and stiffness K of the joints in a state, and the rotors behind them."""
        impedances = self._impedances(x[: self._n], v)
        rows: Rows = {
            "M": [0.0 if a is None else a for row in self._at(x).mass_matrix() for a in row],
            "D": self._explicit(x, v).damping,
            "K": [sum((z.stiffness * z.active for z in joint), 0.0) for joint in impedances],
        }
        rotors = self._transmission.rotors()
        return {**rows, **rotors._asdict()} if rotors.inertia else rows

    def _forces(self, passed: Row, impedances: Sequence[Sequence[Impedance]], qd: Row, h: Number = 0.0) -> _Forces:
        """Forces of the joints, of torques that the transmission passes on, damping being that at the end of a step."""
        damping, torques = [], []
        for t, joint, v in zip(passed, impedances, qd, strict=True):
            D, f, g = total(joint, h)
            free = t - (D * v + f)
            grip = g * load_size(free, g, v)
            damping.append(D + grip)
            torques.append(free - grip * v)
        return _Forces(passed, damping, torques)

    def _explicit(self, x: Row, v: Row) -> _Forces:
        """Forces of the joints in a state."""
        q, qd = x[: self._n], v[: self._n]
        return self._forces(self._transmission.torques(self.u, x, v), self._impedances(q, v), qd)

    # --- evaluations of integrators ---

    def accelerations(self, x: Row, v: Row) -> list[Number]:
        """Accelerations in a state."""
        at = self._at(x)
        forces, closures, first = self._explicit(x, v), self._closures(x, v), len(self._free)
        net = self._net(at, forces.torques, x, v, self._acting(at, x, v).exerted)
        for k, torque in [found for closure in closures if closure[1] for found in torques(*closure).items()]:
            net[first + k] = net[first + k] + torque
        held = [stabilised(gap, first) for gap, springs in closures if not springs]
        qdd, base = self._parts(x, self._solved(at, net, held))
        rotors = self._transmission.accelerations(self.u, forces.passed)
        kept = sum(effect.memory(self._n) for _, effect in self.scene.spec.of(BodyEffect))  # by implicit steps alone
        return [*qdd, *rotors, *self._inner_rates(x[: self._n], v, v[: self._n]), *[0.0] * kept, *base]

    def implicit_velocities(self, x: Row, v: Row, h: Number) -> list[Number]:
        """Velocities at the end of a step whose impedances and transmission act on the state at its end."""
        q, qd = x[: self._n], v[: self._n]
        at = self._at(x)
        joints = self._transmission.eliminated(self.u, x, v[: self._moving], h)
        forces = self._forces(joints.torques, self._impedances(q, v, h), qd, h)
        inertia = [a + h * d for a, d in zip(joints.inertia, forces.damping, strict=True)]
        heavy, acting = at.with_armature([*self._free, *inertia]), self._acting(at, x, v, h)
        if acting.points:
            heavy = heavy.with_masses([point.mass(h) for point in acting.points])
        net = self._midway(v, self._net(at, forces.torques, x, v, acting.exerted), h)
        held = [at_end(gap, len(self._free), h, springs) for gap, springs in self._closures(x, v)]
        solution = self._solved(heavy, net, held)
        qdd, base = self._parts(x, solution)
        ends = [w + h * a for w, a in zip(qd, qdd, strict=True)]
        rates = [*qdd, *joints.rotors(qdd), *self._inner_rates(q, v, ends, h)]
        moved = [w + h * a for w, a in zip(v[: len(rates)], rates, strict=True)]
        free = [w + h * a for w, a in zip(v[len(v) - len(base) :], base, strict=True)]
        return [*moved, *self._kept(acting, solution, h), *free]

    def _kept(self, acting: _Acting, a: Row, h: Number) -> Row:
        """Memory of effects on bodies at the end of a step, with the accelerations a over it."""
        points = [(p.kept, p) for p in acting.points if p.kept is not None]
        now = acting.bodies
        rates = now.moving(a) if points else now
        found: list[Number] = []
        for kept, p in points:
            (w, _), (wd, _) = (x.twist(p.link, p.against) for x in (now, rates))
            u, ud = (x.velocity(p.link, p.point, p.against) for x in (now, rates))
            found += kept(quat.add(u, quat.scale(h, ud)), quat.add(w, quat.scale(h, wd)))
        return effect_checks.kept([effect for _, effect in self.scene.spec.of(BodyEffect)], found, self._n)

    def momentum_accelerations(self, x: Row, v: Row) -> list[Number]:
        """Accelerations M(q)^-1 (dL/dq + forces), and those of the rotors."""
        q, qd = x[: self._n], v[: self._n]
        explicit = self._explicit(x, v)
        at, forces = self.scene.posed(q), explicit.torques
        exerted = self._acting(at, x, v).exerted
        if exerted is not None:
            # inverse dynamics at rest without gravity: the wrenches alone
            forces = difference(forces, at.without_gravity().torques(None, None, exerted))
        rate = [f + g for f, g in zip(forces, lagrangian_gradient(self.scene, q, qd), strict=True)]
        rotors = self._transmission.accelerations(self.u, explicit.passed)
        return [*self._solved(at, rate), *rotors, *self._inner_rates(q, v, qd)]

    def velocities_at(self, x: Row, v: Row, to: Row) -> list[Number]:
        """Velocities at the positions `to` that have the momentum of (x, v); rotors keep theirs."""
        n = self._n
        # by the mass matrix, whose rounding is that of the solution, and not by the cheaper inverse dynamics
        momentum = matrix.matvec(self.scene.posed(x[:n]).mass_matrix(), v[:n], mul, plus)
        return [*self._solved(self.scene.posed(to[:n]), momentum), *v[n:]]


def with_growths(scene: RecordedScene, u: Row, rows: Callable[[SceneSystem], Rows]) -> Rows:
    """Rows computed from the equations of motion, with the factors by which their solutions magnify rounding errors."""
    growths: list[Number] = []
    return {**rows(SceneSystem(scene, u, growths.append)), GROWTH: growths}


def lagrangian_gradient(scene: RecordedScene, q: Row, qd: Row) -> list[Number]:
    """Gradient dL/dq of L = T - U, by reverse mode on the recorded energies."""
    robot = scene.spec.robot
    given = {name: row for name, row in scene.overrides.items() if row is not None}
    known = [(name, k) for name, row in given.items() for k, x in enumerate(row) if isinstance(x, Recorded)]
    arguments = [Argument("q", robot.n), Argument("qd", robot.n), Argument("overrides", len(known))]

    def lagrangian(q: Row, qd: Row, numbers: Row) -> Rows:
        overrides: dict[str, Any] = {name: None if row is None else list(row) for name, row in scene.overrides.items()}
        for (name, k), x in zip(known, numbers, strict=True):
            overrides[name][k] = x
        at = posed(robot, q, overrides, scene.per_sample)
        return {"L": [at.kinetic_energy(qd) - at.potential_energy()]}

    program = record("lagrangian", arguments, lagrangian)
    values = replay(program, [q, qd, [given[name][k] for name, k in known]])
    found = derive.gradient(program, values, program.results[0].values[0])
    return [found.get((0, i), 0.0) for i in range(robot.n)]
