"""Robots that ship with the package, each with the source of its numbers."""

from collections.abc import Callable

from torchdq.errors import UnknownNameError
from torchdq.robot.robot import Robot
from torchdq.robot.shipped import go2, panda, puma560, two_link, ur10e

__all__ = ["load", "names"]

ROBOTS: dict[str, Callable[[], Robot]] = {
    "two_link": two_link.build,
    "panda": panda.build,
    "ur10e": ur10e.build,
    "puma560": puma560.build,
    "go2": go2.build,
}


def names() -> tuple[str, ...]:
    """Names of the shipped robots.

    >>> names()
    ('two_link', 'panda', 'ur10e', 'puma560', 'go2')
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
