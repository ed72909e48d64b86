"""Facts about effects, computed by the package: operations, states, allowed values, and where an effect may be used."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

import torchdq
from pages.cases import CASES, built
from torchdq import Closure, Scene, effects
from torchdq.effects import Effect
from torchdq.effects.friction import of_layers
from torchdq.errors import TorchdqError
from torchdq.learning.identification import terms
from torchdq.learning.identification.terms import Term
from torchdq.robot import Robot
from torchdq.robot.fields import trailing

ARM = "panda"
TRIED = (-1.0, 0.0, 0.5, 1.0, 2.0, math.inf)  # values of a parameter


class Facts(NamedTuple):
    """Facts about an effect of a seven-joint arm, computed by the package: operations, states, places of use."""

    operations: int  # that it adds to a step, its parameters being numbers
    with_tensors: int | None  # the same, each sample having parameters of its own; None: it has none
    states: float  # numbers that it remembers, per joint or per point of a body
    noises: float  # random numbers per joint that a step takes
    inputs: tuple[str, ...]
    once: str
    slot: str
    scene: bool
    layer: bool
    identify: bool
    c: bool


@cache
def arm(name: str = "") -> Robot:
    """The seven-joint arm, for the effect of that name: elastic closures need a loop."""
    robot = torchdq.robots.load(ARM)
    loop = Closure(robot.frame_names[0], robot.end_effector().name, "weld")
    return robot.with_closures(loop) if name == "Closures" else robot


@cache
def operations(*parts: Effect) -> int:
    """Operations of a step of the arm with some effects."""
    return Scene(arm(*[type(part).__name__ for part in parts]), parts).count().total


def tensors_of(effect: Effect, robot: Robot, batch: int) -> Effect:
    """Effect with a tensor [batch, ...] instead of each number that differs from its default."""
    whole = effect.resolved(robot)
    defaults = {entry.name: entry.default for entry in dataclasses.fields(effect)}
    given = [name for name in whole.SHAPES if name in whole.DESCRIBED or getattr(effect, name) != defaults[name]]

    def spread(name: str) -> Tensor:
        shape = trailing(whole.SHAPES[name], robot.sizes)
        return torch.as_tensor(getattr(whole, name), dtype=torch.float64).expand(batch, *shape).clone()

    return dataclasses.replace(whole, **{name: spread(name) for name in given})


@cache
def facts(name: str) -> Facts:
    """Facts about the effect of that name."""
    robot, effect = arm(name), built(CASES[name].made)
    bare, n = operations(), robot.n
    differing = operations(tensors_of(effect, robot, 2)) - bare if effect.SHAPES else None
    return Facts(
        operations(effect) - bare,
        differing,
        effect.resolved(robot).memory(n) / (1 if effect.SLOT == "body" else n),
        effect.noises(n) / n,
        tuple(effect.inputs(n)),
        effect.ONCE,
        effect.SLOT,
        True,
        _works(lambda: of_layers([effect], robot)),
        type(effect) in identified(),
        not effect.outside(),
    )


def identified() -> set[type]:
    """Effects whose numbers `identify` finds; rotor inertia is a term that is no friction."""
    named = [x for x in vars(terms).values() if isinstance(x, Term)]
    found = {type(term.law) for term in (*named, *terms.SHAPES) if term.law is not None}
    return found | ({effects.RotorInertia} if any(term.described == "armature" for term in named) else set())


def kinds() -> list[type[Effect]]:
    """All public effects."""
    return [getattr(effects, name) for name in effects.__all__ if name not in ("Effect", "HeightMap")]


def allowed(effect: Effect, name: str, robot: Robot) -> str:
    """Text for the allowed values of a parameter, found by trying some."""
    if name not in effect.PARAMETERS:
        return ""
    axes = effect.PARAMETERS[name].axes
    if axes and not any(isinstance(axis, str) for axis in axes):
        return f"{axes[0]} numbers"
    ordered: Sequence[str] = getattr(effect, "ORDERED", ())
    together = ordered if name in ordered else (name,)

    def taken(x: float) -> bool:
        return _works(lambda: dataclasses.replace(effect, **dict.fromkeys(together, x)).resolved(robot))

    below, zero, half, one, two, infinite = map(taken, TRIED)
    if below:
        words = "any"
    elif zero:
        words = "≥ 0" if two else "≥ 0 and < 1" if half and not one else "0"
    else:
        words = "> 0" if half else "≥ 1"
    return words + (", may be infinite" if infinite else "")


def required(effect: Effect, name: str, robot: Robot) -> bool:
    """Whether a parameter must be given: None stands for nothing."""
    return not _works(lambda: dataclasses.replace(effect, **{name: None}).resolved(robot))


def _works(call: Any) -> bool:
    try:
        call()
    except TorchdqError:
        return False
    return True
