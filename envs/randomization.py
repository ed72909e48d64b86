"""Domain randomisation: parameters of a scene that are drawn for every episode."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.effects import MassScale, Payload
from torchdq.envs.scene import Scene
from torchdq.errors import ArgumentError, UnknownNameError


class Randomised(NamedTuple):
    """Parameters of an effect that are drawn for every episode: their bases times one factor per number."""

    effect: int  # position among the scene's effects
    bases: dict[str, Tensor]  # by parameter, [width] or [N, width]
    lower: float  # bounds of the factor
    upper: float

    @property
    def width(self) -> int:
        """Number of random numbers that a draw takes."""
        return next(iter(self.bases.values())).shape[-1]

    def tensors(self, scene: Scene) -> dict[str, Tensor]:
        """The scene's own tensors, a row per environment; the next step uses what is written into them."""
        return {name: getattr(scene.effects[self.effect], name) for name in self.bases}

    def draw(self, scene: Scene, rows: Tensor, u: Tensor) -> None:
        """Write new values into some rows; u are random numbers [k, width]."""
        factor = self.lower + (self.upper - self.lower) * u
        for name, target in self.tensors(scene).items():
            base = self.bases[name]
            values = (base if base.ndim == 1 else base[rows]) * factor
            target.index_copy_(0, rows, values.reshape(-1, *target.shape[1:]))


def randomised(
    scene: Scene, half_widths: Mapping[str, float], num_envs: int, like: Tensor
) -> tuple[Scene, tuple[Randomised, ...]]:
    """Scene with a row of parameters per environment, its sensors last, and the parameters to draw.

    Args:
        scene: effects that are missing are added.
        half_widths: "mass": every link heavier or lighter by up to this fraction, inertia included; "friction": the
            friction of every joint and effect likewise; "payload": up to this mass held by the end effector [kg].
        num_envs: number of environments.
        like: a tensor whose dtype and device the parameters have.
    """
    robot = scene.robot
    found = [e for e in scene.effects if e.SLOT != "sensor"]
    sensors = [e for e in scene.effects if e.SLOT == "sensor"]
    drawn: list[Randomised] = []

    def randomise(at: int, parameters: Sequence[str], lower: float, upper: float) -> None:
        effect, bases, rows = found[at], {}, {}
        for name in parameters:
            value = torch.as_tensor(getattr(effect, name)).to(like)
            bases[name] = value.reshape(*value.shape, 1) if not effect.SHAPES[name] else value
            rows[name] = like.new_ones((num_envs, *(robot.n if a == "n" else int(a) for a in effect.SHAPES[name])))
        found[at] = replace(effect, **rows)
        drawn.append(Randomised(at, bases, lower, upper))

    for name, half in sorted(half_widths.items()):  # the payload last: it does not grow with the link that holds it
        if not (isinstance(half, int | float) and 0 <= half < math.inf) or (name != "payload" and half >= 1):
            raise ArgumentError(
                f"randomise[{name!r}] must be {'a mass in kg' if name == 'payload' else 'a fraction from 0 to 1'}, "
                f"found {half!r}"
            )
        if name == "mass":
            found.append(MassScale((1.0,) * robot.n))
            randomise(len(found) - 1, ("factor",), 1 - half, 1 + half)
        elif name == "payload":
            found.append(Payload(float(half)))
            randomise(len(found) - 1, ("mass",), 0.0, 1.0)
        elif name == "friction":
            there = [i for i, effect in enumerate(found) if effect.SCALES]
            if not there:
                raise ArgumentError("randomise['friction'] needs effects with friction, found none; add Viscous()")
            for i in there:
                randomise(i, found[i].SCALES, 1 - half, 1 + half)
        else:
            raise UnknownNameError("thing to randomise", name, ("mass", "friction", "payload"))
    return scene.replace(effects=(*found, *sensors)), tuple(drawn)
