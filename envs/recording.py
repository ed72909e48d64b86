"""Programs of a scene: its step as a computation on numbers, recorded.

A step has three stages. `drive` turns commands into torques at the transmission: controller, then actuators. `flow`
carries positions x and velocities v over the step under those torques. `sense` makes a state of them and reads it. They
are recorded as one program, unless the integrator is one that is not recorded: then `drive` and `sense` are programs,
and so is each evaluation that the integrator asks for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

from torchdq.effects.actuator import Actuator
from torchdq.effects.sensor import Sensor
from torchdq.envs.integrators import Integrator
from torchdq.envs.spec import Memory, RecordedScene, Row, Rows, SceneSpec, Task, View, recorded
from torchdq.envs.system import SceneSystem
from torchdq.functions.catalogue import ways
from torchdq.program.program import Argument, Program, record

MOST_PROGRAMS = 256  # kept by a process


class Driven(NamedTuple):
    """Actuator torques u, positions x and velocities v to integrate, and the memory."""

    u: Row
    x: Row
    v: Row
    memory: Memory


def drive(scene: RecordedScene) -> Driven:
    """Beginning of a step."""
    inputs, spec = scene.inputs, scene.spec
    n, q, qd = spec.robot.n, inputs["q"], inputs["qd"]
    memory = spec.split(inputs.get("memory", ()))
    u: Row = inputs.get("torque") or [0.0] * n
    if spec.controller is not None:
        reading, reference = inputs.get("reading", (*q, *qd)), inputs["reference"]
        control = spec.controller.torques(scene.posed(reading[:n]), reference, reading[:n], reading[n:])
        u = [a + b for a, b in zip(u, control, strict=True)]
    x, v = scene.packed(q, qd, memory)
    for i, actuator in spec.of(Actuator):
        u, memory[i] = actuator.driven(u, v[-n:], memory[i], spec.dt)  # motors turn with the rotors
    return Driven(u, x, v, memory)


def flow(scene: RecordedScene, u: Row, x: Row, v: Row) -> tuple[Row, Row]:
    """Positions and velocities at the end of a step."""
    system, spec = SceneSystem(scene, u), scene.spec
    for _ in range(spec.substeps):
        x, v = spec.integrator.step(system, x, v, spec.dt / spec.substeps)
    return x, v


def sense(scene: RecordedScene, task: Task | None, u: Row, x: Row, v: Row, memory: Memory) -> Rows:
    """State at the end of a step, and the task's rows; sensors without a memory start with what they sense."""
    q, qd, memory = scene.unpacked(x, v, memory)
    n, used = len(q), 0
    reading: Row = (*q, *qd)
    noise = scene.inputs.get("noise", ())
    for i, sensor in scene.spec.of(Sensor):
        before = memory[i] if i in memory else sensor.start(reading[:n], reading[n:])
        width = sensor.noises(n)
        reading, memory[i] = sensor.read(reading, before, noise[used : used + width])
        used += width
    rows: Rows = {"q": q, "qd": qd, **_remembered(memory)}
    if scene.spec.senses:
        rows["reading"] = reading
    if task is not None:
        rows.update(task.rows(View(scene, q, qd, reading, u, scene.inputs)))
    return rows


def _remembered(memory: Memory) -> Rows:
    """Row of the memory, if there is any."""
    row = [x for i in sorted(memory) for x in memory[i]]
    return {"memory": row} if row else {}


# --- stages ----------------------------------------------------------------------------------------------------------


def _step(scene: RecordedScene, task: Task | None) -> Rows:
    u, x, v, memory = drive(scene)
    return sense(scene, task, u, *flow(scene, u, x, v), memory)


def _drive(scene: RecordedScene, task: Task | None) -> Rows:
    u, x, v, memory = drive(scene)
    return {"u": u, "x": x, "v": v, **_remembered(memory)}


def _sense(scene: RecordedScene, task: Task | None) -> Rows:
    given = scene.inputs
    return sense(scene, task, given["u"], given["x"], given["v"], scene.spec.split(given.get("memory", ())))


def _begin(scene: RecordedScene, task: Task | None) -> Rows:
    q, qd = scene.inputs["q"], scene.inputs["qd"]
    sensors = {i for i, _ in scene.spec.of(Sensor)}
    memory = {i: e.start(q, qd) for i, e in enumerate(scene.spec.effects) if i not in sensors}
    return sense(scene, task, [0.0] * len(q), *scene.packed(q, qd, memory), memory)


def _energy(scene: RecordedScene, task: Task | None) -> Rows:
    at = scene.posed(scene.inputs["q"])
    return {"E": (at.kinetic_energy(scene.inputs["qd"]), at.potential_energy())}


def _evaluation(method: Callable[..., Row], *names: str) -> Callable[[RecordedScene, Task | None], Rows]:
    """Stage of an evaluation of the equations of motion, with the inputs of those names as its arguments."""

    def stage(scene: RecordedScene, task: Task | None) -> Rows:
        system = SceneSystem(scene, scene.inputs["u"])
        return {"a": method(system, *[scene.inputs[name] for name in names])}

    return stage


EVALUATIONS = {
    "accelerations": _evaluation(SceneSystem.accelerations, "x", "v"),
    "implicit_accelerations": _evaluation(lambda s, x, v, h: s.implicit_accelerations(x, v, h[0]), "x", "v", "h"),
    "momentum_accelerations": _evaluation(SceneSystem.momentum_accelerations, "x", "v"),
    "velocities_at": _evaluation(SceneSystem.velocities_at, "x", "v", "to"),
}
STAGES = {"step": _step, "drive": _drive, "sense": _sense, "begin": _begin, "energy": _energy, **EVALUATIONS}


# --- programs --------------------------------------------------------------------------------------------------------


class Signature(NamedTuple):
    """Signature of a stage's program, which depends on it and on the specification."""

    stage: str  # one of STAGES
    inputs: tuple[tuple[str, int], ...]  # name, width
    tensors: tuple[tuple[int, str, int, bool], ...]  # owner, name, width, uniform
    task: Task | None


def program(spec: SceneSpec, signature: Signature) -> Program:
    """Program of a stage, recorded once."""
    if signature.stage in EVALUATIONS:  # independent of controller and time step
        spec = replace(spec, integrator=Integrator(), dt=1.0, substeps=1, controller=None)
    return _program(spec, signature)


@lru_cache(MOST_PROGRAMS)
def _program(spec: SceneSpec, signature: Signature) -> Program:
    arguments = [Argument(name, width) for name, width in signature.inputs]
    arguments += [Argument(f"{owner}.{name}", width, uniform) for owner, name, width, uniform in signature.tensors]
    names = [name for name, _ in signature.inputs]
    owners = [(owner, name) for owner, name, _, _ in signature.tensors]
    per_sample = [(owner, name) for owner, name, _, uniform in signature.tensors if not uniform]

    def way(linear: bool) -> Program:
        def algorithm(*rows: Row) -> Rows:
            inputs = dict(zip(names, rows[: len(names)], strict=True))
            tensors = dict(zip(owners, rows[len(names) :], strict=True))
            return STAGES[signature.stage](recorded(spec, linear, inputs, tensors, per_sample), signature.task)

        return record(f"{signature.stage}_{spec.robot.name}", arguments, algorithm)

    return min(map(way, ways(spec.robot.n, (False, True))), key=lambda p: p.count().total)
