"""XML of a URDF file: bounded, without entities, and told apart from the formats that are often passed in its place."""

from __future__ import annotations

import reprlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from xml.parsers import expat

from torchdq.errors import DescriptionError

MOST_TAGS = 200_000
MOST_ATTRIBUTES = 200_000
# children of <robot>, besides links and joints, that say nothing of a tree of bodies
BESIDES = {"material", "gazebo", "transmission", "ros2_control", "sensor", "mujoco"}
SEMANTIC = {
    "group",
    "group_state",
    "disable_collisions",
    "virtual_joint",
    "end_effector",
    "passive_joint",
}  # tags in SRDF files
FOREIGN = {
    "sdf": "this is SDF; load the URDF file it was made from",
    "mujoco": "this is MJCF, a model for MuJoCo; use Robot.from_mjcf",
    "srdf": "this is SRDF, which names groups of joints and describes no bodies; load the URDF file it belongs to",
    "launch": "this is a launch file of ROS; load the URDF file that it names",
    "COLLADA": "this is a mesh; load the URDF file that names it",
    "html": "this is a web page; download the file itself (on GitHub: 'Raw')",
    "Robot": "tags are written in lower case",
}
# what other files begin with
UNMARKED = {
    "version https://git-lfs": "it stands for a file of Git LFS; fetch that by `git lfs pull`",
    "PXR-USDC": "this is USD; load the URDF file that it was made from",
    "#usda": "this is USD; load the URDF file that it was made from",
    "{": "this is JSON; a URDF file was expected",
    "xml:": "this is YAML; a URDF file was expected",
    "404": "a server's answer that there is no such file; check the address it was downloaded from",
    "solid": "this is a mesh; load the URDF file that names it",
}
XACRO = (
    "this is xacro, which must be expanded first: use Robot.from_xacro(path), or run `xacro` and load what it writes"
)


def root_of(text: str) -> ET.Element:
    """Root element <robot> of a text; prefixes stay in the names of tags and need no declaration, as in ROS."""
    if (start := text.lstrip("\ufeff \t\r\n")) and not start.startswith("<"):
        kind = next((words for sign, words in UNMARKED.items() if start.startswith(sign)), "it does not begin with '<'")
        raise DescriptionError(f"the file is not XML, found {start[:20]!r} at its start; {kind}")
    if start[:14].lower() == "<!doctype html":
        raise DescriptionError(f"the file must hold <robot>, found <!DOCTYPE html>; {FOREIGN['html']}")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DescriptionError("the file declares a document type or entities, which a robot description never needs")
    for sign, most, what in (("<", MOST_TAGS, "tags"), ("=", MOST_ATTRIBUTES, "attributes")):
        if text.count(sign) > most:
            raise DescriptionError(f"the file has {text.count(sign)} {what}; a robot description has at most {most}")
    builder, parser = ET.TreeBuilder(), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    try:
        parser.Parse(text, True)
    except (expat.ExpatError, UnicodeError) as error:
        raise DescriptionError(f"the file is not well-formed XML: {error}") from error
    root = builder.close()
    if (found := next(_xacro(root), None)) is not None:
        raise DescriptionError(f"{XACRO}; found {reprlib.repr(found)[1:-1]}")
    if root.tag != "robot":
        advice = FOREIGN.get(root.tag, "a URDF file was expected")
        raise DescriptionError(
            f"the file's root element must be <robot>, found <{reprlib.repr(root.tag)[1:-1]}>; {advice}"
        )
    # extensions with a prefix say nothing of bodies either
    others = sorted(tag for tag in {child.tag for child in root} - {"link", "joint"} - BESIDES if ":" not in tag)
    if others and root.find("joint") is None:
        advice = "a robot is described by <link> and <joint>" if SEMANTIC.isdisjoint(others) else FOREIGN["srdf"]
        raise DescriptionError(f"<robot> holds no <joint> but {reprlib.repr(others)}; {advice}")
    return root


def _xacro(root: ET.Element) -> Iterator[str]:
    """Tags and values that only the macros of xacro can be, outside of what is not read."""
    elements = [root]
    while elements:
        element = elements.pop()
        if element.tag in ("visual", "collision", *BESIDES):
            continue
        if element.tag.startswith("xacro:"):
            yield f"<{element.tag}>"
        for name, value in element.attrib.items():
            if name.startswith("xacro:") or "${" in value or "$(" in value:
                yield f'{name}="{value}"'
        elements += reversed(element)
