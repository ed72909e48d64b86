"""Several robots in one batch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchdq.errors import ArgumentError
from torchdq.robot.arrays import equal
from torchdq.robot.description import Limits
from torchdq.robot.edit.replaced import replace
from torchdq.robot.fields import SHAPES
from torchdq.robot.model import AnyRobot, batches, present, require_unchanged, values

# fields that the robots of a stack may have different values of
STACKED = (*SHAPES, "limits", "damping", "friction")


def stack(cls: type[AnyRobot], robots: Sequence[AnyRobot]) -> AnyRobot:
    """Batch of robots with equal trees, as one robot with a new leading axis.

    Tensors that are equal in all robots stay as they are; if all are equal, the masses have the new axis. The name
    is that of the first robot.

    >>> import torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> torchdq.Robot.stack([robot, robot.replace(mass=2 * robot.mass)]).mass
    tensor([[1., 1.],
            [2., 2.]], dtype=torch.float64)
    """
    if not robots or not all(isinstance(robot, cls) for robot in robots):
        raise ArgumentError(f"robots must be a sequence of torchdq.Robot, found {robots!r}")
    first, notes = robots[0], dict.fromkeys(note for robot in robots for note in robot.notes)
    changes: dict[str, Any] = {"notes": tuple(notes)}
    for robot in robots:
        require_unchanged(robot)
        for field, x in present(robot, SHAPES).items():
            mine = getattr(first, field)
            if mine is not None and (mine.dtype, mine.device) != (x.dtype, x.device):
                raise ArgumentError(
                    f"robots of a stack must have one dtype and device, found {field} with {mine.dtype} on "
                    f"{mine.device} and with {x.dtype} on {x.device}; convert them by robot.to(dtype, device)"
                )
        for field, axes in batches(robot).items():
            raise ArgumentError(
                f"robots of a stack must have no batch axes, found {axes} of {field} in robot {robot.name!r}; stack "
                "the single robots"
            )
    for name, value in values(first).items():
        found = [getattr(robot, name) for robot in robots]
        if name in ("name", "notes") or all(equal(value, other) for other in found):
            continue
        if name not in STACKED:
            pair = value, next(x for x in found if not equal(value, x))
            if all(isinstance(x, tuple) for x in pair) and len(pair[0]) == len(pair[1]):  # what differs in them
                pair = next(two for two in zip(*pair, strict=True) if not equal(*two))
            raise ArgumentError(f"robots of a stack must have the same {name}, found {pair[0]} and {pair[1]}")
        changes[name] = Limits(*map(_stacked, zip(*found, strict=True))) if name == "limits" else _stacked(found)
    if not {*SHAPES} & {*changes}:  # equal robots are several, too
        changes["mass"] = _stacked([robot.mass for robot in robots])
    return replace(first, **changes)


def _stacked(found: Sequence[Tensor | None]) -> Tensor:
    zero = torch.zeros_like(next(x for x in found if x is not None))
    return torch.stack(torch.broadcast_tensors(*(zero if x is None else x for x in found)))
