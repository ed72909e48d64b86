"""Diagrams of boxes, arrows and words, as small SVG files that are readable on light and on dark pages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

from pages.pictures import COLOURS

PALETTE = COLOURS | {"panel": ("#eef2f6", "#252b35"), "green": ("#007f5f", "#4cc9a0")}
SANS = "'DejaVu Sans', Verdana, sans-serif"
MONO = "'DejaVu Sans Mono', Menlo, Consolas, monospace"
TITLE, TEXT, LINE = 14, 12.5, 19  # of boxes: sizes of letters, and distance of two lines [pixels]
Point = tuple[float, float]


def colours() -> str:
    """Rules of CSS for the colours, light or dark like the reader's pages."""
    light, dark = ("; ".join(f"--{name}: {pair[k]}" for name, pair in PALETTE.items()) for k in (0, 1))
    return f"svg {{ {light} }} @media (prefers-color-scheme: dark) {{ svg {{ {dark} }} }}"


class Diagram:
    """A card of a size in pixels, on which parts are drawn one over the other."""

    def __init__(self, width: float, height: float) -> None:
        self.size, self.parts = (width, height), list[str]()

    def svg(self) -> str:
        """Text of the file."""
        width, height = self.size
        head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{width:g}" height="{height:g}" '
        head += f'viewBox="0 0 {width:g} {height:g}" font-family="{SANS}" font-size="13">'
        card = f'<rect width="{width:g}" height="{height:g}" rx="8" fill="var(--paper)"/>'
        return "\n".join([head, f"<style>{colours()}</style>", card, *self.parts, "</svg>", ""])

    def shape(self, tag: str, fill: str = "none", stroke: str = "none", **attributes: float | str) -> None:
        """A shape of SVG; colours are names, attributes have underscores for hyphens."""
        given = {"fill": _colour(fill), "stroke": _colour(stroke), **attributes}
        words = " ".join(f'{name.replace("_", "-")}="{_number(x)}"' for name, x in given.items())
        self.parts.append(f"<{tag} {words}/>")

    def text(
        self, at: Point, words: str, colour: str = "ink", size: float = 13, anchor: str = "start", **look: str
    ) -> None:
        """Text on a base line at a point; parts between backticks are names in code."""
        x, y = at
        given = {"fill": _colour(colour), "font_size": size, "text_anchor": anchor, **look}
        attributes = " ".join(f'{name.replace("_", "-")}="{_number(a)}"' for name, a in given.items())
        spans = [
            f'<tspan font-family="{MONO}">{escape(part)}</tspan>' if k % 2 else escape(part)
            for k, part in enumerate(words.split("`"))
        ]
        self.parts.append(f'<text x="{x:.1f}" y="{y:.1f}" {attributes}>{"".join(spans)}</text>')

    def line(self, points: Sequence[Point], colour: str = "grey", width: float = 1.6, **look: str) -> None:
        """A line through some points."""
        row = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self.shape("polyline", stroke=colour, points=row, stroke_width=width, stroke_linejoin="round", **look)

    def arrow(self, points: Sequence[Point], colour: str = "grey", width: float = 1.6, **look: str) -> None:
        """A line through some points with a head at the last one."""
        (a, b), (x, y) = points[-2:]
        size, length = 3.0 + 2.2 * width, math.hypot(x - a, y - b)
        u, v = (x - a) / length, (y - b) / length
        base = (x - size * u, y - size * v)
        self.line([*points[:-1], base], colour, width, **look)
        wings = [(base[0] - 0.45 * size * s * v, base[1] + 0.45 * size * s * u) for s in (1, -1)]
        self.shape("polygon", fill=colour, points=" ".join(f"{p:.1f},{q:.1f}" for p, q in [(x, y), *wings]))

    def box(self, at: Point, size: Point, title: str, *lines: str, colour: str = "blue") -> None:
        """A box with a title and lines below it, and an edge in a colour."""
        (x, y), (width, height) = at, size
        self.shape("rect", fill="panel", x=x, y=y, width=width, height=height, rx=5)
        self.shape("rect", fill=colour, x=x, y=y, width=4, height=height, rx=2)
        top = y + (height - LINE * (len(lines) + 1)) / 2 + TITLE
        self.text((x + 16, top), title, size=TITLE, font_weight="bold")
        for k, words in enumerate(lines, 1):
            self.text((x + 16, top + LINE * k), words, size=TEXT)


def _colour(name: str) -> str:
    return name if name == "none" else f"var(--{name})"


def _number(x: float | str) -> str:
    return x if isinstance(x, str) else f"{x:.4g}"
