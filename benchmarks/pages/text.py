"""Markdown of pages: tables, sentences, and where they are written."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path

MADE = "<!-- made by {script}: change the docstrings, or that script, and run it with --write -->"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Table of rows under a head."""
    lines = [head, ["---"] * len(head), *[[cell(x) for x in row] for row in rows]]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(text: str) -> str:
    """Text in which no bar ends a cell of a table."""
    return text.replace("\\|", "|").replace("|", "\\|")


def sentence(text: str) -> str:
    """Text whose angle brackets are no tags."""
    return text.replace("<", "&lt;")


def wrapped(text: str) -> str:
    """Paragraph in lines of 120 characters; tables, code, formulas and comments as they are."""
    if text.startswith(("|", "`" * 3, "$$", "<!--", "#", "![")):
        return text
    return "\n".join(textwrap.fill(x, 120, break_long_words=False, break_on_hyphens=False) for x in text.split("\n"))


def write(folder: Path, files: Mapping[str, str | bytes], owned: str = "*") -> list[str]:
    """Write files into a folder and remove those that are no longer made; names of what changed."""
    folder.mkdir(parents=True, exist_ok=True)
    changed = []
    for name, content in files.items():
        path, data = folder / name, content.encode() if isinstance(content, str) else content
        if not path.exists() or path.read_bytes() != data:
            path.write_bytes(data)
            changed.append(name)
    for path in sorted(folder.glob(owned)):
        if path.name not in files:
            path.unlink()
            changed.append(f"{path.name} (removed)")
    return changed
