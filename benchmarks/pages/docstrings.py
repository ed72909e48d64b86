"""Docstrings of the package, taken apart: what a thing is, its formulas, what else is said, arguments and sources."""

from __future__ import annotations

import inspect
import re
from typing import Any, NamedTuple

from pages import formulas

HEADS = ("Args:", "Raises:", "Returns:")
UNIT = re.compile(r"\s*\[(?![^\]]*\.\.\.)([^\]]*)\](?=[,.;: ]|$)")
SHAPE = re.compile(r",?\s*(?:a number or (\[\.\.\.\])|shape (\[[^\]]*\]))")


class ArgumentText(NamedTuple):
    """An argument as its docstring describes it."""

    meaning: str
    unit: str  # "": a pure number, or none
    shape: str


class Documented(NamedTuple):
    """A docstring."""

    summary: str  # the first sentence, without its formula
    formulas: tuple[str, ...]  # as printed
    text: tuple[str, ...]  # paragraphs, without formulas, sources and examples
    sources: tuple[str, ...]
    arguments: dict[str, ArgumentText]


def documented(thing: Any, known: frozenset[str] = frozenset()) -> Documented:
    """Docstring of an object; `known` are names that are symbols in its formulas."""
    document = inspect.getdoc(thing) or ""
    above, _, below = _head(document).partition("\nArgs:\n")
    blocks = above.split("\n\n")
    summary, formula, rest = taken_apart(" ".join(blocks[0].split()), known)
    found, text, sources = [formula] if formula else [], [rest] if rest else [], []
    for block in blocks[1:]:
        words = " ".join(block.split())
        if block.startswith("    "):
            found += [line.strip() for line in block.splitlines() if line.strip()]
        elif words.startswith("Source"):
            sources.append(words)
        else:
            text.append(words)
    return Documented(summary, tuple(found), tuple(text), tuple(sources), _arguments(below))


def taken_apart(text: str, known: frozenset[str]) -> tuple[str, str, str]:
    """A sentence before its formula, the formula, and what is said after it."""
    for match in re.finditer(r"[:,] ", text):
        after = text[match.end() :]
        if end := formulas.length(after, known):
            rest = after[end:].strip().lstrip(",;.").strip()
            return text[: match.start()] + ".", after[:end].strip(), rest
    return text, "", ""


def _head(document: str) -> str:
    """Docstring before its examples."""
    return document.partition("\n>>>")[0].rstrip()


def _arguments(text: str) -> dict[str, ArgumentText]:
    """Arguments of the section below "Args:"."""
    entries: list[tuple[str, list[str]]] = []
    for line in text.splitlines():
        if line.strip() in HEADS:
            break
        if re.match(r" {4}\S", line):
            names, _, words = line.strip().partition(":")
            entries.append((names, [words.strip()]))
        elif line.strip() and entries:
            entries[-1][1].append(line.strip())
    return {name: _argument(" ".join(words)) for names, words in entries for name in names.split(", ")}


def _argument(text: str) -> ArgumentText:
    shape = SHAPE.search(text)
    text = SHAPE.sub("", text, count=1)
    unit = UNIT.search(text)
    text = UNIT.sub("", text, count=1).strip(" .,;:")
    return ArgumentText(text, unit.group(1) if unit else "", "" if shape is None else shape.group(1) or shape.group(2))
