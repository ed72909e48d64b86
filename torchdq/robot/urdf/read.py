"""Descriptions of robots in URDF files: document, elements, tree and description, one after the other."""

from __future__ import annotations

import itertools
import reprlib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import torch

from torchdq.base.sources import file_name, located
from torchdq.dynamics.tree import BASE
from torchdq.errors import MissingFileError
from torchdq.findings import Finding
from torchdq.robot.arrays import SIX, double, matrices
from torchdq.robot.assembly import described, linked
from torchdq.robot.check import consistency
from torchdq.robot.description import Base, Drawing, RobotDescription, Shape, note, require_usable
from torchdq.robot.urdf.diagnostics import diagnostics
from torchdq.robot.urdf.document import root_of
from torchdq.robot.urdf.elements import Elements, Part, elements
from torchdq.robot.urdf.mimic import locked, motions
from torchdq.robot.urdf.segments import pose, rooted, segments_of


def read(
    source: Any, kept: Any = None, lock: Any = None, base: Base = "file", mimic: str = "coupled", repair: bool = False
) -> RobotDescription:
    """Description of the robot in a file; `Robot.from_urdf` says what is expected."""
    coupled = mimic == "coupled"
    root = root_of(source)
    found = elements(root)
    faults: list[Finding] = []
    tree = rooted(found, base, faults)
    root_floats = base == "floating" and tree.free is None
    floating = root_floats or tree.free is not None
    still_free = motions(found.joints, coupled, faults)
    # bodies that never move need not be readable
    excused = set() if root_floats or faults else tree.still
    unreadable = [x for name, all_of in found.unreadable.items() if name not in excused for x in all_of]
    require_usable([*unreadable, *found.faults, *faults])
    moves, lock_notes = locked(found, still_free, coupled, kept, lock)
    judged, findings = physical(found, repair)
    shapes = {
        tag: {x.get("name", ""): tuple(map(_shape, x.findall(tag))) for x in root.findall("link")}
        for tag in ("collision", "visual")
    }
    file = file_name(source)
    folder = str((located(file, MissingFileError) if file else Path("text")).absolute().parent)
    segments = []
    for x in segments_of(judged, tree.root, moves):
        touching, seen = (shapes[tag].get(x.name, ()) for tag in ("collision", "visual"))
        segments.append(x._replace(shapes=touching, drawing=Drawing(seen or touching, folder)))
    carried = None if tree.free is None else [segment.name for segment in segments].index(tree.free.child)
    links = linked(segments, moves, carried)
    moving = {frame.name for frame in links.frames if floating or frame.link != BASE}
    unphysical = [x for name, all_of in findings.items() if name in moving for x in all_of]
    body = links.bodies[BASE]
    if floating and not any((body.mass, *body.inertia)):
        expected, missing = "a floating base must have mass", "none on it and on links that are fixed to it"
        cure = "give it mass, or pass base='fixed'"
        unphysical.append(
            Finding("base.massless", f"link {segments[carried or 0].name!r}", expected, missing, cure, severity="error")
        )
    notes = diagnostics(root, found, tree, links, still_free, moves, coupled)
    return described(found.name, links, moves, floating, (*unphysical, *lock_notes, *notes))


def physical(file: Elements, repair: bool) -> tuple[Elements, dict[str, list[Finding]]]:
    """Bodies whose inertias are not rounding, and are repaired on request; by link, faults and notes of changes."""
    links = {name: body for name, body in file.links.items() if body and name not in file.unreadable}
    names = tuple(links)
    mass = double([body.mass for body in links.values()])
    six = double([body.inertia for body in links.values()]).reshape(-1, 6)
    tiny = ((six != 0).any(-1) & (six.abs().amax(-1) <= consistency.rounding(mass))).tolist() if names else []
    six = torch.where(double(tiny).bool()[:, None], 0.0, six)
    findings: dict[str, list[Finding]] = {name: [] for name in names}
    for name in itertools.compress(names, tiny):
        findings[name].append(note("inertia.rounding", [name], "inertia that is rounding taken as zero"))
    I, repairs = consistency.repaired(names, mass, matrices(six)) if repair else (matrices(six), [])
    subjects = {f"link {name!r}": name for name in names}
    for x in (*consistency.bodies(names, mass, I), *repairs):
        # the numbers of a body without mass are well defined, and other readers use them as well
        findings[subjects[x.subject]].append(x._replace(severity="note") if x.code == consistency.MASSLESS else x)
    bodies = {
        name: body._replace(inertia=tuple(row))
        for (name, body), row in zip(links.items(), I[:, *SIX].tolist(), strict=True)
    }
    return file._replace(links={name: bodies.get(name) for name in file.links}), findings


def _shape(element: ET.Element) -> Shape:
    """Shape of a <collision> or <visual> element; one that cannot be read is kept with the reason."""
    faults: list[Finding] = []
    part = Part("", "", element, faults)
    form = element.find("geometry/*")
    name, origin = part.name("name"), part.origin()
    kind, size, mesh = _form(Part("", "", form, faults), "nothing" if form is None else form.tag)
    if faults:
        kind, size, mesh = f"a {kind} with a fault, {faults[0]}", (), ""
    return Shape(kind, size, pose(origin), name, mesh)


def _form(part: Part, tag: str) -> tuple[str, tuple[float, ...], str]:
    """Kind, size and file of a shape."""
    if tag == "box":
        return tag, tuple(0.5 * x for x in part.numbers("size", None, 3, signed=False)), ""
    if tag == "sphere":
        return tag, (part.number("radius", None, signed=False),), ""
    if tag in ("capsule", "cylinder"):
        return tag, (part.number("radius", None, signed=False), 0.5 * part.number("length", None, signed=False)), ""
    file = part.name("filename")
    kind = f"{reprlib.repr(tag)[1:-1]} {file!r}" if file else reprlib.repr(tag)[1:-1]
    return kind, part.numbers("scale", 1.0, 3) if file else (), file
