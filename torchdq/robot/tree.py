"""Tree of links and joints of a robot, in numbers of any kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from torchdq.algebra.inertia import Inertia
from torchdq.dynamics.joints import KINDS, Free
from torchdq.dynamics.tree import Tree, on_base
from torchdq.findings import Finding
from torchdq.robot.check import consistency
from torchdq.robot.description import NO_MASS
from torchdq.robot.fields import BASE_BODY, INERTIAL, SHAPES
from torchdq.robot.model import RobotModel, factors, present, require_unchanged

MASSLESS = Finding(
    NO_MASS,
    "",
    "something that moves must have mass",
    "none: kinematics only",
    "give links mass, as robot.with_rods does, or joints armature",
)


def general_tree(robot: RobotModel, values: Callable[[str], Any], free: bool = False) -> Tree:
    """Tree of all joints of a robot, in the link frames of the description, on a base that may be a free body.

    `values` has the numbers of the tensor with a name, in a row or one row per link; None: absent.
    """
    bodies = zip(*map(values, ("mass", "com", "inertia")), strict=True)
    return on_base(
        robot.parents,
        [KINDS[kind]((s[:3], s[3:])) for kind, s in zip(robot.kinds, values("screw"), strict=True)],
        [(x[:4], x[4:]) for x in values("X_PB_home")],
        [Inertia.from_com(*body) for body in bodies],
        None if robot.joint_map else values("armature"),
        values("gravity"),
        *((Free(), Inertia.from_com(*map(values, BASE_BODY))) if free else ()),
    )


def tree(robot: RobotModel) -> Tree:
    """Tree of the robot, with numbers that are tensors of the batch axes."""
    require_unchanged(robot)
    return general_tree(robot, partial(unbound, robot), robot.floating)


def massless(robot: RobotModel, overrides: Mapping[str, Any] | None = None) -> bool:
    """Whether nothing that moves has mass, inertia or a rotor; `overrides` replace tensors, None an absent one."""
    numbers = {name: bool(x.any()) for name, x in present(robot, INERTIAL).items()}
    numbers |= {name: row is not None for name, row in (overrides or {}).items() if name in INERTIAL}
    return bool(robot.link_names) and not any(numbers.values())


def inert_joints(robot: RobotModel) -> list[Finding]:
    """Faults of coordinates that move no inertia in any position, whatever the base does; one if no mass moves."""
    if massless(robot):
        return [MASSLESS]
    known = robot.every_joint
    faults = consistency.inert_joints(known, general_tree(robot, partial(plain, robot)))
    rotors = [0.0] * robot.n if robot.armature is None else robot.armature.tolist()
    followers = [[known[i] for i in column.nonzero().flatten().tolist()] for column in factors(robot).T]
    return [
        faults[names[0]]
        for names, rotor in zip(followers, rotors, strict=True)
        if not rotor and set(names) <= set(faults)
    ]


def plain(robot: RobotModel, name: str) -> Any:
    """Tensor of a robot without batch axes as nested tuples of numbers; None: absent."""
    value = getattr(robot, name)
    if value is None:
        return None
    if not SHAPES[name]:
        return value.item()
    return tuple(tuple(row) if isinstance(row, list) else row for row in value.tolist())


def unbound(robot: RobotModel, name: str) -> Any:
    """Tensor of a robot as nested lists of tensors of the batch axes; None: absent."""
    x = getattr(robot, name)
    if x is None or not SHAPES[name]:
        return x
    return x.unbind(-1) if len(SHAPES[name]) == 1 else [row.unbind(-1) for row in x.unbind(-2)]
