"""XML of robot files as elements, and elements as XML; prefixes are part of names and need no declaration."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from xml.parsers import expat

from torchdq.errors import DescriptionError

# robot descriptions stay far below; hostile files do not
MOST_TAGS = 200_000
MOST_ATTRIBUTES = 200_000


_BLANK = r"(?>[\s\ufeff]|<!--.*?-->)"  # atomic: else the ways to part a row of comments double with each of them
_BEGINNING = re.compile(rf"({_BLANK}++)(<\?xml\s.*?\?>)?", re.DOTALL)
_ROOT = re.compile(rf"(?>{_BLANK}|<\?.*?\?>|<![^\[>]*>)*+<([^\s/>!?]+)", re.DOTALL)


def root_name(text: str) -> str:
    """Tag of the root element, by which formats differ; empty where a text begins with something else.

    >>> root_name("<?xml version='1.0'?><!-- <mujoco> --><robot name='arm'/>")
    'robot'
    """
    found = _ROOT.match(text)
    return found[1] if found else ""


def _well_begun(text: str) -> str:
    """Text with blanks for what parsers refuse: byte order marks, and an XML declaration after blanks or comments."""
    found = _BEGINNING.match(text)
    if found is None:
        return text
    before, declaration = found[1].replace("\ufeff", "   "), " " * len((found[2] or "").encode())  # bytes keep places
    return f"{before}{declaration}{text[found.end() :]}"


def parsed(text: str, whole: bool = False) -> ET.Element:
    """Root element of a text of bounded size without entities; `whole`: with its comments and blanks."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DescriptionError("the file declares a document type or entities, which a robot description never needs")
    for sign, most, what in (("<", MOST_TAGS, "tags"), ("=", MOST_ATTRIBUTES, "attributes")):
        if text.count(sign) > most:
            raise DescriptionError(f"the file has {text.count(sign)} {what}; a robot description has at most {most}")
    builder, parser = ET.TreeBuilder(insert_comments=whole), expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = builder.start, builder.end
    if whole:
        parser.CharacterDataHandler, parser.CommentHandler = builder.data, builder.comment
    try:
        parser.Parse(_well_begun(text), True)
    except (expat.ExpatError, UnicodeError) as error:
        raise DescriptionError(f"the file is not well-formed XML: {error}") from error
    return builder.close()


def written(root: ET.Element, original: str) -> str:
    """Text of elements, between what stands before and after the root element of the original text."""
    places: list[int] = []
    parser = expat.ParserCreate()
    parser.StartElementHandler = lambda *_: places.append(parser.CurrentByteIndex)
    parser.EndElementHandler = lambda *_: places.append(parser.CurrentByteIndex)
    parser.Parse(_well_begun(original), True)
    data = original.encode()
    after = data.index(b">", places[-1]) + 1
    return data[: places[0]].decode() + ET.tostring(root, encoding="unicode") + data[after:].decode()


def add(parent: ET.Element, tag: str) -> ET.Element:
    """New first child of an element, on a line of its own if the element's others are."""
    child = ET.Element(tag)
    child.tail = parent.text
    parent.insert(0, child)
    return child
