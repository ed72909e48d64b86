"""Changes of a robot: one that happened in place, values for its fields, and several robots as one batch."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.compiler import is_compiling

from torchdq.errors import ArgumentError, UnknownNameError
from torchdq.robot import consistency, fields, units
from torchdq.robot.constants import version
from torchdq.robot.description import Limits
from torchdq.robot.fields import SHAPES, batches
from torchdq.robot.tree import general_tree, plain

if TYPE_CHECKING:
    from torchdq.robot.robot import Robot

# fields that the robots of a stack may have different values of
STACKED = (*SHAPES, "limits", "damping", "friction")


def values(robot: Robot) -> dict[str, Any]:
    """Values of the public fields of a robot, by name."""
    return {name: value for name, value in vars(robot).items() if not name.startswith("_")}


def require_unchanged(robot: Robot, replaced: Collection[str] = ()) -> None:
    """Raise if a constant tensor was changed in place or requires grad: programs have its numbers, not the tensor.

    Changes through `x.data` and `x.numpy()` are not seen, since torch does not count them. Tensors with the names
    `replaced` may require grad.
    """
    if is_compiling():
        return
    if any(map(version, robot._storages)):
        constant = {name: x for name, x in values(robot).items() if name not in ("notes", *robot._arguments)}
        names = robot._constants.changed(constant) or ["a tensor"]  # type: ignore[union-attr]
        raise ArgumentError(
            f"{', '.join(names)} of robot {robot.name!r} was changed in place, but its programs still have the numbers "
            f"of before; load the robot again and use robot.replace({names[0]}=...)"
        )
    for name, x in fields.present(robot, SHAPES).items():
        if x.requires_grad and name not in (*replaced, *robot._arguments):
            raise ArgumentError(
                f"{name} of robot {robot.name!r} requires grad, but is a constant of its programs and would get no "
                f"gradient; use robot.replace({name}={name}) with a tensor that requires grad"
            )


def require_fields(robot: Robot, changes: Mapping[str, Any]) -> None:
    """Raise unless changes are new values for fields of a robot, of their kind and length."""
    known = values(robot)
    for name in changes:
        if name not in known:
            raise UnknownNameError(f"field of robot {robot.name!r}", name, known)
    require_unchanged(robot, changes)
    fields.require_structure(robot.name, robot.n, changes)


def faults_of(robot: Robot, changes: Collection[str]) -> list[str]:
    """Faults of changed fields that the notes do not tell of; raises unless the tip is a frame."""
    if {"tip", "frames"} & set(changes) and robot.tip is not None:
        robot.frame(robot.tip)
    known = {_without_numbers(note) for note in robot.notes}
    return [fault for fault in fields.faults(robot, changes) if _without_numbers(fault) not in known]


def _without_numbers(fault: str) -> str:
    return fault.partition(", found")[0]


def check(robot: Robot) -> None:
    """Raise unless a robot can exist; see `Robot.check`."""
    require_unchanged(robot)
    names = values(robot)
    fields.require_structure(robot.name, robot.n, names)
    faults = fields.faults(robot, names, everything=True)
    if not faults and not fields.batches(robot):
        faults = consistency.inert_joints(robot.joint_names, general_tree(robot, partial(plain, robot)))
    consistency.complain(robot.name, faults, "error")
    units.doubts(robot)


# --- robots in one batch ---------------------------------------------------------------------------------------------


def stacked(kind: type[Robot], robots: Sequence[Robot]) -> Robot:
    """Batch of robots; see `Robot.stack`."""
    if not robots or not all(isinstance(robot, kind) for robot in robots):
        raise ArgumentError(f"robots must be a sequence of torchdq.Robot, found {robots!r}")
    first, notes = robots[0], dict.fromkeys(note for robot in robots for note in robot.notes)
    changes: dict[str, Any] = {"notes": tuple(notes)}
    for robot in robots:
        require_unchanged(robot)
        for field, axes in batches(robot).items():
            raise ArgumentError(
                f"robots of a stack must have no batch axes, found {axes} of {field} in robot {robot.name!r}; stack "
                "the single robots"
            )
    for name, value in values(first).items():
        found = [getattr(robot, name) for robot in robots]
        if name in ("name", "notes") or all(_equal(value, other) for other in found):
            continue
        if name not in STACKED:
            other = next(x for x in found if not _equal(value, x))
            raise ArgumentError(f"robots of a stack must have the same {name}, found {value} and {other}")
        changes[name] = Limits(*map(_together, zip(*found, strict=True))) if name == "limits" else _together(found)
    return first.replace(**changes)


def _together(found: Sequence[Tensor | None]) -> Tensor:
    """Tensors along a new leading axis; absent ones are zero."""
    zero = torch.zeros_like(next(x for x in found if x is not None))
    return torch.stack(torch.broadcast_tensors(*(zero if x is None else x for x in found)))


def _equal(a: Any, b: Any) -> bool:
    """Whether two values of a field are equal; a tensor that requires grad equals only itself."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        return a is b or (not (a.requires_grad or b.requires_grad or a.dtype != b.dtype) and torch.equal(a, b))
    if isinstance(a, tuple) and isinstance(b, tuple):
        return len(a) == len(b) and all(map(_equal, a, b))
    return type(a) is type(b) and bool(a == b)
