"""Unknown parameters of a scene, by name, and how a step of least squares changes them.

The names are those of `fit_rollout(learn=...)`: "Viscous.coefficient", "PD.kp", "Coulomb2.level" for the second of two
effects of a class, "mass", "com" and "inertia" of the links with mass, and "delay" of all inputs.

A step is taken in the parameters themselves where they may have any sign. Positive ones grow along the step and fall
along the exponential with the same slope, so that they stay positive, and friction, which enters linearly, is still
found in few steps, however small it was. Inertias move in the coordinates of `torchdq.layers.parametrizations`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from functools import cached_property, partial

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import tensor_of
from torchdq.effects.effect import Effect, Parametric
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.layers.parametrizations import PhysicalInertia
from torchdq.robot.fields import trailing
from torchdq.scene.scene import Scene

DELAY = "delay"
BODIES = ("mass", "com", "inertia")  # parameters of the links
LEAST = 1e-9  # least value of a parameter that is positive [SI]
LENGTH = 0.1  # least size of a change of a centre of mass [m]
INERTIA = PhysicalInertia()


@dataclass(frozen=True)
class SignedNumbers:
    """Parameters of any sign, to which steps add."""

    unit: float = 1.0  # least size of a step [SI]

    def moved(self, value: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Values [w] after a step [w]."""
        return value + step

    def slopes(self, value: np.ndarray) -> np.ndarray:
        """Derivatives [w, w] of the values by a step."""
        return np.eye(len(value))

    def sizes(self, value: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Sizes of steps [w] that change the values by as much as they are, or as they were at the start."""
        return np.full(len(value), max(abs(value).max(), abs(start).max(), self.unit))

    def scales(self, value: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Sizes [w] of the values."""
        return self.sizes(value, start)

    def offset(self, value: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Step [w] from the start to the values."""
        return value - start


@dataclass(frozen=True)
class PositiveNumbers(SignedNumbers):
    """Parameters that are positive, and stay so."""

    def moved(self, value: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Values after a step, along a line up and along the exponential of the same slope down."""
        down = np.maximum(value * np.exp(np.minimum(step, 0.0) / value), LEAST)  # a long step would come to zero itself
        return np.where(step >= 0, value + step, down)

    def sizes(self, value: np.ndarray, start: np.ndarray) -> np.ndarray:
        """The values, or those at the start where they were larger."""
        return np.maximum(value, start)


@dataclass(frozen=True)
class Inertias(SignedNumbers):
    """Inertias about centres of mass, six numbers each, physically consistent."""

    def moved(self, value: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Inertias after a step in the coordinates in which all bodies can exist."""
        return INERTIA(self._coordinates(value) + torch.from_numpy(step).reshape(-1, 6)).flatten().numpy()

    def slopes(self, value: np.ndarray) -> np.ndarray:
        """Derivatives of the inertias in those coordinates."""
        found = torch.func.vmap(torch.func.jacfwd(INERTIA))(self._coordinates(value))
        return torch.block_diag(*found).numpy()

    def sizes(self, value: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Ones, as those coordinates are logarithms and ratios."""
        return np.ones_like(value)

    def scales(self, value: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Principal entries, and the roots of the products of two for those off the diagonal."""
        x, y, z = np.sqrt(np.maximum(value, start).reshape(-1, 6)[:, [0, 2, 5]]).T
        return np.stack([x * x, x * y, y * y, x * z, y * z, z * z], 1).ravel()

    def offset(self, value: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Step from the start to the inertias."""
        return (self._coordinates(value) - self._coordinates(start)).flatten().numpy()

    def _coordinates(self, value: np.ndarray) -> Tensor:
        """Coordinates [links, 6] of inertias."""
        return INERTIA.right_inverse(torch.from_numpy(value).reshape(-1, 6))


@dataclass(frozen=True)
class Unknown:
    """Parameter of a scene that is estimated."""

    name: str  # "Viscous.coefficient"
    key: str  # its name in the programs of the scene, "1.coefficient"; "": the delay of the inputs
    labels: tuple[str, ...]  # one for each number, "Viscous.coefficient[elbow]"
    coordinates: SignedNumbers
    whole: np.ndarray  # the parameter with all its numbers, at the start
    at: np.ndarray  # [w] places of the estimated numbers among them

    @property
    def start(self) -> np.ndarray:
        """Estimated numbers [w] at the start."""
        return self.whole.ravel()[self.at]

    def filled(self, value: np.ndarray) -> Tensor:
        """Parameter with the estimated numbers [w] in their places."""
        flat = self.whole.flatten()
        flat[self.at] = value
        return torch.from_numpy(flat.reshape(self.whole.shape))


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

    def parameters(self, values: np.ndarray) -> dict[str, Tensor]:
        """Parameters of the scene, by their names in its programs."""
        return {part.key: part.filled(v) for part, v in zip(self.parts, self.split(values), strict=True) if part.key}

    def delay(self, values: np.ndarray) -> float:
        """Delay of the inputs [s]."""
        return next((float(v[0]) for part, v in zip(self.parts, self.split(values), strict=True) if not part.key), 0.0)

    def moved(self, values: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Numbers [p] after a step [p]."""
        return self._each("moved", values, step)

    def slopes(self, values: np.ndarray) -> np.ndarray:
        """Derivatives [p, p] of the numbers by a step."""
        own = zip(self.parts, self.split(values), strict=True)
        return torch.block_diag(*(torch.from_numpy(part.coordinates.slopes(v)) for part, v in own)).numpy()

    def sizes(self, values: np.ndarray) -> np.ndarray:
        """Steps [p] as large as the numbers, or as they were at the start."""
        return self._each("sizes", values, self.start)

    def scales(self, values: np.ndarray) -> np.ndarray:
        """Sizes [p] of the numbers."""
        return self._each("scales", values, self.start)

    def offset(self, values: np.ndarray) -> np.ndarray:
        """Step [p] from the start to the numbers."""
        return self._each("offset", values, self.start)

    def _each(self, method: str, *numbers: np.ndarray) -> np.ndarray:
        """Results of a method of the coordinates of every unknown, on its part of some numbers [p]."""
        own = zip(self.parts, *map(self.split, numbers), strict=True)
        return np.concatenate([getattr(part.coordinates, method)(*x) for part, *x in own])


def unknowns(scene: Scene, learn: str | Sequence[str]) -> Unknowns:
    """Unknown parameters of a scene; raises unless every name or pattern is one that can be learned."""
    known = _candidates(scene)
    words = (learn,) if isinstance(learn, str) else learn
    if not isinstance(words, Sequence) or not words or not all(isinstance(word, str) for word in words):
        raise ArgumentError(f"learn must be a name or several, found {learn!r}; known: {', '.join(known)}")
    chosen = []
    for word in words:
        found = [name for name in known if fnmatchcase(name, word)]
        if not found:
            raise UnknownNameError("parameter to learn", word, known, every=True)
        chosen += found
    parts = tuple(known[name]() for name in dict.fromkeys(chosen))
    for part in parts:
        zero = [k for k, x in enumerate(part.start.tolist()) if x <= 0]
        if zero and isinstance(part.coordinates, PositiveNumbers):
            raise ArgumentError(
                f"{part.labels[zero[0]]} must start from a positive number, which says how large it may be, found 0; "
                "give the scene one"
            )
    return Unknowns(parts)


def _candidates(scene: Scene) -> dict[str, Callable[[], Unknown]]:
    """Everything of a scene that can be learned, by name, as functions that return it."""
    found = {DELAY: lambda: Unknown(DELAY, "", (DELAY,), SignedNumbers(scene.dt), np.zeros(1), np.arange(1))}
    kinds = [type(effect).__name__ for effect in scene.effects]
    for owner, (kind, effect) in enumerate(zip(kinds, scene.effects, strict=True)):
        title = kind if kinds.count(kind) == 1 else f"{kind}{kinds[: owner + 1].count(kind)}"
        found.update(_parameters(scene, title, owner, effect))
    if scene.controller is not None:
        found.update(_parameters(scene, type(scene.controller).__name__, -1, scene.controller))
    robot = scene.robot
    for name in BODIES:
        x = getattr(robot, name).detach().double()
        if x.ndim == 1 + (name != "mass") and robot.mass.ndim == 1:
            places = np.arange(x.numel()).reshape(x.shape)[(robot.mass > 0).numpy()].ravel()
            found[name] = partial(_unknown, name, f"-2.{name}", x, name, places, robot.link_names)
    return found


def _parameters(scene: Scene, title: str, owner: int, part: Parametric) -> dict[str, Callable[[], Unknown]]:
    """Parameters of an effect or a controller that can be learned: finite numbers without batch axes.

    One that is absent, and with which the scene would ask for a further input, cannot.
    """
    found: dict[str, Callable[[], Unknown]] = {}
    for name, axes in part.SHAPES.items():
        value = tensor_of(getattr(part, name)).detach().double()
        if tuple(value.shape) != trailing(axes, scene.robot.sizes) or not bool(value.isfinite().all()):
            continue
        inputs = [x.inputs(scene.n) for x in (part, replace(part, **{name: value})) if isinstance(x, Effect)]
        if inputs[:1] == inputs[1:]:
            body = (name, axes) in (("inertia", (6,)), ("com", (3,)))
            kind = name if body else "" if name in part.SIGNED else "mass"
            labels = scene.robot.joint_names if axes == ("n",) else scene.robot.link_names if axes == ("links",) else ()
            called, at = f"{title}.{name}", np.arange(value.numel())
            found[called] = partial(_unknown, called, f"{owner}.{name}", value, kind, at, labels)
    return found


def _unknown(name: str, key: str, value: Tensor, kind: str, at: np.ndarray, owners: Sequence[str]) -> Unknown:
    """Unknown of a kind: "mass" for positive numbers, "com", "inertia", or "" for numbers of any sign."""
    coordinates = {"mass": PositiveNumbers(), "inertia": Inertias(), "com": SignedNumbers(LENGTH)}.get(
        kind, SignedNumbers()
    )
    flat = value.flatten().numpy().copy()
    if kind == "inertia":
        flat[at] = coordinates.moved(flat[at], np.zeros(len(at)))
    each = value.numel() // max(len(owners), 1)
    parts = ("",) if each == 1 else (".x", ".y", ".z") if each == 3 else (".xx", ".xy", ".yy", ".xz", ".yz", ".zz")
    places = [f"[{owner}]" for owner in owners] or [""]
    labels = [f"{name}{place}{part}" for place in places for part in parts[:each]]
    return Unknown(name, key, tuple(labels[k] for k in at.tolist()), coordinates, flat.reshape(tuple(value.shape)), at)


def changed(scene: Scene, found: Mapping[str, Tensor]) -> Scene:
    """Scene with parameters instead of its own, by "owner.name"; the higher of two that have an order is not lower."""
    values = dict(found)
    for k, effect in enumerate(scene.effects):
        ordered = {f"{k}.{name}": getattr(effect, name) for name in getattr(effect, "ORDERED", ())}
        if ordered.keys() & values.keys():
            lower, upper = (tensor_of(values.get(key, own)) for key, own in ordered.items())
            values[[*ordered][1]] = torch.maximum(lower, upper)
    return scene.with_parameters(values)
