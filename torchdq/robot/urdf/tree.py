"""Tree of a URDF file in numbers: its moving links in order, and the place of every link on the link that carries it.

Joints come depth first, those on a link in the alphabetical order of their names: the order of Pinocchio.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from torchdq.algebra import dual_quaternion, screw
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import RigidBody
from torchdq.algebra.quaternion import Pure, Quaternion
from torchdq.dynamics.tree import BASE
from torchdq.findings import Finding
from torchdq.robot.arrays import double
from torchdq.robot.assembly import Links, MovingLink
from torchdq.robot.bodies import NOTHING, merged
from torchdq.robot.description import Frame
from torchdq.robot.edit.couplings import Follows
from torchdq.robot.urdf.elements import Elements, Inertial, Origin, UrdfJoint, listed

AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def rooted(file: Elements, faults: list[Finding]) -> tuple[str, list[str]]:
    """Link that no joint carries, and others that are only frames; faults keep links and joints from being one tree."""
    links = file.links
    carried: dict[str, str] = {}  # link -> joint that carries it
    children = children_of(file.joints)
    for name, joint in file.joints.items():
        for end in (joint.parent, joint.child):
            if end and end not in links:
                faults.append(Finding("link.unknown", f"joint {name!r}", f"there is no link {end!r}"))
        if joint.child in carried:
            found = f"it is carried by two joints, {carried[joint.child]!r} and {name!r}"
            faults.append(Finding("link.carried_twice", f"link {joint.child!r}", found))
        if joint.child:
            carried[joint.child] = name
    roots = [link for link in links if link not in carried]
    bases = roots if len(roots) == 1 else [link for link in roots if link in children or _massive(links[link])]
    if len(bases) != 1:
        expected = "exactly one link must be the base, carried by no joint"
        expected = expected if links else f"the robot has no links; {expected}"
        faults.append(Finding("base", "", expected, f"{len(roots)}: {listed(roots)}"))
    # links that hang on a missing link are in no loop
    reached = below([*roots, *(parent for parent in children if parent not in links)], children)
    if loose := [link for link in links if link not in reached]:
        faults.append(Finding("link.loop", "", f"links {listed(loose)} hang in a loop"))
    return (bases[0] if bases else ""), [link for link in roots if link not in bases]


def _massive(body: Inertial | None) -> bool:
    return body is not None and any((body.mass, *body.inertia))


def children_of(joints: Mapping[str, UrdfJoint], fixed: bool = False) -> dict[str, list[str]]:
    """Links that each link carries, by any joint or by fixed ones alone."""
    children: dict[str, list[str]] = {}
    for joint in joints.values():
        if not (fixed and joint.moves):
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


def links_of(file: Elements, base: str, moves: Sequence[Follows]) -> Links:
    """Links that joints move, with everything that is fixed to them; joints that stand still are fixed ones."""
    carries: dict[str, list[str]] = {}
    for name in sorted(file.joints, reverse=True):
        carries.setdefault(file.joints[name].parent, []).append(name)
    places = {base: (BASE, dual_quaternion.ONE)}
    links: list[MovingLink] = []
    waiting = list(carries.get(base, ()))
    while waiting:
        joint = file.joints[waiting.pop()]
        link, X = places[joint.parent]
        X = _unit(dual_quaternion.mul(X, pose(joint.origin)))
        x = moves[joint.row]
        if x.root is not None:
            own = joint if x.root == joint.row else joint._replace(effort=None)  # that of its driver counts
            links.append(MovingLink(joint.child, link, own, X))
            link, X = len(links) - 1, dual_quaternion.ONE
        elif x.offset:
            X = _unit(dual_quaternion.mul(X, _motion(joint, x.offset)))
        places[joint.child] = (link, X)
        waiting += carries.get(joint.child, ())
    bodies = dict.fromkeys(range(BASE, len(links)), NOTHING)
    for name, (link, X) in places.items():
        if (inertial := file.links[name]) is not None:
            body = RigidBody(inertial.mass, quat.ZERO, inertial.inertia)
            bodies[link] = merged(bodies[link], body.moved(dual_quaternion.mul(X, pose(inertial.origin))))
    frames = [Frame(name, link, double(r + d)) for name, (link, (r, d)) in places.items()]
    return Links(
        links, bodies, frames, [name for name, (link, _) in places.items() if link >= 0 and name not in carries]
    )


def pose(origin: Origin) -> DualQuaternion:
    """Pose of an origin: roll, pitch and yaw about the fixed x, then y, then z axis."""
    r = quat.ONE
    for axis, angle in zip(AXES, origin.rpy, strict=True):
        r = quat.mul(_turn(axis, angle), r)
    return dual_quaternion.from_pose(r, origin.xyz)


def _turn(axis: Pure, angle: float) -> Quaternion:
    return (math.cos(0.5 * angle), *quat.scale(math.sin(0.5 * angle), axis))


def _motion(joint: UrdfJoint, value: float) -> DualQuaternion:
    """Motion of a joint to a position [rad or m]."""
    if joint.kind == "prismatic":
        return screw.exp_prismatic(joint.axis, value)
    return (_turn(joint.axis, value), dual_quaternion.ZERO)


def _unit(X: DualQuaternion) -> DualQuaternion:
    """Pose without the rounding of its norm, with w >= 0."""
    (r, d), n = X, math.sqrt(quat.norm2(X[0]))
    s = math.copysign(1.0 / n, r[0]) if r[0] else 1.0 / n
    return (quat.scale(s, r), quat.scale(s, d))
