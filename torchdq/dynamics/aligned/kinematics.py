"""Positions, directions, poses and Jacobians in aligned frames."""

from collections.abc import Sequence
from typing import NamedTuple

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.elementary import Angle
from torchdq.algebra.quaternion import Pure
from torchdq.algebra.screw import Screw
from torchdq.dynamics.aligned.placement import Alignment, Steps
from torchdq.dynamics.joints import Coordinate
from torchdq.dynamics.posed import Point, Seen
from torchdq.dynamics.tree import Tree, freedoms, path


def position(tree: Tree, steps: Steps, i: int, r: Pure) -> Pure:
    """Position in the base frame of a point r of link i."""
    for j in path(tree.links, i):
        step = steps[j]
        r = r if step is None else step.point_to_parent(r)
    return r


def to_base(tree: Tree, steps: Steps, i: int, v: Pure) -> Pure:
    """Components in the base frame of a vector of link i."""
    for j in path(tree.links, i):
        step = steps[j]
        v = v if step is None else step.vector_to_parent(v)
    return v


def to_link(tree: Tree, steps: Steps, i: int, v: Pure) -> Pure:
    """Components in link i's frame of a vector of the base frame."""
    for j in reversed(list(path(tree.links, i))):
        step = steps[j]
        v = v if step is None else step.vector_to_link(v)
    return v


def joint_screws(tree: Tree, steps: Steps, i: int, frame: Point) -> dict[int, Screw]:
    """Screws of the degrees of freedom on the path from link i to the base, in a frame on link i."""
    found: dict[int, Screw] = {}
    for j in path(tree.links, i):
        for k, (w, v) in freedoms(tree.links[j]):
            moved = quat.add(v, quat.cross(w, frame.position))
            found[k] = (tuple(quat.dot(e, w) for e in frame.axes), tuple(quat.dot(e, moved) for e in frame.axes))
        step = steps[j]
        if step is not None:
            axes = tuple(step.vector_to_parent(e) for e in frame.axes)
            frame = Point(step.point_to_parent(frame.position), axes)
    return found


def joint_screws_in_base(tree: Tree, steps: Steps, i: int, r: Pure) -> dict[int, Screw]:
    """Screws of the degrees of freedom that move link i, about its point r and in the axes of the base."""
    axes: dict[int, Sequence[Pure]] = {}  # axes of the base, in the link's frame
    for j in reversed(list(path(tree.links, i))):
        step = steps[j]
        axes[j] = quat.UNITS if step is None else tuple(step.vector_to_link(e) for e in axes[tree.links[j].parent])
    # from the origin of the link to the point: no difference of positions, which are large far from the base
    arm = tuple(quat.dot(e, r) for e in axes[i])
    found: dict[int, Screw] = {}
    for j in path(tree.links, i):
        link, step = tree.links[j], steps[j]
        for k, (w, v) in freedoms(link):
            w_W, v_W = (tuple(quat.dot(e, x) for e in axes[j]) for x in (w, v))
            found[k] = (w_W, quat.add(v_W, quat.cross(w_W, arm)))
        if step is not None:
            along = tuple(e[2] * step.theta.shift for e in axes[j])
            arm = quat.add(quat.add(arm, along), tuple(quat.dot(e, step.placement.p) for e in axes[link.parent]))
    return found


def seen_from(tree: Tree, steps: Steps, axes: Sequence[Pure], p: Pure, links: Sequence[int]) -> dict[int, Seen]:
    """Links as seen from a frame O, of which axes and origin are given in the base frame."""
    rows: dict[int, Sequence[Pure]] = {}  # axes of O, in the link's frame
    origins: dict[int, Pure] = {}
    columns: dict[int, dict[int, Screw]] = {}
    for j in sorted({j for i in links for j in path(tree.links, i)}):
        link, step = tree.links[j], steps[j]
        if step is None:
            rows[j], origins[j], columns[j] = axes, tuple(-quat.dot(e, p) for e in axes), {}
        else:
            before = rows[link.parent]
            rows[j] = tuple(step.vector_to_link(e) for e in before)
            arm = tuple(
                quat.dot(e, step.placement.p) + f[2] * step.theta.shift for e, f in zip(before, rows[j], strict=True)
            )
            origins[j], columns[j] = quat.add(origins[link.parent], arm), dict(columns[link.parent])
        for k, s in freedoms(link):
            w, v = (tuple(quat.dot(e, x) for e in rows[j]) for x in s)
            columns[j][k] = w, quat.add(v, quat.cross(origins[j], w))
    return {i: Seen(tuple(zip(*rows[i], strict=True)), origins[i], columns[i]) for i in links}


def poses(
    tree: Tree, steps: Steps, alignments: Sequence[Alignment], turns: Sequence[Angle], X_WB: DualQuaternion
) -> list[DualQuaternion]:
    """Poses of the link frames of the description, as products of elementary screws (39).

    Args:
        alignments: constants of the moving links.
        turns: cosines and sines of half of the angles of their joints, offsets included.
        X_WB: pose of the base.
    """
    X = [X_WB]  # poses of the aligned frames
    found = [X_WB]
    for link, step, at, half_turn in zip(tree.links[1:], steps[1:], alignments, turns, strict=True):
        X.append(step.pose_in(X[link.parent], at.half, half_turn))
        found.append(dq.mul(X[-1], at.X_LB))
    return found


class FromBase(NamedTuple):
    """Pose of a link as a product of exponentials and the home pose: X_WB = motion home."""

    motion: DualQuaternion
    home: DualQuaternion


def poses_from_base(
    tree: Tree, alignments: Sequence[Alignment], q: Sequence[Coordinate], X_WB: DualQuaternion
) -> list[FromBase]:
    """Pose of every link by the product of exponentials, with joint screws in the base frame.

    It has one product less per joint than `poses` if few poses are needed.

    Args:
        alignments, q: constants of the moving links, and coordinates of their joints.
        X_WB: pose of the base.
    """
    found = [FromBase(X_WB, dq.ONE)]
    for link, at, q_i in zip(tree.links[1:], alignments, q, strict=True):
        found.append(FromBase(dq.mul(found[link.parent].motion, at.joint_W.motion(q_i)), at.X_WB_home))  # (39)
    return found
