"""Domain randomisation: parameters of a scene that are drawn for every episode.

    randomise={"mass": 0.1, "gravity": (0.9, 1.1), "friction": LogNormal(0.0, 0.2), "payload": (0.0, 2.0)}

    name                what is drawn                                                   a number x is the range
    "mass"              factor of mass and inertia of every link                        1 - x to 1 + x
    "friction"          factor of all friction of a joint, one for every joint          1 - x to 1 + x
    "damping"           factor of `Viscous.coefficient` of every joint                  1 - x to 1 + x
    "armature"          factor of `RotorInertia.inertia` of every joint                 1 - x to 1 + x
    "gravity"           factor of every component of `Gravity.acceleration`             1 - x to 1 + x
    "gains"             factor of every gain of the controller                          1 - x to 1 + x
    "Effect.parameter"  factor of every number of that parameter of an effect           1 - x to 1 + x
    "object.parameter"  the same of an object, called by its name                       1 - x to 1 + x
    "com"               shift of every coordinate of the links' centres of mass [m]     -x to x
    "payload"           mass held by the end effector [kg]                              0 to x
    "delay"             delay of commanded torques [time steps], whole or not           0 to x

A value is a number x, a pair (lower, upper) of what is drawn, or a distribution of torch with an inverse of its
cumulative distribution (`icdf`), such as Uniform, Normal or LogNormal. An `Absolute` draws the numbers of an
"Effect.parameter" themselves, which may be zero or negative: {"Bias.position": Absolute(-0.01, 0.01)}. Several effects
of a kind are counted from zero, in the order of the scene: "Contact.0.height", "Contact.1.height".

Everything is drawn from the environments' own streams of random numbers, so a row is the same whatever the others are.
What an effect or a controller would refuse as a constant is refused at construction, and so are draws that only
together are wrong, such as a lower limit above the upper one.
A drawn payload and a drawn delay add to those that the scene has.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from torchdq.base.checks import is_number
from torchdq.dynamics.posed import Row
from torchdq.effects import Gravity, MassScale, Payload, RotorInertia, Viscous
from torchdq.effects.actuator import Actuator
from torchdq.effects.effect import MOST_LATE, Effect
from torchdq.envs.rng import SMALLEST, seeded
from torchdq.envs.row_selection import Indexed, SomeRows
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions import signature
from torchdq.functions.parametric import Parameter
from torchdq.numbers.functions import absolute, maximum
from torchdq.objects import Object
from torchdq.robot.fields import trailing
from torchdq.scene.scene import Scene
from torchdq.scene.spec import CONTROLLER, OBJECTS, ROBOT


@dataclass(frozen=True)
class Absolute:
    """Range of the numbers of a parameter themselves, where `randomise` would draw factors of them.

    Args:
        lower: smallest number, in the unit of the parameter: one for all its components, or one for each. Or, without
            `upper`, a distribution as in `torchdq.envs.randomization`.
        upper: largest number, likewise.

    >>> import torchdq
    >>> from torchdq import effects
    >>> from torchdq.envs import Absolute, RobotVectorEnv
    >>> tilted = Absolute([-1.0, -1.0, -9.81], [1.0, 1.0, -9.81])
    >>> envs = RobotVectorEnv(64, "reach", "panda", randomise={"Gravity.acceleration": tilted})
    """

    lower: float | Sequence[float] | Distribution
    upper: float | Sequence[float] | None = None


Randomise = Mapping[str, float | tuple[float, float] | Distribution | Absolute]  # by name, as above
SAMPLES = 256  # draws that are tried at construction, beside the ends of the ranges
TRIED = 2**16  # rows of them that are tried at once
ADDED = {"com": -math.inf, "payload": 0.0, "delay": 0.0}  # not drawn as factors, and their smallest values


class Span(NamedTuple):
    """Range of what is drawn, evenly unless there is a distribution."""

    lower: Tensor  # one for all numbers, or one for each
    upper: Tensor
    distribution: Distribution | None = None

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the ranges: () if all numbers have the same."""
        return tuple(self.lower.shape if self.distribution is None else self.distribution.batch_shape)

    def __call__(self, u: Tensor) -> Tensor:
        """Values of random numbers in (0, 1)."""
        if self.distribution is None:
            return self.lower + (self.upper - self.lower) * u
        return self.distribution.icdf(u).to(u)


Drawn = tuple["Randomised", ...]  # all that is drawn
Owned = tuple[int, str]  # a parameter: ROBOT, CONTROLLER, or position among the scene's effects; and its name


class Randomised(NamedTuple):
    """Parameters of a scene, of equal shapes, that are drawn together for every episode: one draw per number."""

    name: str  # in `randomise`
    bases: dict[Owned, Tensor]  # [N, ...]
    span: Span = Span(torch.ones(()), torch.ones(()))
    how: Literal["factor", "shift", "absolute"] = "factor"  # what is drawn multiplies the bases, is added, or replaces

    @property
    def width(self) -> int:
        """Number of random numbers that a draw takes."""
        return next(iter(self.bases.values()))[0].numel()

    def tensors(self, scene: Scene) -> dict[Owned, Tensor]:
        """The scene's own tensors, a row per environment; the next step uses what is written into them."""
        parts = {ROBOT: scene.robot, **_parts(scene)}
        return {(owner, name): getattr(parts[owner], name) for owner, name in self.bases}

    def draw(self, scene: Scene, rows: SomeRows, u: Tensor) -> None:
        """Write new values into some rows; u are random numbers [k, width]."""
        found, targets = self.values(rows, u), self.tensors(scene)
        for parameter, x in found.items():
            rows.write(targets[parameter], x)

    def values(self, rows: SomeRows, u: Tensor) -> dict[Owned, Tensor]:
        """Values [k, ...] of the parameters of some rows; u are random numbers [k, width]."""
        drawn, found = self.span(u), {}
        for parameter, x in self.bases.items():
            base = rows.of(x)
            value = drawn.reshape(base.shape)
            found[parameter] = {"factor": base * value, "shift": base + value, "absolute": value}[self.how]
        return found


@dataclass(frozen=True)
class DrawnDelay(Actuator):
    """Torques that arrive a number of steps late that differs from row to row; before that, none.

    Between whole numbers of steps, a torque is on the line between the two that are nearest in time.

    Args:
        late: delay [time steps], a number or [...], at most `steps`.
        steps: number of remembered steps.
    """

    late: Parameter = field(metadata=signature.parameter())
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


def randomised(scene: Scene, randomise: Randomise, num_envs: int, like: Tensor) -> tuple[Scene, Scene, Drawn]:
    """Scene with all that carries what is drawn, the same with a row of it per environment, and the parameters to draw.

    Args:
        scene: effects that are missing are added for "mass", "payload" and "delay".
        randomise: what is drawn, by the names above; a number, a pair or a distribution each.
        num_envs: number of environments.
        like: a tensor whose dtype and device the parameters have.
    """
    _require_known(scene, randomise)
    scene, own = _with_effects(scene, {name: _span(name, randomise[name], like) for name in sorted(randomise)})
    drawn: list[Randomised] = []
    taken: dict[Owned, str] = {}
    for name in sorted(randomise):
        for parameters in _targets(scene, own, name):
            for parameter in parameters:
                if (other := taken.setdefault(parameter, name)) != name:
                    raise ArgumentError(f"randomise: {other!r} and {name!r} both change {parameter[1]}; leave one out")
            drawn.append(Randomised(name, {p: _base(scene, p, num_envs, like) for p in parameters}))
    rows = {f"{owner}.{name}": x.clone() for r in drawn for (owner, name), x in r.bases.items()}
    simulated = scene.with_parameters(rows) if rows else scene
    return scene, simulated, with_ranges(scene, drawn, randomise, like)


def with_ranges(scene: Scene, drawn: Sequence[Randomised], randomise: Randomise, like: Tensor) -> Drawn:
    """Parameters to draw in a scene without them, with the ranges of `randomise`; others keep theirs."""
    _require_known(scene, randomise)
    found = list(drawn)
    for name, given in randomise.items():
        at = [k for k, r in enumerate(drawn) if r.name == name]
        if not at:
            raise ArgumentError(
                f"randomise[{name!r}] needs another program, since these environments draw "
                f"{', '.join(dict.fromkeys(r.name for r in drawn)) or 'nothing'}; make them with it, at first with a "
                "range of a single value, such as (1.0, 1.0)"
            )
        span, absolute = _span(name, given, like), name in ADDED or isinstance(given, Absolute)
        how: Any = "shift" if name == "com" else "absolute" if absolute else "factor"
        for k in at:
            found[k] = r = drawn[k]._replace(span=span, how=how)
            if r.span.shape not in ((), (1,), (r.width,)):
                raise ArgumentError(
                    f"randomise[{name!r}] must have one range, or {r.width} of them, found the shape {r.span.shape}"
                )
        most = [effect.steps for effect in scene.effects if isinstance(effect, DrawnDelay)]
        if name == "delay" and span.upper > most[0]:
            raise ArgumentError(
                f"randomise['delay'] needs another program above {most[0]} steps, found {span.upper:g}; begin with more"
            )
        if how == "factor" and not any(bool(x.any()) for k in at for x in drawn[k].bases.values()):
            raise ArgumentError(f"randomise[{name!r}] is a factor of zeros and would change nothing; leave it out")
    _require_allowed(scene, found)
    return tuple(found)


def _require_known(scene: Scene, randomise: Any) -> None:
    """Raise unless what is drawn is given by names of parameters."""
    if not isinstance(randomise, Mapping):
        raise ArgumentError(f"randomise must be a dict such as {{'mass': 0.1}}, found {randomise!r}")
    for name in randomise:
        if name not in (known := (*SHORT, *_parameters(_parts(scene)))):
            raise UnknownNameError("parameter to randomise", name, known, every=True)


# --- names -----------------------------------------------------------------------------------------------------------


def _parts(scene: Scene) -> dict[int, Any]:
    """Controller, objects and effects by their owner's number."""
    own = {} if scene.controller is None else {CONTROLLER: scene.controller}
    objects = {OBJECTS - k: body for k, body in enumerate(scene.objects)}
    return {**own, **objects, **dict(enumerate(scene.effects))}


def _parameters(parts: Mapping[int, Any]) -> dict[str, Owned]:
    """Every parameter of parts by "Class.parameter", or by "Class.0.parameter" where several are of that class.

    An object is called by its own name.
    """
    kinds = [part.name if isinstance(part, Object) else type(part).__name__ for part in parts.values()]
    number, before, found = Counter(kinds), Counter[str](), dict[str, Owned]()
    for kind, (owner, part) in zip(kinds, parts.items(), strict=True):
        label = f"{kind}.{before[kind]}" if number[kind] > 1 else kind
        before[kind] += 1
        found |= {f"{label}.{parameter}": (owner, parameter) for parameter in part.SHAPES}
    return found


def _targets(scene: Scene, own: Sequence[int], name: str) -> list[list[Owned]]:
    """Parameters that a name stands for; those in one list share their draws.

    Args:
        own: positions of the effects that were not added to carry what is drawn.
    """
    parts = _parts(scene)
    if "." in name:
        return [[_parameters({i: part for i, part in parts.items() if i < 0 or i in own})[name]]]
    if name == "com":
        return [[(ROBOT, "com")]]
    if name == "friction":
        shared: dict[tuple[int | str, ...], list[Owned]] = {}  # by shape: one draw for a joint, whatever its effects
        for i in own:
            for parameter in parts[i].SCALES:
                shared.setdefault(parts[i].SHAPES[parameter], []).append((i, parameter))
        found, missing = list(shared.values()), "effects with friction, found none; add Viscous()"
    elif name == "gains":
        control = [part for i, part in parts.items() if i == CONTROLLER]
        found = [[(CONTROLLER, gain)] for part in control for gain in part.SHAPES if not part.interval(gain).signed]
        missing = "a controller with gains, found none; choose action='residual' or 'reference'"
    else:
        kind, parameter = KINDS[name]
        added = name in ("mass", "payload", "delay")
        found = [[(i, parameter)] for i, part in parts.items() if isinstance(part, kind) and (i in own) != added]
        missing = f"the effect {kind.__name__}, found none; add {kind.__name__}()"
    if not found:
        raise ArgumentError(f"randomise[{name!r}] needs {missing}")
    return found


# --- values ----------------------------------------------------------------------------------------------------------


def _span(name: str, x: Any, like: Tensor) -> Span:
    """Range of a value of `randomise`."""
    what, added = f"randomise[{name!r}]", name in ADDED
    if isinstance(x, Absolute):
        if "." not in name:
            raise ArgumentError(
                f"{what} must be a number, a pair or a distribution, found {x}; Absolute is for the parameter of one "
                "effect, such as 'Gravity.acceleration'"
            )
        return _absolute(what, x, like)
    if isinstance(x, Distribution):
        span = _distributed(what, x, like)
    elif is_number(x):
        if not (0 <= x < math.inf) or (not added and x >= 1):
            units = {"com": "a shift in m", "payload": "a mass in kg", "delay": "a number of time steps"}
            expected = units.get(name, "a fraction from 0 to 1")
            raise ArgumentError(f"{what} must be {expected}, or a pair (lower, upper), found {x!r}")
        lower, upper = (0.0 if name in ("payload", "delay") else -x, x) if added else (1 - x, 1 + x)
        span = Span(like.new_tensor(lower), like.new_tensor(upper))
    else:
        pair = isinstance(x, Sequence) and len(x) == 2 and all(map(is_number, x))
        if not (pair and math.isfinite(x[0]) and math.isfinite(x[1]) and x[0] <= x[1]):
            raise ArgumentError(
                f"{what} must be a number, a pair (lower, upper) of finite numbers, or a distribution of torch, "
                f"found {x!r}"
            )
        span = Span(like.new_tensor(x[0]), like.new_tensor(x[1]))
    if not (ADDED[name] <= span.lower if added else span.lower > 0) or not span.upper < math.inf:
        expected = f"values from {ADDED[name]:g}" if added else "factors above 0"
        raise ArgumentError(f"{what} must draw finite {expected}, found some from {span.lower:.4g} to {span.upper:.4g}")
    if name == "delay" and span.upper > MOST_LATE:
        raise ArgumentError(f"{what} must draw at most {MOST_LATE} time steps, found up to {span.upper:g}")
    return span


def _distributed(what: str, x: Distribution, like: Tensor) -> Span:
    """Range of a distribution, between the ends of the random numbers in (0, 1)."""
    ends = torch.tensor([SMALLEST[like.dtype], 1 - SMALLEST[like.dtype]], dtype=like.dtype, device=like.device)
    try:
        found = x.icdf(ends.reshape(2, *[1] * len(x.batch_shape)))
    except NotImplementedError as error:
        raise ArgumentError(
            f"{what} must be a distribution with icdf(), such as Uniform, Normal or LogNormal, found {x}"
        ) from error
    return Span(found.min(), found.max(), x)


def _absolute(what: str, x: Absolute, like: Tensor) -> Span:
    """Range of the numbers of a parameter."""
    if isinstance(x.lower, Distribution) and x.upper is None:
        return _distributed(what, x.lower, like)
    ends = [tuple(end) if isinstance(end, Sequence) else (end,) for end in (x.lower, x.upper)]
    numbers = all(is_number(number) for end in ends for number in end) and len(ends[0]) == len(ends[1])
    if not numbers or not all(-math.inf < a <= b < math.inf for a, b in zip(*ends, strict=True)):
        raise ArgumentError(
            f"{what} must be Absolute(lower, upper) of finite numbers, or of as many as the parameter has, with lower "
            f"<= upper, or Absolute(distribution), found {x}"
        )
    return Span(like.new_tensor(ends[0]), like.new_tensor(ends[1]))


def _require_allowed(scene: Scene, drawn: Sequence[Randomised]) -> None:
    """Raise if an effect or the controller refuses some of what may be drawn together.

    Args:
        scene: the scene without what is drawn.
        drawn: what is drawn; samples are tried in all environments if their other numbers differ.
    """
    if not drawn:
        return
    bases = {parameter: x for r in drawn for parameter, x in r.bases.items()}
    names = {parameter: r.name for r in drawn for parameter in r.bases}
    parts = {i: part for i, part in _parts(scene).items() if any(i == owner for owner, _ in bases)}
    batched = {
        i: {name: x for name, x in part.tensors().items() if x.ndim > len(part.SHAPES[name]) and len(x) > 1}
        for i, part in parts.items()
    }
    differ = any(batched.values()) or any(x.stride(0) for x in bases.values())
    like = next(iter(bases.values()))
    number = len(like) if differ else 1
    for u in _samples(drawn, like).split(max(1, TRIED // number)):
        rows = Indexed(torch.arange(number, device=like.device).repeat(len(u)))
        columns = u.repeat_interleave(number, 0).split([r.width for r in drawn], 1)
        values = {owned: x for r, c in zip(drawn, columns, strict=True) for owned, x in r.values(rows, c).items()}
        for i, part in parts.items():
            own = {name: x for (owner, name), x in values.items() if owner == i}
            try:
                replace(part, **{name: rows.of(x) for name, x in batched[i].items()} | own).resolved(scene.robot)
            except ArgumentError as error:
                what = " and ".join(f"randomise[{name!r}]" for name in dict.fromkeys(names[i, name] for name in own))
                raise ArgumentError(
                    f"{what} must draw only what {type(part).__name__} takes: {error}; narrow the range, or "
                    "leave it out"
                ) from error


def _samples(drawn: Sequence[Randomised], like: Tensor) -> Tensor:
    """Random numbers [k, all widths] that are tried: each at both ends, with the others at both ends, and some within.

    So the worst of a condition that is monotone in one number or in two, such as an order, is among them.
    """
    ends = [
        (0.0, 1.0) if r.span.distribution is None else (SMALLEST[like.dtype], 1 - SMALLEST[like.dtype]) for r in drawn
    ]
    low, high = (
        torch.cat([like.new_full((r.width,), end[k]) for r, end in zip(drawn, ends, strict=True)]) for k in (0, 1)
    )
    one = torch.eye(len(low), dtype=torch.bool, device=like.device)
    within, _ = seeded(0, SAMPLES, like.device).uniform(len(low), like.dtype)
    return torch.cat([low[None], high[None], torch.where(one, high, low), torch.where(one, low, high), within])


# --- scenes ----------------------------------------------------------------------------------------------------------


def _with_effects(scene: Scene, spans: Mapping[str, Span]) -> tuple[Scene, list[int]]:
    """Scene with the effects that carry what is drawn, its sensors last, and the positions of those it had."""
    sensors = [e for e in scene.effects if e.SLOT == "sensor"]
    found = [e for e in scene.effects if e.SLOT != "sensor"]
    if "delay" in spans:
        found.insert(0, DrawnDelay(0.0, max(1, math.ceil(spans["delay"].upper))))
    if "mass" in spans:  # the first, since a payload of the scene does not grow with the link that holds it
        found.insert(0, MassScale((1.0,) * len(scene.robot.link_names)))
    if "payload" in spans:  # the last, since it does not grow with the link that holds it
        found.append(Payload(1.0))
    found += sensors
    had = {id(e) for e in scene.effects}
    return scene.replace(effects=found), [i for i, e in enumerate(found) if id(e) in had]


def _base(scene: Scene, parameter: Owned, num_envs: int, like: Tensor) -> Tensor:
    """Value of a parameter before anything is drawn, a row per environment."""
    owner, name = parameter
    part = {ROBOT: scene.robot, **_parts(scene)}[owner]
    value = torch.as_tensor(getattr(part, name)).detach().to(like)
    return value.expand(num_envs, *trailing(scene.spec.shapes(owner)[name], scene.robot.sizes))
