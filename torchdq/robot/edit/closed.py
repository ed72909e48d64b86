"""Robots whose links are held together in loops."""

from __future__ import annotations

from typing import get_args

from torchdq.base.checks import require_choice
from torchdq.errors import ArgumentError
from torchdq.robot.description import Closure, ClosureKind
from torchdq.robot.edit.replaced import replace
from torchdq.robot.model import AnyRobot


def with_closures(robot: AnyRobot, *closures: Closure) -> AnyRobot:
    """Robot of which pairs of frames are held together, besides those that are already.

    Scenes and `forward_dynamics` keep them together by forces between the two links; `torchdq.closed` gives positions
    at which they are. A file in URDF has no place for them: its loops are cut at a joint, with a frame (a link without
    a mass, on a fixed joint) on either side.

    Raises:
        ArgumentError: frames of a closure are on one link.
        UnknownNameError: the robot has no frame of that name.

    >>> import torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> robot.with_closures(torchdq.Closure("base", "tip")).closures
    (Closure(frame_a='base', frame_b='tip', kind='point'),)
    """
    for closure in closures:
        if not isinstance(closure, Closure):
            raise ArgumentError(f"closures must be torchdq.Closure(frame_a, frame_b, kind), found {closure!r}")
        require_choice("kind of a closure", closure.kind, get_args(ClosureKind))
        a, b = robot.frame(closure.frame_a), robot.frame(closure.frame_b)
        if a.link == b.link:
            raise ArgumentError(
                f"frames of a closure must be on different links, found {a.name!r} and {b.name!r} on one; what is "
                "fixed to one link is held together anyway"
            )
    return replace(robot, closures=(*robot.closures, *closures))
