"""What an environment simulates unless it is told, and what differs from one of its episodes to the next."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq import effects as kinds
from torchdq.effects import Effect
from torchdq.effects.effect import owned
from torchdq.envs.scene import Scene
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot import Robot

ROTOR, DAMPING = 0.1, 1.0  # where a description has none [kg m^2 or kg, N m s/rad or N s/m]; common for geared arms
# effects with friction, and which of their parameters grow and shrink together
FRICTION = (
    (kinds.Viscous, ("coefficient",)),
    (kinds.Coulomb, ("level",)),
    (kinds.Stribeck, ("coulomb", "static")),
)


def usual(robot: Robot) -> tuple[Effect, ...]:
    """Effects of an ordinary arm: gravity, and joints with rotors, friction, limits and motors.

    Numbers are those of the description. Where it has none, rotors and damping are `ROTOR` and `DAMPING`, since
    without them small joints would turn faster than any motor does. Motors lose torque with speed if the limits of
    torque and velocity of all joints are known; if not, torques are only limited.
    """
    limits, rotors = robot.limits, owned(robot, robot.armature)
    found: list[Effect] = [
        kinds.Gravity(),
        kinds.RotorInertia((ROTOR,) * robot.n if rotors is None else rotors),
        kinds.Viscous(tuple(d if d > 0 else DAMPING for d in robot.damping.tolist())),
    ]
    if bool((robot.friction > 0).any()):
        found.append(kinds.Coulomb())
    if bool((limits.lower.isfinite() | limits.upper.isfinite()).any()):
        found.append(kinds.Limits())
    both = torch.stack([limits.effort, limits.velocity])
    if bool((both.isfinite() & (both > 0)).all()):
        found.append(kinds.TorqueSpeed())
    elif bool(limits.effort.isfinite().any()):
        found.append(kinds.Saturation())
    return tuple(found)


def nominal(scene: Scene) -> Robot:
    """The rigid bodies as a controller may know them: as described, with the scene's gravity and rotors.

    Friction, payloads and whatever differs between episodes it does not know.
    """
    known: dict[str, Tensor | None] = {"gravity": None, "armature": None}
    for effect in scene.effects:
        if isinstance(effect, kinds.Gravity):
            known["gravity"] = _constant(effect.acceleration)
        if isinstance(effect, kinds.RotorInertia):
            known["armature"] = _constant(effect.inertia)
    return scene.robot.replace(**known).bake()


def _constant(x: Tensor | Sequence[float]) -> Tensor:
    """One value of a parameter; the mean of those that differ from sample to sample."""
    x = torch.as_tensor(x, dtype=torch.float64)
    return x.reshape(-1, x.shape[-1]).mean(0)


class Varied(NamedTuple):
    """Parameters of an effect that are drawn anew for every episode: what they are, times one factor per number."""

    effect: int  # position among the scene's effects
    bases: dict[str, Tensor]  # by parameter, [width] or [N, width]
    lower: float  # bounds of the factor
    upper: float

    @property
    def width(self) -> int:
        """How many random numbers it takes."""
        return next(iter(self.bases.values())).shape[-1]

    def tensors(self, scene: Scene) -> dict[str, Tensor]:
        """The scene's own tensors, a row per environment; what is written into them, the next step uses."""
        return {name: getattr(scene.effects[self.effect], name) for name in self.bases}

    def draw(self, scene: Scene, rows: Tensor, u: Tensor) -> None:
        """Write new values into some rows; u are random numbers [k, width]."""
        factor = self.lower + (self.upper - self.lower) * u
        for name, target in self.tensors(scene).items():
            base = self.bases[name]
            values = (base if base.ndim == 1 else base[rows]) * factor
            target.index_copy_(0, rows, values.reshape(-1, *target.shape[1:]))


def varied(
    scene: Scene, half_widths: Mapping[str, float], num_envs: int, like: Tensor
) -> tuple[Scene, tuple[Varied, ...]]:
    """A scene with a row of parameters per environment, its sensors last, and what is to be drawn of them.

    Args:
        scene: effects that are missing are added.
        half_widths: "mass": every link heavier or lighter by up to this fraction, inertia included; "friction": that
            of every joint and friction effect likewise; "payload": up to this mass held by the end effector [kg].
        num_envs: number of environments.
        like: a tensor whose dtype and device the parameters have.
    """
    robot = scene.robot
    found = [e for e in scene.effects if e.SLOT != "sensor"]
    sensors = [e for e in scene.effects if e.SLOT == "sensor"]
    drawn: list[Varied] = []

    def vary(at: int, parameters: Sequence[str], lower: float, upper: float) -> None:
        effect, bases, rows = found[at], {}, {}
        for name in parameters:
            value = torch.as_tensor(getattr(effect, name)).to(like)
            bases[name] = value.reshape(*value.shape, 1) if not effect.SHAPES[name] else value
            rows[name] = like.new_ones((num_envs, *(robot.n if a == "n" else int(a) for a in effect.SHAPES[name])))
        found[at] = replace(effect, **rows)
        drawn.append(Varied(at, bases, lower, upper))

    for name, half in sorted(half_widths.items()):  # the payload last: it does not grow with the link that holds it
        if not (isinstance(half, int | float) and 0 <= half < math.inf) or (name != "payload" and half >= 1):
            raise ArgumentError(
                f"randomise[{name!r}] must be {'a mass in kg' if name == 'payload' else 'a fraction from 0 to 1'}, "
                f"found {half!r}"
            )
        if name == "mass":
            found.append(kinds.MassScale((1.0,) * robot.n))
            vary(len(found) - 1, ("factor",), 1 - half, 1 + half)
        elif name == "payload":
            found.append(kinds.Payload(float(half)))
            vary(len(found) - 1, ("mass",), 0.0, 1.0)
        elif name == "friction":
            there = [(i, names) for i, e in enumerate(found) for kind, names in FRICTION if isinstance(e, kind)]
            if not there:
                raise ArgumentError("randomise['friction'] needs effects with friction, found none; add Viscous()")
            for i, names in there:
                vary(i, names, 1 - half, 1 + half)
        else:
            raise UnknownNameError("thing to randomise", name, ("mass", "friction", "payload"))
    return scene.replace(effects=(*found, *sensors)), tuple(drawn)
