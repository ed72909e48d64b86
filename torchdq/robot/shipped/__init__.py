"""Robots that ship with the package: `torchdq.robots.load("panda")`, and `names()` of all of them.

two_link is the planar arm of the paper, panda, ur10e and puma560 are arms, panda_hand is an arm with a gripper, go2 a
quadruped; the file of each states where its numbers are from. Other robots are read by `torchdq.Robot.from_urdf` and
`Robot.from_mjcf`.
"""

from collections.abc import Callable

from torchdq.errors import UnknownNameError
from torchdq.robot.robot import Robot
from torchdq.robot.shipped import go2, panda, panda_hand, puma560, two_link, ur10e

__all__ = ["load", "names"]

ROBOTS: dict[str, Callable[[], Robot]] = {
    "two_link": two_link.build,
    "panda": panda.build,
    "panda_hand": panda_hand.build,
    "ur10e": ur10e.build,
    "puma560": puma560.build,
    "go2": go2.build,
}


def __dir__() -> list[str]:
    """Public names."""
    return __all__


def names() -> tuple[str, ...]:
    """Names of the shipped robots.

    >>> names()
    ('two_link', 'panda', 'panda_hand', 'ur10e', 'puma560', 'go2')
    """
    return tuple(ROBOTS)


def load(name: str) -> Robot:
    """Shipped robot of that name.

    Args:
        name: one of `names()`.
    Raises:
        UnknownNameError: there is no such robot; the message has the closest names.

    >>> load("two_link").n
    2
    """
    if name not in ROBOTS:
        raise UnknownNameError("shipped robot", name, ROBOTS)
    return ROBOTS[name]()
