"""Pictures of curves, as small SVG files that are readable on light and on dark pages.

A picture has its own card, light or dark like the reader's system. It also contains some points of its curves, which
`curves_of` reads, so that a test compares data and not drawings.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure

SIZE, SMALL = (6.4, 3.4), (4.8, 3.6)  # [inches]; the second is readable on a telephone
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
DATA = re.compile(r"<metadata>(.*?)</metadata>", re.DOTALL)  # points of the curves
POINTS = 60  # of a curve, at least, if it has as many
REFERENCES = ("without", "true", "rigid")  # curves that others are compared with


class Curve(NamedTuple):
    """Points of a curve."""

    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    range: tuple[Sequence[float], Sequence[float]] | None = None  # lowest and highest y
    look: tuple[str, str] | None = None  # colour and line; None: those of its place in `LOOKS`
    marker: str = ""  # of its points
    label: tuple[str, float, float] | None = None  # words, and the place of their left end; None: in the legend


class Picture(NamedTuple):
    """Curves over one axis, by the words of the legend: up to three, or more that have looks of their own."""

    x: str  # label of the axis, with a unit
    y: str
    curves: Mapping[str, Curve]
    log: str = ""  # axes with a logarithmic scale: "y", "xy"
    size: tuple[float, float] = SIZE


def svg(picture: Picture, *others: Picture) -> str:
    """Text of an SVG file; others are below, with the same legend."""
    pictures = (picture, *others)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(picture.size[0], len(pictures) * picture.size[1]), layout="constrained")
        for k, one in enumerate(pictures):
            scales = {f"{axis}scale": "log" if axis in one.log else "linear" for axis in "xy"}
            axes = figure.add_subplot(len(pictures), 1, k + 1, xlabel=one.x, ylabel=one.y, **scales)
            for (words, curve), look in zip(one.curves.items(), cycle(LOOKS)):
                colour, line = curve.look or (OTHER if words in REFERENCES else look)
                style = {"color": LIGHT[colour], "marker": curve.marker, "markersize": 5}
                axes.plot(curve.x, curve.y, line, **style, label=words if k == 0 else None)
                if curve.label is not None:
                    name, *place = curve.label
                    axes.text(*place, name, color=LIGHT[colour], fontsize=10, va="center")
                if curve.range is not None:
                    axes.fill_between(curve.x, *curve.range, color=LIGHT[colour], alpha=0.2, linewidth=0)
        if len(picture.curves) > 1 and not any(curve.label for curve in picture.curves.values()):
            crowded = {"fontsize": 10, "columnspacing": 1.2, "handlelength": 2.6} if len(picture.curves) > 3 else {}
            figure.legend(loc="outside upper left", ncols=3, **crowded)
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
    points = json.dumps([_points(curve) for one in pictures for curve in one.curves.values()])
    return re.sub(
        r" +$", "", text.replace(" <defs>", f" <metadata>{points}</metadata>\n <defs>", 1), flags=re.MULTILINE
    )


def _short(number: re.Match[str]) -> str:
    return f"{float(number.group()):.2f}"


def _points(curve: Curve) -> list[list[float]]:
    """Some points of a curve, in four digits."""
    every = max(1, len(curve.x) // POINTS)
    rows = zip(np.asarray(curve.x, float)[::every], np.asarray(curve.y, float)[::every], strict=True)
    return [[float(f"{x:.4g}"), float(f"{y:.4g}")] for x, y in rows]


def curves_of(text: str) -> list[np.ndarray]:
    """Points [k, 2] of the curves of an SVG file, in their units."""
    match = DATA.search(text)
    return [np.array(points) for points in json.loads(match[1])] if match else []
