"""Checks of what effects contribute to a step, while it is recorded; an effect of one's own is named with its fault."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torchdq.algebra.screw import Screw
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Effect
from torchdq.effects.joint import Impedance
from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot import Robot
from torchdq.robot.fields import SHAPES, trailing


def impedances(effect: Effect, found: Any, n: int) -> Sequence[Impedance]:
    """Impedances of a joint effect; raises unless there is one for every joint, without constants below zero."""
    what, expected = f"impedances of {type(effect).__name__}", f"one Impedance for each of {n} joints"
    if not _sequence(found) or not all(isinstance(z, Impedance) for z in found):
        raise ArgumentError(f"{what} must return {expected}, found {_kind(found)}")
    if len(found) != n:
        raise ArgumentError(f"{what} must return {expected}, found {len(found)}")
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
    if not (isinstance(found, tuple) and len(found) == 2 and all(map(_sequence, found))):
        raise ArgumentError(f"{what} must return a row of {size} numbers and its memory, (row, ()) if it has none")
    for name, row, expected in (("row", found[0], size), ("memory", found[1], kept)):
        if len(row) != expected:
            raise ArgumentError(f"{what} must return a {name} of {expected} numbers, found {len(row)}")
    return found


def wrenches(effect: Effect, found: Any, links: int) -> dict[int, Screw]:
    """Wrenches of a body effect; raises unless they are pairs of three numbers on links from 0, the base, on."""
    what = f"wrenches of {type(effect).__name__}"
    if not isinstance(found, Mapping):
        raise ArgumentError(f"{what} must return a dict of wrenches by the links' numbers, found {_kind(found)}")
    for link, wrench in found.items():
        if not isinstance(link, int) or not 0 <= link <= links:
            raise ArgumentError(
                f"{what} must be on links from 0, the base, to {links}, found {link!r}; bodies.frame(name) has them"
            )
        pair = _sequence(wrench) and len(wrench) == 2
        if not pair or not all(x is None or (_sequence(x) and len(x) == 3) for x in wrench):
            raise ArgumentError(f"{what} must be (force, moment) with three numbers each, found {_kind(wrench)}")
    return dict(found)


def changes(effect: Effect, found: Any, robot: Robot) -> dict[str, Row]:
    """Rows that a model effect changes; raises unless they are those of a robot, without constant masses below zero."""
    what = f"changed of {type(effect).__name__}"
    if not isinstance(found, Mapping):
        raise ArgumentError(f"{what} must return a dict of rows by the names of tensors, found {_kind(found)}")
    for name, row in found.items():
        if name not in SHAPES:
            raise UnknownNameError(f"tensor of a robot that {what} may return", name, SHAPES)
        size = 1
        for axis in trailing(SHAPES[name], robot.sizes):
            size *= axis
        if row is not None and (not _sequence(row) or len(row) != size):
            counted = str(len(row)) if _sequence(row) else _kind(row)
            raise ArgumentError(f"{name} from {what} must be a row of {size} numbers, found {counted}")
        if name in ("mass", "armature") and any(isinstance(x, float | int) and not x >= 0 for x in row or ()):
            raise ArgumentError(f"{name} from {what} must not be negative, found {[*row]}")
    return dict(found)


def _sequence(x: Any) -> bool:
    return isinstance(x, Sequence) and not isinstance(x, str)


def _kind(x: Any) -> str:
    return f"{type(x).__name__} of {len(x)}" if _sequence(x) else type(x).__name__
