"""Kinetic and potential energy."""

from collections.abc import Sequence

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.dynamics.tree import Tree


def kinetic_energy(tree: Tree, V: Sequence[Screw | None], qd: Sequence[Number]) -> Number:
    """Kinetic energy 1/2 sum of G_i(V_i) (.) swap(V_i), rotors included [J]."""
    twice = 0.0
    for link, V_i in zip(tree.links, V, strict=True):
        if V_i is not None and link.inertia is not None:
            twice = twice + screw.power(link.inertia.momentum(V_i), V_i)
        if link.armature is not None:
            rate = qd[link.v.start]
            twice = twice + link.armature * (rate * rate)
    return 0.5 * twice


def potential_energy(gravity: Pure | None, first: Pure | None) -> Number:
    """Potential energy -g . (sum of m p_com) [J]; zero if the common centre of mass is at the world's origin.

    Args:
        gravity: acceleration in the world frame [m/s^2]; None: none.
        first: first moments of all moving bodies about the world's origin [kg m]; None: no body.
    """
    return 0.0 if gravity is None or first is None else -quat.dot(gravity, first)
