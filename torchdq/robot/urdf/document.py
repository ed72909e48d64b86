"""Root element of a URDF file, distinguished from the formats that are often passed instead."""

from __future__ import annotations

import reprlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from typing import Any

from torchdq.base.sources import xml
from torchdq.errors import DescriptionError, MissingFileError
from torchdq.robot.xml_text import parsed

MOST_BYTES = 10_000_000
MOST_LINKS = 2_000
# children of <robot>, besides links and joints, that say nothing of a tree of bodies
EXTENSIONS = {"material", "gazebo", "transmission", "ros2_control", "sensor", "mujoco"}
DRAKE = {"frame", "force_element"}  # beside the links of a body without joints
SEMANTIC = {
    "group",
    "group_state",
    "disable_collisions",
    "virtual_joint",
    "end_effector",
    "passive_joint",
}  # SRDF has them
FOREIGN = {  # by root element
    "sdf": "this is SDF; load the URDF file it was made from",
    "mujoco": "this is MJCF, a model for MuJoCo; use Robot.from_mjcf",
    "srdf": "this is SRDF, which names groups of joints and describes no bodies; load the URDF file it belongs to",
    "launch": "this is a launch file of ROS; load the URDF file that it names",
    "COLLADA": "this is a mesh; load the URDF file that names it",
    "html": "this is a web page; download the file itself (on GitHub: 'Raw')",
    "Robot": "tags are written in lower case",
}
UNMARKED = {  # by the beginning of the text
    "version https://git-lfs": "it is a Git LFS pointer; run `git lfs pull`",
    "PXR-USDC": "this is USD; load the URDF file that it was made from",
    "#usda": "this is USD; load the URDF file that it was made from",
    "{": "this is JSON; a URDF file was expected",
    "xml:": "this is YAML; a URDF file was expected",
    "404": "a server's answer that there is no such file; check the address it was downloaded from",
    "solid": "this is a mesh; load the URDF file that names it",
}
XACRO = "xacro:"
DEFINITIONS = {f"{XACRO}{name}" for name in ("property", "arg")}  # which hold no part of a robot
# all others are calls of macros
LANGUAGE = {f"{XACRO}{x}" for x in ("include", "macro", "if", "unless", "element", "attribute", "insert_block", "call")}
UNEXPANDED = (
    "this is xacro, which must be expanded first: use Robot.from_xacro(path), or run `xacro` and load what it writes"
)


def text_of(source: Any) -> str:
    """XML text of a source, or the text itself; it may be of another format."""
    known = isinstance(source, str) and source.isidentifier()
    hint = f"a robot that comes with this package is torchdq.robots.load({source!r})" if known else ""
    return xml("robot description", source, MOST_BYTES, DescriptionError, MissingFileError, hint)


def root_of(source: Any) -> ET.Element:
    """Root element <robot> of a source."""
    text = text_of(source)
    if (start := text.lstrip("\ufeff \t\r\n")) and not start.startswith("<"):
        kind = next((advice for sign, advice in UNMARKED.items() if start.startswith(sign)), "it must begin with '<'")
        raise DescriptionError(f"the file is not XML, found {start[:20]!r} at its start; {kind}")
    if start[:14].lower() == "<!doctype html":
        raise DescriptionError(f"the file must hold <robot>, found <!DOCTYPE html>; {FOREIGN['html']}")
    root = parsed(text)
    if (found := next(_xacro(root), None)) is not None:
        raise DescriptionError(f"{UNEXPANDED}; found {reprlib.repr(found)[1:-1]}")
    if root.tag != "robot":
        advice = FOREIGN.get(root.tag, "a URDF file was expected")
        shown = reprlib.repr(root.tag)[1:-1]
        raise DescriptionError(f"the file's root element must be <robot>, found <{shown}>; {advice}")
    # extensions with a prefix say nothing of bodies either
    read = {"link", "joint"} | EXTENSIONS | DRAKE
    others = sorted(tag for tag in {child.tag for child in root} - read if ":" not in tag)
    if others and root.find("joint") is None:
        advice = "a robot is described by <link> and <joint>" if SEMANTIC.isdisjoint(others) else FOREIGN["srdf"]
        raise DescriptionError(f"<robot> holds no <joint> but {reprlib.repr(others)}; {advice}")
    links, joints = (len(root.findall(tag)) for tag in ("link", "joint"))
    if max(links, joints) > MOST_LINKS:
        raise DescriptionError(f"the file has {links} links and {joints} joints; at most {MOST_LINKS} are read")
    return root


def _xacro(root: ET.Element) -> Iterator[str]:
    """Tags and values that xacro has not expanded, and that the robot depends on.

    Old versions of xacro leave calls of macros that they do not know; those beside the links and joints are only warned
    of, unless they are all that there is.
    """
    elements, stray = [root], set() if root.find("joint") is None else {id(element) for element in root}
    while elements:
        element = elements.pop()
        if element.tag in ("visual", "collision", *DEFINITIONS, *EXTENSIONS):
            continue
        if element.tag in LANGUAGE or (element.tag.startswith(XACRO) and id(element) not in stray):
            yield f"<{element.tag}>"
        for name, value in element.attrib.items():
            if name.startswith(XACRO) or "${" in value or "$(" in value:
                yield f'{name}="{value}"'
        elements += reversed(element)
