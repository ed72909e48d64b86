"""Mass matrix by composite rigid bodies.

The inertias of all links that a joint moves are summed into one composite body. The momentum of this body for a unit
rate of the joint, transformed along the path to another joint, gives their entry of the mass matrix.

The transformation of an inertia and of a wrench from link i to its parent is an argument, so the algorithm serves both
forms of a robot.
"""

from collections.abc import Callable, Sequence

from torchdq.algebra import screw
from torchdq.algebra.matrix import Matrix
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.dynamics.tree import Tree, freedoms, path


def composites(tree: Tree, carried: Callable) -> list:
    """Composite inertias: in link i's frame, of all links that joint i moves; None: no body.

    Args:
        carried: takes the index of a link and an inertia in its frame, returns this inertia in the parent's frame.
    """
    found: list = [link.inertia for link in tree.links]
    for i in reversed(range(1, len(found))):
        if found[i] is not None:
            parent, inertia = tree.links[i].parent, carried(i, found[i])
            found[parent] = inertia if found[parent] is None else found[parent].plus(inertia)
    return found


def diagonal(tree: Tree, composite: Sequence) -> list[Number]:
    """Diagonal of the mass matrix, rotors included."""
    entries: list[Number] = []
    for link, inertia in zip(tree.links, composite, strict=True):
        for _, a in freedoms(link):
            entry = 0.0 if inertia is None else screw.power(inertia.momentum(a), a)
            entries.append(entry if link.armature is None else entry + link.armature)
    return entries


def mass_matrix(tree: Tree, composite: Sequence, to_parent: Callable[[int, Screw], Screw]) -> Matrix:
    """Mass matrix M(q), exactly symmetric; None for degrees of freedom on different branches.

    Args:
        composite: from `composites`.
        to_parent: takes the index of a link and a wrench in its frame, returns this wrench in the parent's frame.
    """
    M: list[list[Number | None]] = [[None] * tree.nv for _ in range(tree.nv)]
    for k, entry in enumerate(diagonal(tree, composite)):
        M[k][k] = entry
    for i, inertia in enumerate(composite):
        for k, a in freedoms(tree.links[i]):
            momentum = None if inertia is None else inertia.momentum(a)
            below = i
            for j in path(tree.links, i):
                if momentum is None:
                    break
                if j != i:
                    momentum = to_parent(below, momentum)
                below = j
                for l, b in freedoms(tree.links[j]):
                    if l < k:
                        M[k][l] = M[l][k] = screw.power(momentum, b)
    return tuple(map(tuple, M))
