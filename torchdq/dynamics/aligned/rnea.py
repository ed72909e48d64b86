"""Recursive Newton-Euler algorithm: Algorithm 1 of the paper in aligned frames.

It computes the torques of `general.rnea` with fewer operations:

* Ad of a joint's pose is a product of elementary screws, planar rotations of both parts, instead of 3x3 matrices.
* The dual part of the twists is not computed: V = (w, None). The wrenches do not depend on it, and the dual part of A
  becomes the acceleration d of the frame's origin.
* The acceleration of the next origin and the net wrench share U = [wd] + [w]^2 (`dynamics.acceleration`).

`torchdq.paper.ladder` derives it from the printed algorithm, one step at a time.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.algebra.structural import add
from torchdq.dynamics.acceleration import Matrix3, apply, net_wrench, tensor
from torchdq.dynamics.aligned.placement import Step, Steps
from torchdq.dynamics.tree import Tree, freedoms, path


class FrameMotion(NamedTuple):
    """Angular velocity and acceleration of a link's frame."""

    w: Pure  # primary part of the twist V
    A: Screw  # (wd, d), gravity subtracted from d
    u: Matrix3


def base_motion(X_WB: DualQuaternion | None, gravity: Pure | None, V: Screw | None, A: Screw | None) -> FrameMotion:
    """Motion of the base from its pose X_WB, its twist V and the rate A of V, in its frame; None: zero."""
    g = quat.ZERO if gravity is None else gravity if X_WB is None else quat.rotate(quat.conj(X_WB[0]), gravity)
    (w, v), (wd, vd) = V or screw.ZERO, A or screw.ZERO
    d = quat.sub(quat.add(vd, quat.cross(w, v)), g)
    return FrameMotion(w, (wd, d), tensor(w, wd))


def carried(step: Step, parent: FrameMotion, rate: Screw | None, change: Screw | None) -> FrameMotion:
    """Motion of a link from that of its parent, and the velocity (`rate`) and acceleration (`change`) of its joint."""
    w, (wd, d), u = parent
    w, wd = step.vector_to_link(w), step.vector_to_link(wd)
    d = step.vector_to_link(quat.add(d, apply(u, step.placement.p)))
    if rate is not None:
        across = quat.cross(w, rate[1])
        wd, d = quat.add(wd, quat.cross(w, rate[0])), quat.add(d, quat.add(across, across))
        w = quat.add(w, rate[0])  # (40)
    if change is not None:
        wd, d = quat.add(wd, change[0]), quat.add(d, change[1])  # (44)
    u = tensor(w, wd)
    # points on the axis move with both links, so the link's own U may be used for the shift along it
    return FrameMotion(w, (wd, quat.add(d, apply(u, (0.0, 0.0, step.theta.shift)))), u)


def outward(
    tree: Tree, steps: Steps, X_WB: DualQuaternion | None, qd: Sequence[Number] | None, qdd: Sequence[Number] | None
) -> Iterator[FrameMotion]:
    """Motion of every link, one after the other from the base outwards."""
    rates, changes = tree.rates(qd), tree.rates(qdd)
    motion = [base_motion(X_WB, tree.gravity, rates[0], changes[0])]
    yield motion[0]
    for i, link in enumerate(tree.links[1:], 1):
        motion.append(carried(steps[i], motion[link.parent], rates[i], changes[i]))
        yield motion[i]


def inverse_dynamics(
    tree: Tree,
    steps: Steps,
    X_WB: DualQuaternion | None,
    qd: Sequence[Number] | None,
    qdd: Sequence[Number] | None,
    exerted: Sequence[Screw | None] | None = None,
) -> list[Number]:
    """Generalised forces of a motion.

    Args:
        steps: poses of the links in their parents.
        X_WB: pose of a floating base in the world; None: a fixed one.
        qd, qdd: velocities and accelerations; None: zero.
        exerted: wrenches that the links exert on the environment, in link frames; None: none.
    """
    # right after the motion of the link, which is not read again: six numbers per link are kept, instead of twelve
    net = [
        None if link.inertia is None else net_wrench(link.inertia, m.u, m.A[1])
        for link, m in zip(tree.links, outward(tree, steps, X_WB, qd, qdd), strict=True)
    ]  # (45)
    passed_on: list[list[Screw]] = [[] for _ in tree.links]
    tau: list[Number] = [0.0] * tree.nv
    for i in reversed(range(len(tree.links))):
        link, step = tree.links[i], steps[i]
        F = add(net[i], None if exerted is None else exerted[i], *passed_on[i])  # (46), (47)
        if F is None:
            continue
        for k, force in zip(range(link.v.start, link.v.stop), link.joint.project(F), strict=True):
            tau[k] = force if link.armature is None or qdd is None else force + link.armature * qdd[k]  # (48)
        if step is not None:
            passed_on[link.parent].append(step.to_parent(F))
    return tau


def generalised(tree: Tree, steps: Steps, i: int, F: Screw) -> list[Number | None]:
    """Generalised forces of a wrench F on link i, in its frame; None: the link does not move with that coordinate."""
    found: list[Number | None] = [None] * tree.nv
    for j in path(tree.links, i):
        for k, a in freedoms(tree.links[j]):
            found[k] = screw.power(F, a)
        step = steps[j]
        if step is not None:
            F = step.to_parent(F)
    return found


def twists(tree: Tree, steps: Steps, qd: Sequence[Number] | None) -> list[Screw]:
    """Twist of every link in its frame, both parts."""
    V: list[Screw] = []
    for link, step, rate in zip(tree.links, steps, tree.rates(qd), strict=True):
        V.append(add(screw.ZERO if step is None else step.to_link(V[link.parent]), rate) or screw.ZERO)  # (40)
    return V
