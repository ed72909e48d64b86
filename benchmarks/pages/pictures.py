"""Pictures of curves, as small SVG files that are readable on light and on dark pages.

A picture has a card of its own, light or dark as the reader's system is. Curves have names, `curve 1` and so on, under
which `curves_of` reads them back from a file.
"""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

SIZE = (6.4, 3.4)  # [inches]
# light and dark colour of every part, by the colour that stands for it while a picture is drawn
COLOURS = {
    "ink": ("#24292f", "#d5dbe2"),
    "paper": ("#fdfdfe", "#191d24"),
    "grid": ("#e4e4e4", "#353b45"),
    "blue": ("#0072b2", "#56b4e9"),
    "orange": ("#d55e00", "#f0913a"),
    "grey": ("#7a7a7b", "#a3a9b1"),
}
LIGHT = {name: light for name, (light, _) in COLOURS.items()}
STYLE = {
    "font.family": ["DejaVu Sans", "sans-serif"],
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.xmargin": 0.02,
    "axes.edgecolor": LIGHT["ink"],
    "axes.labelcolor": LIGHT["ink"],
    "axes.facecolor": "none",
    "figure.facecolor": LIGHT["paper"],
    "text.color": LIGHT["ink"],
    "xtick.color": LIGHT["ink"],
    "ytick.color": LIGHT["ink"],
    "grid.color": LIGHT["grid"],
    "legend.frameon": False,
    "lines.linewidth": 2.0,
    "svg.fonttype": "none",
    "svg.hashsalt": "torchdq",
    "path.simplify": False,
}
LOOKS = (("blue", "-"), ("orange", "-"), ("grey", "--"))
OTHER = ("grey", "--")


LONG = re.compile(r"\d+\.\d{3,}")  # of coordinates
REFERENCES = ("without", "true", "rigid")  # curves that others are compared with


class Curve(NamedTuple):
    """Points of a curve."""

    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray


class Picture(NamedTuple):
    """Up to three curves over one axis, by the words of the legend."""

    x: str  # label of the axis, with a unit
    y: str
    curves: Mapping[str, Curve]


def svg(picture: Picture) -> str:
    """Text of an SVG file."""
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=SIZE, layout="constrained")
        axes = figure.add_subplot(xlabel=picture.x, ylabel=picture.y)
        for k, ((words, curve), look) in enumerate(zip(picture.curves.items(), LOOKS, strict=False), 1):
            colour, line = OTHER if words in REFERENCES else look
            axes.plot(curve.x, curve.y, line, color=LIGHT[colour], label=words, gid=f"curve {k}")
        if len(picture.curves) > 1:
            figure.legend(loc="outside upper left", ncols=3)
        file = io.StringIO()
        figure.savefig(file, format="svg", metadata={"Date": None, "Creator": None})
    text = file.getvalue()
    for name, light in LIGHT.items():
        text = text.replace(light, f"var(--{name})")
    rule = ["; ".join(f"--{name}: {pair[dark]}" for name, pair in COLOURS.items()) for dark in (False, True)]
    style = f"svg {{ {rule[0]} }} @media (prefers-color-scheme: dark) {{ svg {{ {rule[1]} }} }}"
    text = re.sub(r"<metadata>.*?</metadata>\s*", "", text[text.index("<svg") :], flags=re.DOTALL)
    text = text.replace("<defs>", f"<defs>\n  <style>{style}</style>", 1)
    text = re.sub(r'"[^"]*"', lambda attribute: LONG.sub(_short, attribute.group()), text)
    return re.sub(r" +$", "", text, flags=re.MULTILINE)


def _short(number: re.Match[str]) -> str:
    return f"{float(number.group()):.2f}"


def curves_of(text: str) -> list[np.ndarray]:
    """Points [k, 2] of the curves of an SVG file, in points of the picture."""
    paths = re.findall(r'<g id="curve \d">\s*<path d="([^"]*)"', text)
    return [np.array(re.findall(r"-?\d+\.?\d*", path), float).reshape(-1, 2) for path in paths]
