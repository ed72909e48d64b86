"""Poses, adjoint columns and Jacobians: the forward kinematics of section 5.1."""

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.dynamics.tree import BASE, Coordinate, Link, Mechanism, path


def joint_motion(link: Link, q: Coordinate) -> DualQuaternion:
    """Motion exp(a_i dq/2) of a joint; the only place that knows joint types."""
    if link.kind == "revolute":
        return screw.exp_revolute(link.screw, q.cos, q.sin)  # (27), erratum 25
    if link.kind == "prismatic":
        return screw.exp_prismatic(link.screw[1], q.value)  # (27)
    return screw.exp_helical(link.screw, q.value, q.cos, q.sin)  # (27)


def joint_poses(mechanism: Mechanism, q: Sequence[Coordinate]) -> tuple[DualQuaternion, ...]:
    """Pose X_PB of every link in its parent: delta_i^{i-1} exp(a_i dq_i/2)."""
    return tuple(
        dq.mul(link.X_PB_home, joint_motion(link, q_i)) for link, q_i in zip(mechanism.links, q, strict=True)
    )  # (38), erratum 38


def adjoints(X_PB: Sequence[DualQuaternion]) -> tuple[Adjoint, ...]:
    """Columns A_P, A_D of every joint's pose, built once and used in both directions."""
    return tuple(screw.columns(x) for x in X_PB)  # (34), (35)


def link_poses(mechanism: Mechanism, X_PB: Sequence[DualQuaternion]) -> tuple[DualQuaternion, ...]:
    """Pose X_WB of every link in the base frame: the product of the joint poses on its path."""
    X_WB: list[DualQuaternion] = []
    for link, x in zip(mechanism.links, X_PB, strict=True):
        X_WB.append(x if link.parent == BASE else dq.mul(X_WB[link.parent], x))  # (39)
    return tuple(X_WB)


class FromBase(NamedTuple):
    """Pose of a link as what its joints did to the one at home: X_WB = motion home."""

    motion: DualQuaternion
    home: DualQuaternion


def link_poses_from_base(mechanism: Mechanism, q: Sequence[Coordinate]) -> tuple[FromBase, ...]:
    """Pose of every link, by screws that are given in the base frame.

    One product less per joint than `link_poses` where few poses are wanted, if the robot's geometry is constant.
    """
    homes = link_poses(mechanism, [link.X_PB_home for link in mechanism.links])
    found: list[FromBase] = []
    for link, q_i, home in zip(mechanism.links, q, homes, strict=True):
        s = screw.ad(screw.columns(home), link.screw)
        step = joint_motion(link._replace(screw=s), q_i)
        motion = step if link.parent == BASE else dq.mul(found[link.parent].motion, step)  # (39)
        found.append(FromBase(motion, home))
    return tuple(found)


def joint_screws(mechanism: Mechanism, Ad: Sequence[Adjoint], i: int) -> dict[int, Screw]:
    """Screw a_j, in link i's frame, of every joint j on the path from link i to the base."""
    screws = {}
    to_i = None  # Ad(x_j^i)
    for j in path(mechanism.links, i):
        a = mechanism.links[j].screw
        screws[j] = a if to_i is None else screw.ad(to_i, a)
        step = screw.inverse(Ad[j])
        to_i = step if to_i is None else screw.compose(to_i, step)
    return screws


def jacobian(
    mechanism: Mechanism, Ad: Sequence[Adjoint], i: int, X_BF: DualQuaternion | None
) -> tuple[Screw | None, ...]:
    """Columns of the Jacobian of a frame F fixed to link i: the twist of F in F per joint rate; None off the path."""
    to_frame = None if X_BF is None else screw.inverse(screw.columns(X_BF))
    screws = joint_screws(mechanism, Ad, i)
    return tuple(
        screw.ad(to_frame, screws[j]) if to_frame is not None and j in screws else screws.get(j)
        for j in range(len(mechanism.links))
    )
