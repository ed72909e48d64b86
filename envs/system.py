"""Equations of motion of a scene: the moving bodies and rotors that integrators integrate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from operator import add as plus
from operator import mul
from typing import Any

from torchdq.algebra import matrix
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.algebra.structural import add, difference, neg
from torchdq.dynamics.posed import Posed, Row
from torchdq.effects.body import Bodies, BodyEffect
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.effects.transmission import Transmission
from torchdq.envs.integrators import System
from torchdq.envs.spec import RecordedScene, Rows
from torchdq.errors import ArgumentError
from torchdq.numbers.record import Recorded
from torchdq.program import autodiff as derive
from torchdq.program.program import GROWTH, Argument, record, replay
from torchdq.robot.posed import posed, solve


@dataclass(frozen=True)
class SceneSystem(System):
    """Joints, and rotors behind them, under actuator torques u that are constant over a step."""

    scene: RecordedScene
    u: Row
    watch: Callable[[Number], object]  # receives the factor by which a solution magnifies rounding errors

    # --- mechanics ---

    def _exerted(self, at: Posed, qd: Row) -> list[Screw | None] | None:
        """Wrenches of the links on the environment; None: there are no body effects."""
        effects = self.scene.spec.of(BodyEffect)
        if not effects:
            return None
        bodies = Bodies(self.scene.spec.robot, at, at.twists(qd))
        wrenches: list[Screw | None] = [None] * (len(qd) + 1)  # the base's first
        for _, effect in effects:
            for i, wrench in effect.wrenches(bodies, self.scene.inputs).items():
                wrenches[i] = add(wrenches[i], wrench)
        return [neg(f) for f in wrenches]

    def _solved(self, at: Posed, b: Row) -> Sequence[Number]:
        """Solution of M x = b."""
        x, growth = solve(self.scene.spec.robot, at, b, self.scene.linear)
        self.watch(growth)
        return x

    # --- forces at the joints ---

    @property
    def _n(self) -> int:
        return self.scene.spec.robot.n

    @property
    def _transmission(self) -> Transmission:
        return self.scene.spec.transmission[1]

    def _impedances(self, q: Row, qd: Row) -> list[list[Impedance]]:
        """Impedances of every joint."""
        found = [effect.impedances(q, qd, self.scene.inputs) for _, effect in self.scene.spec.of(JointEffect)]
        for (_, effect), row in zip(self.scene.spec.of(JointEffect), found, strict=True):
            if len(row) != len(q):
                raise ArgumentError(
                    f"impedances of {type(effect).__name__} must return one Impedance for each of {len(q)} joints, "
                    f"found {len(row)}"
                )
        return [list(joint) for joint in zip(*found, strict=True)] if found else [[] for _ in q]

    def frozen(self, x: Row, v: Row) -> Rows:
        """Mass matrix M of the joints, their damping D and stiffness K in a state, and the rotors behind them."""
        q = x[: self._n]
        impedances = self._impedances(q, v[: self._n])
        rows: Rows = {
            "M": [0.0 if a is None else a for row in self.scene.posed(q).mass_matrix() for a in row],
            "D": [sum((z.damping for z in joint), 0.0) for joint in impedances],
            "K": [sum((z.stiffness * z.active for z in joint), 0.0) for joint in impedances],
        }
        rotors = self._transmission.rotors()
        return {**rows, **rotors._asdict()} if rotors.inertia else rows

    def _forces(self, passed: Row, impedances: Sequence[Sequence[Impedance]], damping: Row, qd: Row) -> list[Number]:
        """Torques on the joints: those that the transmission passes on, less those of the impedances."""
        forces = [sum((z.force for z in joint), 0.0) for joint in impedances]
        return [t - (d * v + f) for t, d, v, f in zip(passed, damping, qd, forces, strict=True)]

    def _explicit(self, x: Row, v: Row) -> tuple[Row, list[Number]]:
        """Torques passed on by the transmission, and all torques on the joints, in a state."""
        q, qd = x[: self._n], v[: self._n]
        passed, impedances = self._transmission.torques(self.u, x, v), self._impedances(q, qd)
        damping = [sum((z.damping for z in joint), 0.0) for joint in impedances]
        return passed, self._forces(passed, impedances, damping, qd)

    # --- evaluations of integrators ---

    def accelerations(self, x: Row, v: Row) -> list[Number]:
        """Accelerations in a state."""
        q, qd = x[: self._n], v[: self._n]
        at = self.scene.posed(q)
        passed, forces = self._explicit(x, v)
        net = difference(forces, at.torques(qd, None, self._exerted(at, qd)))
        return [*self._solved(at, net), *self._transmission.accelerations(self.u, passed)]

    def implicit_accelerations(self, x: Row, v: Row, h: Number) -> list[Number]:
        """Mean accelerations over a step whose impedances and transmission act on the state at its end."""
        q, qd = x[: self._n], v[: self._n]
        at = self.scene.posed(q)
        joints = self._transmission.eliminated(self.u, x, v, h)
        impedances = self._impedances(q, qd)
        damping = [sum((z.damping_at_end(h) for z in joint), 0.0) for joint in impedances]
        forces = self._forces(joints.torques, impedances, damping, qd)
        net = difference(forces, at.torques(qd, None, self._exerted(at, qd)))
        inertia = [a + h * d for a, d in zip(joints.inertia, damping, strict=True)]
        qdd = self._solved(at.with_armature(inertia), net)
        return [*qdd, *joints.rotors(qdd)]

    def momentum_accelerations(self, x: Row, v: Row) -> list[Number]:
        """Accelerations M(q)^-1 (dL/dq + forces), and those of the rotors."""
        q, qd = x[: self._n], v[: self._n]
        passed, forces = self._explicit(x, v)
        at = self.scene.posed(q)
        exerted = self._exerted(at, qd)
        if exerted is not None:
            # inverse dynamics at rest without gravity: the wrenches alone
            forces = difference(forces, at.without_gravity().torques(None, None, exerted))
        rate = [f + g for f, g in zip(forces, lagrangian_gradient(self.scene, q, qd), strict=True)]
        return [*self._solved(at, rate), *self._transmission.accelerations(self.u, passed)]

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
    (value,) = program.results[0].values
    if isinstance(value, float):
        return [0.0] * robot.n
    rows = [q, qd, [given[name][k] for name, k in known]]
    values = replay(program, rows)
    found = derive.cotangents(program, values, {value[0]: -1.0 if value[1] else 1.0})
    return [found.get((0, i), 0.0) for i in range(robot.n)]
