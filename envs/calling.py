"""Calls of a scene's programs on tensors: checks, batch axes, and the programs that inputs of certain shapes need."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchdq.backends import choice as backends
from torchdq.backends import run
from torchdq.envs import recording
from torchdq.envs.recording import EVALUATIONS, Signature
from torchdq.envs.spec import CONTROLLER, ROBOT, SceneSpec, Task
from torchdq.errors import ArgumentError, DtypeError
from torchdq.program.program import Program
from torchdq.robot.robot import DTYPES, SHAPES

if TYPE_CHECKING:
    from torchdq.envs.scene import Scene

Shapes = tuple[tuple[int, ...], tuple[int, ...]]


class TensorArgument(NamedTuple):
    """A tensor of robot, controller or effects that is an argument of the scene's programs."""

    owner: int  # ROBOT, CONTROLLER, or the position of an effect
    name: str
    tensor: Tensor
    width: int  # numbers in a row of it
    axes: int  # trailing axes that are not batch axes

    @property
    def batch(self) -> tuple[int, ...]:
        """Batch axes; () where samples share one."""
        return tuple(self.tensor.shape[: self.tensor.ndim - self.axes])


class _Plan(NamedTuple):
    """Program for inputs of certain shapes."""

    program: Program
    batch: tuple[int, ...]
    rows: tuple[Shapes, ...]  # shapes that each argument is expanded to, and then reshaped to
    eager: bool


_specs: dict[SceneSpec, SceneSpec] = {}  # equal scenes share their programs
_plans: dict[tuple, _Plan] = {}
_MOST_PLANS = 1024


def interned(spec: SceneSpec) -> SceneSpec:
    """First specification that is equal to this one."""
    if len(_specs) >= _MOST_PLANS:
        _specs.clear()
    return _specs.setdefault(spec, spec)


def call(scene: Scene, stage: str, given: Mapping[str, Tensor], task: Task | None = None) -> dict[str, Tensor]:
    """Rows of a stage's program, with the batch axes of everything that goes in; the first input is of the state."""
    like = next(iter(given.values()))
    if scene.precision == "double" and like.dtype == torch.float32:
        if any(getattr(x, "dtype", None) != like.dtype for x in given.values()):
            check(scene, stage, given, like, task)  # after the cast, mixed input dtypes could not be detected
        wide = {name: x.double() if x.dtype == torch.float32 else x for name, x in given.items()}
        return {name: y.to(like.dtype) for name, y in call(scene, stage, wide, task).items()}
    tensors = arguments(scene)
    if torch.compiler.is_compiling():
        return _traced(scene, stage, given, tensors, like, task)
    look = (
        scene.spec, stage, task, scene.backend, backends.present(), like.dtype, like.device,
        *[(name, getattr(x, "shape", None), getattr(x, "dtype", None), type(x)) for name, x in given.items()],
        *[x.device for x in given.values() if isinstance(x, Tensor)],
        *[t.tensor.shape for t in tensors],
    )  # fmt: skip
    plan = _plans.get(look)
    if plan is None:
        plan = _plan(scene, stage, given, tensors, like, task)
        if len(_plans) >= _MOST_PLANS:
            _plans.clear()
        _plans[look] = plan
    inputs = [*given.values(), *[t.tensor for t in tensors]]
    rows = [run.row(x, like, shapes) for x, shapes in zip(inputs, plan.rows, strict=True)]
    outputs = run.eager(plan.program, rows) if plan.eager else run.compiled(plan.program, rows)
    names = [result.name for result in plan.program.results]
    return {name: y.reshape(*plan.batch, y.shape[-1]) for name, y in zip(names, outputs, strict=True)}


def _traced(
    scene: Scene, stage: str, given: Mapping[str, Tensor], tensors: Sequence[TensorArgument], like: Tensor,
    task: Task | None,
) -> dict[str, Tensor]:  # fmt: skip
    """`call` in a graph that is being traced: sizes may be symbols, and the program goes by its name."""
    batch = torch.broadcast_shapes(*[x.shape[:-1] for x in given.values()], *[t.batch for t in tensors])
    shapes, inputs, signature = _layout(given, tensors, batch, widths(scene, task))
    rows = [
        run.row(x, like, shape)
        for x, shape in zip([*given.values(), *[t.tensor for t in tensors]], shapes, strict=True)
    ]
    key, names = _constant_program(scene.spec, (stage, inputs, signature, task))
    if backends.choose(scene.backend, like.device.type) == "eager":
        outputs = run.eager(run.found(key), rows)
    else:
        outputs = run.operator(key, rows)
    return {name: y.reshape((*batch, y.shape[-1])) for name, y in zip(names, outputs, strict=True)}


def _plan(
    scene: Scene, stage: str, given: Mapping[str, Tensor], tensors: Sequence[TensorArgument], like: Tensor,
    task: Task | None,
) -> _Plan:  # fmt: skip
    """Plan for inputs of these shapes, after they were checked."""
    check(scene, stage, given, like, task)
    shapes = [x.shape[:-1] for x in given.values()]
    try:
        batch = torch.broadcast_shapes(*shapes, *[t.batch for t in tensors])
    except RuntimeError as error:
        found = ", ".join(f"{name} {tuple(x.shape)}" for name, x in given.items())
        raise ArgumentError(f"the batch axes of state, inputs and parameters must broadcast, found {found}") from error
    own = tuple(torch.broadcast_shapes(*shapes))
    for t in tensors:
        # a [batch, 1] parameter would broadcast against the batch axis to [batch, batch]
        if not t.axes and own and t.batch == (*own, 1) and own[-1] > 1:
            raise ArgumentError(f"{t.name} is one number for each sample: shape {own}, found {t.batch}")
    rows, inputs, signature = _layout(given, tensors, batch, widths(scene, task))
    program = recording.program(scene.spec, Signature(stage, inputs, signature, task))
    return _Plan(program, tuple(batch), rows, backends.choose(scene.backend, like.device.type) == "eager")


def arguments(scene: Scene) -> list[TensorArgument]:
    """Every argument of the scene's programs that is not an input."""
    parts: list = [] if scene.controller is None else [(CONTROLLER, scene.controller)]
    owned = [(ROBOT, name, getattr(scene.robot, name), len(SHAPES[name])) for name in scene.spec.varying]
    for owner, part in (*parts, *enumerate(scene.effects)):
        owned += [(owner, name, x, len(part.SHAPES[name])) for name, x in part.tensors().items()]
    return [TensorArgument(owner, name, x, math.prod(x.shape[x.ndim - axes :]), axes) for owner, name, x, axes in owned]


def widths(scene: Scene, task: Task | None) -> dict[str, int]:
    """Width of every input that a program of the scene may have."""
    n, memory = scene.n, sum(effect.memory(scene.n) for effect in scene.effects)
    moving = n + scene.spec.transmission[1].memory(n) // 2
    own = {"q": n, "qd": n, "memory": memory, "reading": 2 * n, "noise": scene.noises}
    asked = {} if task is None else task.inputs(n)
    return {**own, **scene.inputs, **asked, "u": n, "x": moving, "v": moving, "to": moving, "h": 1}


def check(scene: Scene, stage: str, given: Mapping[str, Tensor], like: Tensor, task: Task | None) -> None:
    """Raise, naming the input that is missing, unknown, or of another shape, dtype or device."""
    n, known = scene.n, widths(scene, task)
    for name, x in given.items():
        if name not in known:
            raise ArgumentError(f"{name} is no input of this scene; it has {', '.join(scene.inputs)}")
        if not isinstance(x, Tensor):
            raise ArgumentError(f"{name} must be a tensor, found {type(x).__name__}")
    for name, x in given.items():
        if x.dtype not in DTYPES or x.dtype != like.dtype:
            raise DtypeError(f"{name} must be float32 or float64 like the state, {like.dtype}, found {x.dtype}")
        if x.device != like.device:
            raise ArgumentError(f"{name} is on {x.device} but the state is on {like.device}; move one of them")
        if x.shape[-1:] != (known[name],):
            raise ArgumentError(
                f"{name} must have the shape [..., {known[name]}] for robot {scene.robot.name!r}, "
                f"found {tuple(x.shape)}"
            )
    if stage in ("step", "drive"):
        kept = {"memory": bool(known["memory"]), "reading": scene.spec.senses}
        for name, there in kept.items():
            if there and name not in given:
                raise ArgumentError(f"{name} must be part of the state; `start` makes one that has it")
    if stage in ("step", "drive", *EVALUATIONS):
        needed = [name for effect in scene.effects for name in effect.needs(n)]
        needed += ["reference"] if scene.controller is not None and stage not in EVALUATIONS else []
        for name in needed:
            if name not in given:
                raise ArgumentError(f"{name} must be given, shape [..., {known[name]}]; the scene asks for it")


def _layout(
    given: Mapping[str, Tensor], tensors: Sequence[TensorArgument], batch: Sequence[int], known: Mapping[str, int]
) -> tuple[tuple[Shapes, ...], tuple, tuple]:
    """Shapes of the rows of a program that inputs and tensors become, and both in the program's signature."""
    samples = math.prod(batch)
    inputs = {name: known[name] for name in given}
    rows: list[Shapes] = [((*batch, width), (samples, width)) for width in inputs.values()]
    signature = []
    for owner, name, x, width, axes in tensors:
        uniform = x.ndim == axes
        trailing = tuple(x.shape[x.ndim - axes :])
        signature.append((owner, name, width, uniform))
        rows.append((trailing, (width,)) if uniform else ((*batch, *trailing), (samples, width)))
    return tuple(rows), tuple(inputs.items()), tuple(signature)


@torch.compiler.assume_constant_result
def _constant_program(spec: SceneSpec, signature: tuple) -> tuple[str, tuple[str, ...]]:
    """Name of a program, and those of its results; a tracer hands over plain tuples, not named ones."""
    program = recording.program(spec, Signature(*signature))
    return run.key(program), tuple(result.name for result in program.results)
