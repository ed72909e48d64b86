"""Slips of the pen in a URDF file: words that look meant but are not read, elements given twice, and limits left out.

Extensions of other programs stay silent: names with a prefix, and attributes beside all that URDF itself has.
"""

from __future__ import annotations

import reprlib
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches

from torchdq.robot.units import TURN
from torchdq.robot.urdf_elements import Inertial, UrdfJoint
from torchdq.robot.urdf_xml import BESIDES

TAGS = {
    "robot": {"link", "joint"} | BESIDES,
    "link": {"inertial", "visual", "collision", "sensor", "contact"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "calibration", "safety_controller"},
    "inertial": {"origin", "mass", "inertia"},
}
PLACED = {"link", "joint"} | TAGS["joint"] | TAGS["inertial"] | {"inertial"}  # tags that have a place in a URDF
MANY = {"visual", "collision", "sensor", "contact"}  # elements that a link may have several of
ATTRIBUTES = {
    "origin": ("xyz", "rpy"),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "velocity", "effort"),
    "dynamics": ("damping", "friction"),
    "mimic": ("joint", "multiplier", "offset"),
}
# names that other formats and libraries have for the same things
ELSEWHERE = {
    "min": "lower",
    "max": "upper",
    "speed": "velocity",
    "force": "effort",
    "torque": "effort",
    "factor": "multiplier",
    "scale": "multiplier",
    "ratio": "multiplier",
    "pos": "xyz",
    "translation": "xyz",
    "rotation": "rpy",
    "euler": "rpy",
    "viscous": "damping",
    "coulomb": "friction",
}


def slips(root: ET.Element, links: Mapping[str, ET.Element], joints: Mapping[str, ET.Element]) -> list[str]:
    """Notes about slips of the pen.

    Args:
        root: root element.
        links, joints: elements by name.
    """
    named = [(f"link {name!r}", link) for name, link in links.items()]
    named += [(f"joint {name!r}", joint) for name, joint in joints.items()]
    inside = [(name, part) for name, element in named for part in element.findall("inertial")[:1]]
    holders = [*named, *inside]
    unread = [
        (child.tag, where)
        for where, element in (("<robot>", root), *holders)
        for child in element
        if ":" not in child.tag and child.tag not in TAGS[element.tag]
    ]
    names = {name for element in root.iter() for name in (element.tag, *element.attrib) if ":" in name}
    declared = {"xml", "xmlns"} | {name.removeprefix("xmlns:") for name in names if name.startswith("xmlns:")}
    notes = {
        "tags that are not of URDF, not read": {reprlib.repr(tag)[1:-1] for tag, _ in unread if tag not in PLACED},
        "tags in the wrong place, not read": {f"<{tag}> in {where}" for tag, where in unread if tag in PLACED},
        "attributes that are not of URDF, not read": {x for at, element in holders for x in _misspelt(at, element)},
        "elements given more than once, of which the first is read": {x for at, y in holders for x in _doubled(at, y)},
        "limits left out of <limit>, taken as 0, as the format has it": {
            x for at, joint in joints.items() for x in _left_out(at, joint)
        },
        "XML prefixes that are not declared": {
            reprlib.repr(prefix)[1:-1] for prefix in {name.partition(":")[0] for name in names} - declared
        },
    }
    return [f"{note}: {', '.join(_some(found))}" for note, found in notes.items() if found]


def in_degrees(bodies: Mapping[str, Inertial | None], joints: Mapping[str, UrdfJoint]) -> list[str]:
    """Doubts about angles of placements, by link and joint: those of more than a turn."""
    origins = {f"link {name!r}: rpy of its inertial": body.origin for name, body in bodies.items() if body}
    origins |= {f"joint {name!r}: rpy": joint.origin for name, joint in joints.items()}
    return [
        f"{what} must be in rad, found {' '.join(f'{angle:g}' for angle in origin['rpy'])}; is it in degrees?"
        for what, origin in origins.items()
        if any(abs(angle) > TURN for angle in origin["rpy"])
    ]


def _misspelt(at: str, element: ET.Element) -> Iterator[str]:
    """Attributes that seem to stand for one that is missing, and those where there is none of URDF's own."""
    yield from (f"{name} in {at}" for name in element.attrib if any(name in known for known in ATTRIBUTES.values()))
    for part in element:
        if part.tag not in ATTRIBUTES or part.tag not in TAGS[element.tag]:
            continue
        missing = [name for name in ATTRIBUTES[part.tag] if name not in part.attrib]
        for name in part.attrib:
            if ":" in name or name in ATTRIBUTES[part.tag]:
                continue
            meant = _meant(name, missing)
            if meant or len(missing) == len(ATTRIBUTES[part.tag]):
                shown = reprlib.repr(name)[1:-1]
                yield f"{shown} of <{part.tag}> in {at}" + (f" (is {meant} meant?)" if meant else "")


def _meant(name: str, missing: Iterable[str]) -> str | None:
    """Attribute that is missing and probably meant by a name."""
    known = {word: word for word in missing} | {word: x for word, x in ELSEWHERE.items() if x in missing}
    close = get_close_matches(name.lower(), known, n=1, cutoff=0.6)
    return known[close[0]] if close else None


def _doubled(at: str, element: ET.Element) -> Iterator[str]:
    counts = Counter(child.tag for child in element if child.tag in TAGS[element.tag] - MANY)
    yield from (f"{count} <{tag}> in {at}" for tag, count in counts.items() if count > 1)


def _left_out(name: str, joint: ET.Element) -> Iterator[str]:
    """Limits of a position that <limit> does not give."""
    limit = joint.find("limit")
    if limit is not None and joint.get("type") in ("revolute", "prismatic"):
        missing = [key for key in ("lower", "upper") if key not in limit.attrib]
        yield from [f"{name} ({' and '.join(missing)})"] if missing else []


def _some(found: set[str]) -> list[str]:
    """The first twenty in their order, shortened."""
    return [x if len(x) <= 200 else f"{x[:200]}..." for x in sorted(found)[:20]]
