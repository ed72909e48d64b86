"""XML text whose attributes are changed in place: every other byte stays, comments, order and blanks too."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from torchdq.errors import DescriptionError

_TAG = re.compile(rb"""<[^\s/>]+((?:\s+[^\s=/>]+\s*=\s*(?:"[^"]*"|'[^']*'))*)\s*(/?)>""")
_ATTRIBUTE = re.compile(rb"""\s+([^\s=/>]+)\s*=\s*("[^"]*"|'[^']*')""")


@dataclass(eq=False)
class Element:
    """Element of a text."""

    tag: str
    attributes: dict[str, str]
    start: int  # place of its start tag, in bytes
    parent: Element | None = field(default=None, repr=False)
    children: list[Element] = field(default_factory=list)

    def find(self, tag: str) -> Element | None:
        """First child with a tag."""
        return next((child for child in self.children if child.tag == tag), None)

    def under(self, *tags: str) -> Iterator[Element]:
        """Descendants with one of these tags, in the order of the text."""
        for child in self.children:
            if child.tag in tags:
                yield child
            yield from child.under(*tags)


class XmlText:
    """Text with its elements; `str` is the text with the changes that were made."""

    def __init__(self, text: str):
        self._data = text.encode()
        self._edits: list[tuple[int, int, bytes]] = []  # start and end of what is replaced, and by what
        self.root = self._parsed()

    def set(self, element: Element, changes: Mapping[str, str | None]) -> None:
        """Change, add or remove (None) attributes of an element."""
        tag = _TAG.match(self._data, element.start)
        if tag is None:
            raise DescriptionError(f"<{element.tag}> of the original cannot be changed, found it written in an odd way")
        spans = {found[1].decode(): found for found in _ATTRIBUTE.finditer(self._data, *tag.span(1))}
        added = ""
        for name, value in changes.items():
            if name in spans:
                start, end = spans[name].span(0 if value is None else 2)
                self._edits.append((start, end, b"" if value is None else quoteattr(value).encode()))
            elif value is not None:
                added += f" {name}={quoteattr(value)}"
        if added:
            self._edits.append((tag.end(1), tag.end(1), added.encode()))

    def add(self, parent: Element, *lines: str) -> None:
        """Put lines of XML before the first child of an element."""
        tag = _TAG.match(self._data, parent.start)
        if tag is None:
            raise DescriptionError(f"<{parent.tag}> of the original cannot be changed, found it written in an odd way")
        newline = b"\r\n" if b"\r\n" in self._data else b"\n"
        outer = newline + (self._indent(parent.start) or b"")
        inner = self._indent(parent.children[0].start) if parent.children else None
        before = outer + b"  " if not parent.children else b"" if inner is None else newline + inner
        inserted = b"".join(before + (line if before else line.strip()).encode() for line in lines)
        if tag[2]:
            closing = outer + b"</" + parent.tag.encode() + b">"
            self._edits.append((tag.start(2), tag.end(), b">" + inserted + closing))
        else:
            self._edits.append((tag.end(), tag.end(), inserted))

    def __str__(self) -> str:
        parts, place = [], 0
        for start, end, by in sorted(self._edits, key=lambda edit: edit[:2]):
            parts += [self._data[place:start], by]
            place = end
        return b"".join([*parts, self._data[place:]]).decode()

    def _indent(self, place: int) -> bytes | None:
        """Blanks before what begins a line; None if it does not."""
        before = self._data[self._data.rfind(b"\n", 0, place) + 1 : place]
        return None if before.strip() else before

    def _parsed(self) -> Element:
        found: list[Element] = []
        parser = expat.ParserCreate("UTF-8")

        def opened(tag: str, attributes: dict[str, str]) -> None:
            element = Element(tag, attributes, parser.CurrentByteIndex, found[-1] if found else None)
            if found:
                found[-1].children.append(element)
            found.append(element)

        def closed(_: str) -> None:
            if len(found) > 1:
                found.pop()

        parser.StartElementHandler, parser.EndElementHandler = opened, closed
        try:
            parser.Parse(self._data, True)
        except expat.ExpatError as error:
            raise DescriptionError(f"the original is not well-formed XML: {error}") from error
        return found[0]
