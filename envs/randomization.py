"""Domain randomisation: parameters of a scene that are drawn for every episode.

    randomise={"mass": 0.1, "gravity": (0.9, 1.1), "friction": LogNormal(0.0, 0.2), "payload": (0.0, 2.0)}

    name                what is drawn                                                   a number x is the range
    "mass"              factor of mass and inertia of every link                        1 - x to 1 + x
    "friction"          factor of all friction of every joint                           1 - x to 1 + x
    "damping"           factor of `Viscous.coefficient` of every joint                  1 - x to 1 + x
    "armature"          factor of `RotorInertia.inertia` of every joint                 1 - x to 1 + x
    "gravity"           factor of every component of `Gravity.acceleration`             1 - x to 1 + x
    "gains"             factor of every gain of the controller                          1 - x to 1 + x
    "Effect.parameter"  factor of every number of that parameter of the scene           1 - x to 1 + x
    "com"               shift of every coordinate of the links' centres of mass [m]     -x to x
    "payload"           mass held by the end effector [kg]                              0 to x
    "delay"             delay of commanded torques [time steps], whole or not           0 to x

A value is a number x, a pair (lower, upper) of what is drawn, or a distribution of torch with an inverse of its
cumulative distribution (`icdf`), such as Uniform, Normal or LogNormal. Everything is drawn from the environments' own
streams of random numbers, so a row is the same whatever the others are. A drawn payload and a drawn delay add to those
that the scene has.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchdq.base.checks import is_number
from torchdq.dynamics.posed import Row
from torchdq.effects import Gravity, MassScale, Payload, RotorInertia, Viscous
from torchdq.effects.actuator import Actuator
from torchdq.effects.effect import MOST_LATE, Effect, Parameter, Shapes
from torchdq.envs.rng import SMALLEST
from torchdq.envs.row_selection import SomeRows
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.numbers.functions import absolute, maximum
from torchdq.robot.fields import trailing
from torchdq.scene.scene import Scene
from torchdq.scene.spec import CONTROLLER, ROBOT

Randomise = Mapping[str, float | tuple[float, float] | Distribution]  # by name, as above
ADDED = {"com": -math.inf, "payload": 0.0, "delay": 0.0}  # not drawn as factors, and their smallest values


class Span(NamedTuple):
    """Range of what is drawn, evenly unless there is a distribution."""

    lower: float
    upper: float
    distribution: Distribution | None = None

    def __call__(self, u: Tensor) -> Tensor:
        """Values of random numbers in (0, 1)."""
        if self.distribution is None:
            return self.lower + (self.upper - self.lower) * u
        return self.distribution.icdf(u).to(u)


class Randomised(NamedTuple):
    """Parameters of one part of a scene that are drawn for every episode, with one draw per number."""

    owner: int  # ROBOT, CONTROLLER, or position among the scene's effects
    bases: dict[str, Tensor]  # by parameter, [N, ...]
    span: Span
    shift: bool  # True: what is drawn is added to the bases; False: it multiplies them

    @property
    def width(self) -> int:
        """Number of random numbers that a draw takes."""
        return next(iter(self.bases.values()))[0].numel()

    def tensors(self, scene: Scene) -> dict[str, Tensor]:
        """The scene's own tensors, a row per environment; the next step uses what is written into them."""
        part = scene.robot if self.owner == ROBOT else _parts(scene)[self.owner]
        return {name: getattr(part, name) for name in self.bases}

    def draw(self, scene: Scene, rows: SomeRows, u: Tensor) -> None:
        """Write new values into some rows; u are random numbers [k, width]."""
        drawn = self.span(u)
        for name, target in self.tensors(scene).items():
            base = rows.of(self.bases[name])
            value = drawn.reshape(base.shape)
            rows.write(target, base + value if self.shift else base * value)


@dataclass(frozen=True)
class DrawnDelay(Actuator):
    """Torques that arrive a number of steps late that differs from row to row; before that, none.

    Between whole numbers of steps, a torque is on the line between the two that are nearest in time.

    Args:
        late: delay [time steps], a number or [...], at most `steps`.
        steps: number of remembered steps.
    """

    SHAPES: ClassVar[Shapes] = {"late": ()}
    late: Parameter
    steps: int

    def memory(self, n: int) -> int:
        """Length of the remembered torques, the oldest first."""
        return self.steps * n

    def driven(self, u: Row, qd: Row, memory: Row, dt: float) -> tuple[Row, Row]:
        """The torques of `late` steps ago."""
        n, known = len(u), (*memory, *u)
        weights = [maximum(1.0 - absolute(self.late - k), 0.0) for k in range(self.steps + 1)]
        found = [sum((w * known[(self.steps - k) * n + i] for k, w in enumerate(weights)), 0.0) for i in range(n)]
        return found, known[n:]


# effect and parameter of the names that stand for one
KINDS: dict[str, tuple[type[Effect], str]] = {
    "mass": (MassScale, "factor"),
    "armature": (RotorInertia, "inertia"),
    "damping": (Viscous, "coefficient"),
    "gravity": (Gravity, "acceleration"),
    "payload": (Payload, "mass"),
    "delay": (DrawnDelay, "late"),
}
SHORT = ("com", "friction", "gains", *KINDS)


def randomised(scene: Scene, randomise: Randomise, num_envs: int, like: Tensor) -> tuple[Scene, tuple[Randomised, ...]]:
    """Scene with a row of parameters per environment, its sensors last, and the parameters to draw.

    Args:
        scene: effects that are missing are added for "mass", "payload" and "delay".
        randomise: what is drawn, by the names above; a number, a pair or a distribution each.
        num_envs: number of environments.
        like: a tensor whose dtype and device the parameters have.
    """
    if not isinstance(randomise, Mapping):
        raise ArgumentError(f"randomise must be a dict such as {{'mass': 0.1}}, found {randomise!r}")
    for name in randomise:
        if name not in (known := (*SHORT, *_parameters(scene))):
            raise UnknownNameError("parameter to randomise", name, known, every=True)
    spans = {name: _span(name, randomise[name], like) for name in sorted(randomise)}
    scene = _with_effects(scene, spans)
    drawn: list[Randomised] = []
    taken: dict[tuple[int, str], str] = {}
    for name, span in spans.items():
        found = []
        for owner, parameters in _targets(scene, name):
            for parameter in parameters:
                if (other := taken.setdefault((owner, parameter), name)) != name:
                    raise ArgumentError(f"randomise: {other!r} and {name!r} both change {parameter}; leave one out")
            bases = {parameter: _base(scene, owner, parameter, num_envs, like) for parameter in parameters}
            found.append(Randomised(owner, bases, span, name == "com"))
        if name not in ADDED and not any(bool(x.any()) for r in found for x in r.bases.values()):
            raise ArgumentError(f"randomise[{name!r}] is a factor of zeros and would change nothing; leave it out")
        for r in found:
            if span.distribution is not None and tuple(span.distribution.batch_shape) not in ((), (1,), (r.width,)):
                raise ArgumentError(
                    f"randomise[{name!r}] must be one distribution or {r.width} of them, found the shape "
                    f"{tuple(span.distribution.batch_shape)}"
                )
        drawn += found
    for r in drawn:
        scene = _with_rows(scene, r)
    return scene, tuple(drawn)


# --- names -----------------------------------------------------------------------------------------------------------


def _parts(scene: Scene) -> dict[int, Any]:
    """Controller and effects by their owner's number."""
    return {**({} if scene.controller is None else {CONTROLLER: scene.controller}), **dict(enumerate(scene.effects))}


def _parameters(scene: Scene) -> dict[str, list[tuple[int, tuple[str, ...]]]]:
    """Owners of every parameter of controller and effects, by "Class.parameter"."""
    found: dict[str, list[tuple[int, tuple[str, ...]]]] = {}
    for owner, part in _parts(scene).items():
        for parameter in part.SHAPES:
            found.setdefault(f"{type(part).__name__}.{parameter}", []).append((owner, (parameter,)))
    return found


def _targets(scene: Scene, name: str) -> list[tuple[int, tuple[str, ...]]]:
    """Owners and parameters that a name stands for; those of one owner share their draws."""
    parts = _parts(scene)
    if "." in name:
        return _parameters(scene)[name]
    if name == "com":
        return [(ROBOT, ("com",))]
    if name == "friction":
        found = [(i, part.SCALES) for i, part in parts.items() if isinstance(part, Effect) and part.SCALES]
        missing = "effects with friction, found none; add Viscous()"
    elif name == "gains":
        found = [(i, (parameter,)) for i, part in parts.items() if i == CONTROLLER for parameter in part.SHAPES]
        missing = "a controller with gains, found none; choose action='residual' or 'reference'"
    else:
        kind, parameter = KINDS[name]
        found = [(i, (parameter,)) for i, part in parts.items() if isinstance(part, kind)]
        missing = f"the effect {kind.__name__}, found none; add {kind.__name__}()"
    if not found:
        raise ArgumentError(f"randomise[{name!r}] needs {missing}")
    # the one that was added
    return found[:1] if name == "mass" else found[-1:] if name == "payload" else found


# --- values ----------------------------------------------------------------------------------------------------------


def _span(name: str, x: Any, like: Tensor) -> Span:
    """Range of a value of `randomise`."""
    what, added = f"randomise[{name!r}]", name in ADDED
    if isinstance(x, Distribution):
        ends = torch.tensor([SMALLEST[like.dtype], 1 - SMALLEST[like.dtype]], dtype=like.dtype, device=like.device)
        try:
            found = x.icdf(ends.reshape(2, *[1] * len(x.batch_shape)))
        except NotImplementedError as error:
            raise ArgumentError(
                f"{what} must be a distribution with icdf(), such as Uniform, Normal or LogNormal, found {x}"
            ) from error
        span = Span(found.min().item(), found.max().item(), x)
    elif is_number(x):
        if not (0 <= x < math.inf) or (not added and x >= 1):
            units = {"com": "a shift in m", "payload": "a mass in kg", "delay": "a number of time steps"}
            expected = units.get(name, "a fraction from 0 to 1")
            raise ArgumentError(f"{what} must be {expected}, or a pair (lower, upper), found {x!r}")
        span = Span(0.0 if name in ("payload", "delay") else -x, float(x)) if added else Span(1 - x, 1 + x)
    else:
        pair = isinstance(x, Sequence) and len(x) == 2 and all(map(is_number, x))
        if not (pair and math.isfinite(x[0]) and math.isfinite(x[1]) and x[0] <= x[1]):
            raise ArgumentError(
                f"{what} must be a number, a pair (lower, upper) of finite numbers, or a distribution of torch, "
                f"found {x!r}"
            )
        span = Span(float(x[0]), float(x[1]))
    if not (ADDED[name] <= span.lower if added else span.lower > 0) or not span.upper < math.inf:
        expected = f"values from {ADDED[name]:g}" if added else "factors above 0"
        raise ArgumentError(f"{what} must draw finite {expected}, found some from {span.lower:.4g} to {span.upper:.4g}")
    if name == "delay" and span.upper > MOST_LATE:
        raise ArgumentError(f"{what} must draw at most {MOST_LATE} time steps, found up to {span.upper:g}")
    return span


# --- scenes ----------------------------------------------------------------------------------------------------------


def _with_effects(scene: Scene, spans: Mapping[str, Span]) -> Scene:
    """Scene with the effects that carry what is drawn, its sensors last."""
    found = [e for e in scene.effects if e.SLOT != "sensor"]
    if "delay" in spans:
        found.insert(0, DrawnDelay(0.0, max(1, math.ceil(spans["delay"].upper))))
    if "mass" in spans:  # the first, since a payload of the scene does not grow with the link that holds it
        found.insert(0, MassScale((1.0,) * len(scene.robot.link_names)))
    if "payload" in spans:  # the last, since it does not grow with the link that holds it
        found.append(Payload(1.0))
    return scene.replace(effects=(*found, *[e for e in scene.effects if e.SLOT == "sensor"]))


def _base(scene: Scene, owner: int, name: str, num_envs: int, like: Tensor) -> Tensor:
    """Value of a parameter before anything is drawn, a row per environment."""
    if isinstance(part := _parts(scene).get(owner), DrawnDelay):
        return like.new_ones(num_envs)
    shape = trailing(scene.spec.shapes(owner)[name], scene.robot.sizes)
    value = torch.as_tensor(getattr(scene.robot if owner == ROBOT else part, name)).detach().to(like)
    return value.expand(num_envs, *shape)


def _with_rows(scene: Scene, r: Randomised) -> Scene:
    """Scene with tensors of its own for the parameters that are drawn."""
    rows: dict[str, Any] = {name: x.clone() for name, x in r.bases.items()}
    if r.owner == ROBOT:
        return scene.replace(robot=scene.robot.replace(**rows))
    if r.owner == CONTROLLER:
        return scene.replace(controller=replace(scene.controller, **rows))  # type: ignore[type-var]
    effects = list(scene.effects)
    effects[r.owner] = replace(effects[r.owner], **rows)
    return scene.replace(effects=effects)
