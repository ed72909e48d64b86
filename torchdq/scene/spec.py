"""Specification of a scene, which its programs depend on, and the scene while it is recorded."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol, TypeVar

from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.base.caches import PROGRAMS, remembered
from torchdq.control.law import Law
from torchdq.dynamics.free_bodies import WithFreeBodies
from torchdq.dynamics.posed import Point, Posed, Row
from torchdq.effects.body import Bodies, BodyEffect
from torchdq.effects.contact import Contact, Contacts
from torchdq.effects.effect import Effect
from torchdq.effects.joint import JointEffect
from torchdq.effects.model import ModelEffect
from torchdq.effects.sensor import Sensor
from torchdq.effects.transmission import Transmission
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import Shapes
from torchdq.functions.posed import Overrides, frame, posed
from torchdq.functions.posed import field as tensor
from torchdq.objects import Object
from torchdq.robot import Robot
from torchdq.robot.fields import BODIES, SHAPES
from torchdq.scene import free_base
from torchdq.scene.effect_checks import changes
from torchdq.scene.free_base import POSE, START, TWIST
from torchdq.scene.integrators import Integrator

Rows = dict[str, Row]
Memory = dict[int, Row]  # remembered values of each effect, by its position
E = TypeVar("E", bound=Effect)

ORDER = ("poses", "X_WB", "q", "twists", "V_WB_B", "qd", "memory", "reading")  # of the rows of a state, linearized
GROUND = "ground"  # what contacts without an object touch
LABELS = {"poses": "X_WO", "twists": "V_WO"}  # arguments that rows of a state are
POSES = ("poses", "X_WB")  # which are displaced by twists
# owners of tensors; an effect owns its tensors by its position, and the objects begin with -4, downwards
OBJECTS, POLICY, ROBOT, CONTROLLER = -4, -3, -2, -1


class Task(Protocol):
    """Rows that an environment adds to a step, computed from the state at its end."""

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of its inputs, without the state."""

    def rows(self, view: View) -> Rows:
        """Rows of numbers, by name."""


class Formula(Protocol):
    """Torques of a policy, computed from the state before a step; hashable, since programs depend on it."""

    @property
    def control(self) -> str:
        """Input that they are: "torque", or "target" of a servo."""

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
    objects: tuple[Object, ...] = ()
    _hash: int = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        # once, since every step asks for it; the parameters of the effects would take most of the time
        kinds = map(type, (*self.effects, *self.objects))
        object.__setattr__(self, "_hash", hash((self.robot, self.arguments, self.dt, self.substeps, *kinds)))

    def __hash__(self) -> int:
        return self._hash

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
        return {name: state[name] * TWIST // POSE if name in POSES else state[name] for name in ORDER if name in state}

    @property
    def moving(self) -> dict[str, int]:
        """Names and widths of the positions and velocities of a state."""
        base = {"X_WB": POSE, "V_WB_B": TWIST} if self.robot.floating else {}
        k = len(self.objects)
        return {
            "q": self.robot.n,
            "qd": self.robot.n,
            **base,
            **({"poses": POSE * k, "twists": TWIST * k} if k else {}),
        }

    @property
    def free(self) -> int:
        """Number of free bodies: the objects, and the base if it is floating."""
        return len(self.objects) + self.robot.floating

    @property
    def links(self) -> dict[str, int]:
        """Links of the objects by their names: those after the robot's own."""
        return {body.name: i for i, body in enumerate(self.objects, len(self.robot.link_names) + 1)}

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
    def touching(self) -> list[tuple[str, str]]:
        """Frame or object of the point, and object or "ground" that it touches, of every contact."""
        return [(point.frame, on or GROUND) for _, effect in self.of(Contact) for point, on in effect.touching]

    @property
    def inner(self) -> int:
        """Number of values that those effects remember."""
        return sum(effect.memory(self.robot.n) for _, effect in self.integrated)

    def shapes(self, owner: int) -> Shapes:
        """Trailing axes of the parameters of the robot, the controller, or the effect at a position."""
        if owner == ROBOT:
            return SHAPES
        part: Any = (
            self.objects[OBJECTS - owner]
            if owner <= OBJECTS
            else self.effects[owner]
            if owner >= 0
            else self.controller
        )
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

    def posed(self, q: Row, X_WB: DualQuaternion | None = None, poses: Sequence[DualQuaternion] = ()) -> Posed:
        """Robot at joint positions, if its base is free at the pose of it, and objects, with the scene's changes."""
        spec, robot = self.spec, posed(self.spec.robot, q, self.overrides, self.per_sample, X_WB)
        if not poses:
            return robot
        free = [body.posed(X_WO) for body, X_WO in zip(spec.objects, poses, strict=True)]
        pairs = [pair for _, effect in spec.of(BodyEffect) for pair in effect.pairs(spec.robot, spec.links)]
        gravity = tensor(spec.robot, "gravity", self.overrides)
        found: Any = WithFreeBodies.at(robot, free, len(spec.robot.link_names) + 1, gravity, [*dict.fromkeys(pairs)])
        return found

    def bodies(self, at: Posed) -> Bodies:
        """Links of the robot and objects, at rest."""
        links = self.spec.links
        return Bodies(self.spec.robot, at, objects={body.name: (links[body.name], body) for body in self.spec.objects})

    def packed(self, q: Row, qd: Row, memory: Memory) -> tuple[Row, Row]:
        """Positions and velocities of the joints and then of the rotors behind them."""
        at, transmission = self.spec.transmission
        return transmission.extended(q, qd, () if at is None else memory[at])

    def with_inner(self, v: Row, memory: Memory) -> Row:
        """Velocities, and then what effects at the joints and on bodies remember."""
        return (*v, *[value for i, _ in self.spec.integrated for value in memory[i]])

    @property
    def _coms(self) -> list[Pure]:
        """Centres of mass of the free bodies in their frames: of the objects, and of a floating base."""
        base = [tensor(self.spec.robot, "base_com", self.overrides)] if self.spec.robot.floating else []
        return [*[quat.ZERO] * len(self.spec.objects), *base]

    def free_of(self, x: Row, v: Row) -> list[tuple[Row, Row, Pure]]:
        """Displacement, velocities and centre of mass of every free body, which are the last of x and of v."""
        k = self.spec.free
        X, V = _parts(x[len(x) - POSE * k :], POSE), _parts(v[len(v) - TWIST * k :], TWIST)
        return [*zip(X, V, self._coms, strict=True)]

    def with_free(self, x: Row, v: Row) -> tuple[Row, Row]:
        """Integrated positions x and velocities v: `packed` ones, then those of free bodies; see `free_base`."""
        V = _parts((*self.inputs.get("twists", ()), *self.inputs.get("V_WB_B", ())), TWIST)
        centres = [y for V_B, c in zip(V, self._coms, strict=True) for y in free_base.at_centre(START, V_B, c)]
        return (*x, *START * self.spec.free), (*v, *centres)

    def poses_of(self, x: Row) -> tuple[DualQuaternion | None, list[DualQuaternion]]:
        """Pose X_WB of a floating base, None if it is fixed, and poses of the objects, of integrated positions."""
        start = _parts((*self.inputs.get("poses", ()), *self.inputs.get("X_WB", ())), POSE)
        X = _parts(x[len(x) - POSE * self.spec.free :], POSE)
        found = [free_base.placed(*at) for at in zip(start, X, self._coms, strict=True)]
        return (found.pop() if self.spec.robot.floating else None), found

    def unpacked(self, x: Row, v: Row, memory: Memory) -> tuple[Rows, Memory]:
        """State of integrated positions x and velocities v, and the memory."""
        (at, _), n = self.spec.transmission, self.spec.robot.n
        rows: Rows = {"q": x[:n], "qd": v[:n]}
        X_WB, poses = self.poses_of(x)
        twists = [free_base.twist(*of) for of in self.free_of(x, v)]
        if X_WB is not None:
            rows |= {"X_WB": free_base.unit(X_WB), "V_WB_B": twists.pop()}
        if poses:
            rows |= {"poses": [y for X in poses for y in free_base.unit(X)], "twists": [y for V in twists for y in V]}
        k = self.spec.free
        x, v = x[: len(x) - POSE * k], v[: len(v) - TWIST * k]
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
    poses: Row = ()  # [8 objects]
    twists: Row = ()  # [6 objects]

    def posed(self, q: Row) -> Posed:
        """Robot at joint positions, in the world if its base is floating."""
        return self.scene.posed(q, free_base.as_pose(self.X_WB) if self.X_WB else None)

    def frame(self, name: str) -> Point:
        """Origin and three axes of a frame in the base frame, or in the world if the base is floating."""
        at, (link, X_BF) = self.posed(self.q), frame(self.scene.spec.robot, name)
        found = at.point(link, X_BF)
        return Point(at.position(link, found.position), tuple([at.to_world(link, e) for e in found.axes]))

    def velocity(self, name: str) -> Pure:
        """Velocity of the origin of a frame in the base frame, or in the world if the base is floating [m/s]."""
        at, (link, X_BF) = self.posed(self.q), frame(self.scene.spec.robot, name)
        bodies = Bodies(self.scene.spec.robot, at).moving([*self.V_WB_B, *self.qd])
        return at.to_world(link, bodies.velocity(link, at.point(link, X_BF).position))

    @property
    def bodies(self) -> Bodies:
        """Links of the robot and objects, at rest."""
        poses = [free_base.as_pose(X) for X in _parts(self.poses, POSE)]
        return self.scene.bodies(self.scene.posed(self.q, free_base.as_pose(self.X_WB) if self.X_WB else None, poses))

    @property
    def contacts(self) -> list[Contacts]:
        """Contact of every point of the scene."""
        spec, bodies = self.scene.spec, self.bodies.moving([*self.twists, *self.V_WB_B, *self.qd])
        found = [effect.readings(bodies, self.scene.inputs, self.memory[i]) for i, effect in spec.of(Contact)]
        return [point for points in found for point in points]

    def pressing(self, name: str) -> dict[str, Number]:
        """Sums of the normal forces on an object, by the frames and objects that touch it [N]."""
        found: dict[str, Number] = {}
        for (by, on), contact in zip(self.scene.spec.touching, self.contacts, strict=True):
            if on == name:
                found[by] = found.get(by, 0.0) + contact.normal_force
        return found


def _parts(row: Row, size: int) -> list[Row]:
    """Parts of a row, each of that many numbers."""
    return [row[k : k + size] for k in range(0, len(row), size)]


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

    objects = tuple(bound(OBJECTS - k, body) for k, body in enumerate(spec.objects))
    spec = replace(
        spec,
        effects=tuple(bound(i, effect).of_objects(objects) for i, effect in enumerate(spec.effects)),
        controller=None if spec.controller is None else bound(CONTROLLER, spec.controller),
        objects=objects,
    )
    for i, effect in sorted(spec.of(ModelEffect), key=lambda found: found[1].LATE):
        changed = changes(effect, effect.changed(spec.robot, overrides), spec.robot)
        overrides.update(changed)
        if any(owner == i for owner, _ in per_sample):
            differing.update(changed)
    return RecordedScene(spec, overrides, tuple(name for name in BODIES if name in differing), linear, inputs)
