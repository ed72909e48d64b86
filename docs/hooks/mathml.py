"""Formulas `$...$` and `$$...$$` of a page as MathML, which browsers draw by themselves.

As on GitHub: a `$` opens a formula if no space follows it, and closes it if no space precedes and no digit follows it.
"""

import re
from xml.etree import ElementTree as etree

from latex2mathml.converter import convert
from markdown import Extension
from markdown.blockprocessors import BlockProcessor
from markdown.inlinepatterns import InlineProcessor

INLINE = r"(?<![\\$\w])\$(?![\s$])((?:[^$\\]|\\.)+?)(?<!\s)\$(?![\d$])"
DISPLAY = re.compile(r"\$\$(.+?)\$\$", re.DOTALL)


def formula(latex: str, display: str = "inline") -> etree.Element:
    """MathML element of a formula."""
    text = convert(latex.strip(), display=display).replace(' xmlns="http://www.w3.org/1998/Math/MathML"', "")
    return etree.fromstring(text)


class _Inline(InlineProcessor):
    def handleMatch(self, m, data):
        return formula(m.group(1)), m.start(0), m.end(0)


class _Display(BlockProcessor):
    def test(self, parent, block):
        return block.lstrip().startswith("$$")

    def run(self, parent, blocks):
        text = blocks.pop(0)
        while not (found := DISPLAY.match(text.lstrip())):
            if not blocks:
                raise ValueError(f"a formula is opened by $$ and never closed: {text!r}")
            text += "\n" + blocks.pop(0)
        box = etree.SubElement(parent, "div", {"class": "formula"})
        box.append(formula(found.group(1), "block"))
        if rest := text.lstrip()[found.end() :].strip():
            blocks.insert(0, rest)


class Formulas(Extension):
    """Formulas of Markdown as MathML."""

    def extendMarkdown(self, md):
        """Both kinds of formula, after code and before what would read `_` and `*` as emphasis."""
        md.inlinePatterns.register(_Inline(INLINE, md), "formula", 185)
        md.parser.blockprocessors.register(_Display(md.parser), "formula", 75)
