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
from torchdq.effects.effect import listed
from torchdq.envs.scene import Scene
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot import Robot

ROTOR, DAMPING = 0.1, 1.0  # where a description has none [kg m^2 or kg, N m s/rad or N s/m]; common for geared arms
FRICTION = ((kinds.Viscous, "coefficient"), (kinds.Coulomb, "level"), (kinds.Stribeck, "coulomb"))


def usual(robot: Robot) -> tuple[Effect, ...]:
    """Effects of an ordinary arm: gravity, and joints with rotors, friction, limits and motors.

    Numbers are those of the description. Where it has none, rotors and damping are `ROTOR` and `DAMPING`, since
    without them small joints would turn faster than any motor does. Motors lose torque with speed if the limits of
    torque and velocity of all joints are known; if not, torques are only limited.
    """
    limits, rotors = robot.limits, listed(robot.armature)
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
    """A parameter of an effect that is drawn anew, uniformly, for every episode."""

    effect: int  # position among the scene's effects
    parameter: str
    lower: Tensor  # [width]
    upper: Tensor  # [width]

    @property
    def width(self) -> int:
        """How many random numbers it takes."""
        return len(self.lower)

    def tensor(self, scene: Scene) -> Tensor:
        """The scene's own tensor, a row per environment; what is written into it, the next step uses."""
        return getattr(scene.effects[self.effect], self.parameter)

    def draw(self, scene: Scene, rows: Tensor, u: Tensor) -> None:
        """Write new values into some rows; u are random numbers [k, width]."""
        values = self.lower + (self.upper - self.lower) * u
        target = self.tensor(scene)
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

    def vary(effect: Effect, parameter: str, lower: Tensor, upper: Tensor, at: int) -> None:
        shape = (num_envs, *(robot.n if axis == "n" else int(axis) for axis in effect.SHAPES[parameter]))
        found[at] = replace(effect, **{parameter: like.new_ones(shape)})
        drawn.append(Varied(at, parameter, lower.to(like), upper.to(like)))

    for name, half in sorted(half_widths.items()):  # the payload last: it does not grow with the link that holds it
        if not (isinstance(half, int | float) and 0 <= half < math.inf) or (name != "payload" and half >= 1):
            raise ArgumentError(
                f"randomise[{name!r}] must be {'a mass in kg' if name == 'payload' else 'a fraction from 0 to 1'}, "
                f"found {half!r}"
            )
        one = torch.ones(robot.n)
        if name == "mass":
            found.append(kinds.MassScale(1.0))
            vary(found[-1], "factor", one - half, one + half, len(found) - 1)
        elif name == "payload":
            found.append(kinds.Payload(0.0))
            vary(found[-1], "mass", torch.zeros(1), torch.full((1,), float(half)), len(found) - 1)
        elif name == "friction":
            there = [(i, e, p) for i, e in enumerate(found) for kind, p in FRICTION if isinstance(e, kind)]
            if not there:
                raise ArgumentError("randomise['friction'] needs effects with friction, found none; add Viscous()")
            for i, effect, parameter in there:
                value = _constant(getattr(effect, parameter))
                vary(effect, parameter, value * (1 - half), value * (1 + half), i)
        else:
            raise UnknownNameError("thing to randomise", name, ("mass", "friction", "payload"))
    return scene.replace(effects=(*found, *sensors)), tuple(drawn)
