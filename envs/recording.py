"""What is recorded of a scene: its step as a computation on numbers, and the programs it becomes.

A step is three stages. The drive turns commands into torques at the joints: controller, then actuators. The flow
carries the state over the step under those torques: joint and body effects, rigid bodies, integrator. The senses read
the state at its end. They are recorded as one program, unless the integrator is adaptive.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.caches import PROGRAMS, remembered
from torchdq.dynamics.absent import neg, total
from torchdq.effects.body import Bodies
from torchdq.effects.effect import Effect
from torchdq.effects.joint import Elastic, Impedance
from torchdq.envs.controllers import Controller
from torchdq.envs.integrators import Integrator, System
from torchdq.functions.catalogue import ways
from torchdq.numbers.record import Number as Recorded
from torchdq.program import autodiff as derive
from torchdq.program.program import Argument, Program, record, replay
from torchdq.robot import Robot
from torchdq.robot.posed import INERTIAL, AlignedModel, Given, PaperModel, model, solve

Row = Sequence[Number]
Rows = dict[str, Row]


class Task(Protocol):
    """What an environment adds to a step: rows computed from the state at its end."""

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of what it needs beside the state."""

    def rows(self, view: View) -> Rows:
        """Rows of numbers, by name."""


@dataclass(frozen=True)
class Blueprint:
    """Everything about a scene that its programs depend on: the scene without its tensors."""

    robot: Robot  # whose constants are the programs'
    varying: tuple[str, ...]  # tensors of the robot that are arguments
    effects: tuple[Effect, ...]
    controller: Controller | None
    integrator: Integrator
    dt: float
    substeps: int

    def of_slot(self, slot: str) -> list[tuple[int, Any]]:
        """Effects of a slot with their positions among all."""
        return [(i, effect) for i, effect in enumerate(self.effects) if slot == effect.SLOT]

    def memory(self) -> dict[int, slice]:
        """Where in the memory each effect keeps its own."""
        slices, at = {}, 0
        for i, effect in enumerate(self.effects):
            size = effect.memory(self.robot.n)
            if size:
                slices[i] = slice(at, at + size)
                at += size
        return slices

    def elastic(self) -> int | None:
        """Position of the elastic joints among the effects."""
        found = [i for i, effect in self.of_slot("joint") if isinstance(effect, Elastic)]
        return found[0] if found else None


class View(NamedTuple):
    """A state as a task sees it."""

    scene: Recording
    q: Row
    qd: Row
    reading: Row  # 2 n
    torque: Row  # at the joints over the last step
    inputs: Mapping[str, Row]

    def bodies(self) -> Bodies:
        """Poses and twists of the links."""
        return Bodies(self.scene.plan.robot, self.q, self.qd, self.scene.fields)


@dataclass(frozen=True)
class Recording:
    """A scene while it is recorded: its tensors and inputs are rows of numbers."""

    plan: Blueprint  # with numbers in the place of its tensors
    fields: Given  # the robot's tensors that are not its own constants
    varied: tuple[str, ...]  # those that differ from sample to sample
    linear: bool  # whether accelerations come from articulated bodies
    inputs: Mapping[str, Row] = field(default_factory=dict)

    # --- stages ---

    def drive(self, q: Row, qd: Row, reading: Row, memory: Row) -> tuple[Row, dict[int, Row]]:
        """Torques behind the actuators, and what these remember."""
        n = self.plan.robot.n
        u: Row = self.inputs.get("torque") or [0.0] * n
        if self.plan.controller is not None:
            control = self.plan.controller.torques(
                self.plan.robot, self.fields, self.varied, self.inputs["reference"], reading[:n], reading[n:]
            )
            u = [a + b for a, b in zip(u, control, strict=True)]
        slices, remembered = self.plan.memory(), {}
        _, speeds = self.extended(q, qd, memory)
        for i, actuator in self.plan.of_slot("actuator"):
            u, kept = actuator.driven(u, speeds[-n:], memory[slices[i]] if i in slices else (), self.plan.dt)
            if i in slices:
                remembered[i] = kept
        return u, remembered

    def flow(self, q: Row, qd: Row, u: Row, memory: Row) -> tuple[Row, Row, dict[int, Row]]:
        """State after a step."""
        system = Motion(self, u)
        x, v, i, n = *self.extended(q, qd, memory), self.plan.elastic(), self.plan.robot.n
        for _ in range(self.plan.substeps):
            x, v = self.plan.integrator.step(system, x, v, self.plan.dt / self.plan.substeps)
        return x[:n], v[:n], {} if i is None else {i: (*x[n:], *v[n:])}

    def extended(self, q: Row, qd: Row, memory: Row) -> tuple[Row, Row]:
        """Positions and velocities with those of the rotors behind elastic joints."""
        i, n = self.plan.elastic(), self.plan.robot.n
        if i is None:
            return q, qd
        rotors = memory[self.plan.memory()[i]]
        return (*q, *rotors[:n]), (*qd, *rotors[n:])

    def sense(self, q: Row, qd: Row, memory: Row, beginning: bool = False) -> tuple[Row, dict[int, Row]]:
        """Readings, and what the sensors remember; at the beginning they remember what comes to them then."""
        reading: Row = (*q, *qd)
        slices, remembered, used = self.plan.memory(), {}, 0
        noise = self.inputs.get("noise", ())
        for i, sensor in self.plan.of_slot("sensor"):
            wanted, n = sensor.noises(self.plan.robot.n), len(q)
            kept = sensor.start(reading[:n], reading[n:]) if beginning else memory[slices[i]] if i in slices else ()
            reading, kept = sensor.read(reading, kept, noise[used : used + wanted])
            used += wanted
            if i in slices:
                remembered[i] = kept
        return reading, remembered


@dataclass(frozen=True)
class Motion(System):
    """The moving bodies under torques that are constant over a step: what integrators integrate."""

    scene: Recording
    u: Row

    def _model(self, q: Row) -> AlignedModel | PaperModel:
        return model(self.scene.plan.robot, q, self.scene.fields, self.scene.varied)

    def _exerted(self, q: Row, qd: Row) -> list[Screw | None] | None:
        """Wrenches of the links on the environment, in link frames."""
        effects = self.scene.plan.of_slot("body")
        if not effects:
            return None
        bodies = Bodies(self.scene.plan.robot, q, qd, self.scene.fields)
        felt: list[Screw | None] = [None] * len(q)
        for _, effect in effects:
            for i, wrench in effect.wrenches(bodies, self.scene.inputs).items():
                felt[i] = total(felt[i], wrench)
        return [neg(f) for f in felt]

    def _impedances(self, q: Row, qd: Row) -> list[list[Impedance]]:
        """Impedances of every joint."""
        found = [effect.impedances(q, qd, self.scene.inputs) for _, effect in self.scene.plan.of_slot("joint")]
        return [list(joint) for joint in zip(*found, strict=True)] if found else [[] for _ in q]

    def _elastic(self) -> Elastic | None:
        return next((effect for _, effect in self.scene.plan.of_slot("joint") if isinstance(effect, Elastic)), None)

    def _springs(self, x: Row, v: Row) -> list[Number]:
        """Torques that the springs of elastic joints pass on to the joints; without any, those of the actuators."""
        elastic, n = self._elastic(), self.scene.plan.robot.n
        if elastic is None:
            return list(self.u)
        return [
            k * (x[n + i] - x[i]) + d * (v[n + i] - v[i])
            for i, (k, d) in enumerate(zip(elastic.stiffness, elastic.damping, strict=True))
        ]

    def _joint_torques(self, x: Row, v: Row) -> list[Number]:
        """Torques on the joints, all but those of the bodies' own motion."""
        n = self.scene.plan.robot.n
        tau = self._springs(x, v)
        for i, impedances in enumerate(self._impedances(x[:n], v[:n])):
            for impedance in impedances:
                tau[i] = tau[i] + impedance.torque(x[i], v[i])
        return tau

    def _rotors(self, springs: Row) -> list[Number]:
        """Accelerations of the rotors behind elastic joints."""
        elastic = self._elastic()
        if elastic is None:
            return []
        return [(u - t) / J for u, t, J in zip(self.u, springs, elastic.inertia, strict=True)]

    def _net(self, x: Row, v: Row) -> tuple[AlignedModel | PaperModel, list[Number]]:
        """The bodies in their positions, and the torques that are left to accelerate them."""
        n = self.scene.plan.robot.n
        q, qd = x[:n], v[:n]
        m = self._model(q)
        return m, _less(self._joint_torques(x, v), m.torques(qd, None, self._exerted(q, qd)))

    def accelerations(self, x: Row, v: Row) -> list[Number]:
        """Accelerations in a state."""
        m, net = self._net(x, v)
        return [*solve(m, net, self.scene.linear), *self._rotors(self._springs(x, v))]

    def implicit_accelerations(self, x: Row, v: Row, h: Number) -> list[Number]:
        """Mean accelerations over a step whose impedances and springs act on the state at its end."""
        n = self.scene.plan.robot.n
        q, qd = x[:n], v[:n]
        m, net = self._net(x, v)
        diagonal: list[Number] = [0.0] * n
        for i, impedances in enumerate(self._impedances(q, qd)):
            for impedance in impedances:
                diagonal[i] = diagonal[i] + h * (impedance.damping + h * impedance.stiffness)
                net[i] = net[i] - h * impedance.stiffness * qd[i]
        elastic = self._elastic()
        if elastic is None:
            return list(solve(m.with_rotors(diagonal), net, self.scene.linear))
        # the rotor's velocity at the end of the step, thd' = (b + s qd')/a, is eliminated from the joint's equation
        coupled = []
        for i, (k, d, J) in enumerate(zip(elastic.stiffness, elastic.damping, elastic.inertia, strict=True)):
            s = h * (d + h * k)
            a = J + s
            b = J * v[n + i] + h * (self.u[i] - k * (x[n + i] - x[i]))
            coupled.append((s, a, b))
            diagonal[i] = diagonal[i] + s * J / a
            # the spring acts with the state at the end of the step instead of the one at its beginning
            net[i] = net[i] - d * (v[n + i] - v[i]) + (s * b / a - s * J / a * v[i]) / h
        qdd = solve(m.with_rotors(diagonal), net, self.scene.linear)
        ends = [v_i + h * a_i for v_i, a_i in zip(qd, qdd, strict=True)]
        rotors = [((b + s * end) / a - before) / h for (s, a, b), end, before in zip(coupled, ends, v[n:], strict=True)]
        return [*qdd, *rotors]

    def momentum_accelerations(self, x: Row, v: Row) -> list[Number]:
        """M(q)^-1 (dL/dq + forces), and the accelerations of the rotors."""
        n = self.scene.plan.robot.n
        q, qd = x[:n], v[:n]
        forces = self._joint_torques(x, v)
        exerted = self._exerted(q, qd)
        if exerted is not None:
            m = self._model(q)
            # the wrenches' share of the inverse dynamics, which is linear in them
            forces = _less(forces, _less(m.torques(None, None, exerted), m.torques(None, None, None)))
        rate = [f + g for f, g in zip(forces, lagrangian_gradient(self.scene, q, qd), strict=True)]
        return [*solve(self._model(q), rate, self.scene.linear), *self._rotors(self._springs(x, v))]

    def carried(self, x: Row, v: Row, to: Row) -> list[Number]:
        """Velocities at other positions that have the same momentum."""
        n = self.scene.plan.robot.n
        M = self._model(x[:n]).mass_matrix()
        momentum = [sum((M[i][j] * v[j] for j in range(n)), 0.0) for i in range(n)]
        return [*solve(self._model(to[:n]), momentum, self.scene.linear), *v[n:]]


def _less(a: Sequence[Number], b: Sequence[Number | None]) -> list[Number]:
    return [x if y is None else x - y for x, y in zip(a, b, strict=True)]


# --- energies --------------------------------------------------------------------------------------------------------


def energies(robot: Robot, fields: Given, q: Row, qd: Row) -> tuple[Number, Number]:
    """Kinetic and potential energy of the rigid bodies."""
    m = PaperModel.of(robot, q, fields)
    return m.kinetic_energy(qd), m.potential_energy()


def lagrangian_gradient(scene: Recording, q: Row, qd: Row) -> list[Number]:
    """dL/dq of L = T - U, by reverse mode on the recorded energies."""
    robot = scene.plan.robot
    given = {name: row for name, row in scene.fields.items() if row is not None}
    known = [(name, k) for name, row in given.items() for k, x in enumerate(row) if isinstance(x, Recorded)]
    arguments = [Argument("q", robot.n), Argument("qd", robot.n), Argument("fields", len(known))]

    def lagrangian(q: Row, qd: Row, numbers: Row) -> Rows:
        fields: dict[str, Any] = {name: None if row is None else list(row) for name, row in scene.fields.items()}
        for (name, k), x in zip(known, numbers, strict=True):
            fields[name][k] = x
        T, U = energies(robot, fields, q, qd)
        return {"L": [T - U]}

    program = record("lagrangian", arguments, lagrangian)
    (value,) = program.results[0].values
    if isinstance(value, float):
        return [0.0] * robot.n
    rows = [q, qd, [given[name][k] for name, k in known]]
    values = replay(program, rows)
    found = derive.cotangents(program, values, {value[0]: -1.0 if value[1] else 1.0})
    return [found.get((0, i), 0.0) for i in range(robot.n)]


# --- programs --------------------------------------------------------------------------------------------------------


class Signature(NamedTuple):
    """What the program of a stage depends on beside the blueprint."""

    stage: str  # one of STAGES
    inputs: tuple[tuple[str, int], ...]  # name, width
    tensors: tuple[
        tuple[int, str, int, bool], ...
    ]  # owner (-2: robot, -1: controller, i: effect), name, width, uniform
    task: Task | None


def recording(
    plan: Blueprint,
    linear: bool,
    inputs: Mapping[str, Row],
    tensors: Mapping[tuple[int, str], Row],
    varied: Sequence[tuple[int, str]],
) -> Recording:
    """The scene with rows of numbers in the place of inputs and tensors."""
    robot = plan.robot
    own = {name: row for (owner, name), row in tensors.items() if owner == ROBOT}
    fields: dict[str, Any] = {"gravity": None, "armature": None, **own}
    differing = {name for owner, name in varied if owner == ROBOT}

    def bound(owner: int, part: Any) -> Any:
        return part.bound({name: row for (of, name), row in tensors.items() if of == owner})

    effects = tuple(bound(i, effect) for i, effect in enumerate(plan.effects))
    for i, effect in enumerate(effects):
        if effect.SLOT == "model":
            changes = effect.changed(robot, fields)
            fields.update(changes)
            if any(owner == i for owner, _ in varied):
                differing.update(changes)
    controller = None if plan.controller is None else bound(CONTROLLER, plan.controller)
    bound_plan = replace(plan, effects=effects, controller=controller)
    return Recording(bound_plan, fields, tuple(name for name in INERTIAL if name in differing), linear, inputs)


ROBOT, CONTROLLER = -2, -1


def program(plan: Blueprint, signature: Signature) -> Program:
    """Program of a stage, recorded once."""
    if signature.stage in MOTION:
        # how time passes does not enter
        plan = replace(plan, integrator=Integrator(), dt=1.0, substeps=1, controller=None)
    return _program(plan, signature)


@remembered(PROGRAMS)
def _program(plan: Blueprint, signature: Signature) -> Program:
    arguments = [Argument(name, width) for name, width in signature.inputs]
    arguments += [Argument(f"{owner}.{name}", width, uniform) for owner, name, width, uniform in signature.tensors]
    names = [name for name, _ in signature.inputs]
    owners = [(owner, name) for owner, name, _, _ in signature.tensors]
    varied = [(owner, name) for owner, name, _, uniform in signature.tensors if not uniform]

    def recorded(linear: bool) -> Program:
        def algorithm(*rows: Row) -> Rows:
            inputs = dict(zip(names, rows[: len(names)], strict=True))
            tensors = dict(zip(owners, rows[len(names) :], strict=True))
            scene = recording(plan, linear, inputs, tensors, varied)
            return STAGES[signature.stage](scene, signature.task)

        return record(f"{signature.stage}_{plan.robot.name}", arguments, algorithm)

    return min(map(recorded, ways(plan.robot.n, (False, True))), key=lambda p: p.count().total)


def _joined(plan: Blueprint, memory: Row, *changes: Mapping[int, Row]) -> Row:
    """The memory with what changed in it."""
    row = list(memory)
    for change in changes:
        for i, kept in change.items():
            row[plan.memory()[i]] = list(kept)
    return row


def step(scene: Recording, task: Task | None) -> Rows:
    """q, qd, memory, reading and the task's rows at the end of a step."""
    x = scene.inputs
    q, qd, memory = x["q"], x["qd"], x.get("memory", ())
    u, driven = scene.drive(q, qd, x.get("reading", (*q, *qd)), memory)
    q, qd, moved = scene.flow(q, qd, u, memory)
    reading, sensed = scene.sense(q, qd, memory)
    rows: Rows = {"q": q, "qd": qd}
    if memory:
        rows["memory"] = _joined(scene.plan, memory, driven, moved, sensed)
    if scene.plan.of_slot("sensor"):
        rows["reading"] = reading
    if task is not None:
        rows.update(task.rows(View(scene, q, qd, reading, u, x)))
    return rows


def drive(scene: Recording, task: Task | None) -> Rows:
    """Torques behind the actuators, and the memory."""
    x = scene.inputs
    memory = x.get("memory", ())
    u, driven = scene.drive(x["q"], x["qd"], x.get("reading", (*x["q"], *x["qd"])), memory)
    return {"u": u, **({"memory": _joined(scene.plan, memory, driven)} if memory else {})}


def accelerations(scene: Recording, task: Task | None) -> Rows:
    """Accelerations under the torques `u`, rotors of elastic joints included in the state."""
    x = scene.inputs
    return {"a": Motion(scene, x["u"]).accelerations(x["x"], x["v"])}


def implicit_accelerations(scene: Recording, task: Task | None) -> Rows:
    """Mean accelerations over a step `h` whose impedances act on the state at its end."""
    x = scene.inputs
    return {"a": Motion(scene, x["u"]).implicit_accelerations(x["x"], x["v"], x["h"][0])}


def momentum_accelerations(scene: Recording, task: Task | None) -> Rows:
    """Rate of the momentum, as an acceleration."""
    x = scene.inputs
    return {"a": Motion(scene, x["u"]).momentum_accelerations(x["x"], x["v"])}


def carried(scene: Recording, task: Task | None) -> Rows:
    """Velocities at the positions `to` that have the same momentum."""
    x = scene.inputs
    return {"a": Motion(scene, x["u"]).carried(x["x"], x["v"], x["to"])}


def begin(scene: Recording, task: Task | None) -> Rows:
    """Memory, reading and the task's rows at the beginning."""
    return sense(scene, task, beginning=True)


def sense(scene: Recording, task: Task | None, beginning: bool = False) -> Rows:
    """Memory, reading and the task's rows in a state."""
    x = scene.inputs
    q, qd, memory = x["q"], x["qd"], x.get("memory", ())
    reading, sensed = scene.sense(q, qd, memory, beginning)
    rows: Rows = {}
    if memory:
        rows["memory"] = _joined(scene.plan, memory, sensed)
    if scene.plan.of_slot("sensor"):
        rows["reading"] = reading
    if task is not None:
        rows.update(task.rows(View(scene, q, qd, reading, x.get("u", [0.0] * len(q)), x)))
    return rows


def energy_rows(scene: Recording, task: Task | None) -> Rows:
    """Kinetic and potential energy."""
    return {"E": energies(scene.plan.robot, scene.fields, scene.inputs["q"], scene.inputs["qd"])}


# what an integrator asks of the moving bodies, where it is not recorded with them
MOTION = {stage.__name__: stage for stage in (accelerations, implicit_accelerations, momentum_accelerations, carried)}
STAGES = {"step": step, "drive": drive, "sense": sense, "begin": begin, "energy": energy_rows, **MOTION}
