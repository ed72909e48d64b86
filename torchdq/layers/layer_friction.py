"""Friction of a layer: its effects, and which of their numbers it learns, under which names."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchdq.base.checks import tensor_of
from torchdq.effects.friction import Coulomb, Friction, Viscous, of_layers
from torchdq.effects.resistance import Parts, parts
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import TENSOR
from torchdq.layers.parametrizations import Fraction, Positive
from torchdq.robot import Robot

INITIAL = 1e-2  # initial value of a coefficient that is learned and is not given [SI]


class LayerFriction(NamedTuple):
    """Friction effects of a layer."""

    effects: tuple[Friction, ...]  # resolved; what is learned has its initial value
    learned: Mapping[str, tuple[int, str]]  # position of the effect and its parameter, by the quantity's name
    fixed: Parts  # the effects with a tensor, not named yet, for everything that is learned

    def parts(self, values: Mapping[str, Tensor]) -> Parts:
        """Effects for programs, with the present values of what is learned, by quantity."""
        own = {f"{k}.{parameter}": values[quantity] for quantity, (k, parameter) in self.learned.items()}
        return Parts(self.fixed.templates, {**self.fixed.tensors, **own})

    def present(self, values: Mapping[str, Any]) -> tuple[Friction, ...]:
        """Effects with the present values of what is learned, by quantity."""
        found = list(self.effects)
        for quantity, (k, parameter) in self.learned.items():
            found[k] = replace(found[k], **{parameter: values[quantity]})
        return tuple(found)

    def initial(self) -> dict[str, Tensor]:
        """Initial values [n] of what is learned."""
        found = {name: tensor_of(getattr(self.effects[k], p)).detach() for name, (k, p) in self.learned.items()}
        return {name: x.to(torch.float64).where(x != 0, INITIAL) for name, x in found.items()}

    def constraint(self, quantity: str) -> type[Positive | Fraction] | None:
        """Parametrisation of a learned quantity; None: it may have any value."""
        k, parameter = self.learned[quantity]
        check = self.effects[k].interval(parameter)
        return Fraction if check.below < math.inf else None if check.signed else Positive


def layer_friction(robot: Robot, effects: Sequence[Friction], learn: bool, width: float) -> LayerFriction:
    """Friction of a layer, checked.

    Args:
        robot: the robot.
        effects: those that are given.
        learn: whether their linear parameters are learned; if none are given, those of viscous and Coulomb friction.
        width: of that Coulomb friction [rad/s or m/s].
    """
    if learn and not effects:
        effects = (Viscous(), Coulomb(sign_width=width))
    resolved = of_layers(effects, robot, learn)
    learned: dict[str, tuple[int, str]] = {}
    for k, effect in enumerate(resolved if learn else ()):
        if effect.ORDERED:
            low, high = effect.ORDERED
            raise ArgumentError(
                f"learn must not name 'friction' with {type(effect).__name__} among it, whose {low} an optimiser could "
                f"move above {high}; learn others, or find its numbers by torchdq.learning.identify"
            )
        for parameter in effect.LINEAR:
            name = effect.LEARNED_AS.get(parameter, f"{type(effect).__name__.lower()}_{parameter}")
            if name in learned:
                raise ArgumentError(f"learn must not name 'friction' with {type(effect).__name__} twice among it")
            learned[name] = (k, parameter)
    fixed = list(resolved)
    for k, parameter in learned.values():
        fixed[k] = replace(fixed[k], **{parameter: TENSOR})
    return LayerFriction(resolved, learned, parts(fixed, robot.n))


def described(robot: Robot, width: float) -> LayerFriction:
    """Friction of a robot's description; none if all of it is zero."""
    there = bool((robot.damping != 0).any() or (robot.friction != 0).any())
    return layer_friction(robot, (Viscous(), Coulomb(sign_width=width)) if there else (), False, width)
