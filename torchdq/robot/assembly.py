"""Descriptions of robots from segments in numbers, as URDF and MJCF have them, and from tables of links.

Segments that no joint moves are fixed to the link that carries them, and a segment on several joints is several links.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from torchdq.algebra import dual_quaternion
from torchdq.algebra import quaternion as quat
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.inertia import RigidBody
from torchdq.dynamics.joints import KINDS, Coordinate
from torchdq.dynamics.tree import BASE
from torchdq.errors import DescriptionError
from torchdq.findings import Finding
from torchdq.robot.arrays import IDENTITY, distinct, double, inertias, matrices, table
from torchdq.robot.bodies import NOTHING, merged
from torchdq.robot.check import consistency
from torchdq.robot.description import NO_TIP, Drawing, Frame, JointMap, Limits, RobotDescription, Shape, note
from torchdq.robot.edit.couplings import Follows

APART = -2  # link of what stands still apart from a floating base
NEAR = 1e-6  # difference of limits that is not noted: files are printed with about six digits


class Segment(NamedTuple):
    """Body of a description, and the joints between it and the segment that carries it."""

    name: str
    parent: int | None  # place in the row of segments; None: the root, which stands still
    X_PB: DualQuaternion  # pose in the frame of the parent, all joints at home
    # from the parent on; each with name, row, kind, screw, home, lower, upper, velocity, effort, damping, friction and
    # armature; effort is None where nothing acts on the joint itself
    joints: Sequence[Any] = ()
    body: RigidBody = NOTHING
    X_BC: DualQuaternion = dual_quaternion.ONE  # pose of the frame in which the body is given
    shapes: tuple[Shape, ...] = ()
    drawing: Drawing = Drawing()


class MovingLink(NamedTuple):
    """Link and the joint that carries it."""

    name: str
    parent: int
    joint: Any
    X_PB: DualQuaternion  # at home


class Links(NamedTuple):
    """Links of a robot that move, and everything that is fixed to them."""

    links: list[MovingLink]
    bodies: Mapping[int, RigidBody]  # by link; that of the base too
    places: list[tuple[int, DualQuaternion]]  # link of every segment, and its pose there
    frames: list[Frame]
    leaves: list[str]  # moving segments that carry no others


class CoordinateNumbers(NamedTuple):
    """Numbers of a coordinate, from those of the joints that follow it."""

    lower: float
    upper: float
    velocity: float
    effort: float
    damping: float
    friction: float
    armature: float


def linked(segments: Sequence[Segment], moves: Sequence[Follows], free: int | None = None) -> Links:
    """Links that joints move, with the segments that are fixed to them.

    Args:
        segments: those of the description, each after its parent.
        moves: displacement of every joint, by row.
        free: segment that is the floating base, apart from which nothing may move; None: the root is the base.

    Raises:
        DescriptionError: a joint moves something apart from the floating base.
    """
    links: list[MovingLink] = []
    places: list[tuple[int, DualQuaternion]] = []
    bodies: dict[int, RigidBody] = {}
    for i, (name, parent, X_PB, joints, body, X_BC, *_) in enumerate(segments):
        link, X = (BASE if free is None else APART, dual_quaternion.ONE) if parent is None else places[parent]
        X = _unit(dual_quaternion.mul(X, X_PB))
        moving = [joint for joint in joints if moves[joint.row].leader is not None]
        for joint in joints:
            if joint in moving:
                if link == APART:
                    base = "" if free is None else segments[free].name
                    raise DescriptionError(
                        f"everything that moves must hang on the floating base {base!r}, found that joint "
                        f"{joint.name!r} carries {name!r} apart from it; lock that joint, or hold the base with "
                        "base='fixed'"
                    )
                links.append(MovingLink(name if joint is moving[-1] else f"{name} before {joint.name}", link, joint, X))
                link, X = len(links) - 1, dual_quaternion.ONE
            elif x := moves[joint.row].offset:
                at = Coordinate(x, math.cos(0.5 * x), math.sin(0.5 * x))
                X = _unit(dual_quaternion.mul(X, KINDS[joint.kind](joint.screw).motion(at)))
        if i == free:
            link, X = BASE, dual_quaternion.ONE
        places.append((link, X))
        bodies[link] = merged(bodies.get(link, NOTHING), body.moved(dual_quaternion.mul(X, X_BC)))
    placed = [*zip(segments, places, strict=True)]
    frames = [
        Frame(x.name, link, double((*r, *d)), x.shapes, x.drawing) for x, (link, (r, d)) in placed if link != APART
    ]
    parents = {x.parent for x in segments}
    leaves = [x.name for i, (x, (link, _)) in enumerate(placed) if link >= 0 and i not in parents]
    return Links(links, bodies, places, frames, leaves)


def _unit(X: DualQuaternion) -> DualQuaternion:
    """Pose without the rounding of its norm, with w >= 0."""
    (r, d), n = X, math.sqrt(quat.norm2(X[0]))
    s = math.copysign(1.0 / n, r[0]) if r[0] else 1.0 / n
    return (quat.scale(s, r), quat.scale(s, d))


def described(
    name: str, of: Links, moves: Sequence[Follows], free: bool, notes: Sequence[Finding] = ()
) -> RobotDescription:
    """Description of a robot by its links and the displacement of every joint, with the findings of its reader."""
    carrying = [link.joint for link in of.links]
    n, roots = len(carrying), [joint for joint in carrying if moves[joint.row].leader == joint.row]
    following: dict[int | None, list[Any]] = {root.row: [] for root in roots}
    for joint in carrying:
        following[moves[joint.row].leader].append(joint)
    findings = [*notes]
    numbers = [_coordinate(root, [(x, moves[x.row]) for x in following[root.row]], findings) for root in roots]
    rows = (
        [double(row) for row in zip(*numbers, strict=True)] if roots else [double([])] * len(CoordinateNumbers._fields)
    )
    lower, upper, velocity, effort, damping, friction, armature = rows
    homes: dict[int | None, float] = {root.row: root.home for root in roots}
    # at q, a joint that follows is displaced by factor (q - home of its root) + offset = (S q) - home
    home = double([x.factor * homes[x.leader] - x.offset for x in (moves[joint.row] for joint in carrying)])
    joint_map = None
    if len(roots) < n:
        S, equations = double([[0.0] * len(roots)] * n), []
        rows_of = {joint.row: i for i, joint in enumerate(carrying)}
        for k, root in enumerate(roots):
            for joint in following[root.row]:
                S[rows_of[joint.row], k] = moves[joint.row].factor
                equations += [] if joint is root else [_equation(joint, moves[joint.row], root)]
        joint_map = JointMap(tuple(joint.name for joint in carrying), S)
        findings.append(note("joint.follows", [], f"joints follow others: {', '.join(equations)}"))
    if len(of.leaves) > 1:
        cure = "name one with tip="
        findings.append(Finding(NO_TIP, "", f"no tip chosen among {', '.join(of.leaves)}", cure=cure, severity="note"))
    bodies = [of.bodies.get(i, NOTHING) for i in range(n)]
    base = of.bodies.get(BASE, NOTHING)
    return RobotDescription(
        name=name,
        joint_names=tuple(root.name for root in roots),
        link_names=tuple(link.name for link in of.links),
        parents=tuple(link.parent for link in of.links),
        kinds=tuple(joint.kind for joint in carrying),
        X_PB_home=double([(*link.X_PB[0], *link.X_PB[1]) for link in of.links]).reshape(n, 8),
        screw=double([(*joint.screw[0], *joint.screw[1]) for joint in carrying]).reshape(n, 6),
        mass=double([body.mass for body in bodies]),
        com=double([body.com for body in bodies]).reshape(n, 3),
        inertia=double([body.inertia for body in bodies]).reshape(n, 6),
        limits=Limits(lower, upper, velocity, effort),
        damping=damping,
        friction=friction,
        frames=tuple(of.frames),
        tip=of.leaves[0] if len(of.leaves) == 1 else None,
        home=home if bool(home.any()) else None,
        armature=armature if bool(armature.any()) else None,
        base_mass=double(base.mass) if free else None,
        base_com=double(base.com) if free else None,
        base_inertia=double(base.inertia) if free else None,
        joint_map=joint_map,
        notes=tuple(findings),
    )


def _equation(joint: Any, x: Follows, root: Any) -> str:
    """Position of a joint by that of the joint that it follows."""
    rest = joint.home + x.offset - x.factor * root.home
    return f"{joint.name} = {x.factor:g} {root.name}" + (f" {'-' if rest < 0 else '+'} {abs(rest):g}" if rest else "")


def _coordinate(root: Any, following: Sequence[tuple[Any, Follows]], findings: list[Finding]) -> CoordinateNumbers:
    """Numbers of the coordinate of a joint; limits of followers that leave it no room are left out."""
    lower, upper, velocity = root.lower, root.upper, root.velocity
    for joint, x in following:
        if joint is not root:
            ends = [root.home + (bound - joint.home - x.offset) / x.factor for bound in (joint.lower, joint.upper)]
            low, high = max(lower, min(ends)), min(upper, max(ends))
            speed = min(velocity, joint.velocity / abs(x.factor))
            if lower < upper and velocity > 0 and not (low < high and speed > 0):
                findings.append(note("limits.no_room", [joint], "limits that leave its driver no room, left out"))
            else:
                lower, upper, velocity = low, high, speed
    pairs = {"lower": (root.lower, lower), "upper": (root.upper, upper), "velocity": (root.velocity, velocity)}
    narrowed = [f"{key} {a:g} to {b:g}" for key, (a, b) in pairs.items() if not math.isclose(a, b, abs_tol=NEAR)]
    if narrowed:
        findings.append(
            note("limits.narrowed", [root], f"limits narrowed to those of followers: {', '.join(narrowed)}")
        )
    efforts = [abs(x.factor) * joint.effort for joint, x in following if joint.effort is not None]
    return CoordinateNumbers(
        lower,
        upper,
        velocity,
        sum(efforts) if efforts else math.inf,
        sum(x.factor**2 * joint.damping for joint, x in following),
        sum(abs(x.factor) * joint.friction for joint, x in following),
        sum(x.factor**2 * joint.armature for joint, x in following),
    )


# --- links without a tree of segments ------------------------------------------------------------------------------


def assemble(
    joint_names: tuple[str, ...],
    parents: tuple[int, ...],
    kinds: tuple[str, ...],
    X_PB_home: Tensor,
    screw: Tensor,
    X_BE: Tensor,
    *,
    name: str,
    link_names: Sequence[str] | None,
    mass: Any,
    com: Any,
    inertia: Any,
    home: Any = None,
) -> RobotDescription:
    """Description without limits or friction, with a frame per link, one at the tip and one at the base."""
    n = len(parents)
    if not isinstance(name, str):
        raise DescriptionError(f"name must be a string, found {name!r}")
    links = distinct("link", link_names, n)
    if {"base", "tip"} & set(links):
        raise DescriptionError(f"link_names must not be 'base' or 'tip', which are frames already, found {links}")
    missing = [key for key, x in (("mass", mass), ("com", com), ("inertia", inertia)) if x is None]
    if 0 < len(missing) < 3:
        raise DescriptionError(f"mass, com and inertia must be given together, found no {' and no '.join(missing)}")
    if missing:
        mass, com, inertia = ([[0.0] * k] * n if k else [0.0] * n for k in (0, 3, 6))
    mass, com, inertia = table("mass", mass, n), table("com", com, n, 3), inertias(inertia, n)
    zero, infinite = double([0.0] * n), double([math.inf] * n)
    at_links = (Frame(link, i, IDENTITY) for i, link in enumerate(links))
    return RobotDescription(
        name=name,
        joint_names=joint_names,
        link_names=links,
        parents=parents,
        kinds=kinds,
        X_PB_home=X_PB_home,
        screw=screw,
        mass=mass,
        com=com,
        inertia=inertia,
        limits=Limits(-infinite, infinite, infinite, infinite),
        damping=zero,
        friction=zero,
        frames=(Frame("base", BASE, IDENTITY), *at_links, Frame("tip", n - 1, X_BE)),
        tip="tip",
        home=None if home is None else table("home", home, n),
        notes=tuple(consistency.bodies(links, mass, matrices(inertia))),
    )
