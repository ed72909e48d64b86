"""Robots from URDF files. Numbers are read and checked in `urdf_document`; pinocchio places the joints and the links.

Bodies are lumped here, because pinocchio drops an inertia that it finds ill-written (a blank after the mass is enough)
and goes on, and loses the centre of mass of a body lighter than 2e-16 kg.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdq import dq
from torchdq.backends.choice import backend
from torchdq.dynamics.tree import BASE
from torchdq.errors import DescriptionError
from torchdq.robot import consistency
from torchdq.robot.arrays import SIX, double
from torchdq.robot.description import Frame, Limits, RobotDescription
from torchdq.robot.urdf_document import MOVING, Document, Inertial, UrdfJoint, children_of, parse, text_of
from torchdq.robot.urdf_lock import locked, notes_of


def _codes(kind: str, names: Iterable[str]) -> dict[str, str]:
    """Plain names in the alphabetic order of the names, by which pinocchio sorts the joints on a link.

    Pinocchio has names of its own: it takes a joint of a file that is named 'universe' for the base.
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
        rotated = placement.rotation @ inertial.inertia.numpy() @ placement.rotation.T
        apart = placement.translation - com[i]
        total = mass[i] + inertial.mass
        share = inertial.mass / total if total else 0.0
        com[i] += share * apart
        inertia[i] += rotated + mass[i] * share * (apart @ apart * np.eye(3) - np.outer(apart, apart))
        mass[i] = total
    return torch.from_numpy(mass), torch.from_numpy(com), torch.from_numpy(inertia[:, *SIX])


@backend("eager")  # a few poses are not worth a compilation
def _pose(placement) -> Tensor:
    return dq.from_matrix(torch.from_numpy(np.array(placement.homogeneous, dtype=np.float64)))


def read(source: Any, kept: Any, lock: Any) -> tuple[RobotDescription, list[str]]:
    """Description and its faults; `Robot.from_urdf` says what is expected."""
    import pinocchio as pin

    document = parse(text_of(source))
    at = locked(document, kept, lock)
    model = _reduced(document, at)
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
    axes = double([joint.axis for joint in joints]).reshape(n, 3)
    turns = torch.tensor([MOVING[joint.kind] == "revolute" for joint in joints], dtype=torch.bool).reshape(n, 1)
    placements = [_pose(placement) for placement in list(model.jointPlacements)[1:]]
    mass, com, inertia = _lumped(document, placed, n)
    moving = {name: document.links[name] for name in document.links if placed.get(name, (BASE,))[0] != BASE}
    faults = [f for name, body in moving.items() if body for f in consistency.body(name, body.mass, body.inertia)]
    children = children_of(document)
    leaves = [name for name in moving if name not in children]
    description = RobotDescription(
        name=document.name,
        joint_names=names,
        link_names=tuple(joint.child for joint in joints),
        parents=tuple(int(parent) - 1 for parent in list(model.parents)[1:]),
        kinds=tuple(MOVING[joint.kind] for joint in joints),
        X_PB_home=torch.stack(placements) if n else torch.zeros(0, 8, dtype=torch.float64),
        screw=torch.where(turns, torch.cat([axes, 0 * axes], -1), torch.cat([0 * axes, axes], -1)),
        mass=mass,
        com=com,
        inertia=inertia,
        limits=Limits(*(double([joint.limits[key] for joint in joints]) for key in Limits._fields)),
        damping=double([joint.damping for joint in joints]),
        friction=double([joint.friction for joint in joints]),
        frames=tuple(Frame(name, link, _pose(placement)) for name, (link, placement) in placed.items()),
        tip=leaves[0] if len(leaves) == 1 else None,
        notes=_notes(document, names, moving, leaves, at),
    )
    return description, faults


def _notes(
    document: Document,
    names: tuple[str, ...],
    moving: dict[str, Inertial | None],
    leaves: list[str],
    lock: dict[str, float],
) -> tuple[str, ...]:
    """Requests of the file that the dynamics do not use, or use otherwise."""

    def listed(wanted: Callable[[UrdfJoint], object]) -> str:
        found = [name for name in names if wanted(document.joints[name])]
        return "all joints" if 1 < len(found) == len(names) else ", ".join(found)

    massless = ", ".join(name for name, inertial in moving.items() if inertial is None or inertial.mass == 0)
    points = ", ".join(name for name, inertial in moving.items() if inertial and inertial.mass and not inertial.stated)
    fixed = sum(joint.kind == "fixed" for joint in document.joints.values())
    given = (
        ("viscous damping given but not simulated", lambda j: j.damping),
        ("Coulomb friction given but not simulated", lambda j: j.friction),
        ("mimic joints treated as independent", lambda j: j.mimics is not None),
        ("limits given but not enforced", lambda j: any(map(math.isfinite, j.limits.values()))),
        ("axes scaled to unit length", lambda j: j.scaled),
    )
    notes = [
        (f"{fixed} fixed joints lumped; their links are frames", fixed),
        *((note, True) for note in notes_of(document, lock)),
        (f"links without mass: {massless}", massless),
        (f"links with mass but without <inertia>, taken as points at their centres of mass: {points}", points),
        *((f"{what}: {listed(wanted)}", listed(wanted)) for what, wanted in given),
        (f"no tip chosen among the leaves {', '.join(leaves)}; name one with tip=", len(leaves) > 1),
    ]
    return tuple(note for note, applies in notes if applies)
