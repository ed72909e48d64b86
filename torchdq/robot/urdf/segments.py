"""Tree of a URDF file: its base, and its links as segments in order.

Joints come depth first, those on a link in the alphabetical order of their names: the order of Pinocchio.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import RigidBody
from torchdq.findings import Finding
from torchdq.robot.assembly import Segment
from torchdq.robot.bodies import NOTHING
from torchdq.robot.description import Base
from torchdq.robot.edit.couplings import Follows
from torchdq.robot.urdf.elements import Elements, Inertial, Origin, UrdfJoint, listed

OPEN = (
    "kinematic loops are not supported: remove one of its joints, and let the others follow by <mimic> or robot.couple"
)
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Rooted(NamedTuple):
    """Root of a tree of links."""

    root: str  # link that no joint carries
    frames: list[str]  # others that no joint carries, which are left out
    free: UrdfJoint | None  # floating joint, which carries the base; None: there is none, or it is held
    still: set[str]  # links that never move, unless the root itself is a floating base


def rooted(file: Elements, base: Base, faults: list[Finding]) -> Rooted:
    """Root of the links of a file; faults keep links and joints from being one tree."""
    links = file.links
    carried: dict[str, str] = {}  # link -> joint that carries it
    children = children_of(file.joints.values())
    for name, joint in file.joints.items():
        for end in (joint.parent, joint.child):
            if end and end not in links:
                faults.append(Finding("link.unknown", f"joint {name!r}", f"there is no link {end!r}"))
        if joint.child in carried:
            found = f"it is carried by two joints, {carried[joint.child]!r} and {name!r}"
            faults.append(Finding("link.carried_twice", f"link {joint.child!r}", found, cure=OPEN))
        if joint.child:
            carried[joint.child] = name
    roots = [link for link in links if link not in carried]
    bases = roots if len(roots) == 1 else [link for link in roots if link in children or massive(links[link])]
    if len(bases) != 1:
        expected = "exactly one root link expected" if links else "the robot has no links; one root link expected"
        faults.append(Finding("base", "", expected, listed(roots)))
    # links that hang on a missing link are in no loop
    reached = below([*roots, *(parent for parent in children if parent not in links)], children)
    if loose := [link for link in links if link not in reached]:
        faults.append(Finding("link.loop", "", f"links {listed(loose)} form a loop"))
    root = bases[0] if bases else ""
    world = below([root], children_of(x for x in file.joints.values() if x.kind == "fixed"))
    floating = [joint for joint in file.joints.values() if joint.kind == "floating"]
    for joint in floating:
        if joint.parent not in world or len(floating) > 1:
            expected = "a floating joint must be the only one, and carry the base of the robot from a link that stands"
            faults.append(Finding("joint.floating", f"joint {joint.name!r}", expected, f"parent {joint.parent!r}"))
    free = floating[0] if floating and base != "fixed" else None
    still = below([root], children_of(x for x in file.joints.values() if not x.moves and x is not free))
    return Rooted(root, [link for link in roots if link not in bases], free, still)


def massive(body: Inertial | None) -> bool:
    """Whether a body has mass or inertia."""
    return body is not None and any((body.mass, *body.inertia))


def children_of(joints: Iterable[UrdfJoint]) -> dict[str, list[str]]:
    """Links that each link carries by these joints."""
    children: dict[str, list[str]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint.child)
    return children


def below(roots: Sequence[str], children: Mapping[str, Sequence[str]]) -> set[str]:
    """Links that are among the roots or hang on one of them."""
    reached, frontier = set(roots), list(roots)
    while frontier:
        for child in children.get(frontier.pop(), ()):
            if child not in reached:
                reached.add(child)
                frontier.append(child)
    return reached


def segments_of(file: Elements, root: str, moves: Sequence[Follows]) -> list[Segment]:
    """Links as segments, from the root on."""
    carries: dict[str, list[UrdfJoint]] = {}
    for name in sorted(file.joints, reverse=True):
        carries.setdefault(file.joints[name].parent, []).append(file.joints[name])
    found = [Segment(root, None, dual_quaternion.ONE, (), *body_of(file.links[root]))]
    at = {root: 0}
    waiting = [*carries.get(root, ())]
    while waiting:
        joint = waiting.pop()
        # the effort of a joint that follows is its driver's
        own = joint if moves[joint.row].leader == joint.row else joint._replace(effort=None)
        at[joint.child] = len(found)
        found.append(
            Segment(joint.child, at[joint.parent], pose(joint.origin), (own,), *body_of(file.links[joint.child]))
        )
        waiting += carries.get(joint.child, ())
    return found


def body_of(inertial: Inertial | None) -> tuple[RigidBody, DualQuaternion]:
    """Body of an <inertial> element, and the pose of its frame in that of the link."""
    if inertial is None:
        return NOTHING, dual_quaternion.ONE
    return RigidBody(inertial.mass, quat.ZERO, inertial.inertia), pose(inertial.origin)


def pose(origin: Origin) -> DualQuaternion:
    """Pose of an origin: its quaternion, or roll, pitch and yaw about the fixed x, then y, then z axis."""
    if origin.turn is not None:
        return dual_quaternion.from_pose(origin.turn, origin.xyz)
    r = quat.ONE
    for axis, angle in zip(AXES, origin.rpy, strict=True):
        r = quat.mul((math.cos(0.5 * angle), *quat.scale(math.sin(0.5 * angle), axis)), r)
    return dual_quaternion.from_pose(r, origin.xyz)
