"""Elements of a URDF file: names, numbers, inertials and joints, checked one by one."""

from __future__ import annotations

import math
import re
import reprlib
import xml.etree.ElementTree as ET
from typing import NamedTuple

from torchdq.algebra.inertia import Six
from torchdq.robot.arrays import MOST

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
MOST_CHARACTERS = 1_000  # longest name
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)


Origin = dict[str, tuple[float, ...]]  # "xyz" and "rpy"


class Inertial(NamedTuple):
    """Inertial element of a link."""

    mass: float
    inertia: Six  # about the centre of mass, axes of the origin
    origin: Origin
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
    origin: Origin
    axis: tuple[float, ...]  # unit vector
    scaled: bool  # whether the file's axis had another length
    limits: dict[str, float]
    damping: float
    friction: float
    mimics: Mimic | None


def name_in(what: str, element: ET.Element | None, attribute: str, faults: list[str]) -> str:
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
    default: float | None,
    count: int,
    faults: list[str],
    signed: bool = True,
    most: float = MOST,
) -> tuple[float, ...]:
    """Numbers of an attribute, `count` finite ones; a plain float() would let 'nan', '1_0' and other digits through.

    An attribute that is absent has `default` in place of each number; None: it must not be absent.
    """
    text = None if element is None else element.get(attribute)
    found = _absent(element) if text is None else reprlib.repr(text)
    if text is None and default is not None:
        return (default,) * count
    text = text or ""
    words = text.split(None, count + 1)[: count + 1]  # a file of nothing but numbers is not taken apart
    values = tuple(float(word) for word in words if _NUMBER.fullmatch(word))
    expected = "a finite number" if count == 1 else f"{count} finite numbers"
    if len(words) != count or len(values) != count or not all(map(math.isfinite, values)):
        faults.append(f"{what} {attribute} must be {expected}, found {found}")
    elif not signed and min(values) < 0:
        faults.append(f"{what} {attribute} must not be negative, found {reprlib.repr(text)}")
    elif any(abs(value) > most for value in values):
        faults.append(f"{what} {attribute} must not exceed {most:g} in size, found {reprlib.repr(text)}")
    else:
        return values
    return (0.0,) * count


def _absent(element: ET.Element | None) -> str:
    """Words for an attribute that is not there, with those that are."""
    others = ", ".join(map(reprlib.repr, () if element is None else element.attrib))
    return f"none beside {others}" if others else "none"


def _origin(what: str, element: ET.Element, faults: list[str]) -> Origin:
    origin = element.find("origin")
    if origin is not None and "quat_xyzw" in origin.attrib:
        faults.append(f"{what} origin must be given as xyz and rpy, found quat_xyzw")
    return {key: _numbers(f"{what} origin", origin, key, 0.0, 3, faults) for key in ("xyz", "rpy")}


def inertial_of(name: str, link: ET.Element, faults: list[str]) -> Inertial | None:
    """Inertial element of a link; None if it is absent or gives no mass."""
    element = link.find("inertial")
    if element is None:
        return None
    what = f"link {name!r}:"
    origin = _origin(f"{what} inertial", element, faults)
    mass, inertia = element.find("mass"), element.find("inertia")
    if mass is None:
        return None
    # one attribute that is not given is a fault; without any the body is a point
    stated = inertia is not None and bool(inertia.attrib)
    absent = None if stated else 0.0
    entries = tuple(
        _numbers(f"{what} inertia", inertia, key, absent, 1, faults)[0]
        for key in ("ixx", "ixy", "iyy", "ixz", "iyz", "izz")
    )
    return Inertial(_numbers(f"{what} mass", mass, "value", None, 1, faults)[0], entries, origin, stated)


def joint_of(name: str, joint: ET.Element, faults: list[str]) -> UrdfJoint:
    """Joint element."""
    what, kind = f"joint {name!r}:", joint.get("type", "")
    if kind not in MOVING and kind not in ("fixed", "planar"):
        advice = "; leave it out and pass base='floating' if it carries the robot" if kind == "floating" else ""
        known = "revolute, continuous, prismatic, planar or fixed"
        faults.append(f"{what} type must be {known}, found {reprlib.repr(kind)}{advice}")
    ends = {}
    for end in ("parent", "child"):
        element = joint.find(end)
        ends[end] = name_in(f"{what} {end}", element, "link", faults)
        if not ends[end]:
            faults.append(f"{what} it names no {end} link; a file has it as <{end} link=...>")
    origin = _origin(what, joint, faults)
    before = len(faults)
    axis = joint.find("axis")
    given = axis is not None and "xyz" in axis.attrib
    x, y, z = _numbers(f"{what} axis", axis, "xyz", None, 3, faults) if given else (1.0, 0.0, 0.0)
    length = math.hypot(x, y, z)
    if kind in (*MOVING, "planar") and length < 1e-9 and len(faults) == before:
        faults.append(f"{what} axis must have a direction, found {(x, y, z)}")
    limit, dynamics, mimic = joint.find("limit"), joint.find("dynamics"), joint.find("mimic")
    limits = {"lower": -math.inf, "upper": math.inf, "velocity": math.inf, "effort": math.inf}
    if limit is not None:
        for key in ("velocity", "effort") if kind == "continuous" else tuple(limits):
            place = key in ("lower", "upper")
            # the format's own default for a limit that is not stated is 0 for the positions
            if place or limit.get(key) is not None:
                limits[key] = _numbers(f"{what} limit", limit, key, 0.0, 1, faults, signed=place, most=math.inf)[0]
        if limits["lower"] > limits["upper"]:
            faults.append(f"{what} lower limit {limits['lower']:g} is above upper limit {limits['upper']:g}")
    return UrdfJoint(
        kind,
        ends["parent"],
        ends["child"],
        origin,
        (x / length, y / length, z / length) if length >= 1e-9 else (1.0, 0.0, 0.0),
        abs(length - 1.0) > 1e-6,
        limits,
        _numbers(f"{what} dynamics", dynamics, "damping", 0.0, 1, faults, signed=False)[0],
        _numbers(f"{what} dynamics", dynamics, "friction", 0.0, 1, faults, signed=False)[0],
        None if mimic is None else _mimic(f"{what} mimic", mimic, faults),
    )


def _mimic(what: str, mimic: ET.Element, faults: list[str]) -> Mimic:
    factors = {"multiplier": 1.0, "offset": 0.0}
    numbers = (_numbers(what, mimic, key, default, 1, faults)[0] for key, default in factors.items())
    return Mimic(name_in(what, mimic, "joint", faults), *numbers)


def listed(names: list[str]) -> str:
    """Names in brackets, the first twenty of many."""
    return f"{names}" if len(names) <= 20 else f"{names[:20]} and {len(names) - 20} more"
