"""Collision shapes of the links of a URDF file; one that cannot be read is kept with the reason."""

from __future__ import annotations

import reprlib
import xml.etree.ElementTree as ET

from torchdq.findings import Finding
from torchdq.robot.description import Shape
from torchdq.robot.urdf.elements import Part
from torchdq.robot.urdf.segments import pose


def shapes_of(root: ET.Element) -> dict[str, tuple[Shape, ...]]:
    """Shapes of the <collision> elements of a file, by link."""
    return {link.get("name", ""): tuple(map(_shape, link.findall("collision"))) for link in root.findall("link")}


def _shape(element: ET.Element) -> Shape:
    faults: list[Finding] = []
    part = Part("", "", element, faults)
    form = element.find("geometry/*")
    name, origin = part.name("name"), part.origin()
    kind, size = _form(Part("", "", form, faults), "nothing" if form is None else form.tag)
    if faults:
        kind, size = f"a {kind} with a fault, {faults[0]}", ()
    return Shape(kind, size, pose(origin), name)


def _form(part: Part, tag: str) -> tuple[str, tuple[float, ...]]:
    """Kind and size of the element of a form."""
    if tag == "box":
        return tag, tuple(0.5 * x for x in part.numbers("size", None, 3, signed=False))
    if tag == "sphere":
        return tag, (part.number("radius", None, signed=False),)
    if tag in ("capsule", "cylinder"):
        return tag, (part.number("radius", None, signed=False), 0.5 * part.number("length", None, signed=False))
    file = part.name("filename")
    return f"{reprlib.repr(tag)[1:-1]} {file!r}" if file else reprlib.repr(tag)[1:-1], ()
