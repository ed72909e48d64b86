"""Effects of one scene: resolved for its robot, and checked together."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Sequence

from torch import nn

from torchdq.base.caches import PROGRAMS, Bounded
from torchdq.effects.actuator import Actuator
from torchdq.effects.body import BodyEffect
from torchdq.effects.effect import Effect
from torchdq.effects.joint import JointEffect
from torchdq.effects.model import ModelEffect
from torchdq.effects.sensor import Sensor
from torchdq.effects.transmission import Transmission
from torchdq.errors import ArgumentError
from torchdq.robot import Robot
from torchdq.scene.controllers import Controller
from torchdq.scene.integrators import Integrator

SLOTS = (ModelEffect, JointEffect, Transmission, BodyEffect, Actuator, Sensor)
OWN = ("q", "qd", "X_WB", "V_WB_B", "memory", "reading", "torque", "reference", "noise")  # inputs of every scene
_told: Bounded[tuple[str, type[Effect]], bool] = Bounded(PROGRAMS)  # effects that take nothing, told once


def together(effects: Sequence[Effect], robot: Robot) -> tuple[Effect, ...]:
    """Effects with the numbers of a robot; raises if they cannot be those of one scene."""
    _check_effects(effects)
    resolved = tuple(effect.resolved(robot) for effect in effects)
    for asked, effect in zip(effects, resolved, strict=True):
        _tell_if_idle(asked, effect, robot)
    for effect in resolved:
        for name in effect.inputs(robot.n):
            if name in OWN:
                raise ArgumentError(
                    f"inputs of {type(effect).__name__} must not hold {name!r}, found in every scene; name it apart"
                )
    names = Counter(
        name
        for effect in resolved
        for name in (*effect.inputs(robot.n), *effect.computed(robot.n))
        if name not in effect.SHARED
    )
    for name, number in names.items():
        if number > 1:
            raise ArgumentError(f"the input {name!r} belongs to {number} effects; give them names of their own")
    return resolved


def require_free(robot: Robot, controller: Controller | None, integrator: Integrator) -> None:
    """Raise unless a robot can move, and controller and integrator serve its base: all of them do if it is fixed."""
    if not (robot.n or robot.floating):
        raise ArgumentError(
            f"robot {robot.name!r} must have a joint that moves or a free base to be simulated, found neither; "
            "where it is a single body, load it with base='floating'"
        )
    if robot.floating and controller is not None:
        raise ArgumentError(
            f"controller must be None for a robot with a free base, found {type(controller).__name__}, which commands "
            "joints of a robot with a fixed one; use effects.Servo, or compute torques with torchdq.floating"
        )
    if robot.floating and integrator.FIXED:
        raise ArgumentError(
            f"integrator must be one for robots with a free base, such as RungeKutta4, found "
            f"{type(integrator).__name__}: {integrator.FIXED}"
        )


def _check_effects(effects: Sequence[Effect]) -> None:
    """Raise if some effects cannot be those of one scene."""
    if isinstance(effects, str) or not isinstance(effects, Sequence):
        cure = "effects=(effects.Gravity(), effects.Viscous(0.1))"
        if isinstance(effects, Effect):
            cure = f"effects=({type(effects).__name__}(...),), with a comma"
        raise ArgumentError(f"effects must be a sequence of effects, found {effects!r}; write {cure}")
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ArgumentError(
                f"effects must be objects of torchdq.effects, found {effect!r}"
                + ("; it is a class, call it" if isinstance(effect, type) else "")
                + ("; give it by controller=..." if isinstance(effect, Controller) else "")
                + ("; what a module learned acts as effects.Residual(module)" if isinstance(effect, nn.Module) else "")
            )
        if not isinstance(effect, SLOTS):
            slots = ", ".join(slot.__name__ for slot in SLOTS)
            raise ArgumentError(f"{type(effect).__name__} must extend one of {slots}, found {type(effect).__bases__}")
    for effect in effects:
        name = type(effect).__name__
        if effect.ONCE and sum(other.ONCE == effect.ONCE for other in effects) > 1:
            raise ArgumentError(f"effects must not hold {name} twice: {effect.ONCE}")
        for source in effect.missing().values():
            for other in effects:
                if source in effect.SOLE and other is not effect and source in other.missing().values():
                    raise ArgumentError(
                        f"{name} and {type(other).__name__} would both take {effect.SOLE[source]}, so leave "
                        f"{type(other).__name__} out"
                    )


def _tell_if_idle(asked: Effect, effect: Effect, robot: Robot) -> None:
    """Warn, once for a robot, about an effect that takes its numbers from a description that has none."""
    sources, key = asked.missing(), (robot.name, type(effect))
    if not sources or not robot.n or not effect.idle() or key in _told:
        return
    _told[key] = True
    name, wanted = type(effect).__name__, " and ".join(sources)
    warnings.warn(
        f"{name} takes {wanted} from the description of robot {robot.name!r}, which has no "
        f"{' and '.join(sources.values())}: it acts on no joint; give {wanted}, or leave {name} out",
        stacklevel=5,
    )
