"""Tree of links and joints.

Link 0 is the base: its parent is the world, and its joint is fixed or free. The parent of every other link comes
before it. The velocities of all joints form one row; a link has the slice of its joint, which may be empty.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.dynamics.joints import Fixed, Joint

WORLD = -1  # parent of the base
BASE = -1  # number of the base in descriptions, which number moving links from 0


class Link(NamedTuple):
    """Link, and the joint that connects it to its parent."""

    parent: int
    joint: Any  # a `Joint`
    placement: Any  # home pose in the parent, a pose or `aligned.Placement`; None: the frames coincide
    inertia: Any  # `Inertia` or `Moments` about the link frame's origin; None: no body
    armature: Number | None  # rotor inertia at the joint [kg m^2 or kg]
    v: slice  # velocities of the joint in the row of all velocities


class Tree(NamedTuple):
    """Links, every parent before its children, and gravity."""

    links: tuple[Link, ...]
    gravity: Pure | None  # acceleration in the world frame [m/s^2]

    @property
    def nv(self) -> int:
        """Number of degrees of freedom of all joints."""
        return self.links[-1].v.stop

    def bodies(self) -> range:
        """Indices of the links that move: a floating base, and all others."""
        return range(0 if self.links[0].joint.nv else 1, len(self.links))

    def rates(self, v: Sequence[Number] | None) -> list[Any]:
        """Twist of every link relative to its parent, or its rate if v are accelerations; None: zero."""
        return [link.joint.rate(None if v is None else v[link.v]) for link in self.links]

    def columns(self) -> list[tuple[int, Screw]]:
        """Link and screw of every degree of freedom."""
        return [(i, a) for i, link in enumerate(self.links) for a in link.joint.columns]

    def predecessors(self) -> tuple[int, ...]:
        """Predecessor of every degree of freedom on the path from the base; -1: none."""
        found: list[int] = []
        for link in self.links:
            before = -1
            for i in path(self.links, link.parent):
                if self.links[i].joint.nv:
                    before = self.links[i].v.stop - 1
                    break
            for _ in range(link.joint.nv):
                found.append(before)
                before = len(found) - 1
        return tuple(found)

    def with_armature(self, more: Sequence[Number]) -> Tree:
        """Tree with additional rotor inertia at its joints of one degree of freedom."""
        return self._replace(
            links=tuple(
                link if link.joint.nv != 1 else link._replace(armature=_plus(link.armature, more[link.v.start]))
                for link in self.links
            )
        )

    def with_bodies(self, more: Mapping[int, Any]) -> Tree:
        """Tree with further bodies on its links, by the links' indices."""
        links = list(self.links)
        for i, body in more.items():
            own = links[i].inertia
            links[i] = links[i]._replace(inertia=body if own is None else own.plus(body))
        return self._replace(links=tuple(links))


def _plus(a: Number | None, b: Number) -> Number:
    return b if a is None else a + b


def path(links: Sequence[Link], i: int) -> Iterator[int]:
    """Indices of the links on the path from link i to the base, i first."""
    while i != WORLD:
        yield i
        i = links[i].parent


def freedoms(link: Link) -> list[tuple[int, Screw]]:
    """Position in the row of velocities, and screw, of every degree of freedom of a joint."""
    return list(zip(range(link.v.start, link.v.stop), link.joint.columns, strict=True))


def on_base(
    parents: Sequence[int],
    joints: Sequence[Any],
    placements: Sequence[Any],
    inertias: Sequence[Any],
    armature: Sequence[Number] | None,
    gravity: Pure | None,
    base: Joint | None = None,
    base_inertia: Any = None,
) -> Tree:
    """Tree of moving links on a base, with velocities in the order of the links.

    Args:
        parents: parents of the moving links, which are numbered from 0; -1: the base.
        joints, placements, inertias, armature: those of the moving links.
        base: joint of the base; None: fixed.
        base_inertia: inertia of the base, in its frame; None: no body.
    """
    base = Fixed() if base is None else base
    links = [Link(WORLD, base, None, base_inertia, None, slice(0, base.nv))]
    rotors = armature or [None] * len(joints)
    for parent, joint, placement, inertia, rotor in zip(parents, joints, placements, inertias, rotors, strict=True):
        at = links[-1].v.stop
        links.append(Link(parent + 1, joint, placement, inertia, rotor, slice(at, at + joint.nv)))
    return Tree(tuple(links), gravity)
