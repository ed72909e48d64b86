"""Specification of a scene, which its programs depend on, and the scene while it is recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, TypeVar

from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Pure
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.control.law import Law
from torchdq.dynamics.posed import Posed, Row
from torchdq.effects.body import Bodies, BodyEffect
from torchdq.effects.contact import Contact, Contacts
from torchdq.effects.effect import Effect
from torchdq.effects.joint import JointEffect
from torchdq.effects.model import ModelEffect
from torchdq.effects.sensor import Sensor
from torchdq.effects.transmission import Transmission
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import Shapes
from torchdq.functions.posed import Overrides, posed
from torchdq.functions.posed import field as tensor
from torchdq.robot import Robot
from torchdq.robot.fields import BODIES, SHAPES
from torchdq.scene import free_base
from torchdq.scene.effect_checks import changes
from torchdq.scene.free_base import POSE, START, TWIST
from torchdq.scene.integrators import Integrator

Rows = dict[str, Row]
Memory = dict[int, Row]  # remembered values of each effect, by its position
E = TypeVar("E", bound=Effect)

ORDER = ("X_WB", "q", "V_WB_B", "qd", "memory", "reading")  # of the rows of a state in a linearization
POLICY, ROBOT, CONTROLLER = -3, -2, -1  # owners of tensors; an effect owns its tensors by its position


class Task(Protocol):
    """Rows that an environment adds to a step, computed from the state at its end."""

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of its inputs, without the state."""

    def rows(self, view: View) -> Rows:
        """Rows of numbers, by name."""


class Formula(Protocol):
    """Torques of a policy, computed from the state before a step; hashable, since programs depend on it."""

    def axes(self, n: int, widths: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Trailing axes of its tensors by name, of states with these widths."""

    def torques(self, rows: Mapping[str, Row], weights: Mapping[str, Row]) -> Row:
        """Torques, of rows of the state and inputs, and of its tensors."""


@dataclass(frozen=True)
class SceneSpec:
    """Specification of a scene, on which its programs depend: the scene without its tensors."""

    robot: Robot  # whose constants are the programs'
    arguments: tuple[str, ...]  # tensors of the robot that are arguments
    effects: tuple[Effect, ...]
    controller: Law | None
    integrator: Integrator
    dt: float
    substeps: int

    def __hash__(self) -> int:
        # at every step; the parameters of the effects would take most of the time
        return hash((self.robot, self.arguments, self.dt, self.substeps, *map(type, self.effects)))

    def of(self, base: type[E]) -> list[tuple[int, E]]:
        """Effects of a class, with their positions among all."""
        return [(i, effect) for i, effect in enumerate(self.effects) if isinstance(effect, base)]

    @property
    def state(self) -> dict[str, int]:
        """Names and widths of the rows of a state."""
        n = self.robot.n
        memory = {"memory": self.remembers} if self.remembers else {}
        return {**self.moving, **memory, **({"reading": 2 * n} if self.senses else {})}

    @property
    def displaced(self) -> dict[str, int]:
        """Names and widths of the parts of a displacement of a state, in the order of a linearization."""
        state = self.state
        return {name: TWIST if name == "X_WB" else state[name] for name in ORDER if name in state}

    @property
    def moving(self) -> dict[str, int]:
        """Names and widths of the positions and velocities of a state."""
        base = {"X_WB": POSE, "V_WB_B": TWIST} if self.robot.floating else {}
        return {"q": self.robot.n, "qd": self.robot.n, **base}

    @property
    def senses(self) -> bool:
        """True if there are sensors."""
        return bool(self.of(Sensor))

    @property
    def transmission(self) -> tuple[int | None, Transmission]:
        """Transmission between actuators and joints, and its position among the effects."""
        return next(iter(self.of(Transmission)), (None, Transmission()))

    def inputs(self) -> dict[str, int]:
        """Names and widths of everything that may be given at a step."""
        n = self.robot.n
        found = {"torque": n} | ({} if self.controller is None else {"reference": self.controller.reference(n)})
        for effect in self.effects:
            found.update(effect.inputs(n))
        return found

    def computed(self) -> dict[str, int]:
        """Names and widths of the rows that a scene computes before a step."""
        return {name: width for effect in self.effects for name, width in effect.computed(self.robot.n).items()}

    def require_inputs(self, names: Iterable[str], task: Task | None = None) -> None:
        """Raise unless those are names of inputs, of the scene or of a task, which None may stand for, too."""
        names = dict.fromkeys(names)
        if names.keys() <= {"torque"}:  # an input of every scene; asked at every step
            return
        known, computed = self.inputs() | ({} if task is None else task.inputs(self.robot.n)), self.computed()
        for name in names:
            if name in computed:
                raise ArgumentError(f"{name} is computed by the scene before every step; leave it out")
            if name not in known:
                raise ArgumentError(f"{name} is not an input of this scene; it has {', '.join(self.inputs())}")

    @property
    def noises(self) -> int:
        """Number of random numbers that a step consumes."""
        return sum(effect.noises(self.robot.n) for effect in self.effects)

    @property
    def remembers(self) -> int:
        """Number of values that effects remember."""
        return sum(effect.memory(self.robot.n) for effect in self.effects)

    @property
    def integrated(self) -> list[tuple[int, Effect]]:
        """Effects at the joints and on bodies, whose memory is integrated with the velocities, with their positions."""
        return [*self.of(JointEffect), *self.of(BodyEffect)]

    @property
    def inner(self) -> int:
        """Number of values that those effects remember."""
        return sum(effect.memory(self.robot.n) for _, effect in self.integrated)

    def shapes(self, owner: int) -> Shapes:
        """Trailing axes of the parameters of the robot, the controller, or the effect at a position."""
        if owner == ROBOT:
            return SHAPES
        part = self.controller if owner == CONTROLLER else self.effects[owner]
        return {} if part is None else part.SHAPES

    def split(self, memory: Row) -> Memory:
        """Memory of each effect."""
        found, at = {}, 0
        for i, effect in enumerate(self.effects):
            size = effect.memory(self.robot.n)
            found[i] = memory[at : at + size]
            at += size
        return found


@remembered(PROGRAMS)
def supplied(spec: SceneSpec, task: Task | None) -> frozenset[str]:
    """Names of the inputs that a caller may give, of the scene or of a task."""
    known = spec.inputs() | ({} if task is None else task.inputs(spec.robot.n))
    return frozenset(known.keys() - spec.computed().keys())


@dataclass(frozen=True)
class RecordedScene:
    """A scene while it is recorded: its tensors and inputs are rows of numbers."""

    spec: SceneSpec  # with numbers instead of its tensors
    overrides: Overrides  # the robot's tensors that are not its own constants
    per_sample: tuple[str, ...]  # names of those that differ from sample to sample
    linear: bool  # True: accelerations by articulated bodies, in O(n)
    inputs: Mapping[str, Row] = field(default_factory=dict)

    def posed(self, q: Row, X_WB: DualQuaternion | None = None) -> Posed:
        """Robot at joint positions and, if its base is free, at the pose of it, with the scene's changes."""
        return posed(self.spec.robot, q, self.overrides, self.per_sample, X_WB)

    def packed(self, q: Row, qd: Row, memory: Memory) -> tuple[Row, Row]:
        """Positions and velocities of the joints and then of the rotors behind them."""
        at, transmission = self.spec.transmission
        return transmission.extended(q, qd, () if at is None else memory[at])

    def with_inner(self, v: Row, memory: Memory) -> Row:
        """Velocities, and then what effects at the joints and on bodies remember."""
        return (*v, *[value for i, _ in self.spec.integrated for value in memory[i]])

    @property
    def base_com(self) -> Pure:
        """Centre of mass of a floating base, in its frame [m]."""
        return tensor(self.spec.robot, "base_com", self.overrides)

    def with_base(self, x: Row, v: Row) -> tuple[Row, Row]:
        """Integrated positions x and velocities v: `packed` ones, then those of a floating base; see `free_base`."""
        if not self.spec.robot.floating:
            return x, v
        return (*x, *START), (*v, *free_base.at_centre(START, self.inputs["V_WB_B"], self.base_com))

    def base_of(self, x: Row) -> DualQuaternion | None:
        """Pose X_WB of a floating base, of integrated positions; None: the base is fixed."""
        if not self.spec.robot.floating:
            return None
        return free_base.placed(self.inputs["X_WB"], x[-POSE:], self.base_com)

    def unpacked(self, x: Row, v: Row, memory: Memory) -> tuple[Rows, Memory]:
        """State of integrated positions x and velocities v, and the memory."""
        (at, _), n = self.spec.transmission, self.spec.robot.n
        rows: Rows = {"q": x[:n], "qd": v[:n]}
        if (X_WB := self.base_of(x)) is not None:
            rows["X_WB"] = free_base.unit(X_WB)
            rows["V_WB_B"] = free_base.twist(x[-POSE:], v[-TWIST:], self.base_com)
            x, v = x[:-POSE], v[:-TWIST]
        inner, v = v[len(x) :], v[: len(x)]
        memory = {**memory} if at is None else {**memory, at: (*x[n:], *v[n:])}
        for i, effect in self.spec.integrated:
            size = effect.memory(n)
            memory[i], inner = inner[:size], inner[size:]
        return rows, memory


class View(NamedTuple):
    """A state as a task sees it."""

    scene: RecordedScene
    q: Row
    qd: Row
    reading: Row  # 2 n
    torque: Row  # behind the actuators, over the last step
    inputs: Mapping[str, Row]
    X_WB: Row = ()  # pose [8] and twist [6] of a floating base
    V_WB_B: Row = ()
    memory: Memory = {}  # noqa: RUF012  # of each effect

    def posed(self, q: Row) -> Posed:
        """Robot at joint positions, in the world if its base is floating."""
        return self.scene.posed(q, (tuple(self.X_WB[:4]), tuple(self.X_WB[4:])) if self.X_WB else None)

    @property
    def contacts(self) -> list[Contacts]:
        """Contact of every point of the scene."""
        spec, at = self.scene.spec, self.posed(self.q)
        bodies = Bodies(spec.robot, at, at.twists([*self.V_WB_B, *self.qd]))
        found = [effect.readings(bodies, self.scene.inputs, self.memory[i]) for i, effect in spec.of(Contact)]
        return [point for points in found for point in points]


def recorded(
    spec: SceneSpec,
    linear: bool,
    inputs: Mapping[str, Row],
    tensors: Mapping[tuple[int, str], Row],
    per_sample: Sequence[tuple[int, str]],
) -> RecordedScene:
    """Scene whose inputs and tensors are rows of numbers; tensors are given by owner and name."""
    own = {name: row for (owner, name), row in tensors.items() if owner == ROBOT}
    overrides: dict[str, Any] = {"gravity": None, "armature": None, **own}
    differing = {name for owner, name in per_sample if owner == ROBOT}

    def bound(owner: int, part: Any) -> Any:
        return part.bound({name: row for (of, name), row in tensors.items() if of == owner})

    spec = replace(
        spec,
        effects=tuple(bound(i, effect) for i, effect in enumerate(spec.effects)),
        controller=None if spec.controller is None else bound(CONTROLLER, spec.controller),
    )
    for i, effect in sorted(spec.of(ModelEffect), key=lambda found: found[1].LATE):
        changed = changes(effect, effect.changed(spec.robot, overrides), spec.robot)
        overrides.update(changed)
        if any(owner == i for owner, _ in per_sample):
            differing.update(changed)
    return RecordedScene(spec, overrides, tuple(name for name in BODIES if name in differing), linear, inputs)
