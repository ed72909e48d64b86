"""Diagnostics of a URDF file that has been read: what is ignored though it may matter, and what is used differently."""

from __future__ import annotations

import math
import reprlib
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Any

from torchdq.findings import Finding
from torchdq.robot.assembly import Links
from torchdq.robot.check.units import TURN
from torchdq.robot.description import UNSIMULATED, note
from torchdq.robot.edit.couplings import Follows
from torchdq.robot.urdf.document import DEFINITIONS, EXTENSIONS, XACRO
from torchdq.robot.urdf.elements import Elements
from torchdq.robot.urdf.segments import Rooted, massive

TAGS = {
    "robot": {"link", "joint"} | EXTENSIONS,
    "link": {"inertial", "visual", "collision", "sensor", "contact"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "calibration", "safety_controller"},
    "inertial": {"origin", "mass", "inertia"},
}
ATTRIBUTES = {
    "origin": ("xyz", "rpy", "quat_xyzw"),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "velocity", "effort"),
    "dynamics": ("damping", "friction"),
    "mimic": ("joint", "multiplier", "offset"),
}
USED = {"link", "joint", "inertial", "parent", "child", *ATTRIBUTES}  # tags with numbers of the dynamics
USED_IF_FIXED = {"origin", "parent", "child"}
BOUNDED = ("revolute", "prismatic")
MOST_NAMED = 20  # ignored elements, and as many that may matter


def diagnostics(
    root: ET.Element,
    file: Elements,
    tree: Rooted,
    links: Links,
    free: Sequence[Follows],
    moves: Sequence[Follows],
    coupled: bool,
) -> list[Finding]:
    """Findings of a file; `free` and `moves` are the displacements of its joints without and with locks."""
    joints = _joints(root, file, links, coupled)
    rows = [*_bodies(root, file, tree, links), *joints, *_standing(file, free, moves)]
    found = [
        *_ignored(root),
        *_orphans(file, coupled),
        *_unusable(file),
        *_unstated(root),
        *_world(file, tree),
        *_degrees(file),
    ]
    # a note about joints, not about names, may be about all of them
    among = {code: len(links.links) for code, about, _ in joints if about and not isinstance(about[0], str)}
    return [*found, *(note(*row, among.get(row[0], 0)) for row in rows if row[1])]


# --- warnings --------------------------------------------------------------------------------------------------------


def _ignored(root: ET.Element) -> list[Finding]:
    """Elements and attributes that are not read: those that may have been meant for others are warned of.

    Extensions of other programs stay silent: names with a prefix, and attributes in addition to all that URDF has.
    """
    found: dict[Finding, None] = {}
    for element in (root, *root.findall("link"), *root.findall("joint")):
        subject = "" if element is root else f"{element.tag} {element.get('name', '')!r}"
        used = USED_IF_FIXED if element.get("type") == "fixed" else USED
        for part in (element, *element.findall("inertial")[: element.tag == "link"]):
            for what, cure, matters in (*_tags(part, used), *_attributes(part, used)):
                # what others may need is named once, and not for every link
                about, severity = (subject, "warning") if matters else ("", "note")
                found[Finding("element.ignored", about, what, cure=cure, severity=severity)] = None  # type: ignore[arg-type]
    return [x for kind in ("warning", "note") for x in [x for x in found if x.severity == kind][:MOST_NAMED]]


def _tags(element: ET.Element, used: set[str]) -> Iterator[tuple[str, str, bool]]:
    """Children of an element that are not read, a cure, and whether they may matter."""
    counts, known = Counter(child.tag for child in element), TAGS[element.tag]
    missing = sorted(tag for tag in known & used if tag not in counts or element.tag == "robot")
    for tag, count in counts.items():
        if tag in known and tag in used and count > 1 and element.tag != "robot":
            yield f"<{tag}> is given {count} times, of which the first is read", "", True
        elif tag.startswith(XACRO) and tag not in DEFINITIONS:
            yield (
                f"<{_short(tag)}> is not read",
                "expand the xacro file again if it stands for a part of the robot",
                True,
            )
        elif ":" in tag or tag in known:
            continue
        elif tag in USED:
            # some files place a link, which does nothing; it is the body's place if the body has none of its own
            body = element.find("inertial")
            harmless = tag == "origin" and element.tag == "link" and (body is None or body.find("origin") is not None)
            yield f"<{tag}> is not read in <{element.tag}>", "", not harmless
        else:
            close = get_close_matches(tag.lower(), missing, n=1)
            yield f"<{_short(tag)}> is not read", f"is <{close[0]}> meant?" if close else "", bool(close)


def _attributes(element: ET.Element, used: set[str]) -> Iterator[tuple[str, str, bool]]:
    """Attributes that are not read, a cure, and whether they may matter."""
    for name in element.attrib:
        if any(name in known for known in ATTRIBUTES.values()):
            yield f"{name} is not read in <{element.tag}>", "", True
    for part in element:
        own = ATTRIBUTES.get(part.tag, ()) if part.tag in TAGS[element.tag] else ()
        missing = [name for name in own if name not in part.attrib]
        for name in part.attrib if missing else ():
            if ":" not in name and name not in own:
                close = get_close_matches(name.lower(), missing, n=1)
                # springs and the like stand alone in <dynamics>
                matters = part.tag in used and bool(close or (len(missing) == len(own) and part.tag != "dynamics"))
                yield f"{_short(name)} of <{part.tag}> is not read", f"is {close[0]} meant?" if close else "", matters


def _short(name: str) -> str:
    return reprlib.repr(name)[1:-1]


def _orphans(file: Elements, coupled: bool) -> Iterator[Finding]:
    for name, joint in file.joints.items():
        if coupled and joint.moves and joint.mimic and (driver := joint.mimic.leader) not in file.joints:
            close = get_close_matches(driver, [other for other in file.joints if other != name], n=1)
            meant = f"is {close[0]!r} meant?" if close else ""
            what = f"it mimics {reprlib.repr(driver)}, which is not in the file, and is taken as independent"
            yield Finding("mimic.orphan", f"joint {name!r}", what, cure=meant)


def _unusable(file: Elements) -> Iterator[Finding]:
    for name, joint in file.joints.items():
        if joint.unusable:
            what = f"limits that no motion can keep are taken as none: {', '.join(joint.unusable)}"
            yield Finding("limits.unusable", f"joint {name!r}", what)


def _unstated(root: ET.Element) -> Iterator[Finding]:
    """Limits that state no positions, so that the format's defaults hold the joint at zero."""
    for element in root.findall("joint"):
        limit, kind = element.find("limit"), element.get("type")
        if kind in BOUNDED and limit is not None and not {"lower", "upper"} & limit.attrib.keys():
            cure = "give both" + (", or make it continuous" if kind == "revolute" else "")
            what = "lower and upper are left out of <limit>, taken as 0, as the format has it"
            yield Finding("limits.unstated", f"joint {element.get('name', '')!r}", what, cure=cure)


def _world(file: Elements, tree: Rooted) -> Iterator[Finding]:
    """Mass of the links that a floating base leaves behind."""
    for name in sorted(tree.still):
        if tree.free is not None and massive(file.links[name]):
            what = f"its mass is not used, because it stands still: joint {tree.free.name!r} floats"
            yield Finding(
                "base.left_behind", f"link {name!r}", what, cure="if it is part of the base, make that joint fixed"
            )


def _degrees(file: Elements) -> Iterator[Finding]:
    """Angles of placements that are larger than a turn."""
    placed = [(f"link {name!r}", "rpy of its inertial", body.origin.rpy) for name, body in file.links.items() if body]
    placed += [(f"joint {name!r}", "rpy", joint.origin.rpy) for name, joint in file.joints.items()]
    for subject, what, rpy in placed:
        if any(abs(angle) > TURN for angle in rpy):
            found = " ".join(f"{angle:g}" for angle in rpy)
            yield Finding("units.degrees", subject, f"{what} must be in rad", found, "is it in degrees?")


# --- notes: code, what they are about, and what is so ----------------------------------------------------------------

NoteArguments = tuple[str, Sequence[Any], str]


def _bodies(root: ET.Element, file: Elements, tree: Rooted, links: Links) -> list[NoteArguments]:
    """Links that are left out or have no numbers."""
    world = [] if tree.free is None else [name for name in file.links if name in tree.still]
    held = [x for x in file.joints.values() if x.kind == "floating" and x is not tree.free]
    bodies = {frame.name: file.links[frame.name] for frame in links.frames if frame.link >= 0}
    empty = [x.get("name", "") for x in root.findall("link") if x.find("inertial") is not None]
    empty = [name for name in empty if file.links.get(name) is None and name not in file.unreadable]
    points = [name for name, body in bodies.items() if body and body.mass and not body.stated]
    fixed = sum(joint.kind == "fixed" for joint in file.joints.values())
    return [
        ("frame.left_out", tree.frames, "nothing carries it and it has neither body nor joint, left out"),
        ("frame.left_out", world, "left out, because it stands still and the base is floating"),
        ("joint.held", held, "held where the file puts it"),
        ("inertial.unreadable", [*file.unreadable], "<inertial> cannot be read, of a link that never moves"),
        ("inertial.no_mass", empty, "<inertial> gives no <mass>, taken as massless"),
        ("link.massless", [name for name, x in bodies.items() if x is None or x.mass == 0], "no mass"),
        ("inertial.point", points, "mass without <inertia>, taken as a point at its centre of mass"),
        ("joint.fixed", [f"{fixed} fixed joint" + "s" * (fixed > 1)] * bool(fixed), "lumped; their links are frames"),
    ]


def _joints(root: ET.Element, file: Elements, links: Links, coupled: bool) -> list[NoteArguments]:
    """Properties of joints that rigid-body dynamics do not include."""
    joints = [file.joints[link.joint.name] for link in links.links]
    bounds = {x.get("name", ""): x.find("limit") for x in root.findall("joint") if x.get("type") in BOUNDED}
    partial = [
        f"{name} ({absent[0]})"
        for name, limit in bounds.items()
        if limit is not None and len(absent := [key for key in ("lower", "upper") if key not in limit.attrib]) == 1
    ]
    planar = [x.get("name", "") for x in root.findall("joint") if x.get("type") == "planar"]
    rooms = ((x.name, {"position": x.upper - x.lower, "velocity": x.velocity, "effort": x.effort}) for x in joints)
    zero = [
        f"{name} ({' and '.join(which)})" for name, room in rooms if (which := [k for k, x in room.items() if x == 0])
    ]
    limited = [x for x in joints if any(map(math.isfinite, (x.lower, x.upper, x.velocity, x.effort or 0.0)))]
    return [
        ("limits.missing", [x for x, limit in bounds.items() if limit is None], "no <limit>, taken as unlimited"),
        ("limits.partial", partial, "left out of <limit>, taken as 0, as the format has it"),
        ("joint.planar", planar, "planar, taken as two slides, x and y, and a turn"),
        ("damping.unused", [x for x in joints if x.damping], "viscous damping given but not simulated"),
        ("friction.unused", [x for x in joints if x.friction], "Coulomb friction given but not simulated"),
        ("limits.unused", limited, "limits given but not enforced"),
        ("limits.zero", zero, "limits that leave no room"),
        ("axis.scaled", [x for x in joints if x.scaled], "axes scaled to unit length"),
        (f"{UNSIMULATED}mimic", [x for x in joints if x.mimic and not coupled], "<mimic> not used, independent"),
    ]


def _standing(file: Elements, free: Sequence[Follows], moves: Sequence[Follows]) -> list[NoteArguments]:
    """Mimic joints that stand still, and those that are locked while their drivers move."""
    stuck = [joint for joint in file.joints.values() if joint.moves and free[joint.row].leader is None]
    stand = ", ".join(f"{joint.name} at {free[joint.row].offset:g}" for joint in stuck)
    held = [x for x in file.joints.values() if moves[x.row].leader is None and free[x.row].leader is not None]
    drivers = [(x, file.joints.get(x.mimic.leader)) for x in held if x.mimic]
    apart = [x for x, driver in drivers if driver and moves[driver.row].leader is not None]
    return [
        ("mimic.stuck", stuck, f"it follows nothing that moves: {stand}"),
        ("lock.mimic", apart, "locked although the joint that it mimics moves"),
    ]
