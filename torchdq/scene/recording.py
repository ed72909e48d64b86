"""Programs of a scene: its step as a computation on numbers, recorded.

A step has three stages. `drive` turns commands into torques at the transmission: controller, then actuators. `flow`
carries positions x and velocities v over the step under those torques. `sense` makes a state of them and reads it. They
are recorded as one program; or each by itself, where `flow` is a loop, whose body is a substep or, of an adaptive
integrator, an attempt of one: see `substeps`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import islice
from typing import Any, NamedTuple, NoReturn

from torchdq.backends.call import Computation
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.base.checks import Named
from torchdq.dynamics.posed import Row
from torchdq.effects.actuator import Actuator
from torchdq.effects.body import BodyEffect
from torchdq.effects.contact import Contacts
from torchdq.effects.sensor import Sensor
from torchdq.effects.steady import lines
from torchdq.errors import ArgumentError
from torchdq.export.meaning import heading, part
from torchdq.functions.recipe import alternatives_to_record
from torchdq.program.autodiff import rates
from torchdq.program.program import (
    GROWTH,
    Argument,
    Program,
    finish,
    growths,
    inputs,
    record,
    recording,
    replay,
    results,
)
from torchdq.robot.fields import trailing
from torchdq.scene.effect_checks import row_and_memory
from torchdq.scene.equations_of_motion import SceneSystem, with_growths
from torchdq.scene.free_base import POSE, TWIST, displacements, rates_of
from torchdq.scene.integrators import DormandPrince, Integrator
from torchdq.scene.spec import (
    LABELS,
    POLICY,
    POSES,
    Formula,
    Memory,
    RecordedScene,
    Rows,
    SceneSpec,
    Task,
    View,
    recorded,
)

# of adaptive steps, see `DormandPrince.attempt`; names that no input has
TAKEN, CLOCK, GOAL = "size of a step", "clock of a step", "goal of a step"


def drive(scene: RecordedScene) -> tuple[Row, Row, Row, Memory]:
    """Actuator torques u, positions x and velocities v to integrate, and the memory, by controller and actuators."""
    inputs, spec = scene.inputs, scene.spec
    n, q, qd = spec.robot.n, inputs["q"], inputs["qd"]
    memory = spec.split(inputs.get("memory", ()))
    u: Row = inputs.get("torque") or [0.0] * n
    if spec.controller is not None:
        reading, reference = inputs.get("reading", (*q, *qd)), inputs["reference"]
        control = spec.controller.following(scene.posed(reading[:n]), reference, reading[:n], reading[n:])
        if len(control) != n:
            raise ArgumentError(
                f"torques of {type(spec.controller).__name__} must return {n} numbers, found {len(control)}"
            )
        u = [a + b for a, b in zip(u, control, strict=True)]
    x, v = scene.packed(q, qd, memory)
    for i, actuator in spec.of(Actuator):
        driven = actuator.driven(u, v[-n:], memory[i], spec.dt)  # motors turn with the rotors
        u, memory[i] = row_and_memory(actuator, "driven", driven, n, actuator.memory(n))
    return u, *scene.with_free(x, scene.with_inner(v, memory)), memory


def flow(system: SceneSystem, x: Row, v: Row) -> tuple[Row, Row]:
    """Positions and velocities at the end of a step."""
    spec = system.scene.spec
    for _ in range(spec.substeps):
        x, v = spec.integrator.step(system, x, v, spec.dt / spec.substeps)
    return x, v


def sense(scene: RecordedScene, task: Task | None, u: Row, x: Row, v: Row, memory: Memory) -> Rows:
    """State at the end of a step, and the task's rows; sensors without a memory start with what they sense."""
    moved, memory = scene.unpacked(x, v, memory)
    q, qd = moved["q"], moved["qd"]
    n, used = len(q), 0
    reading: Row = (*q, *qd)
    noise = scene.inputs.get("noise", ())
    for i, sensor in scene.spec.of(Sensor):
        before = memory[i] if i in memory else sensor.start(reading[:n], reading[n:])
        width = sensor.noises(n)
        read = sensor.read(reading, before, noise[used : used + width])
        reading, memory[i] = row_and_memory(sensor, "read", read, 2 * n, sensor.memory(n))
        used += width
    rows: Rows = {**moved, **_remembered(memory)}
    if scene.spec.senses:
        rows["reading"] = reading
    if task is not None:
        rows.update(task.rows(_view(scene, moved, reading, u, memory)))
    return rows


def _remembered(memory: Memory) -> Rows:
    """Row of the memory, if there is any."""
    row = [x for i in sorted(memory) for x in memory[i]]
    return {"memory": row} if row else {}


# --- stages ----------------------------------------------------------------------------------------------------------


def _step(scene: RecordedScene, task: Task | None) -> Rows:
    u, x, v, memory = drive(scene)
    return with_growths(scene, u, lambda system: sense(scene, task, u, *flow(system, x, v), memory))


def _drive(scene: RecordedScene, task: Task | None) -> Rows:
    u, x, v, memory = drive(scene)
    start = {name: scene.inputs[name] for name in POSES if name in scene.inputs}
    return {"u": u, "x": x, "v": v, **start, **_remembered(memory)}


def _sense(scene: RecordedScene, task: Task | None) -> Rows:
    given = scene.inputs
    return sense(scene, task, given["u"], given["x"], given["v"], scene.spec.split(given.get("memory", ())))


def _begin(scene: RecordedScene, task: Task | None) -> Rows:
    q, qd = scene.inputs["q"], scene.inputs["qd"]
    sensors = {i for i, _ in scene.spec.of(Sensor)}
    memory = {i: e.start(q, qd) for i, e in enumerate(scene.spec.effects) if i not in sensors}
    x, v = scene.packed(q, qd, memory)
    return sense(scene, task, [0.0] * len(q), *scene.with_free(x, scene.with_inner(v, memory)), memory)


def _energy(scene: RecordedScene, task: Task | None) -> Rows:
    view = _view(scene, scene.inputs)
    at = view.bodies.posed
    return {"E": (at.kinetic_energy((*view.twists, *view.V_WB_B, *view.qd)), at.potential_energy())}


def _view(
    scene: RecordedScene, moved: Mapping[str, Row], reading: Row = (), u: Row = (), memory: Memory | None = None
) -> View:
    """View of a state; the memory is that which is given."""
    memory = scene.spec.split(scene.inputs.get("memory", ())) if memory is None else memory
    free = {name: moved[name] for name in ("X_WB", "V_WB_B", "poses", "twists") if name in moved}
    return View(scene, moved["q"], moved["qd"], reading, u, scene.inputs, memory=memory, **free)


def _judge(scene: RecordedScene, task: Task | None) -> Rows:
    """Rows of a task in a state at the end of a step."""
    given = scene.inputs
    reading = given.get("reading", (*given["q"], *given["qd"]))
    return {} if task is None else task.rows(_view(scene, given, reading, given.get("torque", ())))


def _contacts(scene: RecordedScene, task: Task | None) -> Rows:
    rows = dict(zip(Contacts._fields, zip(*_view(scene, scene.inputs).contacts, strict=True), strict=True))
    return {**rows, "force": [x for force in rows["force"] for x in force]}


def _places(scene: RecordedScene, task: Task | None) -> Rows:
    """Places of points, by the name of the row that is looked up there."""
    bodies, n = _view(scene, scene.inputs).bodies, scene.spec.robot.n
    return {name: x.places(bodies) for _, x in scene.spec.of(BodyEffect) for name in x.computed(n)}


def _bodies(scene: RecordedScene, task: Task | None) -> Rows:
    return {name: row for name, row in scene.overrides.items() if row is not None}


def _frozen(scene: RecordedScene, task: Task | None) -> Rows:
    """Mass matrix, damping and stiffness of the joints in a state."""
    u, x, v, _ = drive(scene)
    return with_growths(scene, u, lambda system: system.frozen(x, v))


def _substep(scene: RecordedScene, task: Task | None) -> Rows:
    """State after a step of the integrator, whose size is an input, of all samples or of each."""
    given = scene.inputs

    def rows(system: SceneSystem) -> Rows:
        (h,) = given["h"] if "h" in given else given[TAKEN]
        x, v = scene.spec.integrator.step(system, given["x"], given["v"], h)
        return {"x": x, "v": v}

    return with_growths(scene, given["u"], rows)


def _attempt(scene: RecordedScene, task: Task | None) -> Rows:
    """State after an attempt of a step of `DormandPrince`."""
    given = scene.inputs

    def rows(system: SceneSystem) -> Rows:
        x, v, clock, taken = DormandPrince().attempt(system, *[given[name] for name in ("x", "v", CLOCK, GOAL)])
        return {"x": x, "v": v, CLOCK: clock, TAKEN: [taken]}

    return with_growths(scene, given["u"], rows)


STAGES = {
    "step": _step,
    "drive": _drive,
    "sense": _sense,
    "begin": _begin,
    "energy": _energy,
    "judge": _judge,
    "contacts": _contacts,
    "places": _places,
    "bodies": _bodies,
    "frozen": _frozen,
    "substep": _substep,
    "attempt": _attempt,
}
BODIES_OF_LOOPS = ("substep", "attempt")
DRIVEN = ("step", "drive", "frozen")  # stages with controller and actuators


# --- programs --------------------------------------------------------------------------------------------------------


class _StageFields(NamedTuple):
    """Fields of `Stage`."""

    spec: SceneSpec
    stage: str  # one of STAGES
    task: Task | None = None
    # names of inputs and parameters: the results are then the state "after" [s], in the order of a linearization, its
    # derivatives "A" [t, t] in the state, and those in each of these, by its name; or the one "A" [t, 1] along an input
    # "direction" [t + n], a displacement of state and of that one
    wrt: tuple[str, ...] | None = None
    policy: Formula | None = None  # of a step, which adds its torques to those given
    unguarded: bool = False  # whether rows with a singular mass matrix have any numbers, without a look at them


class Stage(_StageFields, Computation):
    """A stage of a scene's step, as a computation of `torchdq.backends.call`; parameters are named "owner.name"."""

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of an input or a parameter."""
        owned = owner_of(name)
        own = {} if self.policy is None else self.policy.axes(self.spec.robot.n, self.spec.state)
        if name in own or (owned is not None and owned[0] == POLICY):
            return own[name if owned is None else owned[1]]
        if owned is not None:
            owner, parameter = owned
            return trailing(self.spec.shapes(owner)[parameter], self.spec.robot.sizes)
        known = self.widths()
        if name not in known:
            raise ArgumentError(f"{name} is not an input of this scene; it has {', '.join(self.spec.inputs())}")
        return (known[name],)

    def widths(self) -> dict[str, int]:
        """Width of every input that a program of the scene may have."""
        spec, n = self.spec, self.spec.robot.n
        moving = n + spec.transmission[1].memory(n) // 2
        asked = {} if self.task is None else self.task.inputs(n)
        evaluated = {"u": n, "x": moving + POSE * spec.free, "v": moving + spec.inner + TWIST * spec.free, "h": 1}
        evaluated |= {TAKEN: 1, CLOCK: 3, GOAL: 4}
        known = {**spec.state, "noise": spec.noises, **spec.inputs(), **spec.computed(), **asked, **evaluated}
        return known if self.wrt is None else {**known, "direction": sum(spec.displaced.values()) + n}

    def results(self, program: Program) -> tuple[tuple[int, ...], ...]:
        """Trailing axes of the results; one number of a task, such as its reward, has none."""
        if self.wrt is not None:
            after, *sizes = (len(result.values) for result in program.results)
            t = sum(self.spec.displaced.values())
            return (after,), *((t, size // t) for size in sizes)
        if self.stage not in ("step", "sense", "begin"):
            return super().results(program)
        rows = (*self.spec.state, "observation", "reference", "carry")
        widths = [(result.name, len(result.values)) for result in program.results]
        return tuple([(width,) if width > 1 or name in rows else () for name, width in widths])

    def shared(self, name: str) -> bool:
        """True for a parameter, and for a step size or a goal that all samples have."""
        return "." in name or name in ("h", GOAL)

    def label(self, name: str) -> str:
        """Name of a parameter without its owner, and of a row of objects as it is given."""
        return LABELS.get(name, name.rpartition(".")[2])

    def subject(self) -> str:
        """Robot that shapes are for, in error messages."""
        return f" for robot {self.spec.robot.name!r}"

    def check(self, tensors: Mapping[str, Any]) -> None:
        """Raise, naming the input that is missing, or the parameter that would broadcast against the batch."""
        spec, known = self.spec, self.widths()
        if self.stage in (*DRIVEN, "contacts"):
            for name in spec.state:
                if name not in tensors:
                    raise ArgumentError(f"{name} must be part of the state; `start` makes one that has it")
        if self.stage in (*DRIVEN, *BODIES_OF_LOOPS):
            needed = [name for effect in spec.effects for name in effect.needs(spec.robot.n)]
            needed += ["reference"] if spec.controller is not None and self.stage in DRIVEN else []
            for name in needed:
                if name not in tensors and (self.policy is None or name != self.policy.control):
                    raise ArgumentError(f"{name} must be given, shape [..., {known[name]}]; the scene needs it")
        batch: tuple[int, ...] = ()
        for name, x in tensors.items():
            if not self.shared(name) and x.ndim - 1 > len(batch):
                batch = tuple(x.shape[:-1])
        for name, x in tensors.items():
            # a [batch, 1] parameter would broadcast against the batch axis to [batch, batch]
            column = self.shared(name) and not self.axes(name) and tuple(x.shape) == (*batch, 1)
            if column and batch and batch[-1] > 1:
                raise ArgumentError(
                    f"{self.label(name)} is one number for each sample: shape {batch}, found {tuple(x.shape)}"
                )

    def program(self, arguments: tuple[Argument, ...]) -> Program:
        """Program of the stage, recorded once."""
        if self.wrt is not None:
            return _linearized(self, arguments)
        if self.stage == "step":
            return _program(self, arguments)
        spec = replace(self.spec, integrator=Integrator(), substeps=1)  # which the others do not depend on
        if self.stage in BODIES_OF_LOOPS:  # nor on controller and time step, nor on tolerances
            adaptive = isinstance(self.spec.integrator, DormandPrince)
            integrator = DormandPrince() if adaptive else self.spec.integrator
            spec = replace(spec, dt=1.0, controller=None, integrator=integrator)
        return _program(self._replace(spec=spec), arguments)


class _Given(Named):
    """Inputs of a scene or task that are given, by name."""

    widths: dict[str, int]  # of all that there may be

    def __missing__(self, name: str) -> NoReturn:
        if name in self.widths:
            raise ArgumentError(f"{name} must be given, shape [..., {self.widths[name]}]; the task needs it")
        super().__missing__(name)


@remembered(PROGRAMS)
def _program(what: Stage, arguments: tuple[Argument, ...]) -> Program:
    spec = what.spec
    owners = [owner_of(a.name) for a in arguments]
    per_sample = [owner for owner, a in zip(owners, arguments, strict=True) if owner and not a.uniform]

    def by(linear: bool) -> Program:
        def algorithm(*rows: Row) -> Rows:
            given = {a.name: row for a, owner, row in zip(arguments, owners, rows, strict=True) if not owner}
            inputs = _Given("input of the scene", given)
            inputs.widths = what.widths()
            tensors = {owner: row for owner, row in zip(owners, rows, strict=True) if owner}
            if what.policy is not None:
                inputs[what.policy.control] = _commanded(what, what.policy, inputs, tensors)
            found = STAGES[what.stage](recorded(spec, linear, inputs, tensors, per_sample), what.task)
            return {name: row for name, row in found.items() if name != GROWTH} if what.unguarded else found

        return record(f"{what.stage}_{spec.robot.name}", arguments, algorithm)

    forms = (False,) if spec.objects or spec.robot.closures else alternatives_to_record(spec.robot.n, (False, True))
    best = min(map(by, forms), key=lambda p: p.count().total)
    steps = f"{what.stage} of {spec.dt:g} s" if what.stage == "step" else what.stage
    n = spec.robot.n
    acting = [(k, effect) for k, effect in enumerate(spec.effects) if not effect.idle() or effect.memory(n)]
    about = [*[f"effect {k}: {part(effect)}" for k, effect in acting], *lines(spec.effects, n)]
    about += [] if spec.controller is None else [f"controller: {part(spec.controller)}"]
    return replace(best, about=(*heading(steps, spec.robot.name, spec.robot.joint_names), *about))


def _commanded(what: Stage, policy: Formula, given: Rows, tensors: Mapping[tuple[int, str], Row]) -> Row:
    """Torques or targets of a policy, with those given."""
    n, weights = what.spec.robot.n, {name: row for (owner, name), row in tensors.items() if owner == POLICY}
    found, control = policy.torques(given, weights), policy.control
    if len(found) != n:
        raise ArgumentError(f"policy must return {n} torques, found {len(found)}")
    return [a + b for a, b in zip(given[control], found, strict=True)] if control in given else found


@remembered(PROGRAMS)
def _linearized(what: Stage, arguments: tuple[Argument, ...]) -> Program:
    """Program of the state after a step and its derivatives by forward mode, whose columns share their common terms."""
    given, parts = tuple([a for a in arguments if a.name != "direction"]), what.spec.displaced
    step, at = what._replace(wrt=None).program(given), {a.name: k for k, a in enumerate(given)}
    name = f"{step.name}_linearized"
    with recording(name) as tape:
        known = {a.name: row for a, row in zip(arguments, inputs(tape, arguments), strict=True)}
        values = replay(step, [known[a.name] for a in given])
        after = results(step, values)

        def moved(by: Rows) -> Row:
            """Displacement of the state after the step, of those of its arguments."""
            by = {of: rates_of(known[of], x) if of in POSES else x for of, x in by.items()}
            found = rates(step, values, {(at[of], j): x for of, row in by.items() for j, x in enumerate(row)})
            found |= {of: displacements(after[of], found[of]) for of in POSES if of in parts}
            return [x for part in parts for x in found[part]]

        def columns(of: str) -> list[Row]:
            width = parts.get(of, given[at[of]].width)
            return [moved({of: [float(j == k) for j in range(width)]}) for k in range(width)]

        if "direction" in known:
            row, widths = iter(known["direction"]), {**parts, **dict.fromkeys(what.wrt or ())}
            blocks = {"A": [moved({of: [*islice(row, width)] for of, width in widths.items()})]}
        else:
            blocks = {"A": [x for part in parts for x in columns(part)], **{of: columns(of) for of in what.wrt or ()}}
        matrices = {of: [x for row in zip(*block, strict=True) for x in row] for of, block in blocks.items()}
        found = {"after": [x for part in parts for x in after[part]], **matrices}
        return finish(name, arguments, tape, found, growths=growths(step, values))


def owner_of(name: str) -> tuple[int, str] | None:
    """Owner and name of a parameter; None for an input."""
    owner, dot, parameter = name.partition(".")
    return (int(owner), parameter) if dot else None
