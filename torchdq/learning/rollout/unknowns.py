"""Unknown parameters of a scene, by name, and how a step of least squares changes them.

The names are those of `fit_rollout(learn=...)`: "Viscous.coefficient", "PD.kp", "Coulomb2.level" for the second of two
effects of a class, "mass", "com" and "inertia" of the links with mass, and "delay" of all inputs.

A step is taken in the parameters themselves where they may have any sign. Positive ones grow along the step and fall
along the exponential with the same slope, so that they stay positive, and friction, which enters linearly, is still
found in few steps, however small it was. Inertias move in the coordinates of `torchdq.layers.parametrizations`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import tensor_of
from torchdq.effects.effect import Effect
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.functions.parametric import Parametric
from torchdq.layers.parametrizations import PhysicalInertia
from torchdq.robot.fields import trailing
from torchdq.scene.scene import Scene

DELAY = "delay"
BODIES = ("mass", "com", "inertia")  # parameters of the links
LEAST = 1e-9  # least value of a parameter that is positive [SI]
LENGTH = 0.1  # least size of a change of a centre of mass [m]
INERTIA = PhysicalInertia()


@dataclass(frozen=True)
class Unknown:
    """Estimated parameter of a scene, of any sign; steps are added to its numbers."""

    name: str  # "Viscous.coefficient"
    key: str  # its name in the programs of the scene, "1.coefficient"; "": the delay of the inputs
    labels: tuple[str, ...]  # one for each number, "Viscous.coefficient[elbow]"
    whole: np.ndarray  # the parameter with all its numbers, at the start
    at: np.ndarray  # [w] places of the estimated numbers among them
    unit: float = 1.0  # least size of a step [SI]

    @property
    def start(self) -> np.ndarray:
        """Estimated numbers [w] at the start."""
        return self.whole.ravel()[self.at]

    def filled(self, value: np.ndarray) -> Tensor:
        """Parameter with the estimated numbers [w] in their places."""
        flat = self.whole.flatten()
        flat[self.at] = value
        return torch.from_numpy(flat.reshape(self.whole.shape))

    def moved(self, value: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Values [w] after a step [w]."""
        return value + step

    def slopes(self, value: np.ndarray) -> np.ndarray:
        """Derivatives [w, w] of the values by a step."""
        return np.eye(len(value))

    def sizes(self, value: np.ndarray) -> np.ndarray:
        """Sizes of steps [w] as large as the values or their starting values, whichever is larger."""
        return np.full(len(value), max(abs(value).max(), abs(self.start).max(), self.unit))

    def scales(self, value: np.ndarray) -> np.ndarray:
        """Sizes [w] of the values."""
        return self.sizes(value)

    def offset(self, value: np.ndarray) -> np.ndarray:
        """Step [w] from the start to the values."""
        return value - self.start


class PositiveNumbers(Unknown):
    """Positive parameter."""

    def moved(self, value: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Values after a step: linear upwards, exponential downwards, so that they stay positive."""
        down = np.maximum(value * np.exp(np.minimum(step, 0.0) / value), LEAST)  # a long step would come to zero itself
        return np.where(step >= 0, value + step, down)

    def sizes(self, value: np.ndarray) -> np.ndarray:
        """The values or their starting values, whichever is larger."""
        return np.maximum(value, self.start)


class Inertias(Unknown):
    """Physically consistent inertias about centres of mass, six numbers each."""

    def moved(self, value: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Inertias after a step in the coordinates of `PhysicalInertia`."""
        return INERTIA(_coordinates(value) + torch.from_numpy(step).reshape(-1, 6)).flatten().numpy()

    def slopes(self, value: np.ndarray) -> np.ndarray:
        """Derivatives of the inertias in those coordinates."""
        return torch.block_diag(*torch.func.vmap(torch.func.jacfwd(INERTIA))(_coordinates(value))).numpy()

    def sizes(self, value: np.ndarray) -> np.ndarray:
        """Ones, as those coordinates are logarithms and ratios."""
        return np.ones_like(value)

    def scales(self, value: np.ndarray) -> np.ndarray:
        """Diagonal entries, and geometric means of two for the products of inertia."""
        x, y, z = np.sqrt(np.maximum(value, self.start).reshape(-1, 6)[:, [0, 2, 5]]).T
        return np.stack([x * x, x * y, y * y, x * z, y * z, z * z], 1).ravel()

    def offset(self, value: np.ndarray) -> np.ndarray:
        """Step from the start to the inertias."""
        return (_coordinates(value) - _coordinates(self.start)).flatten().numpy()


def _coordinates(inertias: np.ndarray) -> Tensor:
    """Coordinates [links, 6] of inertias [6 links]."""
    return INERTIA.right_inverse(torch.from_numpy(inertias).reshape(-1, 6))


@dataclass(frozen=True)
class Unknowns:
    """All unknown parameters of a scene, their numbers one after the other [p]."""

    parts: tuple[Unknown, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the numbers [p]."""
        return tuple(label for part in self.parts for label in part.labels)

    @cached_property
    def start(self) -> np.ndarray:
        """Numbers [p] at the start."""
        return np.concatenate([part.start for part in self.parts])

    @property
    def delayed(self) -> bool:
        """Whether the delay of the inputs is unknown."""
        return any(not part.key for part in self.parts)

    def split(self, values: np.ndarray) -> list[np.ndarray]:
        """Numbers of every unknown."""
        return np.split(values, np.cumsum([len(part.at) for part in self.parts])[:-1])

    def by_name(self, values: np.ndarray) -> dict[str, Tensor]:
        """Numbers of every unknown, by its name."""
        return {part.name: torch.from_numpy(v) for part, v in zip(self.parts, self.split(values), strict=True)}

    def parameters(self, values: np.ndarray) -> dict[str, Tensor]:
        """Parameters of the scene, by their names in its programs."""
        return {part.key: part.filled(v) for part, v in zip(self.parts, self.split(values), strict=True) if part.key}

    def delay(self, values: np.ndarray) -> float:
        """Delay of the inputs [s]."""
        return float(self.by_name(values).get(DELAY, 0.0))

    def slopes(self, values: np.ndarray) -> np.ndarray:
        """Derivatives [p, p] of the numbers by a step."""
        own = zip(self.parts, self.split(values), strict=True)
        return torch.block_diag(*(torch.from_numpy(part.slopes(v)) for part, v in own)).numpy()

    def each(self, method: str, *numbers: np.ndarray) -> np.ndarray:
        """Results [p] of a method of every unknown, such as "sizes", on its part of some numbers [p]."""
        own = zip(self.parts, *map(self.split, numbers), strict=True)
        return np.concatenate([getattr(part, method)(*x) for part, *x in own])


def unknowns(scene: Scene, learn: str | Sequence[str]) -> Unknowns:
    """Unknown parameters of a scene; raises unless every name or pattern matches a learnable one."""
    known = _candidates(scene)
    words = (learn,) if isinstance(learn, str) else learn
    if not isinstance(words, Sequence) or not words or not all(isinstance(word, str) for word in words):
        raise ArgumentError(f"learn must be a name or several, found {learn!r}; known: {', '.join(known)}")
    chosen: dict[str, Unknown] = {}
    for word in words:
        found = {name: part for name, part in known.items() if fnmatchcase(name, word)}
        if not found:
            raise UnknownNameError("parameter to learn", word, known, every=True)
        chosen |= found
    for part in chosen.values():
        for label, x in zip(part.labels, part.start, strict=True):
            if isinstance(part, PositiveNumbers) and x <= 0:
                claim = f"{label} must start from a positive number, which says how large it may be"
                raise ArgumentError(f"{claim}, found 0; give the scene one")
    return Unknowns(tuple(chosen.values()))


def _candidates(scene: Scene) -> dict[str, Unknown]:
    """Learnable parameters of a scene, by name."""
    found = [Unknown(DELAY, "", (DELAY,), np.zeros(1), np.arange(1), scene.dt)]
    kinds = [type(effect).__name__ for effect in scene.effects]
    for owner, (kind, effect) in enumerate(zip(kinds, scene.effects, strict=True)):
        title = kind if kinds.count(kind) == 1 else f"{kind}{kinds[: owner + 1].count(kind)}"
        found += _parameters(scene, title, owner, effect)
    if scene.controller is not None:
        found += _parameters(scene, type(scene.controller).__name__, -1, scene.controller)
    robot = scene.robot
    for name in BODIES:
        x = getattr(robot, name).detach().double()
        if x.ndim == 1 + (name != "mass") and robot.mass.ndim == 1:
            places = np.arange(x.numel()).reshape(x.shape)[(robot.mass > 0).numpy()].ravel()
            found.append(_unknown(name, f"-2.{name}", x, name, places, robot.link_names))
    return {part.name: part for part in found}


def _parameters(scene: Scene, title: str, owner: int, part: Parametric) -> Iterator[Unknown]:
    """Learnable parameters of an effect or a controller: finite, without batch axes, and needing no further input."""
    robot = scene.robot
    for name, axes in part.SHAPES.items():
        value = tensor_of(getattr(part, name)).detach().double()
        if tuple(value.shape) != trailing(axes, robot.sizes) or not bool(value.isfinite().all()):
            continue
        inputs = [x.inputs(scene.n) for x in (part, replace(part, **{name: value})) if isinstance(x, Effect)]
        if inputs[:1] == inputs[1:]:
            body = (name, axes) in (("inertia", (6,)), ("com", (3,)))
            kind = name if body else "" if part.interval(name).signed else "mass"
            labels = robot.joint_names if axes == ("n",) else robot.link_names if axes == ("links",) else ()
            yield _unknown(f"{title}.{name}", f"{owner}.{name}", value, kind, np.arange(value.numel()), labels)


def _unknown(name: str, key: str, value: Tensor, kind: str, at: np.ndarray, owners: Sequence[str]) -> Unknown:
    """Unknown of a kind: "mass" for positive numbers, "com", "inertia", or "" for numbers of any sign."""
    each = value.numel() // max(len(owners), 1)
    parts = ("",) if each == 1 else (".x", ".y", ".z") if each == 3 else (".xx", ".xy", ".yy", ".xz", ".yz", ".zz")
    places = [f"[{owner}]" for owner in owners] or [""]
    labels = [f"{name}{place}{part}" for place in places for part in parts[:each]]
    flat = value.flatten().numpy().copy()
    if kind == "inertia":
        flat[at] = INERTIA(_coordinates(flat[at])).flatten().numpy()
    numbers = {"mass": PositiveNumbers, "inertia": Inertias}.get(kind, Unknown)
    whole, unit = flat.reshape(tuple(value.shape)), LENGTH if kind == "com" else 1.0
    return numbers(name, key, tuple(labels[k] for k in at.tolist()), whole, at, unit)


def changed(scene: Scene, found: Mapping[str, Tensor]) -> Scene:
    """Scene with replaced parameters, by "owner.name"; of two ordered parameters the upper is at least the lower."""
    values = dict(found)
    for k, effect in enumerate(scene.effects):
        ordered = {f"{k}.{name}": getattr(effect, name) for name in getattr(effect, "ORDERED", ())}
        if ordered.keys() & values.keys():
            lower, upper = (tensor_of(values.get(key, own)) for key, own in ordered.items())
            values[[*ordered][1]] = torch.maximum(lower, upper)
    return scene.with_parameters(values)
