"""Robots from URDF files: numbers are read and checked in `urdf_document`, and put together in `urdf_tree`."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import torch

from torchdq.algebra.quaternion import ZERO
from torchdq.base.findings import Finding
from torchdq.dynamics.tree import BASE
from torchdq.robot.arrays import SIX, double, matrices
from torchdq.robot.check import consistency
from torchdq.robot.description import NO_TIP, Frame, Limits, RobotDescription, Unsimulated
from torchdq.robot.urdf.document import Document, parse, text_of
from torchdq.robot.urdf.elements import MOVING, Inertial, UrdfJoint
from torchdq.robot.urdf.lock import locked, notes_of
from torchdq.robot.urdf.mimic import coordinates
from torchdq.robot.urdf.tree import lumped, tree_of


def read(
    source: Any, kept: Any, lock: Any, base: str = "fixed", mimic: str = "coupled", repair: bool = False
) -> tuple[RobotDescription, list[Finding], tuple[str, ...], tuple[str, ...]]:
    """Description, its faults, doubts about units, and notes on what is ignored though it may change the dynamics.

    `Robot.from_urdf` says what is expected.
    """
    free = base == "floating"
    document = parse(text_of(source), free, mimic == "coupled")
    at = locked(document, kept, lock)
    tree = tree_of(document, at | document.stuck)
    joints = [document.joints[name] for name in tree.joints]
    reduced, joint_map, home, coupled = coordinates(dict(zip(tree.joints, joints, strict=True)), document.followers)
    n = len(joints)
    moving = {name: inertial for name, inertial in document.links.items() if tree.places[name].link != BASE}
    judged = {name: inertial for name, inertial in document.links.items() if inertial and (free or name in moving)}
    judged, faults, notes = _physical(judged, repair)
    *bodies, (base_mass, base_com, base_inertia) = lumped(tree.places, judged, n)
    mass, com, inertia = zip(*bodies, strict=True) if n else ((), (), ())
    if free and not any((base_mass, *base_inertia)):
        faults.append(
            Finding(
                "base.massless",
                f"link {document.base!r}",
                "a free base must have mass",
                "none on it and on links that are fixed to it",
                "give it mass, or pass base='fixed'",
                severity="error",
            )
        )
    children = {joint.parent for joint in document.joints.values()}
    leaves = [name for name in moving if name not in children]
    description = RobotDescription(
        name=document.name,
        joint_names=tuple(reduced),
        link_names=tuple(joint.child for joint in joints),
        parents=tree.parents,
        kinds=tuple(MOVING[joint.kind] for joint in joints),
        X_PB_home=double([r + d for r, d in tree.X_PB]).reshape(n, 8),
        screw=double([_screw(joint) for joint in joints]).reshape(n, 6),
        mass=double(mass),
        com=double(com).reshape(n, 3),
        inertia=double(inertia).reshape(n, 6),
        limits=Limits(*(double([joint.limits[key] for joint in reduced.values()]) for key in Limits._fields)),
        damping=double([joint.damping for joint in reduced.values()]),
        friction=double([joint.friction for joint in reduced.values()]),
        frames=tuple(Frame(name, link, double(r + d)) for name, (link, (r, d)) in tree.places.items()),
        tip=leaves[0] if len(leaves) == 1 else None,
        home=None if home is None else double(home),
        base_mass=double(base_mass) if free else None,
        base_com=double(base_com) if free else None,
        base_inertia=double(base_inertia) if free else None,
        joint_map=joint_map,
        notes=(*notes, *_notes(document, tree.joints, moving, leaves, at, coupled, mimic == "independent")),
    )
    return description, faults, document.doubts, document.ignored


def _screw(joint: UrdfJoint) -> tuple[float, ...]:
    return (*joint.axis, *ZERO) if MOVING[joint.kind] == "revolute" else (*ZERO, *joint.axis)


def _physical(
    links: dict[str, Inertial], repair: bool
) -> tuple[dict[str, Inertial], list[Finding], list[Finding | str]]:
    """Bodies whose inertias are not rounding, and are repaired on request; faults, and notes of all that changed."""
    names = tuple(links)
    mass = double([body.mass for body in links.values()])
    six = double([body.inertia for body in links.values()]).reshape(-1, 6)
    tiny = ((six != 0).any(-1) & (six.abs().amax(-1) <= consistency.rounding(mass))).tolist() if names else []
    six = torch.where(double(tiny).bool()[:, None], 0.0, six)
    notes: list[Finding | str] = [
        "inertia that is rounding taken as zero: " + ", ".join(itertools.compress(names, tiny))
    ] * any(tiny)
    I = matrices(six)
    if repair:
        I, more = consistency.repaired(names, mass, I)
        notes += more
    found = consistency.bodies(names, mass, I)
    faults = [fault for fault in found if fault.code != consistency.MASSLESS]
    # the numbers are well defined, and other readers use them as well
    notes += [fault for fault in found if fault.code == consistency.MASSLESS]
    new = {
        name: body._replace(inertia=tuple(row))
        for (name, body), row in zip(links.items(), I[:, *SIX].tolist(), strict=True)
    }
    return new, faults, notes


def _stuck(joint: UrdfJoint) -> bool:
    lower, upper, velocity, effort = (joint.limits[key] for key in Limits._fields)
    return lower == upper or velocity == 0 or effort == 0


def _notes(
    document: Document,
    names: tuple[str, ...],
    moving: dict[str, Inertial | None],
    leaves: list[str],
    lock: dict[str, float],
    coupled: list[str],
    independent: bool,
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
        ("limits given but not enforced", lambda j: any(map(math.isfinite, j.limits.values()))),
        ("limits of zero, which leave no room", _stuck),
        ("axes scaled to unit length", lambda j: j.scaled),
    )
    apart = listed(lambda j: j.mimics is not None and independent)
    notes = [
        (f"{fixed} fixed joints lumped; their links are frames", fixed),
        *((note, True) for note in (*document.notes, *notes_of(document, lock), *coupled)),
        (f"links without mass: {massless}", massless),
        (f"links with mass but without <inertia>, taken as points at their centres of mass: {points}", points),
        *((f"{what}: {listed(wanted)}", listed(wanted)) for what, wanted in given),
        (Unsimulated(f"mimic joints treated as independent: {apart}"), apart),
        (f"{NO_TIP} {', '.join(leaves)}; name one with tip=", len(leaves) > 1),
    ]
    return tuple(note for note, applies in notes if applies)
