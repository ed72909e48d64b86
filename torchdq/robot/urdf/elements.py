"""Links and joints of a URDF file: names and numbers, checked one by one; every fault is found, none raises."""

from __future__ import annotations

import math
import re
import reprlib
import xml.etree.ElementTree as ET
from typing import NamedTuple

from torchdq.algebra.inertia import Six
from torchdq.algebra.quaternion import ZERO, Pure, Quaternion
from torchdq.algebra.screw import Screw
from torchdq.findings import Finding, printable
from torchdq.robot.arrays import MOST
from torchdq.robot.edit.couplings import Follows

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
OTHERS = ("planar", "floating", "fixed")
ENTRIES = ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
PLANAR = ("x", "y", "angle")  # ends of the names of the joints that a planar joint is made of
MOST_CHARACTERS = 1_000  # longest name
UNLIMITED = {"lower": -math.inf, "upper": math.inf, "velocity": math.inf, "effort": math.inf}
_NUMBER = re.compile(r"[+-]?((\d++(\.\d*+)?|\.\d++)(e[+-]?\d++)?|inf(inity)?)", re.ASCII | re.IGNORECASE)


class Origin(NamedTuple):
    """Placement: translation [m], then roll, pitch and yaw about the fixed x, y and z axes [rad], or a quaternion."""

    xyz: Pure = ZERO
    rpy: Pure = ZERO
    turn: Quaternion | None = None  # of unit length; None: `rpy` says it


class Inertial(NamedTuple):
    """Inertial element of a link."""

    mass: float
    inertia: Six  # about the centre of mass, axes of the origin
    origin: Origin
    stated: bool  # whether the file gives an inertia; without one the body is a point


class UrdfJoint(NamedTuple):
    """Joint element."""

    name: str
    kind: str  # "revolute", "prismatic", "fixed" or "floating"
    parent: str
    child: str
    origin: Origin
    axis: Pure  # unit vector
    scaled: bool  # whether the file's axis had another length
    lower: float
    upper: float
    velocity: float
    effort: float | None  # None: it follows another joint, whose effort counts
    damping: float
    friction: float
    mimic: Follows | None  # the leader by name
    unusable: tuple[str, ...] = ()  # limits that no motion can keep, taken as none
    row: int = -1  # among the joints of the file
    home: float = 0.0
    armature: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether the joint has a coordinate; a floating one has none, as it carries the base."""
        return self.kind in MOVING

    @property
    def screw(self) -> Screw:
        """Screw of the joint in the frame of the link that it carries."""
        return (self.axis, ZERO) if self.kind == "revolute" else (ZERO, self.axis)


class Elements(NamedTuple):
    """Links and joints of a file by name, in its order."""

    name: str
    links: dict[str, Inertial | None]
    joints: dict[str, UrdfJoint]
    unreadable: dict[str, list[Finding]]  # faults in <inertial>, by link
    faults: list[Finding]  # all others


def elements(root: ET.Element) -> Elements:
    """Links and joints of a root element; planar joints are taken apart into two slides and a turn."""
    faults: list[Finding] = []
    name = Part("robot", "", root, faults).name("name") or "robot"
    links, joints = (_by_name(root, tag, faults) for tag in ("link", "joint"))
    unreadable: dict[str, list[Finding]] = {name: [] for name in links}
    bodies = {name: _inertial(link, unreadable[name]) for name, link in links.items()}
    found: dict[str, UrdfJoint] = {}
    for name_, element in joints.items():
        joint = _joint(name_, element, faults)
        parts = [joint]
        if joint.kind == "planar":
            between = [f"{name_}_{part}" for part in PLANAR]
            if taken := [x for x in between if x in joints] + [x for x in between[:2] if x in links]:
                becomes = f"it is planar and becomes {', '.join(between)}; {listed(taken)} already exists"
                faults.append(Finding("name.twice", f"joint {name_!r}", becomes))
                continue
            bodies |= dict.fromkeys(between[:2])
            parts = _taken_apart(joint, between)
        for part in parts:
            found[part.name] = part._replace(row=len(found))
    return Elements(name, bodies, found, {name: x for name, x in unreadable.items() if x}, faults)


def _by_name(root: ET.Element, tag: str, faults: list[Finding]) -> dict[str, ET.Element]:
    found: dict[str, ET.Element] = {}
    for element in root.findall(tag):
        name = Part(tag, "", element, faults).name("name")
        if not name:
            faults.append(Finding("name.missing", tag, f"a <{tag}> has no name"))
        elif name in found:
            faults.append(Finding("name.twice", f"{tag} {name!r}", "it is described twice"))
        found[name] = element
    return found


class Part(NamedTuple):
    """Element of a link or a joint; faults of its attributes are added to a list."""

    subject: str  # link or joint
    what: str  # place of the element there
    element: ET.Element | None
    faults: list[Finding]

    def child(self, tag: str) -> Part:
        """First child with a tag."""
        child = None if self.element is None else self.element.find(tag)
        return Part(self.subject, f"{self.what}{tag} ", child, self.faults)

    def fault(self, code: str, expected: str, found: str = "", cure: str = "") -> None:
        """Add a fault."""
        self.faults.append(Finding(code, self.subject, self.what + expected, found, cure))

    def name(self, attribute: str) -> str:
        """Name in an attribute; empty if there is none."""
        name = "" if self.element is None else self.element.get(attribute, "")
        if len(name) > MOST_CHARACTERS:
            expected = f"{attribute} must have at most {MOST_CHARACTERS} characters"
            self.fault("name.long", expected, f"{len(name)}: {name[:30]!r}...")
        return name[:MOST_CHARACTERS]

    def number(self, attribute: str, default: float | None, signed: bool = True, most: float = MOST) -> float:
        """Number of an attribute; see `numbers`."""
        return self.numbers(attribute, default, 1, signed, most)[0]

    def numbers(
        self, attribute: str, default: float | None, count: int, signed: bool = True, most: float = MOST
    ) -> tuple[float, ...]:
        """Numbers of an attribute; a plain float() would let 'nan', '1_0' and other digits through.

        They are finite unless `most` is infinite. An attribute that is absent has `default` for each number; None: it
        must not be absent.
        """
        given = {} if self.element is None else self.element.attrib
        if attribute not in given and default is not None:
            return (default,) * count
        text = given.get(attribute, "")
        words = text.split(None, count + 1)[: count + 1]  # a file of nothing but numbers is not taken apart
        values = tuple(float(word) for word in words if _NUMBER.fullmatch(word))
        found = reprlib.repr(text)
        if attribute not in given:
            found = f"none, but {', '.join(map(reprlib.repr, given))}" if given else "none"
        if len(words) != count or len(values) != count or (most < math.inf and not all(map(math.isfinite, values))):
            kind = "number" if most == math.inf else "finite number"
            expected = f"a {kind}" if count == 1 else f"{count} {kind}s"
            self.fault("number.invalid", f"{attribute} must be {expected}", found)
        elif not signed and min(values) < 0:
            self.fault("number.negative", f"{attribute} must not be negative", found)
        elif any(abs(value) > most for value in values):
            self.fault("number.large", f"{attribute} must not exceed {most:g} in size", found)
        else:
            return values
        return (0.0,) * count

    def origin(self) -> Origin:
        """Placement of the element."""
        origin = self.child("origin")
        xyz, rpy = origin.numbers("xyz", 0.0, 3), origin.numbers("rpy", 0.0, 3)
        if origin.element is None or "quat_xyzw" not in origin.element.attrib:
            return Origin(xyz, rpy)
        before = len(self.faults)
        *v, w = origin.numbers("quat_xyzw", None, 4)
        length = math.hypot(w, *v)
        if "rpy" in origin.element.attrib:
            origin.fault("origin.twice", "must be turned by rpy or by quat_xyzw", "both")
        elif length < 1e-9 and len(self.faults) == before:
            origin.fault("origin.zero", "quat_xyzw must not be zero", f"{(*v, w)}")
        return Origin(xyz, rpy, (w / length, *(x / length for x in v)) if length >= 1e-9 else None)


def _inertial(link: ET.Element, faults: list[Finding]) -> Inertial | None:
    """Inertial element of a link; None if it is absent or gives no mass."""
    part = Part(f"link {link.get('name', '')[:MOST_CHARACTERS]!r}", "", link, faults)
    if link.find("inertial") is None:
        return None
    origin = part.child("inertial").origin()
    if link.find("inertial/mass") is None:
        return None
    part = Part(part.subject, "", link.find("inertial"), faults)
    inertia = part.child("inertia")
    # one attribute that is not given is a fault; without any the body is a point
    stated = inertia.element is not None and bool(inertia.element.attrib)
    moments = tuple(inertia.number(key, None if stated else 0.0) for key in ENTRIES)
    return Inertial(part.child("mass").number("value", None), moments, origin, stated)


def _joint(name: str, element: ET.Element, faults: list[Finding]) -> UrdfJoint:
    part, kind = Part(f"joint {name!r}", "", element, faults), element.get("type", "")
    if kind not in MOVING and kind not in OTHERS:
        known = f"type must be {', '.join((*MOVING, *OTHERS[:-1]))} or {OTHERS[-1]}"
        part.fault("joint.type", known, reprlib.repr(kind))
    ends = []
    for end in ("parent", "child"):
        ends.append(part.child(end).name("link"))
        if not ends[-1]:
            part.fault("joint.end", f"it names no {end} link", cure=f"a file has it as <{end} link=...>")
    origin, axis, before = part.origin(), part.child("axis"), len(faults)
    given = axis.element is not None and "xyz" in axis.element.attrib
    x, y, z = axis.numbers("xyz", None, 3) if given else (1.0, 0.0, 0.0)
    length = math.hypot(x, y, z)
    if kind in (*MOVING, "planar") and length < 1e-9 and len(faults) == before:
        part.fault("axis.zero", "axis must have a direction", f"{(x, y, z)}")
    limit, bounds = part.child("limit"), {**UNLIMITED}
    if limit.element is not None:
        for key in ("velocity", "effort") if kind == "continuous" else tuple(bounds):
            place = key in ("lower", "upper")
            # the format's own default for a limit that is not stated is 0 for the positions
            if place or key in limit.element.attrib:
                bounds[key] = limit.number(key, 0.0, most=math.inf)
    bounds, unusable = _usable(bounds)
    dynamics, mimic = part.child("dynamics"), part.child("mimic")
    return UrdfJoint(
        name,
        MOVING.get(kind, kind if kind in OTHERS else "fixed"),
        ends[0],
        ends[1],
        origin,
        (x / length, y / length, z / length) if length >= 1e-9 else (1.0, 0.0, 0.0),
        abs(length - 1.0) > 1e-6,
        lower=bounds["lower"],
        upper=bounds["upper"],
        velocity=bounds["velocity"],
        effort=bounds["effort"],
        damping=dynamics.number("damping", 0.0, signed=False),
        friction=dynamics.number("friction", 0.0, signed=False),
        mimic=None
        if mimic.element is None
        else Follows(mimic.name("joint"), mimic.number("multiplier", 1.0), mimic.number("offset", 0.0)),
        unusable=unusable,
    )


def _usable(bounds: dict[str, float]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Limits without those that no motion can keep, by which files mean that there are none, and these in words."""
    wrong = [key for key in ("velocity", "effort") if bounds[key] < 0]
    shown = [f"{key} {bounds[key]:g}" for key in wrong]
    if bounds["lower"] > bounds["upper"] or math.inf in (bounds["lower"], -bounds["upper"]):
        wrong += ["lower", "upper"]
        shown.insert(0, f"lower {bounds['lower']:g} above upper {bounds['upper']:g}")
    return bounds | {key: UNLIMITED[key] for key in wrong}, tuple(shown)


def _taken_apart(joint: UrdfJoint, names: list[str]) -> list[UrdfJoint]:
    """Planar joint as two slides in the plane and a turn about its normal, with two more links in between."""
    x, y, z = joint.axis
    # a right-handed frame with the axis as z (Duff et al., JCGT 6(1), 2017)
    s = math.copysign(1.0, z)
    a = -1.0 / (s + z)
    b = x * y * a
    axes = (1.0 + s * x * x * a, s * b, -s * x), (b, s + y * y * a, -y), joint.axis
    ends = [joint.parent, *names[:2], joint.child]
    return [
        joint._replace(
            name=name,
            kind="revolute" if i == 2 else "prismatic",
            parent=ends[i],
            child=ends[i + 1],
            origin=joint.origin if i == 0 else Origin(),
            axis=axes[i],
            **UNLIMITED,  # type: ignore[arg-type]
            unusable=(),
            mimic=None,
        )
        for i, name in enumerate(names)
    ]


def listed(names: list[str]) -> str:
    """Names, the first twenty of many."""
    shown = ", ".join(map(printable, names[:20])) or "none"
    return shown if len(names) <= 20 else f"{shown} and {len(names) - 20} more"
