"""Text of a URDF file, parsed and checked; every fault is named at once.

Only the elements that dynamics need are read: meshes are never opened.
"""

from __future__ import annotations

import math
import re
import reprlib
import xml.etree.ElementTree as ET
from typing import Any, NamedTuple

from torch import Tensor

from torchdq.errors import DescriptionError, MissingFileError
from torchdq.robot.arrays import MOST, double
from torchdq.robot.urdf_xml import root_of
from torchdq.sources import content

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
MOST_BYTES = 10_000_000
MOST_CHARACTERS = 1_000  # longest name
MOST_LINKS = 2_000  # pinocchio recurses over the tree and crashes the process somewhere beyond 3000
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)


class Inertial(NamedTuple):
    """Inertial element of a link."""

    mass: float
    inertia: Tensor  # [3, 3] about the centre of mass
    origin: dict[str, tuple[float, ...]]
    stated: bool  # whether the file gives an inertia; without one the body is a point


class Mimic(NamedTuple):
    """Joint that another follows, at multiplier times its position plus offset."""

    joint: str
    multiplier: float
    offset: float


class UrdfJoint(NamedTuple):
    """Joint element."""

    kind: str
    parent: str
    child: str
    origin: dict[str, tuple[float, ...]]
    axis: tuple[float, ...]  # unit vector
    scaled: bool  # whether the file's axis had another length
    limits: dict[str, float]
    damping: float
    friction: float
    mimics: Mimic | None


class Document(NamedTuple):
    """Links and joints of a file by name, in its order."""

    name: str
    links: dict[str, Inertial | None]
    joints: dict[str, UrdfJoint]


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


def parse(text: str) -> Document:
    """Document of a URDF text; raises `DescriptionError` with every fault found."""
    root = root_of(text)
    faults: list[str] = []
    robot = _name("robot:", root, "name", faults) or "robot"
    links = _by_name(root, "link", faults)
    joints = _by_name(root, "joint", faults)
    if max(len(links), len(joints)) > MOST_LINKS:
        raise DescriptionError(
            f"the file has {len(links)} links and {len(joints)} joints; at most {MOST_LINKS} are read"
        )
    document = Document(
        robot,
        {name: _inertial(name, element, faults) for name, element in links.items()},
        {name: _joint(name, element, faults) for name, element in joints.items()},
    )
    faults += _tree_faults(document)
    if faults:
        raise DescriptionError("the robot description cannot be used:\n  " + "\n  ".join(faults))
    return document


def _by_name(root: ET.Element, tag: str, faults: list[str]) -> dict[str, ET.Element]:
    found: dict[str, ET.Element] = {}
    for element in root.findall(tag):
        name = _name(f"{tag}:", element, "name", faults)
        if not name:
            faults.append(f"a <{tag}> has no name")
        elif name in found:
            faults.append(f"{tag} {name!r} is described twice")
        found[name] = element
    return found


def _name(what: str, element: ET.Element | None, attribute: str, faults: list[str]) -> str:
    """Name in an attribute; empty if there is none."""
    name = "" if element is None else element.get(attribute, "")
    if len(name) <= MOST_CHARACTERS:
        return name
    faults.append(
        f"{what} {attribute} must have at most {MOST_CHARACTERS} characters, found {len(name)}: {name[:30]!r}..."
    )
    return name[:MOST_CHARACTERS]


def _numbers(
    what: str,
    element: ET.Element | None,
    attribute: str,
    default: str,
    count: int,
    faults: list[str],
    signed: bool = True,
    most: float = MOST,
) -> tuple[float, ...]:
    """Numbers of an attribute, `count` finite ones; a plain float() would let 'nan', '1_0' and other digits through."""
    text = default if element is None else element.get(attribute, default)
    words = text.split(None, count + 1)[: count + 1]  # a file of nothing but numbers is not taken apart
    values = tuple(float(word) for word in words if _NUMBER.fullmatch(word))
    expected = "a finite number" if count == 1 else f"{count} finite numbers"
    if len(words) != count or len(values) != count or not all(map(math.isfinite, values)):
        faults.append(f"{what} {attribute} must be {expected}, found {reprlib.repr(text)}")
    elif not signed and min(values) < 0:
        faults.append(f"{what} {attribute} must not be negative, found {reprlib.repr(text)}")
    elif any(abs(value) > most for value in values):
        faults.append(f"{what} {attribute} must not exceed {most:g} in size, found {reprlib.repr(text)}")
    else:
        return values
    return (0.0,) * count


def _origin(what: str, element: ET.Element, faults: list[str]) -> dict[str, tuple[float, ...]]:
    origin = element.find("origin")
    if origin is not None and "quat_xyzw" in origin.attrib:
        faults.append(f"{what} origin must be given as xyz and rpy, found quat_xyzw")
    return {key: _numbers(f"{what} origin", origin, key, "0 0 0", 3, faults) for key in ("xyz", "rpy")}


def _inertial(name: str, link: ET.Element, faults: list[str]) -> Inertial | None:
    element = link.find("inertial")
    if element is None:
        return None
    what = f"link {name!r}:"
    origin = _origin(f"{what} inertial", element, faults)
    mass, inertia = element.find("mass"), element.find("inertia")
    if mass is None:
        faults.append(f"{what} <inertial> must hold <mass>, found only {[child.tag for child in element]}")
        return None
    # an attribute that is not given is a fault, an element that is not given is a point
    absent = "0" if inertia is None else ""
    xx, xy, xz, yy, yz, zz = (
        _numbers(f"{what} inertia", inertia, key, absent, 1, faults)[0]
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    matrix = double([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Inertial(_numbers(f"{what} mass", mass, "value", "", 1, faults)[0], matrix, origin, inertia is not None)


def _joint(name: str, joint: ET.Element, faults: list[str]) -> UrdfJoint:
    what, kind = f"joint {name!r}:", joint.get("type", "")
    if kind not in MOVING and kind != "fixed":
        faults.append(f"{what} type must be revolute, continuous, prismatic or fixed, found {reprlib.repr(kind)}")
    ends = {}
    for end in ("parent", "child"):
        element = joint.find(end)
        ends[end] = _name(f"{what} {end}", element, "link", faults)
        if not ends[end]:
            faults.append(f"{what} it names no {end} link")
    origin = _origin(what, joint, faults)
    before = len(faults)
    x, y, z = _numbers(f"{what} axis", joint.find("axis"), "xyz", "1 0 0", 3, faults)
    length = math.hypot(x, y, z)
    if kind in MOVING and length < 1e-9 and len(faults) == before:
        faults.append(f"{what} axis must have a direction, found {(x, y, z)}")
    limit, dynamics, mimic = joint.find("limit"), joint.find("dynamics"), joint.find("mimic")
    limits = {"lower": -math.inf, "upper": math.inf, "velocity": math.inf, "effort": math.inf}
    if limit is not None:
        for key in ("velocity", "effort") if kind == "continuous" else tuple(limits):
            place = key in ("lower", "upper")
            # the format's own default for a limit that is not stated is 0 for the positions
            if place or limit.get(key) is not None:
                limits[key] = _numbers(f"{what} limit", limit, key, "0", 1, faults, signed=place, most=math.inf)[0]
        if limits["lower"] > limits["upper"]:
            faults.append(f"{what} lower limit {limits['lower']:g} is above upper limit {limits['upper']:g}")
    elif kind in ("revolute", "prismatic"):
        faults.append(f"{what} a {kind} joint must have <limit>; a revolute joint without limits is 'continuous'")
    return UrdfJoint(
        kind,
        ends["parent"],
        ends["child"],
        origin,
        (x / length, y / length, z / length) if length >= 1e-9 else (1.0, 0.0, 0.0),
        abs(length - 1.0) > 1e-6,
        limits,
        _numbers(f"{what} dynamics", dynamics, "damping", "0", 1, faults, signed=False)[0],
        _numbers(f"{what} dynamics", dynamics, "friction", "0", 1, faults, signed=False)[0],
        None if mimic is None else _mimic(f"{what} mimic", mimic, faults),
    )


def _mimic(what: str, mimic: ET.Element, faults: list[str]) -> Mimic:
    factors = {"multiplier": "1", "offset": "0"}
    numbers = (_numbers(what, mimic, key, default, 1, faults)[0] for key, default in factors.items())
    return Mimic(_name(what, mimic, "joint", faults), *numbers)


def _tree_faults(document: Document) -> list[str]:
    """Faults that keep the links and joints from being one tree."""
    if not document.links:
        return ["the robot has no links; exactly one link must be the base, carried by no joint; found 0"]
    faults = []
    carried: dict[str, str] = {}  # link -> joint that carries it
    for name, joint in document.joints.items():
        for end in (joint.parent, joint.child):
            if end and end not in document.links:
                faults.append(f"joint {name!r}: there is no link {end!r}")
        if joint.child in carried:
            faults.append(f"link {joint.child!r} is carried by two joints, {carried[joint.child]!r} and {name!r}")
        if joint.child:
            carried[joint.child] = name
    roots = [link for link in document.links if link not in carried]
    if len(roots) != 1:
        faults.append(f"exactly one link must be the base, carried by no joint; found {len(roots)}: {_listed(roots)}")
    children = children_of(document)
    # links that hang on a missing link are in no loop
    frontier = [*roots, *(parent for parent in children if parent not in document.links)]
    reached = set(frontier)
    while frontier:
        for child in children.get(frontier.pop(), ()):
            if child not in reached:
                reached.add(child)
                frontier.append(child)
    loose = [link for link in document.links if link not in reached]
    return [*faults, f"links {_listed(loose)} hang in a loop"] if loose else faults


def _listed(names: list[str]) -> str:
    """Names in brackets, the first twenty of many."""
    return f"{names}" if len(names) <= 20 else f"{names[:20]} and {len(names) - 20} more"


def children_of(document: Document) -> dict[str, list[str]]:
    """Names of the links that hang on each link by a joint."""
    children: dict[str, list[str]] = {}
    for joint in document.joints.values():
        children.setdefault(joint.parent, []).append(joint.child)
    return children
