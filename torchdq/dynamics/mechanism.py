"""The robot as the algorithms see it: a tree of links whose every constant is a number."""

from collections.abc import Iterator
from typing import NamedTuple

from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw, Symmetric

BASE = -1  # parent index of a link that hangs on the base


class Link(NamedTuple):
    """A moving link B and the joint that carries it on its parent P."""

    parent: int
    kind: str  # "revolute", "prismatic" or "helical"
    X_PB_home: DualQuaternion  # delta_i^{i-1}
    screw: Screw  # a_i, in B
    mass: Number  # [kg]
    first: Pure | None  # m c about B's origin [kg m]; None: B's origin is the centre of mass
    second: Symmetric  # about B's origin [kg m^2]
    armature: Number | None  # rotor inertia seen at the joint [kg m^2 or kg]


class Mechanism(NamedTuple):
    """A tree of links; every parent comes before its children."""

    links: tuple[Link, ...]
    gravity: Pure | None  # acceleration, in the base frame [m/s^2]


class Coordinate(NamedTuple):
    """A joint's displacement from home, with the cosine and sine of half of it."""

    value: Number
    cos: Number
    sin: Number


def path(links: tuple[Link, ...], i: int) -> Iterator[int]:
    """Indices from link i down to the link on the base, i first."""
    while i != BASE:
        yield i
        i = links[i].parent
