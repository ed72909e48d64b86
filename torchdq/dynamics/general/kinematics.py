"""Poses, adjoint columns and Jacobians: forward kinematics of section 5.1 of the paper."""

from collections.abc import Sequence
from typing import Any

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.dynamics.tree import WORLD, Link, Tree, freedoms, path


def compose(x: DualQuaternion | None, y: DualQuaternion | None) -> DualQuaternion | None:
    """Product of poses; None is the identity."""
    return y if x is None else x if y is None else dq.mul(x, y)


def joint_poses(tree: Tree, q: Sequence[Any]) -> tuple[DualQuaternion | None, ...]:
    """Pose X_PB of every link in its parent: delta_i^{i-1} exp(a_i dq_i/2); None: the frames coincide.

    Args:
        q: coordinates of every joint, beginning with the base: a `Coordinate`, a pose, or None if it is fixed.
    """
    return tuple(
        compose(link.placement, link.joint.motion(q_i)) for link, q_i in zip(tree.links, q, strict=True)
    )  # (38), erratum 38


def adjoints(X_PB: Sequence[DualQuaternion | None]) -> tuple[Adjoint | None, ...]:
    """Columns A_P, A_D of the pose of every joint, for both directions."""
    return tuple(None if x is None else screw.columns(x) for x in X_PB)  # (34), (35)


def to_link(Ad_PB: Adjoint | None, m: Screw | None) -> Any:
    """Screw in the link's frame, given in the parent's; `Ad_PB` is None if the frames coincide."""
    return m if Ad_PB is None or m is None else screw.ad(screw.inverse(Ad_PB), m)


def to_parent(Ad_PB: Adjoint | None, m: Screw | None) -> Any:
    """Screw in the parent's frame, given in the link's."""
    return m if Ad_PB is None or m is None else screw.ad(Ad_PB, m)


def momentum(link: Link, V: Screw | None) -> Screw | None:
    """Momentum G_i(V) of a link; None without a body or without motion."""
    return None if link.inertia is None or V is None else link.inertia.momentum(V)  # (32)


def link_poses(tree: Tree, X_PB: Sequence[DualQuaternion | None]) -> tuple[DualQuaternion, ...]:
    """Pose X_WB of every link in the world: the product of the joint poses on its path."""
    X_WB: list[DualQuaternion | None] = []
    for link, x in zip(tree.links, X_PB, strict=True):
        X_WB.append(x if link.parent == WORLD else compose(X_WB[link.parent], x))  # (39)
    return tuple(dq.ONE if x is None else x for x in X_WB)


def joint_screws(tree: Tree, Ad: Sequence[Adjoint | None], i: int) -> dict[int, Screw]:
    """Screws of the degrees of freedom on the path from link i to the base, in link i's frame."""
    screws = {}
    to_i: Adjoint | None = None  # Ad(x_j^i)
    for j in path(tree.links, i):
        for k, a in freedoms(tree.links[j]):
            screws[k] = a if to_i is None else screw.ad(to_i, a)
        step = Ad[j]
        if step is not None:
            to_i = screw.inverse(step) if to_i is None else screw.compose(to_i, screw.inverse(step))
    return screws


def jacobian(tree: Tree, Ad: Sequence[Adjoint | None], i: int, X_BF: DualQuaternion | None) -> tuple[Screw | None, ...]:
    """Columns of the Jacobian of a frame F fixed to link i, in F; None for velocities that do not move it."""
    screws = joint_screws(tree, Ad, i)
    if X_BF is not None:
        to_frame = screw.inverse(screw.columns(X_BF))
        screws = {k: screw.ad(to_frame, a) for k, a in screws.items()}
    return tuple(screws.get(k) for k in range(tree.nv))
