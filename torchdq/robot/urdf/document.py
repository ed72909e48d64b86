"""Text of a URDF file, parsed and checked: every fault is named at once, and what can be done without is noted.

Only the elements that dynamics need are read: meshes are never opened.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any, NamedTuple

from torchdq.base.sources import content
from torchdq.errors import DescriptionError, MissingFileError
from torchdq.robot.urdf.elements import MOVING, Inertial, UrdfJoint, inertial_of, joint_of, listed, name_in
from torchdq.robot.urdf.mimic import Driven, followers, stuck
from torchdq.robot.urdf.misspellings import in_degrees, lines, orphans, slips
from torchdq.robot.urdf.planar import taken_apart
from torchdq.robot.urdf.xml import root_of

MOST_BYTES = 10_000_000
MOST_LINKS = 2_000


class Document(NamedTuple):
    """Links and joints of a file by name, in its order."""

    name: str
    base: str  # link that no joint carries
    links: dict[str, Inertial | None]
    joints: dict[str, UrdfJoint]
    followers: dict[str, Driven]  # moving joints that follow others by <mimic>, unless all are independent
    stuck: dict[str, float]  # positions [rad or m] of mimic joints that never move
    notes: tuple[str, ...]  # parts of the file that are wrong and not needed
    doubts: tuple[str, ...]  # angles that seem to be in degrees
    ignored: tuple[str, ...]  # notes on slips of the pen that may change numbers of the dynamics


def text_of(source: Any) -> str:
    """XML text of a source, or the text itself."""
    if isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<"):
        if len(source) > MOST_BYTES:
            raise DescriptionError(f"the text has {len(source)} characters; a robot has at most {MOST_BYTES}")
        return source
    hint = "XML text would begin with '<'"
    if isinstance(source, str) and source.isidentifier():
        hint += f"; a robot that comes with this package is torchdq.robots.load({source!r})"
    name, data = content("robot description", source, MOST_BYTES, DescriptionError, MissingFileError, hint)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DescriptionError(f"{name} is not UTF-8 text: {error}") from error


def parse(text: str, free: bool, coupled: bool) -> Document:
    """Document of a URDF text; raises `DescriptionError` with every fault found.

    Args:
        text: the text.
        free: whether the base moves.
        coupled: whether mimic joints follow others.
    """
    root = root_of(text)
    faults: list[str] = []
    robot = name_in("robot:", root, "name", faults) or "robot"
    links, elements = _by_name(root, "link", faults), _by_name(root, "joint", faults)
    if max(len(links), len(elements)) > MOST_LINKS:
        raise DescriptionError(
            f"the file has {len(links)} links and {len(elements)} joints; at most {MOST_LINKS} are read"
        )
    wrong: dict[str, list[str]] = {name: [] for name in links}
    bodies = {name: inertial_of(name, link, wrong[name]) for name, link in links.items()}
    beyond: list[str] = []
    joints = {name: joint_of(name, joint, beyond) for name, joint in elements.items()}
    planar = [name for name, joint in joints.items() if joint.kind == "planar"]
    bodies, joints = taken_apart(bodies, joints, beyond)
    follow = followers(joints, beyond) if coupled else {}
    base, others = _base(bodies, joints, beyond)
    still = set() if free or beyond else _still(base, joints)
    faults += [fault for name in links if name not in still for fault in wrong[name]] + beyond
    if faults:
        raise DescriptionError("the robot description cannot be used:\n  " + "\n  ".join(faults))
    excused = [name for name in links if wrong[name]]
    bodies = {name: body for name, body in bodies.items() if name not in others}
    fixed = stuck(joints, follow)
    found = [*slips(root, links, elements), *(orphans(joints) if coupled else ())]
    notes = {
        **{note: True for note in lines(found)},
        f"links that nothing carries and that have neither bodies nor joints, left out: {', '.join(others)}": others,
        f"<inertial> cannot be read in links that never move: {', '.join(excused)}": excused,
        **_gaps(links, elements),
        f"planar joints taken as two slides, x and y, and a turn: {', '.join(planar)}": planar,
        f"mimic joints that stay where they are: {', '.join(f'{name} at {x:g}' for name, x in fixed.items())}": fixed,
    }
    return Document(
        robot,
        base,
        {name: None if name in excused else body for name, body in bodies.items()},
        joints,
        {name: follows for name, follows in follow.items() if name not in fixed},
        fixed,
        tuple(note for note, applies in notes.items() if applies),
        tuple(in_degrees(bodies, joints)),
        tuple(lines(slip for slip in found if slip.matters)),
    )


def _gaps(links: Mapping[str, ET.Element], joints: Mapping[str, ET.Element]) -> dict[str, list[str]]:
    """Notes about elements without their content, with the names of those that the notes are about."""
    empty = [
        name for name, link in links.items() if link.find("inertial") is not None and link.find("inertial/mass") is None
    ]
    bare = [
        name
        for name, joint in joints.items()
        if joint.get("type") in ("revolute", "prismatic") and joint.find("limit") is None
    ]
    return {
        f"links whose <inertial> gives no <mass>, taken as massless: {', '.join(empty)}": empty,
        f"revolute and prismatic joints without <limit>, taken as unlimited: {', '.join(bare)}": bare,
    }


def _by_name(root: ET.Element, tag: str, faults: list[str]) -> dict[str, ET.Element]:
    found: dict[str, ET.Element] = {}
    for element in root.findall(tag):
        name = name_in(f"{tag}:", element, "name", faults)
        if not name:
            faults.append(f"a <{tag}> has no name")
        elif name in found:
            faults.append(f"{tag} {name!r} is described twice")
        found[name] = element
    return found


def _base(
    links: Mapping[str, Inertial | None], joints: Mapping[str, UrdfJoint], faults: list[str]
) -> tuple[str, list[str]]:
    """Link that no joint carries, and others that are only frames; faults keep links and joints from being one tree."""
    if not links:
        faults.append("the robot has no links; exactly one link must be the base, carried by no joint; found 0")
        return "", []
    carried: dict[str, str] = {}  # link -> joint that carries it
    children: dict[str, list[str]] = {}
    for name, joint in joints.items():
        for end in (joint.parent, joint.child):
            if end and end not in links:
                faults.append(f"joint {name!r}: there is no link {end!r}")
        if joint.child in carried:
            faults.append(f"link {joint.child!r} is carried by two joints, {carried[joint.child]!r} and {name!r}")
        if joint.child:
            carried[joint.child] = name
        children.setdefault(joint.parent, []).append(joint.child)
    roots = [link for link in links if link not in carried]
    bases = roots if len(roots) == 1 else [link for link in roots if link in children or _massive(links[link])]
    if len(bases) != 1:
        faults.append(f"exactly one link must be the base, carried by no joint; found {len(roots)}: {listed(roots)}")
    # links that hang on a missing link are in no loop
    reached = _below([*roots, *(parent for parent in children if parent not in links)], children)
    loose = [link for link in links if link not in reached]
    if loose:
        faults.append(f"links {listed(loose)} hang in a loop")
    return (bases[0] if bases else ""), [link for link in roots if link not in bases]


def _massive(body: Inertial | None) -> bool:
    return body is not None and any((body.mass, *body.inertia))


def _still(base: str, joints: Mapping[str, UrdfJoint]) -> set[str]:
    """Links that fixed joints alone carry."""
    children: dict[str, list[str]] = {}
    for joint in joints.values():
        if joint.kind not in MOVING:
            children.setdefault(joint.parent, []).append(joint.child)
    return _below([base], children)


def _below(roots: list[str], children: Mapping[str, list[str]]) -> set[str]:
    """Links that are among the roots or hang on one of them."""
    reached, frontier = set(roots), list(roots)
    while frontier:
        for child in children.get(frontier.pop(), ()):
            if child not in reached:
                reached.add(child)
                frontier.append(child)
    return reached
