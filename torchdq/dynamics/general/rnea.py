"""Recursive dual-quaternion Newton-Euler algorithm: Algorithm 1, corrected, for trees with a fixed or moving base.

With joint screws a_i in link frames and x_i = X_PB the pose of link i in its parent:

    outward  V_i = a_i qd_i + Ad(x_i*) V_p
             A_i = a_i qdd_i + Ad(x_i*) A_p + V_i x (a_i qd_i)
    inward   F_i = G_i(A_i) + V_i x G_i(V_i) - f_ext_i + sum over children c of Ad(x_c) F_c
             tau_i = F_i (.) swap(a_i)

V is a twist, A its rate less the acceleration of gravity, F the wrench that the parent exerts on link i; all about the
link frame's origin, in the link frame. Departures from the print: errata 38, 40, 42, 46, 47 and A1.
"""

from collections.abc import Sequence

from torchdq.algebra import quaternion as quat
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.algebra.structural import add, cross, neg
from torchdq.dynamics.general.kinematics import momentum, to_link, to_parent
from torchdq.dynamics.tree import WORLD, Tree


def world_acceleration(tree: Tree) -> Screw | None:
    """Acceleration -eps g of the world, which stands for gravity."""
    return None if tree.gravity is None else (quat.ZERO, quat.neg(tree.gravity))  # Algorithm 1, initialisation


def outward(
    tree: Tree, Ad: Sequence[Adjoint | None], qd: Sequence[Number] | None, qdd: Sequence[Number] | None
) -> tuple[list, list]:
    """Twist V and acceleration A of every link; None: zero (Algorithm 1, forward iteration)."""
    V: list[Screw | None] = []  # (53)
    A: list[Screw | None] = []  # (56)
    for link, Ad_PB, rate, change in zip(tree.links, Ad, tree.rates(qd), tree.rates(qdd), strict=True):
        # the world does not move
        V_P, A_P = (None, world_acceleration(tree)) if link.parent == WORLD else (V[link.parent], A[link.parent])
        carried = to_link(Ad_PB, V_P)
        V.append(add(rate, carried))  # (40), erratum 40
        # (44), derived in (41) and (43), has V_i x (a qd); V_i may lose its own a qd, since a x a = 0
        A.append(add(change, to_link(Ad_PB, A_P), cross(carried, rate)))  # (44), erratum 40
    return V, A


def inward(
    tree: Tree,
    Ad: Sequence[Adjoint | None],
    V: Sequence[Screw | None],
    A: Sequence[Screw | None],
    f_link: Sequence[Screw | None],
) -> list[Screw | None]:
    """Wrench F on every link from its parent (Algorithm 1, backward iteration); `f_link` is exerted by the links."""
    passed_on: list[list[Screw | None]] = [[] for _ in tree.links]
    F: list[Screw | None] = [None] * len(tree.links)  # (52)
    for i in reversed(range(len(tree.links))):
        link = tree.links[i]
        net = add(momentum(link, A[i]), cross(V[i], momentum(link, V[i])))  # (31), (45)
        F[i] = add(net, f_link[i], *passed_on[i])  # (46), (47), errata 46 and 47
        if link.parent != WORLD:
            passed_on[link.parent].append(to_parent(Ad[i], F[i]))
    return F


def exerted_wrenches(
    n: int,
    f_ext: Sequence[Screw | None] | None,
    tip: tuple[int, Adjoint] | None,
    f_tip: Screw | None,
) -> list[Screw | None]:
    """Wrench that each link exerts on the environment, in link frames: f_tip at the tip, less f_ext on the link."""
    exerted = [None if f_ext is None else neg(f_ext[i]) for i in range(n)]
    if tip is not None and f_tip is not None:
        i, Ad_BE = tip
        exerted[i] = add(exerted[i], to_parent(Ad_BE, f_tip))
    return exerted


def rnea(
    tree: Tree,
    Ad: Sequence[Adjoint | None],
    qd: Sequence[Number] | None,
    qdd: Sequence[Number] | None,
    f_link: Sequence[Screw | None] | None = None,
) -> list[Number | None]:
    """Generalised forces tau_i = F_i (.) swap(a_i) + armature_i qdd_i; None: zero."""
    V, A = outward(tree, Ad, qd, qdd)
    F = inward(tree, Ad, V, A, f_link or [None] * len(tree.links))
    tau: list[Number | None] = []
    for F_i, link in zip(F, tree.links, strict=True):
        tau += [None] * link.joint.nv if F_i is None else link.joint.project(F_i)  # (48), erratum A1
        if link.armature is not None and qdd is not None:
            tau[-1] = (0.0 if tau[-1] is None else tau[-1]) + link.armature * qdd[link.v.start]
    return tau
