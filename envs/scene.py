"""Scenes: a robot and the effects that are simulated, stepped on tensors.

A scene assumes nothing: a bare one has no gravity, no friction and no limits. Every effect is named, belongs to one
slot, and costs what it adds to the one program that a step is recorded into.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint as checkpointed

from torchdq.backends.backend import Backend
from torchdq.backends.choice import BackendName, choose, present
from torchdq.backends.precision import Guarded
from torchdq.backends.run import run
from torchdq.backends.torch import EAGER
from torchdq.caches import Bounded
from torchdq.effects import Effect, Gravity, RotorInertia
from torchdq.effects.joint import Elastic
from torchdq.envs import recording as plans
from torchdq.envs.controllers import Controller
from torchdq.envs.integrators import Integrator, Row, SemiImplicitEuler, Unrecorded
from torchdq.envs.leftout import left_out
from torchdq.envs.recording import CONTROLLER, MOTION, ROBOT, Blueprint, Signature, Task
from torchdq.envs.timing import medians
from torchdq.errors import ArgumentError, DtypeError
from torchdq.functional import Precision, check_precision
from torchdq.program.autograd import named, operator
from torchdq.program.program import Count, Program
from torchdq.robot import Robot
from torchdq.robot.robot import DTYPES, SHAPES, arguments, constants, recorded


class State(NamedTuple):
    """State of a scene: what has to be known to go on."""

    q: Tensor  # [..., n] positions [rad or m]
    qd: Tensor  # [..., n] velocities [rad/s or m/s]
    memory: Tensor | None = None  # [..., m] what the effects remember; None: nothing
    reading: Tensor | None = None  # [..., 2 n] measured positions and velocities; None: there are no sensors

    @property
    def measured(self) -> tuple[Tensor, Tensor]:
        """Positions and velocities as the sensors read them."""
        if self.reading is None:
            return self.q, self.qd
        n = self.q.shape[-1]
        return self.reading[..., :n], self.reading[..., n:]


class Cost(NamedTuple):
    """What an effect adds to a step."""

    effect: str
    slot: str
    operations: int
    nanoseconds: float


class Description(NamedTuple):
    """What a scene simulates, what each part costs, and what it leaves out; `print` it."""

    costs: tuple[Cost, ...]  # the bare step first, then every effect in its order
    total: Cost
    left_out: tuple[str, ...]
    measured_on: str

    def __str__(self) -> str:
        rows = [("effect", "slot", "operations", "ns per step")]
        rows += [(c.effect, c.slot, f"{c.operations}", f"{c.nanoseconds:.1f}") for c in (*self.costs, self.total)]
        widths = [max(len(row[k]) for row in rows) for k in range(4)]
        lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        asked = "\n".join(f"- {what}" for what in self.left_out) or "- nothing"
        return "\n".join(lines) + f"\n({self.measured_on})\n\nasked for by the description, and left out:\n{asked}"


@dataclass(frozen=True, eq=False)
class Scene:
    """A robot, the effects that are simulated, and how time passes.

        state = scene.start(q)
        state = scene.step(state, torque)

    A step is one program: controller, actuators, forces, forward dynamics, integrator and sensors. It is differentiable
    in the state, the inputs, and every parameter that is a tensor.

    Args:
        robot: its gravity and rotor inertia only act if `effects.Gravity()` and `effects.RotorInertia()` are there.
        effects: what is simulated; see `torchdq.effects`. Actuators and sensors act in their order.
        controller: turns the input `reference` into torques; None: there are only the torques that are given.
        integrator: see `torchdq.envs.integrators`.
        dt: duration of a step [s]; torques are constant over it.
        substeps: of the integrator within a step.
        backend: as in `torchdq.functional`.
        precision: "auto": in the dtype of the state; a sample whose mass matrix would cost float32 half of its digits
            takes that step in float64, one whose mass matrix is singular becomes NaN. "double": a float32 state, and
            everything computed in float64.

    >>> import torch, torchdq
    >>> from torchdq.envs import Scene, effects
    >>> scene = Scene(torchdq.robots.load("two_link"), (effects.Gravity(), effects.Viscous(0.1)), dt=0.01)
    >>> state = scene.start(torch.zeros(3, 2))
    >>> scene.step(state, torque=torch.zeros(2)).q.shape
    torch.Size([3, 2])
    """

    robot: Robot
    effects: Sequence[Effect] = ()
    controller: Controller | None = None
    integrator: Integrator = field(default_factory=SemiImplicitEuler)
    dt: float = 0.01
    substeps: int = 1
    backend: BackendName | None = None
    precision: Precision = "auto"
    blueprint: Blueprint = field(init=False, repr=False)

    def __post_init__(self) -> None:
        if not isinstance(self.robot, Robot):
            raise ArgumentError(f"robot must be a torchdq.Robot, found {type(self.robot).__name__}")
        if not isinstance(self.effects, Sequence):
            raise ArgumentError(f"effects must be a sequence of effects, found {self.effects!r}")
        for effect in self.effects:
            if not isinstance(effect, Effect):
                raise ArgumentError(
                    f"effects must be objects of torchdq.effects, found {effect!r}"
                    + ("; it is a class, call it" if isinstance(effect, type) else "")
                )
        if not (self.controller is None or isinstance(self.controller, Controller)):
            raise ArgumentError(f"controller must be one of torchdq.envs.controllers, found {self.controller!r}")
        if not isinstance(self.integrator, Integrator):
            raise ArgumentError(f"integrator must be one of torchdq.envs.integrators, found {self.integrator!r}")
        if not (isinstance(self.dt, int | float) and 0 < self.dt < math.inf):
            raise ArgumentError(f"dt must be a positive number of seconds, found {self.dt!r}")
        if not isinstance(self.substeps, int) or self.substeps < 1:
            raise ArgumentError(f"substeps must be a whole number from 1, found {self.substeps!r}")
        check_precision(self.precision)
        if self.substeps > 1 and isinstance(self.integrator, Unrecorded):
            raise ArgumentError(
                f"substeps are those of a recorded integrator, found {self.substeps} with {self.integrator!r}; "
                f"give them to Repeated, DormandPrince chooses its own"
            )
        if sum(isinstance(effect, Elastic) for effect in self.effects) > 1:
            raise ArgumentError("effects must not hold Elastic twice: a joint has one spring to its rotor")
        for effect in self.effects:
            if effect.SLOT not in SLOTS:
                raise ArgumentError(f"{type(effect).__name__}.SLOT must be one of {SLOTS}, found {effect.SLOT!r}")
        if sum(isinstance(effect, Gravity) for effect in self.effects) > 1:
            raise ArgumentError("effects must not hold Gravity twice: there is one acceleration")
        described = [type(effect) for effect in self.effects if getattr(effect, "inertia", ()) is None]
        if Elastic in described and RotorInertia in described:
            raise ArgumentError(
                "Elastic and RotorInertia would both take the rotor inertia of the description; behind a spring it "
                "does not turn with the link, so leave RotorInertia out"
            )
        resolved = tuple(effect.resolved(self.robot) for effect in self.effects)
        names = Counter(name for effect in resolved for name in effect.inputs(self.robot.n))
        for name, number in names.items():
            if number > 1:
                raise ArgumentError(f"the input {name!r} belongs to {number} effects; give them names of their own")
        controller = None if self.controller is None else self.controller.resolved(self.robot)
        object.__setattr__(self, "effects", resolved)
        object.__setattr__(self, "controller", controller)
        plan = Blueprint(
            recorded(constants(self.robot)),
            tuple(name for name in arguments(self.robot) if name not in ("gravity", "armature")),
            tuple(effect.blueprint() for effect in resolved),
            None if controller is None else controller.blueprint(),
            self.integrator,
            float(self.dt),
            self.substeps,
        )
        object.__setattr__(self, "blueprint", _interned.setdefault(plan, plan))

    # --- what it is ---

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.robot.n

    @property
    def inputs(self) -> dict[str, int]:
        """Names and widths of everything that may be given at a step."""
        found = {"torque": self.n}
        if self.controller is not None:
            found["reference"] = 3 * self.n
        for effect in self.effects:
            found.update(effect.inputs(self.n))
        return found

    @property
    def batches(self) -> dict[str, tuple[int, ...]]:
        """Batch axes of the tensors of robot, controller and effects by their names; () where samples share one."""
        return {name: tuple(x.shape[: x.ndim - axes]) for _, name, x, _, axes in self._tensors()}

    @property
    def noises(self) -> int:
        """How many random numbers a step consumes."""
        return sum(effect.noises(self.n) for effect in self.effects)

    def replace(self, **changes: Any) -> Scene:
        """Scene with some fields replaced; tensors of equal shapes need no new program."""
        return replace(self, **changes)

    # --- time ---

    def start(self, q: Tensor, qd: Tensor | None = None, noise: Tensor | None = None) -> State:
        """State at the beginning, effects at rest, sensors read once.

        Args:
            q: positions [rad or m], shape [..., n].
            qd: velocities [rad/s or m/s], shape [..., n]; None: at rest.
            noise: random numbers for the sensors, as in `step`.
        """
        given = {"q": q} if qd is None else {"q": q, "qd": qd}
        self._check("start", given, q, None)
        try:
            q, qd = torch.broadcast_tensors(q, torch.zeros_like(q) if qd is None else qd)
        except RuntimeError as error:
            found = ", ".join(f"{name} {tuple(x.shape)}" for name, x in given.items())
            raise ArgumentError(f"the batch axes of the state must broadcast, found {found}") from error
        return self.begin(q, qd, {}, noise)[0]

    def begin(
        self, q: Tensor, qd: Tensor, inputs: Mapping[str, Tensor], noise: Tensor | None = None, task: Task | None = None
    ) -> tuple[State, dict[str, Tensor]]:
        """State at the beginning, and rows that a task computes from it."""
        return self._sensed("begin", State(q, qd, self._memory(q, qd)), inputs, noise, task)

    def step(self, state: State, torque: Tensor | None = None, noise: Tensor | None = None, **inputs: Tensor) -> State:
        """State after `dt`.

        Args:
            state: from `start` or an earlier step.
            torque: commanded torques [N m or N], shape [..., n], constant over the step; they add to the controller's.
                None: none.
            noise: uniform random numbers in (0, 1), shape [..., `noises`]; None: drawn from torch's generator if the
                sensors need them.
            inputs: what controller and effects ask for, by name; see `inputs`.
        """
        return self.advance(state, {"torque": torque, **inputs}, noise)[0]

    def advance(
        self,
        state: State,
        inputs: Mapping[str, Tensor | None],
        noise: Tensor | None = None,
        task: Task | None = None,
    ) -> tuple[State, dict[str, Tensor]]:
        """State after `dt`, and rows that a task computes from it in the same program."""
        present = {name: x for name, x in inputs.items() if x is not None}
        if isinstance(self.integrator, Unrecorded):
            narrow = state.q.dtype
            if self.precision != "double" or narrow != torch.float32:
                return self._unrecorded(self.integrator, state, present, noise, task)
            # its own arithmetic is double as well
            wide = State._make(None if x is None else x.double() for x in state)
            given = {name: x.double() for name, x in present.items()}
            noise = None if noise is None else noise.double()
            state, rows = self._unrecorded(self.integrator, wide, given, noise, task)
            rounded = State._make(None if x is None else x.to(narrow) for x in state)
            return rounded, {name: x.to(narrow) for name, x in rows.items()}
        rows = self._call("step", self._given(state, present, noise), task)
        return State(rows.pop("q"), rows.pop("qd"), rows.pop("memory", None), rows.pop("reading", None)), rows

    def rollout(
        self,
        state: State,
        torque: Tensor | None = None,
        steps: int | None = None,
        checkpoint: int = 0,
        **inputs: Tensor,
    ) -> State:
        """States after each of a number of steps, shape [steps, ...].

        Args:
            state: at the beginning; it is not part of the result.
            torque: [steps, ..., n]; None: none, for `steps` steps.
            steps: how many; None: as many as there are torques.
            checkpoint: for the gradient, only every so many states are kept and those between are computed again;
                0 keeps the inputs of every step.
            inputs: as in `step`, shape [steps, ...].
        """
        series = {name: x for name, x in (("torque", torque), *inputs.items()) if x is not None}
        lengths = {name: len(x) for name, x in series.items()}
        total = steps if steps is not None else next(iter(lengths.values()), None)
        if total is None or any(length != total for length in lengths.values()):
            raise ArgumentError(f"steps and the first axes of the inputs must agree, found {steps} and {lengths}")
        for name, number in (("steps", total), ("checkpoint", checkpoint)):
            if number < 0:
                raise ArgumentError(f"{name} must not be negative, found {number}")

        def part(first: int, last: int, state: State) -> list[State]:
            found = []
            for k in range(first, last):
                state = self.step(state, **{name: x[k] for name, x in series.items()})
                found.append(state)
            return found

        stride = checkpoint or max(total, 1)
        found: list[State] = []
        for first in range(0, total, stride):
            last = min(first + stride, total)
            if checkpoint:
                found += checkpointed(part, first, last, state, use_reentrant=False)
            else:
                found += part(first, last, state)
            state = found[-1]
        if not found:
            return State._make(None if x is None else x[None][:0] for x in state)
        return State._make(None if rows[0] is None else torch.stack(rows) for rows in zip(*found, strict=True))

    def energy(self, state: State) -> Tensor:
        """Kinetic and potential energy [J] of the rigid bodies, without springs and their rotors, shape [..., 2]."""
        return self._call("energy", {"q": state.q, "qd": state.qd}, None)["E"]

    # --- what it costs ---

    def program(self, *present: str, task: Task | None = None) -> Program:
        """Program of a step at which the inputs of those names are given; by default, all."""
        if isinstance(self.integrator, Unrecorded):
            name = type(self.integrator).__name__
            raise ArgumentError(f"a step of {name} is no program of its own")
        widths = self._widths(task)
        wanted = ["q", "qd", *(present or ("torque", *(name for name in self.inputs if name != "torque")))]
        wanted += ["memory"] if self._memory_size() else []
        wanted += ["reading"] if self.blueprint.of_slot("sensor") else []
        wanted += ["noise"] if self.noises else []
        for name in wanted:
            if name not in widths:
                raise ArgumentError(f"{name} is no input of this scene; it has {', '.join(self.inputs)}")
        if self.controller is not None and "reference" not in wanted:
            raise ArgumentError("reference must be among the inputs of a scene with a controller")
        tensors = tuple((owner, name, width, x.ndim == axes) for owner, name, x, width, axes in self._tensors())
        inputs = tuple((name, widths[name]) for name in wanted)
        return plans.program(self.blueprint, Signature("step", inputs, tensors, task))

    def count(self) -> Count:
        """Operations of a step."""
        return self.program().count()

    def describe(self, batch: int = 4096, dtype: torch.dtype = torch.float64, seconds: float = 0.2) -> Description:
        """What the scene simulates, what each effect adds to a step, and what it leaves out of the description.

        Effects are added one after the other to the bare step; each costs the difference it makes.

        Args:
            batch: samples per step of which the time is taken, on torch's present number of threads; that of the
                parameters if they differ from sample to sample.
            dtype: of those samples.
            seconds: of measuring per effect.
        """
        batches = self.batches.values()
        batch = math.prod(torch.broadcast_shapes(*batches)) if any(batches) else batch
        bare = self.replace(effects=(), controller=None)
        scenes = [bare]
        labels = [("bare step", "rigid bodies, integrator")]
        for effect in self.effects:
            scenes.append(bare.replace(effects=(*scenes[-1].effects, effect)))
            labels.append((type(effect).__name__, effect.SLOT))
        if self.controller is not None:
            scenes.append(self)
            labels.append((type(self.controller).__name__, "controller"))
        times = medians([scene._trial(batch, dtype) for scene in scenes], batch, seconds)
        counts = [scene.count().total for scene in scenes]
        costs = [
            Cost(*label, count - before, t - t_before)
            for label, count, before, t, t_before in zip(
                labels, counts, [0, *counts], times, [0.0, *times], strict=False
            )
        ]
        on = f"{batch} samples of {str(dtype).removeprefix('torch.')}, {torch.get_num_threads()} threads"
        whole = Cost("all", "", counts[-1], times[-1])
        return Description(tuple(costs), whole, left_out(self.robot, self.effects), on)

    def _trial(self, batch: int, dtype: torch.dtype):
        """A step on a batch of states, to be timed."""
        generator = torch.Generator().manual_seed(0)

        def random(width: int) -> Tensor:
            return torch.rand(batch, width, generator=generator, dtype=dtype)

        state = self.start(random(self.n), random(self.n), random(self.noises))
        inputs = {name: random(width) for name, width in self.inputs.items()}
        noise = random(self.noises) if self.noises else None
        return lambda: self.step(state, noise=noise, **inputs)

    # --- how ---

    def _memory_size(self) -> int:
        return sum(effect.memory(self.n) for effect in self.effects)

    def _memory(self, q: Tensor, qd: Tensor) -> Tensor | None:
        rows = [x for e in self.effects for x in e.start(q.unbind(-1), qd.unbind(-1))]
        if not rows:
            return None
        zero = q.new_zeros(q.shape[:-1])
        return torch.stack([x if isinstance(x, Tensor) else zero + x for x in rows], -1)

    def _tensors(self) -> list[tuple[int, str, Tensor, int, int]]:
        """Owner, name, tensor, width and number of trailing axes of every argument that is not an input."""
        found = []
        for name in self.blueprint.varying:
            x = getattr(self.robot, name)
            axes = len(SHAPES[name])
            found.append((ROBOT, name, x, math.prod(x.shape[x.ndim - axes :]), axes))
        parts = [(CONTROLLER, self.controller)] if self.controller is not None else []
        for owner, part in (*parts, *enumerate(self.effects)):
            for name, x in part.tensors().items():
                axes = len(part.SHAPES[name])
                found.append((owner, name, x, math.prod(x.shape[x.ndim - axes :]), axes))
        return found

    def _given(self, state: State, inputs: Mapping[str, Tensor], noise: Tensor | None) -> dict[str, Tensor]:
        """Everything a step's program takes beside the tensors of robot and effects."""
        given = {"q": state.q, "qd": state.qd}
        if state.memory is not None:
            given["memory"] = state.memory
        if state.reading is not None:
            given["reading"] = state.reading
        given.update(inputs)
        return self._with_noise(given, noise)

    def _with_noise(self, given: dict[str, Tensor], noise: Tensor | None) -> dict[str, Tensor]:
        if self.noises:
            q = given["q"]
            if noise is None:
                # 1 - [0, 1) lies in (0, 1], and the logarithm of 0 is infinite
                noise = 1 - torch.rand(*q.shape[:-1], self.noises, dtype=q.dtype, device=q.device)
            given["noise"] = noise
        return given

    def _sensed(
        self,
        stage: str,
        state: State,
        inputs: Mapping[str, Tensor],
        noise: Tensor | None,
        task: Task | None,
    ) -> tuple[State, dict[str, Tensor]]:
        """The state with its readings, and the task's rows."""
        if not self.blueprint.of_slot("sensor") and task is None:
            return state, {}
        given = {name: x for name, x in (("q", state.q), ("qd", state.qd), ("memory", state.memory)) if x is not None}
        given.update(inputs)
        if self.blueprint.of_slot("sensor"):
            given = self._with_noise(given, noise)
        rows = self._call(stage, given, task)
        return state._replace(memory=rows.pop("memory", None), reading=rows.pop("reading", None)), rows

    def _unrecorded(
        self,
        integrator: Unrecorded,
        state: State,
        inputs: Mapping[str, Tensor],
        noise: Tensor | None,
        task: Task | None,
    ) -> tuple[State, dict[str, Tensor]]:
        """A step of an integrator that is not recorded: drive, motion and senses are programs of their own."""
        goals = {} if task is None else task.inputs(self.n)
        own = {name: x for name, x in inputs.items() if name not in goals}  # the drive refuses what nobody knows
        driven = self._call("drive", {k: x for k, x in self._given(state, own, noise).items() if k != "noise"}, None)
        u, memory = driven["u"], driven.get("memory")
        x, v = (y.expand(*u.shape[:-1], y.shape[-1]) for y in (state.q, state.qd))
        elastic, n = self.blueprint.elastic(), self.n
        if elastic is not None and memory is not None:
            rotors = memory[..., self.blueprint.memory()[elastic]]
            x, v = torch.cat([x, rotors[..., :n]], -1), torch.cat([v, rotors[..., n:]], -1)
        others = {name: y for name, y in own.items() if name not in ("torque", "reference")}

        x, v = integrator.flow(_Bodies(self, {**others, "u": u}), x, v, self.dt)
        if elastic is not None and memory is not None:
            at = self.blueprint.memory()[elastic]
            memory = torch.cat([memory[..., : at.start], x[..., n:], v[..., n:], memory[..., at.stop :]], -1)
        after = State(x[..., :n], v[..., :n], memory)
        return self._sensed("sense", after, {**inputs, "u": u}, noise, task)

    def _call(self, stage: str, given: Mapping[str, Tensor], task: Task | None) -> dict[str, Tensor]:
        """Rows of a stage's program, with the batch axes of everything that goes in."""
        like = given["x"] if stage in MOTION else given["q"]
        if self.precision == "double" and like.dtype == torch.float32:
            if any(getattr(x, "dtype", None) != like.dtype for x in given.values()):
                self._check(stage, given, like, task)  # what is wide already would no longer be noticed
            wide = {name: x.double() if x.dtype == torch.float32 else x for name, x in given.items()}
            return {name: y.to(like.dtype) for name, y in self._call(stage, wide, task).items()}
        tensors = self._tensors()
        if torch.compiler.is_compiling():
            return self._traced(stage, given, tensors, like, task)
        look = (
            self.blueprint, stage, task, self.backend, present(), like.dtype, like.device,
            *[(name, getattr(x, "shape", None), getattr(x, "dtype", None), type(x)) for name, x in given.items()],
            *[x.device for x in given.values() if isinstance(x, Tensor)],
            *[x.shape for _, _, x, _, _ in tensors],
        )  # fmt: skip
        plan = _plans.get(look)
        if plan is None:
            plan = self._plan(stage, given, tensors, like, task)
            _plans[look] = plan
        rows = [
            _row(x, like, shapes)
            for x, shapes in zip([*given.values(), *[t[2] for t in tensors]], plan.rows, strict=True)
        ]
        outputs = run(plan.program, rows, plan.backend)
        return {
            result.name: y.reshape(*plan.batch, y.shape[-1])
            for y, result in zip(outputs, plan.program.results, strict=True)
        }

    def _traced(
        self,
        stage: str,
        given: Mapping[str, Tensor],
        tensors: Sequence[tuple[int, str, Tensor, int, int]],
        like: Tensor,
        task: Task | None,
    ) -> dict[str, Tensor]:
        """The same in a graph that is being traced: sizes may be symbols, and the program goes by its name."""
        batch = torch.broadcast_shapes(
            *[x.shape[:-1] for x in given.values()], *[x.shape[: x.ndim - axes] for _, _, x, _, axes in tensors]
        )
        shapes, inputs, arguments = _layout(given, tensors, batch, self._widths(task))
        rows = [
            _row(x, like, shape) for x, shape in zip([*given.values(), *[t[2] for t in tensors]], shapes, strict=True)
        ]
        key, program, names = _constant_program(
            self.blueprint, (stage, inputs, arguments, task), self.backend, like.device
        )
        outputs = operator(key, rows) if key else run(program, rows, EAGER)
        return {name: y.reshape((*batch, y.shape[-1])) for name, y in zip(names, outputs, strict=True)}

    def _plan(
        self, stage: str, given: Mapping[str, Tensor], tensors: Sequence[tuple[int, str, Tensor, int, int]],
        like: Tensor, task: Task | None,
    ) -> _Plan:  # fmt: skip
        """How inputs of these shapes run, after they were checked."""
        self._check(stage, given, like, task)
        shapes = [x.shape[:-1] for x in given.values()]
        shapes += [x.shape[: x.ndim - axes] for _, _, x, _, axes in tensors]
        try:
            batch = torch.broadcast_shapes(*shapes)
        except RuntimeError as error:
            found = ", ".join(f"{name} {tuple(x.shape)}" for name, x in given.items())
            raise ArgumentError(
                f"the batch axes of state, inputs and parameters must broadcast, found {found}"
            ) from error
        own = torch.broadcast_shapes(*shapes[: len(given)])
        for (_, name, _, _, axes), shape in zip(tensors, shapes[len(given) :], strict=True):
            # one number per sample in a column would make every sample meet every number
            if not axes and own and tuple(shape) == (*own, 1) and own[-1] > 1:
                raise ArgumentError(f"{name} is one number for each sample: shape {tuple(own)}, found {tuple(shape)}")
        rows, inputs, arguments = _layout(given, tensors, batch, self._widths(task))
        program = plans.program(self.blueprint, Signature(stage, inputs, arguments, task))
        return _Plan(program, tuple(batch), rows, choose(self.backend, like.device))

    def _widths(self, task: Task | None) -> dict[str, int]:
        """Width of everything that a program of the scene may be given."""
        n = self.n
        moving = n if self.blueprint.elastic() is None else 2 * n
        own = {"q": n, "qd": n, "memory": self._memory_size(), "reading": 2 * n, "noise": self.noises}
        asked = {} if task is None else task.inputs(n)
        return {**own, **self.inputs, **asked, "u": n, "x": moving, "v": moving, "to": moving, "h": 1}

    def _check(self, stage: str, given: Mapping[str, Tensor], like: Tensor, task: Task | None) -> None:
        """Raise, naming what does not fit."""
        n, widths = self.n, self._widths(task)
        for name, x in given.items():
            if name not in widths:
                raise ArgumentError(f"{name} is no input of this scene; it has {', '.join(self.inputs)}")
            if not isinstance(x, Tensor):
                raise ArgumentError(f"{name} must be a tensor, found {type(x).__name__}")
        for name, x in given.items():
            if x.dtype not in DTYPES or x.dtype != like.dtype:
                raise DtypeError(f"{name} must be float32 or float64 like the state, {like.dtype}, found {x.dtype}")
            if x.device != like.device:
                raise ArgumentError(f"{name} is on {x.device} but the state is on {like.device}; move one of them")
            if x.shape[-1:] != (widths[name],):
                raise ArgumentError(
                    f"{name} must have the shape [..., {widths[name]}] for robot {self.robot.name!r}, "
                    f"found {tuple(x.shape)}"
                )
        if stage in ("step", "drive"):
            kept = {"memory": bool(widths["memory"]), "reading": bool(self.blueprint.of_slot("sensor"))}
            for name, there in kept.items():
                if there and name not in given:
                    raise ArgumentError(f"{name} must be part of the state; `start` makes one that has it")
        if stage in ("step", "drive", *MOTION):
            needed = [name for effect in self.effects for name in effect.needs(n)]
            needed += ["reference"] if self.controller is not None and stage not in MOTION else []
            for name in needed:
                if name not in given:
                    raise ArgumentError(f"{name} must be given, shape [..., {widths[name]}]; the scene asks for it")


SLOTS = ("model", "joint", "body", "actuator", "sensor")
_Shapes = tuple[tuple[int, ...], tuple[int, ...]]


class _Plan(NamedTuple):
    """How inputs of certain shapes run."""

    program: Program
    batch: tuple[int, ...]
    rows: tuple[_Shapes, ...]  # of every argument: what it is expanded to, and then reshaped to
    backend: Backend


_interned: Bounded[Blueprint, Blueprint] = Bounded(1024)  # equal scenes share their programs
_plans: Bounded[tuple, _Plan] = Bounded(1024)


def _row(x: Tensor, like: Tensor, shapes: _Shapes) -> Tensor:
    """A tensor as rows of a program, in the dtype and on the device of another: expanded, and then reshaped."""
    if x.dtype != like.dtype or x.device != like.device:
        x = x.to(like)
    return x if x.shape == shapes[1] else x.expand(shapes[0]).reshape(shapes[1])


@dataclass(frozen=True)
class _Bodies:
    """The moving bodies of a scene as a `System` whose rows are one tensor [..., n], by programs of their own."""

    scene: Scene
    inputs: Mapping[str, Tensor]

    def _asked(self, stage: str, **given: Tensor) -> list[Tensor]:
        return [self.scene._call(stage, {**given, **self.inputs}, None)["a"]]

    def accelerations(self, x: Row, v: Row) -> list[Tensor]:
        return self._asked("accelerations", x=x[0], v=v[0])

    def implicit_accelerations(self, x: Row, v: Row, h: float) -> list[Tensor]:
        return self._asked("implicit_accelerations", x=x[0], v=v[0], h=x[0].new_full((1,), h))

    def momentum_accelerations(self, x: Row, v: Row) -> list[Tensor]:
        return self._asked("momentum_accelerations", x=x[0], v=v[0])

    def carried(self, x: Row, v: Row, to: Row) -> list[Tensor]:
        return self._asked("carried", x=x[0], v=v[0], to=to[0])


_Inputs = tuple[tuple[str, int], ...]
_Arguments = tuple[tuple[int, str, int, bool], ...]


def _layout(
    given: Mapping[str, Tensor],
    tensors: Sequence[tuple[int, str, Tensor, int, int]],
    batch: Sequence[int],
    widths: Mapping[str, int],
) -> tuple[tuple[_Shapes, ...], _Inputs, _Arguments]:
    """How inputs and tensors become rows of a program, and what the program's signature says of them."""
    samples = math.prod(batch)
    inputs = {name: widths[name] for name in given}
    rows: list[_Shapes] = [((*batch, width), (samples, width)) for width in inputs.values()]
    arguments = []
    for owner, name, x, width, axes in tensors:
        uniform = x.ndim == axes
        trailing = tuple(x.shape[x.ndim - axes :])
        arguments.append((owner, name, width, uniform))
        rows.append((trailing, (width,)) if uniform else ((*batch, *trailing), (samples, width)))
    return tuple(rows), tuple(inputs.items()), tuple(arguments)


@torch.compiler.assume_constant_result
def _constant_program(
    plan: Blueprint, signature: tuple, name: BackendName | None, device: torch.device
) -> tuple[str, Program, tuple[str, ...]]:
    """A program, its name unless torch sees its operations, and those of its results.

    A tracer hands over plain tuples, not named ones.
    """
    program, backend = plans.program(plan, Signature(*signature)), choose(name, device)
    key = "" if backend.differentiable else named(Guarded(backend), program)
    return key, program, tuple(result.name for result in program.results)
