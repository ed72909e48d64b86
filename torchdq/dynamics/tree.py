"""The robot as the algorithms see it: a tree of links whose every constant is a number."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from torchdq.algebra import quaternion
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw, Symmetric, inertia_about_origin

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


def path(links: Sequence, i: int) -> Iterator[int]:
    """Indices from link i down to the link on the base, i first."""
    while i != BASE:
        yield i
        i = links[i].parent


def mechanism(
    parents: Sequence[int],
    kinds: Sequence[str],
    X_PB_home: Sequence[Sequence[Number]],
    screw: Sequence[Sequence[Number]],
    mass: Sequence[Number],
    com: Sequence[Pure],
    inertia: Sequence[Sequence[Number]],
    gravity: Pure | None,
    armature: Sequence[Number] | None,
) -> Mechanism:
    """Mechanism of a robot's numbers, whose inertias are about the centres of mass: xx xy yy xz yz zz."""
    links = []
    for i, (parent, kind) in enumerate(zip(parents, kinds, strict=True)):
        x, s, m, c = X_PB_home[i], screw[i], mass[i], com[i]
        xx, xy, yy, xz, yz, zz = inertia[i]
        links.append(
            Link(
                parent=parent,
                kind=kind,
                X_PB_home=(tuple(x[:4]), tuple(x[4:])),
                screw=(tuple(s[:3]), tuple(s[3:])),
                mass=m,
                first=quaternion.scale(m, c),
                second=inertia_about_origin(m, c, ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))),
                armature=None if armature is None else armature[i],
            )
        )
    return Mechanism(tuple(links), gravity)
