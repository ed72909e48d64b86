"""Tree of links and joints of a robot, in numbers of any kind."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from torchdq.algebra.inertia import Inertia
from torchdq.dynamics.joints import KINDS
from torchdq.dynamics.tree import Tree, on_base
from torchdq.robot.fields import SHAPES

if TYPE_CHECKING:
    from torchdq.robot.robot import Robot


def general_tree(robot: Robot, values: Callable[[str], Any]) -> Tree:
    """Tree on a fixed base, in the link frames of the description.

    Args:
        robot: the robot.
        values: numbers of the tensor with a name, in a row or one row per link; None: absent.
    """
    bodies = zip(*map(values, ("mass", "com", "inertia")), strict=True)
    return on_base(
        robot.parents,
        [KINDS[kind]((s[:3], s[3:])) for kind, s in zip(robot.kinds, values("screw"), strict=True)],
        [(x[:4], x[4:]) for x in values("X_PB_home")],
        [Inertia.from_com(*body) for body in bodies],
        values("armature"),
        values("gravity"),
    )


def plain(robot: Robot, name: str) -> tuple | None:
    """Tensor of a robot without batch axes as nested tuples of numbers; None: absent."""
    value = getattr(robot, name)
    if value is None:
        return None
    return tuple(tuple(row) if isinstance(row, list) else row for row in value.tolist())


def unbound(robot: Robot, name: str) -> Sequence[Any] | None:
    """Tensor of a robot as nested lists of tensors of the batch axes; None: absent."""
    x = getattr(robot, name)
    if x is None:
        return None
    return x.unbind(-1) if len(SHAPES[name]) == 1 else [row.unbind(-1) for row in x.unbind(-2)]
