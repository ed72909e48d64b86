"""Robots of URDF files. Pinocchio reads the tree and lumps fixed joints; what it accepts silently is checked here.

Only numbers that dynamics need are read; meshes are never opened, and entities are refused before parsing.
"""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchdq import dq
from torchdq.dynamics.mechanism import BASE
from torchdq.errors import ArgumentError, DescriptionError, UnknownNameError
from torchdq.robot import physical

MOVING = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic"}
MOST_BYTES = 10_000_000
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)


class Inertial(NamedTuple):
    """A link's inertial element."""

    mass: float
    inertia: Tensor  # [3, 3] about the centre of mass


class Joint(NamedTuple):
    """A joint element."""

    kind: str
    parent: str
    child: str
    axis: tuple[float, ...]
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
    if isinstance(source, str) and source.lstrip().startswith("<"):
        return source
    data = Path(source).read_bytes()
    if len(data) > MOST_BYTES:
        raise DescriptionError(f"{source} holds {len(data)} bytes; a robot description has at most {MOST_BYTES}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise DescriptionError(f"{source} is not UTF-8 text: {error}") from error


def parse(text: str) -> Document:
    """Document of a URDF text; raises `DescriptionError` with every fault found."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DescriptionError("the file declares a document type or entities, which a robot description never needs")
    try:
        root = ET.fromstring(text)
    except ET.ParseError as error:
        raise DescriptionError(f"the file is not well-formed XML: {error}") from error
    if root.tag != "robot":
        raise DescriptionError(f"the file's root element must be <robot>, found <{root.tag}>; expand xacro files first")
    faults: list[str] = []
    links = _by_name(root, "link", faults)
    joints = _by_name(root, "joint", faults)
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


def _numbers(owner: str, element: ET.Element | None, attribute: str, default: str, count: int, faults: list[str]):
    """The `count` finite numbers of an attribute; a plain float() would let 'nan', '1_0' and other digits through."""
    text = default if element is None else element.get(attribute, default)
    words = text.split()
    if len(words) != count or not all(_NUMBER.fullmatch(word) for word in words):
        faults.append(f"{owner}: {attribute} must be {count} finite number(s), found {text!r}")
        return (0.0,) * count
    values = tuple(float(word) for word in words)
    if not all(map(math.isfinite, values)):
        faults.append(f"{owner}: {attribute} must be finite, found {text!r}")
        return (0.0,) * count
    return values


def _origin(owner: str, element: ET.Element, faults: list[str]) -> None:
    """Check an origin's numbers; their meaning is left to pinocchio."""
    origin = element.find("origin")
    _numbers(owner, origin, "xyz", "0 0 0", 3, faults)
    _numbers(owner, origin, "rpy", "0 0 0", 3, faults)


def _inertial(name: str, link: ET.Element, faults: list[str]) -> Inertial | None:
    element = link.find("inertial")
    if element is None:
        return None
    owner = f"link {name!r}"
    _origin(owner, element, faults)
    mass, inertia = element.find("mass"), element.find("inertia")
    if mass is None or inertia is None:
        faults.append(f"{owner}: <inertial> must hold <mass> and <inertia>")
        return None
    entries = {k: _numbers(owner, inertia, k, "", 1, faults)[0] for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
    xx, xy, xz, yy, yz, zz = entries.values()
    matrix = torch.tensor([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=torch.float64)
    return Inertial(_numbers(owner, mass, "value", "", 1, faults)[0], matrix)


def _joint(name: str, joint: ET.Element, faults: list[str]) -> Joint:
    owner, kind = f"joint {name!r}", joint.get("type", "")
    if kind not in MOVING and kind != "fixed":
        faults.append(f"{owner}: type must be revolute, continuous, prismatic or fixed, found {kind!r}")
    ends = {}
    for end in ("parent", "child"):
        element = joint.find(end)
        ends[end] = "" if element is None else element.get("link", "")
        if not ends[end]:
            faults.append(f"{owner}: it names no {end} link")
    _origin(owner, joint, faults)
    axis = _numbers(owner, joint.find("axis"), "xyz", "1 0 0", 3, faults)
    if kind in MOVING and math.hypot(*axis) < 1e-9:
        faults.append(f"{owner}: axis must have a direction, found {axis}")
    limit, dynamics, mimic = joint.find("limit"), joint.find("dynamics"), joint.find("mimic")
    limits = {"lower": -math.inf, "upper": math.inf, "velocity": math.inf, "effort": math.inf}
    if limit is not None:
        stated = ("velocity", "effort") if kind == "continuous" else tuple(limits)
        for key in stated:
            # the format's own default for a limit that is not stated is 0 for the positions
            default = "0" if key in ("lower", "upper") else None
            if default is not None or limit.get(key) is not None:
                limits[key] = _numbers(owner, limit, key, default or "", 1, faults)[0]
        if limits["lower"] > limits["upper"]:
            faults.append(f"{owner}: lower limit {limits['lower']:g} is above upper limit {limits['upper']:g}")
    elif kind in ("revolute", "prismatic"):
        faults.append(f"{owner}: a {kind} joint must have <limit>; a revolute joint without limits is 'continuous'")
    return Joint(
        kind,
        ends["parent"],
        ends["child"],
        axis,
        limits,
        _numbers(owner, dynamics, "damping", "0", 1, faults)[0],
        _numbers(owner, dynamics, "friction", "0", 1, faults)[0],
        None if mimic is None else mimic.get("joint", ""),
    )


def _tree_faults(document: Document) -> list[str]:
    """Everything that keeps the links and joints from being one tree."""
    faults = []
    carried: dict[str, str] = {}  # link -> joint that carries it
    for name, joint in document.joints.items():
        for end in (joint.parent, joint.child):
            if end and end not in document.links:
                faults.append(f"joint {name!r}: there is no link {end!r}")
        if joint.child in carried:
            faults.append(f"link {joint.child!r} is carried by two joints, {carried[joint.child]!r} and {name!r}")
        carried[joint.child] = name
    roots = [link for link in document.links if link not in carried]
    if len(roots) != 1:
        faults.append(f"exactly one link must be the base, carried by no joint; found {len(roots)}: {roots}")
    reached, frontier = set(roots), list(roots)
    children = _children(document)
    while frontier:
        for child in children.get(frontier.pop(), ()):
            if child not in reached:
                reached.add(child)
                frontier.append(child)
    loose = [link for link in document.links if link not in reached]
    return [*faults, f"links {loose} hang in a loop"] if loose and not faults else faults


def _children(document: Document) -> dict[str, list[str]]:
    children: dict[str, list[str]] = {}
    for joint in document.joints.values():
        children.setdefault(joint.parent, []).append(joint.child)
    return children


# --- building the robot ----------------------------------------------------------------------------------------------


def _reduced(text: str, document: Document, lock: dict[str, float]):
    """Pinocchio's model of the text with some joints frozen."""
    import pinocchio as pin

    movable = [name for name, joint in document.joints.items() if joint.kind in MOVING]
    for name, value in lock.items():
        if name not in movable:
            raise UnknownNameError("movable joint to lock", name, movable)
        if not math.isfinite(value):
            raise ArgumentError(f"lock[{name!r}] must be finite, found {value}")
    try:
        model = pin.buildModelFromXML(text)
    except Exception as error:  # pinocchio raises its C++ errors as various types
        raise DescriptionError(f"pinocchio cannot read the robot description: {error}") from error
    if not lock:
        return model
    at = pin.neutral(model)
    for name, value in lock.items():
        joint = model.joints[model.getJointId(name)]
        coordinates = [value] if joint.nq == 1 else [math.cos(value), math.sin(value)]
        at[joint.idx_q : joint.idx_q + joint.nq] = coordinates
    return pin.buildReducedModel(model, [model.getJointId(name) for name in lock], at)


def _pose(placement) -> Tensor:
    return dq.from_matrix(torch.from_numpy(np.array(placement.homogeneous, dtype=np.float64)))


def read(source: str | Path, lock: dict[str, float]) -> tuple[dict[str, Any], list[str]]:
    """Arguments of a `Robot`, and what is unphysical about it; `Robot.from_urdf` says what is expected."""
    import pinocchio as pin

    text = text_of(source)
    document = parse(text)
    model = _reduced(text, document, lock)
    names = tuple(model.names)[1:]
    joints = [document.joints[name] for name in names]
    n = len(joints)
    frames = [
        (frame.name, frame.parentJoint - 1, _pose(frame.placement))
        for frame in model.frames
        if frame.type == pin.FrameType.BODY
    ]
    axes = torch.tensor([joint.axis for joint in joints], dtype=torch.float64).reshape(n, 3)
    axes = axes / torch.linalg.vector_norm(axes, dim=-1, keepdim=True)
    turns = torch.tensor([MOVING[joint.kind] == "revolute" for joint in joints]).reshape(n, 1)
    bodies = list(model.inertias)[1:]
    inertias = torch.tensor(np.array([body.inertia for body in bodies]).reshape(n, 3, 3))
    moving = {name for name, link, _ in frames if link != BASE}
    findings = [
        fault
        for name, inertial in document.links.items()
        if inertial is not None and name in moving
        for fault in physical.body(name, inertial.mass, inertial.inertia)
    ]
    leaves = [name for name in document.links if name in moving and name not in _children(document)]
    description = {
        "name": document.name,
        "joint_names": names,
        "link_names": tuple(joint.child for joint in joints),
        "parents": tuple(int(model.parents[i + 1]) - 1 for i in range(n)),
        "kinds": tuple(MOVING[joint.kind] for joint in joints),
        "X_PB_home": torch.stack([_pose(p) for p in list(model.jointPlacements)[1:]]) if n else torch.zeros(0, 8).double(),
        "screw": torch.where(turns, torch.cat([axes, 0 * axes], -1), torch.cat([0 * axes, axes], -1)),
        "mass": torch.tensor([body.mass for body in bodies], dtype=torch.float64),
        "com": torch.tensor(np.array([body.lever for body in bodies]).reshape(n, 3)),
        "inertia": torch.stack([inertias[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))], -1),
        "limits": {
            key: torch.tensor([joint.limits[key] for joint in joints], dtype=torch.float64)
            for key in ("lower", "upper", "velocity", "effort")
        },
        "damping": torch.tensor([joint.damping for joint in joints], dtype=torch.float64),
        "friction": torch.tensor([joint.friction for joint in joints], dtype=torch.float64),
        "frames": frames,
        "tip": leaves[0] if len(leaves) == 1 else None,
        "notes": _notes(document, names, moving, leaves, lock),
    }
    return description, findings


def _notes(
    document: Document, names: tuple[str, ...], moving: set[str], leaves: list[str], lock: dict[str, float]
) -> tuple[str, ...]:
    """What the file asked for that the dynamics do not use, or use otherwise than asked."""
    joints = {name: document.joints[name] for name in names}

    def listed(wanted) -> str:
        return ", ".join(name for name, joint in joints.items() if wanted(joint))

    massless = ", ".join(
        name for name, inertial in document.links.items() if name in moving and (inertial is None or inertial.mass == 0)
    )
    fixed = sum(joint.kind == "fixed" for joint in document.joints.values())
    notes = [
        (f"{fixed} fixed joints lumped; their links are frames", fixed),
        (f"locked: {', '.join(f'{k} at {v:g}' for k, v in lock.items())}", lock),
        (f"links without mass: {massless}", massless),
        (f"viscous damping given but not simulated: {listed(lambda j: j.damping)}", listed(lambda j: j.damping)),
        (f"Coulomb friction given but not simulated: {listed(lambda j: j.friction)}", listed(lambda j: j.friction)),
        (f"mimic joints treated as independent: {listed(lambda j: j.mimics)}", listed(lambda j: j.mimics)),
        (
            f"position limits given but not enforced: {listed(lambda j: math.isfinite(j.limits['upper']))}",
            listed(lambda j: math.isfinite(j.limits["upper"])),
        ),
        (
            f"axes scaled to unit length: {listed(lambda j: abs(math.hypot(*j.axis) - 1) > 1e-6)}",
            listed(lambda j: abs(math.hypot(*j.axis) - 1) > 1e-6),
        ),
        (f"no tip chosen among the leaves {', '.join(leaves)}; name one with tip=", len(leaves) > 1),
    ]
    return tuple(note for note, applies in notes if applies)
