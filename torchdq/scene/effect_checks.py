"""Checks of the effects of one scene: whether they fit together, and the shapes of what they return while recorded."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from torch import nn

from torchdq.algebra.screw import Screw
from torchdq.base.caches import PROGRAMS, Bounded
from torchdq.control.law import Law
from torchdq.dynamics.posed import Row
from torchdq.effects.actuator import Actuator
from torchdq.effects.body import BodyEffect, PointImpedance
from torchdq.effects.closures import Closures
from torchdq.effects.effect import Effect
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.effects.model import ModelEffect
from torchdq.effects.sensor import Sensor
from torchdq.effects.transmission import Transmission
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.objects import Object, resolved
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES, trailing
from torchdq.scene.integrators import Integrator, LinearlyImplicit

SLOTS = (ModelEffect, JointEffect, Transmission, BodyEffect, Closures, Actuator, Sensor)
OWN = (
    "q",
    "qd",
    "X_WB",
    "V_WB_B",
    "poses",
    "twists",
    "memory",
    "reading",
    "torque",
    "reference",
    "noise",
)  # inputs of every scene
_warned: Bounded[tuple[str, type[Effect]], bool] = Bounded(PROGRAMS)  # idle effects that a warning has named


def resolved_objects(objects: Sequence[Object], robot: Robot, integrator: Integrator) -> tuple[Object, ...]:
    """Objects with checked numbers; raises if they cannot be those of one scene."""
    found = resolved(objects, robot)
    if found and integrator.FIXED:
        raise ArgumentError(
            f"integrator must be one for free bodies, such as LinearlyImplicit, in a scene with objects, found "
            f"{type(integrator).__name__}: {integrator.FIXED}"
        )
    return found


def resolved_effects(
    effects: Sequence[Effect], robot: Robot, integrator: Integrator, objects: Sequence[Object] = ()
) -> tuple[Effect, ...]:
    """Effects with the numbers of a robot; raises if they cannot be those of one scene."""
    _require_compatible(effects)
    for effect in effects:
        if effect.IMPLICIT and not isinstance(integrator, LinearlyImplicit):
            raise ArgumentError(
                f"integrator must be LinearlyImplicit in a scene with {type(effect).__name__}, found {integrator}: "
                f"{effect.IMPLICIT}"
            )
    resolved = tuple(effect.among(robot, objects).resolved(robot) for effect in effects)
    for given, effect in zip(effects, resolved, strict=True):
        _warn_if_idle(given, effect, robot)
        for name in effect.inputs(robot.n):
            if name in OWN:
                raise ArgumentError(
                    f"inputs of {type(effect).__name__} must not hold {name!r}, found in every scene; rename it"
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


def _require_compatible(effects: Sequence[Effect]) -> None:
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
                + ("; it is a class; call it to make an object" if isinstance(effect, type) else "")
                + ("; give it by controller=..." if isinstance(effect, Law) else "")
                + ("; what a module learned acts as effects.Residual(module)" if isinstance(effect, nn.Module) else "")
            )
        if not isinstance(effect, SLOTS):
            slots = ", ".join(slot.__name__ for slot in SLOTS)
            raise ArgumentError(f"{type(effect).__name__} must extend one of {slots}, found {type(effect).__bases__}")
        name = type(effect).__name__
        if effect.ONCE and sum(getattr(other, "ONCE", "") == effect.ONCE for other in effects) > 1:
            raise ArgumentError(f"effects must not hold {name} twice: {effect.ONCE}")
    for effect in effects:
        for source in effect.missing().values():
            for other in effects:
                if source in effect.SOLE and other is not effect and source in other.missing().values():
                    raise ArgumentError(
                        f"{type(effect).__name__} and {type(other).__name__} would both take {effect.SOLE[source]}, so "
                        f"leave {type(other).__name__} out"
                    )


def _warn_if_idle(given: Effect, effect: Effect, robot: Robot) -> None:
    """Warn, once for a robot, about an effect that takes its numbers from a description that has none."""
    sources, key = given.missing(), (robot.name, type(effect))
    if not sources or not robot.n or not effect.idle() or key in _warned:
        return
    _warned[key] = True
    name, wanted = type(effect).__name__, " and ".join(sources)
    warnings.warn(
        f"{name} takes {wanted} from the description of robot {robot.name!r}, which has no "
        f"{' and '.join(sources.values())}: it acts on no joint; give {wanted}, or leave {name} out",
        stacklevel=5,
    )


def require_supported_base(robot: Robot, integrator: Integrator) -> None:
    """Raise unless a robot can move, and the integrator serves its base: all of them do if it is fixed."""
    if not (robot.n or robot.floating):
        raise ArgumentError(
            f"robot {robot.name!r} must have a joint that moves or a floating base to be simulated, found neither; "
            "where it is a single body, load it with base='floating'"
        )
    if (robot.floating or robot.closures) and integrator.FIXED:
        what = "a floating base" if robot.floating else "closures"
        raise ArgumentError(
            f"integrator must be one for robots with {what}, such as RungeKutta4, found "
            f"{type(integrator).__name__}: {integrator.FIXED}"
        )


# --- contributions of effects, while a step is recorded --------------------------------------------------------------


def impedances(effect: Effect, found: Any, n: int) -> Sequence[Impedance]:
    """Impedances of a joint effect; raises unless there is one for every joint, without constants below zero."""
    what = f"impedances of {type(effect).__name__}"
    number = len(found) if _is_row(found) and all(isinstance(z, Impedance) for z in found) else _kind(found)
    if number != n:
        raise ArgumentError(f"{what} must return one Impedance for each of {n} joints, found {number}")
    for i, z in enumerate(found):
        for name in ("damping", "stiffness", "per_load"):
            x = getattr(z, name)
            if isinstance(x, float | int) and not x >= 0:
                raise ArgumentError(
                    f"{name} in {what} must not be negative, found {x:g} at joint {i}: a step that uses it at its end "
                    f"would find no velocity; a torque that drives a joint belongs into force, as f = -tau"
                )
    return found


def row_and_memory(effect: Effect, method: str, found: Any, size: int, kept: int) -> tuple[Row, Row]:
    """Row of an actuator or a sensor and its memory; raises unless they have `size` and `kept` numbers."""
    what = f"{method} of {type(effect).__name__}"
    if not (isinstance(found, tuple) and len(found) == 2 and all(map(_is_row, found))):
        raise ArgumentError(f"{what} must return a row of {size} numbers and its memory, (row, ()) if it has none")
    for name, row, expected in (("row", found[0], size), ("memory", found[1], kept)):
        if len(row) != expected:
            raise ArgumentError(f"{what} must return a {name} of {expected} numbers, found {len(row)}")
    return found


def wrenches(effect: Effect, found: Any, links: int) -> Mapping[int, Screw]:
    """Wrenches of a body effect; raises unless they are pairs of three numbers on links from 0, the base, on."""
    what = f"wrenches of {type(effect).__name__}"
    if not isinstance(found, Mapping):
        raise ArgumentError(f"{what} must return a dict of wrenches by the links' numbers, found {_kind(found)}")
    for link, wrench in found.items():
        if not isinstance(link, int) or not 0 <= link <= links:
            raise ArgumentError(
                f"{what} must be on links from 0, the base, to {links}, found {link!r}; bodies.frame(name) has them"
            )
        if not _is_row(wrench, 2) or not all(x is None or _is_row(x, 3) for x in wrench):
            raise ArgumentError(f"{what} must be (force, moment) with three numbers each, found {_kind(wrench)}")
    return found


def points(effect: Effect, found: Any, links: int) -> Sequence[PointImpedance]:
    """Impedances of points; raises unless they are on links from 0, the base, on."""
    what = f"impedances of {type(effect).__name__}"
    if not _is_row(found) or not all(isinstance(point, PointImpedance) for point in found):
        raise ArgumentError(f"{what} must return a sequence of PointImpedance, found {_kind(found)}")
    for point in found:
        if not 0 <= point.link <= links:
            raise ArgumentError(f"{what} must be on links from 0, the base, to {links}, found {point.link!r}")
    return found


def kept(effects: Sequence[Effect], found: Row, n: int) -> Row:
    """Memory of effects on bodies at the end of a step; raises unless it has as many numbers as they state."""
    expected = sum(effect.memory(n) for effect in effects)
    if len(found) != expected:
        names = ", ".join(type(effect).__name__ for effect in effects)
        raise ArgumentError(f"kept in impedances of {names} must return {expected} numbers, found {len(found)}")
    return found


def changes(effect: Effect, found: Any, robot: Robot) -> Mapping[str, Row]:
    """Rows that a model effect changes; raises unless they are those of a robot, without constant masses below zero."""
    what = f"changed of {type(effect).__name__}"
    if not isinstance(found, Mapping):
        raise ArgumentError(f"{what} must return a dict of rows by the names of tensors, found {_kind(found)}")
    for name, row in found.items():
        if name not in SHAPES:
            raise UnknownNameError(f"tensor of a robot that {what} may return", name, SHAPES)
        size, number = math.prod(trailing(SHAPES[name], robot.sizes)), len(row) if _is_row(row) else _kind(row)
        if row is not None and number != size:
            raise ArgumentError(f"{name} from {what} must be a row of {size} numbers, found {number}")
        if name in ("mass", "armature") and any(isinstance(x, float | int) and not x >= 0 for x in row or ()):
            raise ArgumentError(f"{name} from {what} must not be negative, found {[*row]}")
    return found


def _is_row(x: Any, size: int | None = None) -> bool:
    return isinstance(x, Sequence) and not isinstance(x, str) and size in (None, len(x))


def _kind(x: Any) -> str:
    return f"{type(x).__name__} of {len(x)}" if _is_row(x) else type(x).__name__
