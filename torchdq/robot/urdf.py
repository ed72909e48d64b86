"""Robots of URDF files. Numbers are read and checked here; pinocchio puts the joints together and places the links.

Only what dynamics need is read: meshes are never opened, and entities are refused before parsing. Bodies are lumped
here too, because pinocchio drops an inertia that it finds ill-written (a blank after the mass is enough) and goes on,
and loses the centre of mass of a body lighter than 2e-16 kg.
"""

from __future__ import annotations

import math
import re
import reprlib
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq import dq
from torchdq.dynamics.tree import BASE
from torchdq.errors import ArgumentError, DescriptionError, MissingFileError, UnknownNameError
from torchdq.robot import consistency as physical

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
MOST_BYTES = 10_000_000
MOST_TAGS = 200_000
MOST_LINKS = 2_000  # pinocchio recurses over the tree and takes the process with it somewhere beyond 3000
MOST = 1e50  # of any number: the products of three that dynamics form still do not overflow
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d+)?", re.ASCII)


class Inertial(NamedTuple):
    """A link's inertial element."""

    mass: float
    inertia: Tensor  # [3, 3] about the centre of mass
    origin: dict[str, tuple[float, ...]]


class Joint(NamedTuple):
    """A joint element."""

    kind: str
    parent: str
    child: str
    origin: dict[str, tuple[float, ...]]
    axis: tuple[float, ...]  # of unit length
    scaled: bool  # whether the file's axis had another length
    limits: dict[str, float]
    damping: float
    friction: float
    mimics: str | None


class Document(NamedTuple):
    """What the file says, by name, in its order."""

    name: str
    links: dict[str, Inertial | None]
    joints: dict[str, Joint]


# --- reading the text ------------------------------------------------------------------------------------------------


def text_of(source: str | Path) -> str:
    """XML text of a path, or the text itself."""
    if isinstance(source, str) and source.lstrip("\ufeff \t\r\n").startswith("<"):
        if len(source) > MOST_BYTES:
            raise DescriptionError(f"the text has {len(source)} characters; a robot has at most {MOST_BYTES}")
        return source
    try:
        with Path(source).open("rb") as file:
            data = file.read(MOST_BYTES + 1)
    except FileNotFoundError as error:
        raise MissingFileError(f"there is no file {str(source)!r}; XML text would begin with '<'") from error
    except (OSError, ValueError) as error:  # a folder, no permission, a name no file can have
        raise DescriptionError(f"the robot description cannot be read: {error}") from error
    if len(data) > MOST_BYTES:
        raise DescriptionError(f"{source} holds more than {MOST_BYTES} bytes, the most a robot description may have")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise DescriptionError(f"{source} is not UTF-8 text: {error}") from error


def parse(text: str) -> Document:
    """Document of a URDF text; raises `DescriptionError` with every fault found."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DescriptionError("the file declares a document type or entities, which a robot description never needs")
    if text.count("<") > MOST_TAGS:
        raise DescriptionError(f"the file has {text.count('<')} tags; a robot description has at most {MOST_TAGS}")
    try:
        root = ET.fromstring(text)
    except (ET.ParseError, UnicodeError) as error:
        raise DescriptionError(f"the file is not well-formed XML: {error}") from error
    if root.tag != "robot":
        raise DescriptionError(
            f"the file's root element must be <robot>, found <{reprlib.repr(root.tag)[1:-1]}>; expand xacro files first"
        )
    faults: list[str] = []
    links = _by_name(root, "link", faults)
    joints = _by_name(root, "joint", faults)
    if max(len(links), len(joints)) > MOST_LINKS:
        raise DescriptionError(
            f"the file has {len(links)} links and {len(joints)} joints; at most {MOST_LINKS} are read"
        )
    document = Document(
        root.get("name", "robot"),
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
        name = element.get("name", "")
        if not name:
            faults.append(f"a <{tag}> has no name")
        elif name in found:
            faults.append(f"{tag} {name!r} is described twice")
        found[name] = element
    return found


def _numbers(
    what: str,
    element: ET.Element | None,
    attribute: str,
    default: str,
    count: int,
    faults: list[str],
    most: float = MOST,
) -> tuple[float, ...]:
    """The `count` finite numbers of an attribute; a plain float() would let 'nan', '1_0' and other digits through."""
    text = default if element is None else element.get(attribute, default)
    words = text.split()
    values = tuple(float(word) for word in words if _NUMBER.fullmatch(word))
    expected = "a finite number" if count == 1 else f"{count} finite numbers"
    if len(words) != count or len(values) != count or not all(map(math.isfinite, values)):
        faults.append(f"{what} {attribute} must be {expected}, found {reprlib.repr(text)}")
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
    if mass is None or inertia is None:
        faults.append(f"{what} <inertial> must hold <mass> and <inertia>")
        return None
    xx, xy, xz, yy, yz, zz = (
        _numbers(f"{what} inertia", inertia, key, "", 1, faults)[0]
        for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    )
    matrix = torch.tensor([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=torch.float64)
    return Inertial(_numbers(f"{what} mass", mass, "value", "", 1, faults)[0], matrix, origin)


def _joint(name: str, joint: ET.Element, faults: list[str]) -> Joint:
    what, kind = f"joint {name!r}:", joint.get("type", "")
    if kind not in MOVING and kind != "fixed":
        faults.append(f"{what} type must be revolute, continuous, prismatic or fixed, found {kind!r}")
    ends = {}
    for end in ("parent", "child"):
        element = joint.find(end)
        ends[end] = "" if element is None else element.get("link", "")
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
            # the format's own default for a limit that is not stated is 0 for the positions
            default = "0" if key in ("lower", "upper") else None
            if default is not None or limit.get(key) is not None:
                limits[key] = _numbers(f"{what} limit", limit, key, default or "", 1, faults, most=math.inf)[0]
        if limits["lower"] > limits["upper"]:
            faults.append(f"{what} lower limit {limits['lower']:g} is above upper limit {limits['upper']:g}")
    elif kind in ("revolute", "prismatic"):
        faults.append(f"{what} a {kind} joint must have <limit>; a revolute joint without limits is 'continuous'")
    return Joint(
        kind,
        ends["parent"],
        ends["child"],
        origin,
        (x / length, y / length, z / length) if length >= 1e-9 else (1.0, 0.0, 0.0),
        abs(length - 1.0) > 1e-6,
        limits,
        _numbers(f"{what} dynamics", dynamics, "damping", "0", 1, faults)[0],
        _numbers(f"{what} dynamics", dynamics, "friction", "0", 1, faults)[0],
        None if mimic is None else mimic.get("joint", ""),
    )


def _tree_faults(document: Document) -> list[str]:
    """Everything that keeps the links and joints from being one tree."""
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
        faults.append(f"exactly one link must be the base, carried by no joint; found {len(roots)}: {roots}")
    children = _children(document)
    # what hangs on a link that is missing is not in a loop
    frontier = [*roots, *(parent for parent in children if parent not in document.links)]
    reached = set(frontier)
    while frontier:
        for child in children.get(frontier.pop(), ()):
            if child not in reached:
                reached.add(child)
                frontier.append(child)
    loose = [link for link in document.links if link not in reached]
    return [*faults, f"links {loose} hang in a loop"] if loose else faults


def _children(document: Document) -> dict[str, list[str]]:
    children: dict[str, list[str]] = {}
    for joint in document.joints.values():
        children.setdefault(joint.parent, []).append(joint.child)
    return children


# --- building the robot ----------------------------------------------------------------------------------------------


def _codes(kind: str, names: Iterable[str]) -> dict[str, str]:
    """A plain name for each name, in the same alphabetic order, by which pinocchio sorts the joints on a link.

    By their own names pinocchio confuses some; a joint named 'universe' is the base to it.
    """
    return {name: f"{kind}{i:05d}" for i, name in enumerate(sorted(names))}


def _skeleton(document: Document) -> str:
    """URDF text of the joints that were read and checked; every moving joint has one coordinate there."""
    links, joints = _codes("link", document.links), _codes("joint", document.joints)

    def words(numbers: Iterable[float]) -> str:
        return " ".join(map(repr, numbers))

    root = ET.Element("robot", name="robot")
    for name in document.links:
        ET.SubElement(root, "link", name=links[name])
    for name, joint in document.joints.items():
        element = ET.SubElement(root, "joint", name=joints[name], type=MOVING.get(joint.kind, joint.kind))
        ET.SubElement(element, "origin", {key: words(value) for key, value in joint.origin.items()})
        ET.SubElement(element, "parent", link=links[joint.parent])
        ET.SubElement(element, "child", link=links[joint.child])
        ET.SubElement(element, "axis", xyz=words(joint.axis))
        ET.SubElement(element, "limit", lower="0", upper="0", velocity="0", effort="0")
    return ET.tostring(root, encoding="unicode")


def _reduced(document: Document, lock: dict[str, float]):
    """Pinocchio's model of the document with some joints frozen."""
    import pinocchio as pin

    movable = [name for name, joint in document.joints.items() if joint.kind in MOVING]
    for name, value in lock.items():
        if name not in movable:
            raise UnknownNameError("movable joint to lock", name, movable)
        if not abs(value) <= MOST:
            raise ArgumentError(f"lock[{name!r}] must be finite, found {value}")
    try:
        model = pin.buildModelFromXML(_skeleton(document))
    except Exception as error:  # pinocchio raises its C++ errors as various types
        raise DescriptionError(f"pinocchio cannot read the robot description: {error}") from error
    if not lock:
        return model
    codes = _codes("joint", document.joints)
    frozen = [model.getJointId(codes[name]) for name in lock]
    at = pin.neutral(model)
    for joint, value in zip(frozen, lock.values(), strict=True):
        at[model.joints[joint].idx_q] = value
    return pin.buildReducedModel(model, frozen, at)


def _lumped(document: Document, placed: dict[str, tuple[int, Any]], n: int) -> tuple[Tensor, Tensor, Tensor]:
    """Mass [n], centre of mass [n, 3] and inertia [n, 6] of everything that is fixed to each link."""
    import pinocchio as pin

    mass, com, inertia = np.zeros(n), np.zeros((n, 3)), np.zeros((n, 3, 3))
    for name, (i, at) in placed.items():
        inertial = document.links[name]
        if inertial is None or i == BASE:
            continue
        xyz, rpy = (np.array(inertial.origin[key]) for key in ("xyz", "rpy"))
        placement = at * pin.SE3(pin.rpy.rpyToMatrix(*rpy), xyz)
        turned = placement.rotation @ inertial.inertia.numpy() @ placement.rotation.T
        apart = placement.translation - com[i]
        total = mass[i] + inertial.mass
        share = inertial.mass / total if total else 0.0
        com[i] += share * apart
        inertia[i] += turned + mass[i] * share * (apart @ apart * np.eye(3) - np.outer(apart, apart))
        mass[i] = total
    six = inertia[:, [0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
    return torch.from_numpy(mass), torch.from_numpy(com), torch.from_numpy(six)


def _pose(placement) -> Tensor:
    return dq.from_matrix(torch.from_numpy(np.array(placement.homogeneous, dtype=np.float64)))


def read(source: str | Path, lock: dict[str, float]) -> tuple[dict[str, Any], list[str]]:
    """Arguments of a `Robot`, and what is unphysical about it; `Robot.from_urdf` says what is expected."""
    import pinocchio as pin

    document = parse(text_of(source))
    model = _reduced(document, lock)
    known = {code: name for name, code in _codes("joint", document.joints).items()}
    names = tuple(known[code] for code in list(model.names)[1:])
    joints = [document.joints[name] for name in names]
    n = len(joints)
    links = {code: name for name, code in _codes("link", document.links).items()}
    # link and placement there of every link's frame
    placed = {
        links[frame.name]: (frame.parentJoint - 1, frame.placement)
        for frame in model.frames
        if frame.type == pin.FrameType.BODY
    }
    axes = torch.tensor([joint.axis for joint in joints], dtype=torch.float64).reshape(n, 3)
    turns = torch.tensor([MOVING[joint.kind] == "revolute" for joint in joints], dtype=torch.bool).reshape(n, 1)
    placements = [_pose(placement) for placement in list(model.jointPlacements)[1:]]
    mass, com, inertia = _lumped(document, placed, n)
    moving = {name for name, (link, _) in placed.items() if link != BASE}
    findings = [
        fault
        for name, inertial in document.links.items()
        if inertial is not None and name in moving
        for fault in physical.body(name, inertial.mass, inertial.inertia)
    ]
    children = _children(document)
    leaves = [name for name in document.links if name in moving and name not in children]
    description = {
        "name": document.name,
        "joint_names": names,
        "link_names": tuple(joint.child for joint in joints),
        "parents": tuple(int(model.parents[i + 1]) - 1 for i in range(n)),
        "kinds": tuple(MOVING[joint.kind] for joint in joints),
        "X_PB_home": torch.stack(placements) if n else torch.zeros(0, 8, dtype=torch.float64),
        "screw": torch.where(turns, torch.cat([axes, 0 * axes], -1), torch.cat([0 * axes, axes], -1)),
        "mass": mass,
        "com": com,
        "inertia": inertia,
        "limits": {
            key: torch.tensor([joint.limits[key] for joint in joints], dtype=torch.float64)
            for key in ("lower", "upper", "velocity", "effort")
        },
        "damping": torch.tensor([joint.damping for joint in joints], dtype=torch.float64),
        "friction": torch.tensor([joint.friction for joint in joints], dtype=torch.float64),
        "frames": [(name, link, _pose(placement)) for name, (link, placement) in placed.items()],
        "tip": leaves[0] if len(leaves) == 1 else None,
        "notes": _notes(document, names, moving, leaves, lock),
    }
    return description, findings


def _notes(
    document: Document, names: tuple[str, ...], moving: set[str], leaves: list[str], lock: dict[str, float]
) -> tuple[str, ...]:
    """What the file asked for that the dynamics do not use, or use otherwise than asked."""
    joints = {name: document.joints[name] for name in names}

    def listed(wanted: Callable[[Joint], object]) -> str:
        return ", ".join(name for name, joint in joints.items() if wanted(joint))

    massless = ", ".join(
        name for name, inertial in document.links.items() if name in moving and (inertial is None or inertial.mass == 0)
    )
    fixed = sum(joint.kind == "fixed" for joint in document.joints.values())
    given = [
        ("viscous damping given but not simulated", lambda j: j.damping),
        ("Coulomb friction given but not simulated", lambda j: j.friction),
        ("mimic joints treated as independent", lambda j: j.mimics is not None),
        ("limits given but not enforced", lambda j: any(map(math.isfinite, j.limits.values()))),
        ("axes scaled to unit length", lambda j: j.scaled),
    ]
    notes = [
        (f"{fixed} fixed joints lumped; their links are frames", fixed),
        (f"locked: {', '.join(f'{k} at {v:g}' for k, v in lock.items())}", lock),
        (f"links without mass: {massless}", massless),
        *((f"{what}: {listed(wanted)}", listed(wanted)) for what, wanted in given),
        (f"no tip chosen among the leaves {', '.join(leaves)}; name one with tip=", len(leaves) > 1),
    ]
    return tuple(note for note, applies in notes if applies)
