"""The recursive dual-quaternion Newton-Euler algorithm: Algorithm 1, corrected, on trees.

With joint screws a_i in link frames and x_i = X_PB the pose of link i in its parent:

    outward  V_i = a_i qd_i + Ad(x_i*) V_p
             A_i = a_i qdd_i + Ad(x_i*) A_p + V_i x (a_i qd_i)
    inward   F_i = G_i(A_i) + V_i x G_i(V_i) - f_ext_i + sum over children c of Ad(x_c) F_c
             tau_i = F_i (.) swap(a_i)

V is a twist, A its rate plus the pull of gravity, F the wrench the parent exerts on link i; all about the link
frame's origin, in the link frame. Departs from the print where errata 38, 40, 42, 46, 47 and A1 say so.
"""

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.dynamics.absent import ad, ad_inverse, cross, momentum, neg, power, scale, total
from torchdq.dynamics.tree import BASE, Mechanism


class Base(NamedTuple):
    """Motion of the base, in the base frame: twist, and spatial acceleration less gravity; None: none."""

    V: Screw | None
    A: Screw | None


def base_at_rest(mechanism: Mechanism) -> Base:
    """A base that stands still: only gravity is felt, as the acceleration -eps g."""
    if mechanism.gravity is None:
        return Base(None, None)
    gx, gy, gz = mechanism.gravity
    return Base(None, ((0.0, 0.0, 0.0), (-gx, -gy, -gz)))  # Algorithm 1, initialisation


def outward(
    mechanism: Mechanism,
    Ad: Sequence[Adjoint],
    qd: Sequence[Number | None],
    qdd: Sequence[Number | None],
    base: Base,
) -> tuple[list, list]:
    """Twist V and acceleration A of every link, None where there is none (Algorithm 1, forward iteration)."""
    V: list[Screw | None] = []  # (53)
    A: list[Screw | None] = []  # (56)
    for link, Ad_PB, qd_i, qdd_i in zip(mechanism.links, Ad, qd, qdd, strict=True):
        V_P, A_P = base if link.parent == BASE else (V[link.parent], A[link.parent])
        rate = scale(qd_i, link.screw)
        carried = ad_inverse(Ad_PB, V_P)
        V.append(total(rate, carried))  # (40), erratum 40
        # (44), derived in (41) and (43), has V_i x (a qd); V_i may lose its own a qd, since a x a = 0
        A.append(total(scale(qdd_i, link.screw), ad_inverse(Ad_PB, A_P), cross(carried, rate)))  # (44), erratum 40
    return V, A


def inward(
    mechanism: Mechanism,
    Ad: Sequence[Adjoint],
    V: Sequence[Screw | None],
    A: Sequence[Screw | None],
    f_link: Sequence[Screw | None],
) -> list[Screw | None]:
    """Wrench F on every link from its parent (Algorithm 1, backward iteration); `f_link` is exerted by the links."""
    passed_on: list[list[Screw | None]] = [[] for _ in mechanism.links]
    F: list[Screw | None] = [None] * len(mechanism.links)  # (52)
    for i in reversed(range(len(mechanism.links))):
        link = mechanism.links[i]
        net = total(momentum(link, A[i]), cross(V[i], momentum(link, V[i])))  # (31), (45)
        F[i] = total(net, f_link[i], *passed_on[i])  # (46), (47), errata 46 and 47
        if link.parent != BASE:
            passed_on[link.parent].append(ad(Ad[i], F[i]))
    return F


def exerted_wrenches(
    n: int,
    f_ext: Sequence[Screw] | None,
    tip: tuple[int, Adjoint] | None,
    f_tip: Screw | None,
) -> list[Screw | None]:
    """Wrench each link exerts on the environment, in link frames: the tip's f_tip, less the f_ext it receives."""
    exerted = [None if f_ext is None else neg(f_ext[i]) for i in range(n)]
    if tip is not None and f_tip is not None:
        i, Ad_BE = tip
        exerted[i] = total(exerted[i], ad(Ad_BE, f_tip))
    return exerted


def rnea(
    mechanism: Mechanism,
    Ad: Sequence[Adjoint],
    qd: Sequence[Number] | None,
    qdd: Sequence[Number] | None,
    f_link: Sequence[Screw | None] | None = None,
    base: Base | None = None,
) -> list[Number | None]:
    """Joint torques tau_i = F_i (.) swap(a_i) + armature_i qdd_i; None where nothing acts on a joint."""
    n = len(mechanism.links)
    absent: list[None] = [None] * n
    qd, qdd, f_link = qd or absent, qdd or absent, f_link or absent
    V, A = outward(mechanism, Ad, qd, qdd, base or base_at_rest(mechanism))
    F = inward(mechanism, Ad, V, A, f_link)
    tau = [power(F_i, link.screw) for F_i, link in zip(F, mechanism.links, strict=True)]  # (48), erratum A1
    return [
        t if link.armature is None or a is None else (0.0 if t is None else t) + link.armature * a
        for t, a, link in zip(tau, qdd, mechanism.links, strict=True)
    ]
