"""The mass matrix of an aligned mechanism, by composite bodies."""

from collections.abc import Sequence

from torchdq.algebra import quaternion as quat
from torchdq.algebra.matrix import Rows
from torchdq.algebra.quaternion import Number, Pure
from torchdq.dynamics.aligned.tree import Aligned, AlignedLink, Body, Step, carried, joined, to_parent
from torchdq.dynamics.tree import BASE


def unit_momentum(link: AlignedLink, body: Body) -> tuple[Pure, Pure]:
    """Momentum (linear, angular about the origin) of a body under a unit rate of the link's joint."""
    m, (hx, hy, _), (xx, _, yy, xz, yz, _) = body
    slide: tuple[Pure, Pure] = ((0.0, 0.0, m), (hy, -hx, 0.0))
    spin: tuple[Pure, Pure] = ((-hy, hx, 0.0), (-xz, -yz, xx + yy))
    if link.kind == "revolute":
        return spin
    if link.kind == "prismatic":
        return slide
    return (
        quat.add(spin[0], quat.scale(link.pitch, slide[0])),
        quat.add(spin[1], quat.scale(link.pitch, slide[1])),
    )


def along(link: AlignedLink, momentum: tuple[Pure, Pure]) -> Number:
    """Part of a momentum, or wrench, that a joint feels."""
    if link.kind == "revolute":
        return momentum[1][2]
    if link.kind == "prismatic":
        return momentum[0][2]
    return momentum[1][2] + link.pitch * momentum[0][2]


def composites(aligned: Aligned, steps: Sequence[Step]) -> list[Body]:
    """Everything that each joint carries, as one body in its frame."""
    links = aligned.links
    found = [link.body for link in links]
    for i in reversed(range(len(links))):
        parent = links[i].parent
        if parent != BASE:
            found[parent] = joined(found[parent], carried(links[i], steps[i], found[i]))
    return found


def _own(link: AlignedLink, momentum: tuple[Pure, Pure]) -> Number:
    """Entry of the diagonal, rotor included."""
    entry = along(link, momentum)
    return entry if link.armature is None else entry + link.armature


def diagonal(aligned: Aligned, steps: Sequence[Step]) -> tuple[Number, ...]:
    """Diagonal of the mass matrix."""
    bodies = zip(aligned.links, composites(aligned, steps), strict=True)
    return tuple(_own(link, unit_momentum(link, body)) for link, body in bodies)


def mass_matrix(aligned: Aligned, steps: Sequence[Step]) -> Rows:
    """Mass matrix M(q); entries of joints that are on no common path are None."""
    links = aligned.links
    n = len(links)
    composite = composites(aligned, steps)
    M: list[list[Number | None]] = [[None] * n for _ in range(n)]
    for i in reversed(range(n)):
        link = links[i]
        linear, angular = unit_momentum(link, composite[i])
        M[i][i] = _own(link, (linear, angular))
        j = i
        while links[j].parent != BASE:
            linear = to_parent(links[j], steps[j], linear)
            angular = quat.add(to_parent(links[j], steps[j], angular), quat.cross(steps[j].p, linear))
            j = links[j].parent
            M[i][j] = M[j][i] = along(links[j], (linear, angular))
    return tuple(tuple(row) for row in M)
