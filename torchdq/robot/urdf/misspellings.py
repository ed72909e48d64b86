"""Slips of the pen in a URDF file: words that look meant but are not read, elements given twice, and limits left out.

Those that may change numbers of the dynamics matter: they are warned of, while the others are only noted.

Extensions of other programs stay silent: names with a prefix, and attributes beside all that URDF itself has.
"""

from __future__ import annotations

import reprlib
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from typing import NamedTuple

from torchdq.robot.check.units import TURN
from torchdq.robot.urdf.elements import MOVING, Inertial, UrdfJoint
from torchdq.robot.urdf.xml import BESIDES

TAGS = {
    "robot": {"link", "joint"} | BESIDES,
    "link": {"inertial", "visual", "collision", "sensor", "contact"},
    "joint": {"origin", "parent", "child", "axis", "limit", "dynamics", "mimic", "calibration", "safety_controller"},
    "inertial": {"origin", "mass", "inertia"},
}
PLACED = {"link", "joint"} | TAGS["joint"] | TAGS["inertial"] | {"inertial"}  # tags that have a place in a URDF
# tags with numbers of the dynamics, and those that a fixed joint has; slips of these are more than a note
USED = {
    "robot": {"link", "joint"},
    "link": {"inertial"},
    "joint": TAGS["joint"] - {"calibration", "safety_controller"},
    "inertial": TAGS["inertial"],
}
USED_IF_FIXED = {"origin", "parent", "child"}
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


class Slip(NamedTuple):
    """Slip of the pen."""

    kind: str
    found: str
    matters: bool  # whether it may change numbers of the dynamics


def slips(root: ET.Element, links: Mapping[str, ET.Element], joints: Mapping[str, ET.Element]) -> list[Slip]:
    """Slips of the pen.

    Args:
        root: root element.
        links, joints: elements by name.
    """
    named = [(f"link {name!r}", link) for name, link in links.items()]
    named += [(f"joint {name!r}", joint) for name, joint in joints.items()]
    inside = [(name, part) for name, element in named for part in element.findall("inertial")[:1]]
    holders = [*named, *inside]
    found = [slip for at, element in (("<robot>", root), *holders) for slip in _unread(at, element)]
    found += [slip for at, element in holders for slip in (*_misspelt(at, element), *_doubled(at, element))]
    found += [slip for name, joint in joints.items() for slip in _left_out(name, joint)]
    names = {name for element in root.iter() for name in (element.tag, *element.attrib) if ":" in name}
    declared = {"xml", "xmlns"} | {name.removeprefix("xmlns:") for name in names if name.startswith("xmlns:")}
    prefixes = {name.partition(":")[0] for name in names} - declared
    return [*found, *(Slip("XML prefixes that are not declared", _short(prefix), False) for prefix in prefixes)]


def lines(found: Iterable[Slip]) -> list[str]:
    """Slips in words, a line for each kind."""
    kinds: dict[str, set[str]] = {}
    for slip in found:
        kinds.setdefault(slip.kind, set()).add(slip.found)
    return [f"{kind}: {', '.join(_some(which))}" for kind, which in kinds.items()]


def orphans(joints: Mapping[str, UrdfJoint]) -> list[Slip]:
    """Slips of moving joints that mimic a joint that is not in the file."""
    kind, found = "mimic joints whose drivers are not in the file, taken as independent", []
    for name, joint in joints.items():
        if joint.kind in MOVING and joint.mimics and (driver := joint.mimics.joint) not in joints:
            close = get_close_matches(driver, [other for other in joints if other != name], n=2, cutoff=0.6)
            meant = f" (is {' or '.join(map(repr, close))} meant?)" if close else ""
            found.append(Slip(kind, f"{name} mimics {reprlib.repr(driver)}{meant}", True))
    return found


def in_degrees(bodies: Mapping[str, Inertial | None], joints: Mapping[str, UrdfJoint]) -> list[str]:
    """Doubts about angles of placements, by link and joint: those of more than a turn."""
    origins = {f"link {name!r}: rpy of its inertial": body.origin for name, body in bodies.items() if body}
    origins |= {f"joint {name!r}: rpy": joint.origin for name, joint in joints.items()}
    return [
        f"{what} must be in rad, found {' '.join(f'{angle:g}' for angle in origin['rpy'])}; is it in degrees?"
        for what, origin in origins.items()
        if any(abs(angle) > TURN for angle in origin["rpy"])
    ]


def _used(element: ET.Element) -> set[str]:
    """Tags below an element that have numbers of the dynamics."""
    return USED_IF_FIXED if element.tag == "joint" and element.get("type") == "fixed" else USED[element.tag]


def _unread(at: str, element: ET.Element) -> Iterator[Slip]:
    """Tags below an element that are in the wrong place or not of URDF."""
    missing = {tag for tag in _used(element) if element.find(tag) is None or element.tag == "robot"}
    for tag in (child.tag for child in element if ":" not in child.tag and child.tag not in TAGS[element.tag]):
        if tag in PLACED:
            matters = any(tag in used for used in USED.values())
            # some files place a link, which does nothing; it is the body's place if the body has none of its own
            if (element.tag, tag) == ("link", "origin"):
                matters = element.find("inertial") is not None and element.find("inertial/origin") is None
            yield Slip("tags in the wrong place, not read", f"<{tag}> in {at}", matters)
        elif close := get_close_matches(tag.lower(), sorted(missing), n=1, cutoff=0.6):
            found = f"<{_short(tag)}> in {at} (is <{close[0]}> meant?)"
            yield Slip("tags that seem misspelt, not read", found, True)
        else:
            yield Slip("tags that are not of URDF, not read", _short(tag), False)


def _misspelt(at: str, element: ET.Element) -> Iterator[Slip]:
    """Attributes that seem to stand for one that is missing, and those where there is none of URDF's own."""
    kind = "attributes that are not of URDF, not read"
    for name in element.attrib:
        if any(name in known for known in ATTRIBUTES.values()):
            yield Slip(kind, f"{name} in {at}", True)
    for part in element:
        if part.tag not in ATTRIBUTES or part.tag not in TAGS[element.tag]:
            continue
        missing = [name for name in ATTRIBUTES[part.tag] if name not in part.attrib]
        for name in part.attrib:
            if ":" in name or name in ATTRIBUTES[part.tag]:
                continue
            meant = _meant(name, missing)
            if meant or len(missing) == len(ATTRIBUTES[part.tag]):
                found = f"{_short(name)} of <{part.tag}> in {at}" + (f" (is {meant} meant?)" if meant else "")
                # springs and the like stand alone in <dynamics>
                matters = part.tag in _used(element) and (meant is not None or part.tag != "dynamics")
                yield Slip(kind, found, matters)


def _meant(name: str, missing: Iterable[str]) -> str | None:
    """Attribute that is missing and probably meant by a name."""
    known = {word: word for word in missing} | {word: x for word, x in ELSEWHERE.items() if x in missing}
    close = get_close_matches(name.lower(), known, n=1, cutoff=0.6)
    return known[close[0]] if close else None


def _doubled(at: str, element: ET.Element) -> Iterator[Slip]:
    counts = Counter(child.tag for child in element if child.tag in TAGS[element.tag] - MANY)
    for tag, count in counts.items():
        if count > 1:
            kind = "elements given more than once, of which the first is read"
            yield Slip(kind, f"{count} <{tag}> in {at}", tag in _used(element))


def _left_out(name: str, joint: ET.Element) -> Iterator[Slip]:
    """Limits of a position that <limit> does not give."""
    limit = joint.find("limit")
    if limit is not None and joint.get("type") in ("revolute", "prismatic"):
        missing = [key for key in ("lower", "upper") if key not in limit.attrib]
        kind = "limits left out of <limit>, taken as 0, as the format has it"
        yield from [Slip(kind, f"{name} ({' and '.join(missing)})", False)] if missing else []


def _short(name: str) -> str:
    return reprlib.repr(name)[1:-1]


def _some(found: set[str]) -> list[str]:
    """The first twenty in their order, shortened."""
    return [x if len(x) <= 200 else f"{x[:200]}..." for x in sorted(found)[:20]]
