"""Fields and step of a scene: a robot and the effects that are simulated, stepped on tensors.

Below everything that takes many steps or looks at them; `scene.Scene` adds that to it as methods.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import repeat
from typing import Any, Self, TypeVar, get_args

import torch
from torch import Tensor

from torchdq.backends.call import results_of
from torchdq.backends.choice import BackendName
from torchdq.backends.fast_call import quick
from torchdq.base.caches import PROGRAMS, Bounded
from torchdq.base.checks import require_choice, require_count, require_number, require_object, require_tensor
from torchdq.closures import ClosureErrors, closed, closure_errors, held_velocities
from torchdq.control.law import Law
from torchdq.effects.body import BodyEffect
from torchdq.effects.closures import Closures
from torchdq.effects.contact import Contact, Contacts
from torchdq.effects.effect import Effect
from torchdq.effects.joint import JointEffect
from torchdq.effects.sensor import Sensor
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.call import Precision, check_precision
from torchdq.numbers.ops import Count
from torchdq.objects import Object
from torchdq.program.program import Argument, Program
from torchdq.program.transforms import constant_in_graphs
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.robot import arguments, constants, recorded
from torchdq.scene.effect_checks import require_supported_base, resolved_effects, resolved_objects
from torchdq.scene.free_base import POSE, TWIST
from torchdq.scene.integrators import DormandPrince, Integrator, LinearlyImplicit
from torchdq.scene.recording import Stage
from torchdq.scene.spec import CONTROLLER, OBJECTS, POSES, ROBOT, SceneSpec, Task, supplied
from torchdq.scene.state import State, bent_balls, initial_motion, outside_limits, require_state
from torchdq.scene.substeps import flow

MOVED = 1e-4  # change of positions that closes loops, and is not warned of [rad or m]
MOST_OPERATIONS = 150_000  # of substeps up to which they are one program, which then compiles within 20 s
_lengths: Bounded[SceneSpec, int] = Bounded(PROGRAMS)  # operations of all substeps in one program
_interned: Bounded[SceneSpec, SceneSpec] = Bounded(PROGRAMS)  # equal scenes share their programs


@dataclass(frozen=True, eq=False)
class SceneModel:
    """Fields of a scene, its step, and its programs; see `Scene`."""

    robot: Robot
    effects: Sequence[Effect] = ()
    controller: Law | None = None
    integrator: Integrator = field(default_factory=LinearlyImplicit)
    dt: float = 0.01
    substeps: int = 1
    backend: BackendName | None = None
    precision: Precision = "auto"
    unroll: bool | None = None
    objects: Sequence[Object] = ()
    spec: SceneSpec = field(init=False, repr=False)
    noises: int = field(init=False, repr=False)  # random numbers that a step consumes
    computed: dict[str, int] = field(init=False, repr=False)  # rows that a scene computes before a step, with widths
    parameters: dict[str, Tensor] = field(init=False, repr=False)  # tensors of all parts, by "owner.name"

    def __post_init__(self) -> None:
        require_robot(self.robot)
        if self.controller is not None:
            require_object("controller", self.controller, Law, "torchdq.scene.controllers", "PD(kp=9.0, kd=1.0)")
        require_object("integrator", self.integrator, Integrator, "torchdq.scene.integrators", "RungeKutta4()")
        require_number("dt", self.dt, positive=True)
        require_count("substeps", self.substeps)
        check_precision(self.precision)
        require_choice("backend", self.backend, (None, *get_args(BackendName)))
        require_choice("unroll", self.unroll, (None, True, False))
        if self.substeps > 1 and isinstance(self.integrator, DormandPrince):
            raise ArgumentError(f"substeps must be 1 with DormandPrince, which chooses its own, found {self.substeps}")
        require_supported_base(self.robot, self.integrator)
        objects = resolved_objects(self.objects, self.robot, self.integrator)
        resolved = resolved_effects(self.effects, self.robot, self.integrator, objects)
        controller = None if self.controller is None else self.controller.resolved(self.robot)
        spec = SceneSpec(
            recorded(constants(self.robot)),
            tuple(name for name in arguments(self.robot) if name not in ("gravity", "armature")),
            tuple(effect.template() for effect in resolved),
            None if controller is None else controller.template(),
            self.integrator,
            float(self.dt),
            self.substeps,
            tuple(body.template() for body in objects),
        )
        object.__setattr__(self, "effects", resolved)
        object.__setattr__(self, "objects", objects)
        object.__setattr__(self, "controller", controller)
        object.__setattr__(self, "spec", _interned.setdefault(spec, spec))
        found = {f"{ROBOT}.{name}": getattr(self.robot, name) for name in spec.arguments}
        parts = () if controller is None else ((CONTROLLER, controller),)
        for owner, part in (*parts, *enumerate(resolved), *((OBJECTS - k, x) for k, x in enumerate(objects))):
            found.update({f"{owner}.{name}": x for name, x in part.tensors().items()})
        object.__setattr__(self, "noises", spec.noises)
        object.__setattr__(self, "computed", spec.computed())
        object.__setattr__(self, "parameters", found)

    # --- inputs and parameters ---

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.robot.n

    @property
    def inputs(self) -> dict[str, int]:
        """Names and widths of everything that may be given at a step."""
        return self.spec.inputs()

    @property
    def batches(self) -> dict[str, tuple[int, ...]]:
        """Batch axes of the tensors of robot, controller and effects by their names; () where samples share one."""
        stage, found = Stage(self.spec, "step"), self.parameters
        return {stage.label(name): tuple(x.shape[: x.ndim - len(stage.axes(name))]) for name, x in found.items()}

    def replace(self, **changes: Any) -> Self:
        """Scene with some fields replaced; tensors of equal shapes need no new program."""
        return replace(self, **changes)

    def to(self, device: torch.device | str) -> Self:
        """Scene whose parameters that are tensors are on a device; a step would copy them there every time."""
        if all(x.device == torch.device(device) for x in self.parameters.values()):
            return self
        robot = {f"{ROBOT}.{name}": getattr(self.robot, name) for name in arguments(self.robot)}
        return self.with_parameters({name: x.to(device) for name, x in (robot | self.parameters).items()})

    def with_parameters(self, values: Mapping[str, Tensor]) -> Self:
        """Scene with tensors instead of parameters of its own, by "owner.name" as in `parameters`."""
        parts: dict[int, dict[str, Any]] = {}
        for key, x in values.items():
            owner, _, name = key.partition(".")
            parts.setdefault(int(owner), {})[name] = x
        robot, controller = self.robot, self.controller
        if ROBOT in parts:
            robot = robot.replace(**parts[ROBOT])
        if controller is not None:
            controller = replace(controller, **parts.get(CONTROLLER, {}))
        effects = [replace(effect, **parts.get(i, {})) for i, effect in enumerate(self.effects)]
        objects = [replace(body, **parts.get(OBJECTS - k, {})) for k, body in enumerate(self.objects)]
        return self.replace(robot=robot, controller=controller, effects=effects, objects=objects)

    # --- time ---

    def start(
        self,
        q: Tensor,
        qd: Tensor | None = None,
        noise: Tensor | None = None,
        X_WB: Tensor | None = None,
        V_WB_B: Tensor | None = None,
        X_WO: Tensor | None = None,
        V_WO: Tensor | None = None,
    ) -> State:
        """Initial state, effects at rest, sensors read once; positions far outside `effects.JointLimits` are warned of.

        Loops of a robot with closures are closed by `torchdq.closed`, with a warning where that moves joints;
        velocities are the nearest that keep them closed. Elastic ones start as they are.

        Start again after `backward` if parameters of sensors are learned: the reading depends on them.

        Args:
            q: positions [rad or m], shape [..., n].
            qd: velocities [rad/s or m/s], shape [..., n]; None: at rest.
            noise: random numbers for the sensors, as in `step`.
            X_WB: pose of a floating base in the world, shape [..., 8]; None: at the origin.
            V_WB_B: twist (angular, linear) of a floating base in its axes [rad/s, m/s], shape [..., 6]; None: at rest.
            X_WO: poses of the objects in the world, or in the base frame of a fixed robot, shape [..., objects, 8];
                None: at the origin.
            V_WO: their twists (angular, linear) in their axes [rad/s, m/s], shape [..., objects, 6]; None: at rest.
        """
        given = {"q": q, "qd": qd, "X_WB": X_WB, "V_WB_B": V_WB_B}
        given |= {"poses": self._of_objects("X_WO", X_WO, POSE), "twists": self._of_objects("V_WO", V_WO, TWIST)}
        moved = initial_motion(self.spec, given)
        if self.robot.closures and not self.spec.of(Closures):
            q = self._closed(moved["q"])
            moved = {**moved, "q": q, "qd": held_velocities(self.robot, q, moved["qd"])}
        for message in (outside_limits(moved["q"], self.effects, self.robot), bent_balls(moved["q"], self.robot)):
            if message:
                warnings.warn(message, stacklevel=2)
        return self._begin(moved, {}, noise)[0]

    def _closed(self, q: Tensor) -> Tensor:
        """Positions at which loops are closed; a warning says how far they are from others."""
        found = closed(self.robot, q, backend=self.backend)
        far = (found - q).detach().abs().flatten(0, -2) if q.ndim > 1 else (found - q).detach().abs()[None]
        if far.numel() and float(far.amax()) > MOVED:
            joint = self.robot.joint_names[int(far.amax(0).argmax())]
            warnings.warn(
                f"q was moved by up to {float(far.amax()):.3g} rad or m, at joint {joint!r}, to where the loops of "
                f"robot {self.robot.name!r} are closed; torchdq.closed(robot, q, hold=...) says which joints stay",
                stacklevel=3,
            )
        return found

    def _of_objects(self, name: str, x: Tensor | None, width: int) -> Tensor | None:
        """Row of the objects, of a tensor with an axis of objects."""
        if x is None:
            return None
        require_tensor(name, x)
        if x.shape[-2:] != (len(self.objects), width):
            names = ", ".join(body.name for body in self.objects) or "none"
            expected = f"[..., {len(self.objects)}, {width}]"
            raise ArgumentError(f"{name} must be {expected}, of the objects {names}; found {tuple(x.shape)}")
        return x.flatten(-2)

    def _begin(
        self,
        moved: Mapping[str, Tensor],
        inputs: Mapping[str, Tensor],
        noise: Tensor | None = None,
        task: Task | None = None,
    ) -> tuple[State, dict[str, Tensor]]:
        """Initial state, and rows that a task computes from it.

        Args:
            moved: positions and velocities, by their names in a state.
            inputs, noise, task: as in `_advance`.
        """
        if task is None and not self.spec.senses and not self.spec.remembers:
            return State(**moved), {}
        given = {**moved, **inputs, **self._grounds(State(**moved))}
        state, rows = _split(self._evaluate("begin", self._with_noise(given, noise), task))
        return state._replace(**moved), rows

    def step(self, state: State, torque: Tensor | None = None, noise: Tensor | None = None, **inputs: Tensor) -> State:
        """State after `dt`.

        Args:
            state: from `start` or an earlier step.
            torque: commanded torques [N m or N], shape [..., n], constant over the step; they add to the controller's.
                None: none.
            noise: uniform random numbers in (0, 1), shape [..., `noises`]; None: drawn from torch's generator if the
                sensors need them.
            inputs: inputs of controller and effects, by name; see `inputs`.
        """
        return self._advance(state, {"torque": torque, **inputs}, noise)[0]

    def _advance(
        self,
        state: State,
        inputs: Mapping[str, Tensor | None],
        noise: Tensor | None = None,
        task: Task | None = None,
    ) -> tuple[State, dict[str, Tensor]]:
        """State after `dt`, and rows that a task computes from it in the same program."""
        key: Any = None
        if self.backend is None and self.precision == "auto" and not (self.noises or self.computed or self.looped):
            constants(self.robot)  # raises if they were changed in place
            tensors = (*state, *inputs.values(), *self.parameters.values())
            key, names, found = quick((self.spec, task, *inputs), tensors)
            if found is not None:
                return _split(dict(zip(names, found, strict=True)))
        require_state(state)
        if torch.compiler.is_compiling() or not inputs.keys() <= supplied(self.spec, task):
            self.spec.require_inputs(inputs, task)
        if not self.looped:
            given = {**state._asdict(), **inputs, **self._outside(state)}
            return _split(self._evaluate("step", self._with_noise(given, noise), task, key=key))
        present, dtype = {name: x for name, x in inputs.items() if x is not None}, state.q.dtype
        if self.precision == "double" and dtype == torch.float32:
            # the integrator's own arithmetic is double as well
            present, state = {name: x.double() for name, x in present.items()}, state.to(torch.float64)
            noise = None if noise is None else noise.double()
        rows, outside = self._evaluate("drive", {**state.rows(), **present}, task), self._outside(state)
        x, v = rows.pop("x"), rows.pop("v")
        acting = {name: present[name] for e in self.effects for name in e.inputs(self.n) if name in present}
        held = acting | outside | {name: rows[name] for name in ("u", *POSES) if name in rows} | self.parameters
        x, v = flow(self.spec, x, v, held, self.backend)
        given = {"x": x, "v": v, **rows, **present, **{name: outside[name] for name in self.computed}}
        sensed = self._evaluate("sense", self._with_noise(given, noise), task)
        return _split({name: x.to(dtype) for name, x in sensed.items()})

    @property
    def looped(self) -> bool:
        """Whether a step is a loop over a program of its substeps, and no program of its own."""
        if self.substeps == 1:
            return isinstance(self.integrator, DormandPrince)
        return not self.unroll if self.unroll is not None else _length(self) > MOST_OPERATIONS

    def _outside(self, state: State) -> dict[str, Tensor]:
        """Rows that torch computes outside the program, from the state at the start of a step, by name."""
        of = self.spec.of(JointEffect) if self.computed else ()
        learning: dict[str, Any] = {name: self.effects[i] for i, effect in of for name in effect.computed(self.n)}
        return self._grounds(state) | {name: effect.torques(state.q, state.qd) for name, effect in learning.items()}

    def _grounds(self, state: State) -> dict[str, Tensor]:
        """Rows that effects on bodies look up below their points in a state, by name."""
        if not self.computed:
            return {}
        of = self.spec.of(BodyEffect)
        looking: dict[str, Any] = {name: self.effects[i] for i, effect in of for name in effect.computed(self.n)}
        moving = {name: x for name, x in state.rows().items() if name in self.spec.moving}
        places = self._evaluate("places", moving) if looking else {}
        return {name: looking[name].looked_up(x) for name, x in places.items()}

    def energy(self, state: State) -> Tensor:
        """Kinetic and potential energy [J] of the rigid bodies, without springs and their rotors, shape [..., 2]."""
        require_state(state)
        return self._evaluate("energy", {name: x for name, x in state.rows().items() if name in self.spec.moving})["E"]

    def closure_errors(self, state: State) -> ClosureErrors:
        """Errors of the robot's closures in a state, distances [m] and angles [rad], shape [..., closures]."""
        require_state(state)
        return closure_errors(self.robot, state.q, self.backend)

    @property
    def touching(self) -> list[tuple[str, str]]:
        """Frame or object of the point, and object or "ground" that it touches, of every contact in their order."""
        return self.spec.touching

    def contacts(self, state: State, name: str | None = None) -> Contacts:
        """Contact of every point; with stiction the forces are those of the last step, as the state remembers.

        They are in the order of `touching`. A force acts on the first of its pair, and the opposite one on the second.

        Args:
            state: from `start`, `step` or `rollout`, shape [...].
            name: of a frame or an object: the contacts that it takes part in; None: all.

        >>> import torch, torchdq
        >>> from torchdq import Scene, effects
        >>> scene = Scene(torchdq.robots.load("panda"), (effects.Contact(height=0.5),), dt=0.005)
        >>> scene.contacts(scene.start(torch.zeros(4, 7))).force.shape
        torch.Size([4, 1, 3])
        """
        require_state(state)
        if not self.spec.of(Contact):
            raise ArgumentError(
                f"contacts need an effects.Contact in the scene of robot {self.robot.name!r}, found none"
            )
        rows = self._evaluate("contacts", {**state.rows(), **self._grounds(state)})
        force = rows.pop("force").unflatten(-1, (-1, 3))
        found = Contacts(force, touching=rows.pop("touching") != 0, **rows)
        if name is None:
            return found
        known = sorted({one for pair in self.touching for one in pair})
        if name not in known:
            raise UnknownNameError("frame or object with contacts", name, known)
        chosen = [k for k, pair in enumerate(self.touching) if name in pair]
        return Contacts(found.force[..., chosen, :], *(x[..., chosen] for x in found[1:]))

    def grasped(self, state: State, name: str, least: float = 0.5) -> Tensor:
        """True where two or more parts of the robot press on an object, each by a normal force of `least` [N], [...].

        Args:
            state: from `start`, `step` or `rollout`, shape [...].
            name: of the object.
            least: normal force [N].
        """
        if name not in self.spec.links:
            raise UnknownNameError("object of the scene", name, self.spec.links)
        known = [frame for frame, on in self.touching if on == name and frame not in self.spec.links]
        if not known:
            raise ArgumentError(f"the robot must touch {name!r} to grasp it; add effects.Contact(points, on={name!r})")
        found = self.contacts(state)
        parts = [[k for k, pair in enumerate(self.touching) if pair == (frame, name)] for frame in dict.fromkeys(known)]
        pressing = torch.stack([found.normal_force[..., own].sum(-1) >= least for own in parts], -1)
        return pressing.sum(-1) >= 2

    # --- programs ---

    def program(self, *present: str, task: Task | None = None, wrt: tuple[str, ...] | None = None) -> Program:
        """Program of a step at which the inputs of those names are given, by default all; `wrt` as in `Stage`."""
        if self.looped:
            steps = "DormandPrince" if self.substeps == 1 else f"{self.substeps} substeps"
            raise ArgumentError(f"a step of {steps} is a loop, not one program, and has no count of operations")
        return self._recorded(self.spec, present, task, wrt)

    def _recorded(
        self,
        spec: SceneSpec,
        present: tuple[str, ...] = (),
        task: Task | None = None,
        wrt: tuple[str, ...] | None = None,
    ) -> Program:
        stage = Stage(spec, "step", task, wrt)
        wanted = [*self.spec.state, *(present or self.inputs), *self.computed, *["noise"] * bool(self.noises)]
        taken = [Argument(name, math.prod(stage.axes(name))) for name in wanted]
        if self.controller is not None and "reference" not in wanted:
            raise ArgumentError("reference must be among the inputs of a scene with a controller")
        for name, x in self.parameters.items():
            axes = stage.axes(name)
            taken.append(Argument(name, math.prod(axes), x.ndim == len(axes)))
        return stage.program(tuple(taken))

    def count(self) -> Count:
        """Operations of a step."""
        return self.program().count()

    def _evaluate(
        self,
        stage: str,
        given: Mapping[str, Tensor | None],
        task: Task | None = None,
        key: Hashable = None,
    ) -> dict[str, Tensor]:
        """Rows of a stage's program, with the batch axes of everything that goes in; the state's inputs come first."""
        constants(self.robot)  # raises if they were changed in place
        tensors = {**given, **(self._at_rest if stage == "begin" and task is None else self.parameters)}
        what, double = Stage(self.spec, stage, task), self.precision == "double"
        return dict(zip(*results_of(what, tensors, self.backend, double, key=key), strict=True))

    @property
    def _at_rest(self) -> dict[str, Tensor]:
        """Parameters, detached where no start depends on them, so that rollouts from one start share no graph."""
        own = {i for i, x in enumerate(self.effects) if type(x).start != Effect.start}
        own |= {i for i, _ in self.spec.of(Sensor)}
        return {name: x if int(name.partition(".")[0]) in own else x.detach() for name, x in self.parameters.items()}

    def _with_noise(self, given: dict[str, Any], noise: Tensor | None) -> dict[str, Any]:
        """Inputs with the random numbers that the sensors need."""
        if not self.noises:
            return given
        return {**given, "noise": self._random(next(iter(given.values()))) if noise is None else noise}

    def _random(self, like: Tensor, *steps: int) -> Tensor:
        """Random numbers that the sensors need for states like the rows of a tensor, [*steps, ..., noises]."""
        # 1 - [0, 1) lies in (0, 1], and the logarithm of 0 is infinite
        return 1 - torch.rand(*steps, *like.shape[:-1], self.noises, dtype=like.dtype, device=like.device)


@constant_in_graphs
def _length(scene: SceneModel) -> int:
    """Operations of the substeps in one program."""
    if scene.spec not in _lengths:
        _lengths[scene.spec] = scene._recorded(replace(scene.spec, substeps=1)).count().total * scene.substeps
    return _lengths[scene.spec]


AnyScene = TypeVar("AnyScene", bound=SceneModel)


def _split(rows: dict[str, Tensor]) -> tuple[State, dict[str, Tensor]]:
    """State and the task's rows, of the rows of a program."""
    return State._make(map(rows.pop, State._fields, repeat(None))), rows
