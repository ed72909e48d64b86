"""Common style of the films of the README: dark cards with round corners."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from PIL import Image, ImageDraw

CARD, FOG, SLOW, FAST, CHOSEN, INK, QUIET = "#0d1b2a", "#1b2f45", "#5f8fb8", "#d3ecff", "#ffa62b", "#e6eef6", "#8fa3b8"


def card(width: int, height: int, title: str, subtitle: str) -> Figure:
    """Figure of that size [pixels]."""
    figure = plt.figure(figsize=(width / 100, height / 100), dpi=100, facecolor=CARD)
    figure.text(0.025, 1.0 - 28.6 / height, title, size=15, weight="bold", color=INK, va="center")
    figure.text(0.025, 1.0 - 55.0 / height, subtitle, size=10, color=QUIET, va="center")
    return figure


def save(figure: Figure, moves: Iterable[Any], path: Path, pace: int, quality: int) -> None:
    """Write a film of the figure after each of the moves, an image in `pace` [ms], into a folder that may be new."""
    width, height = (round(100 * x) for x in figure.get_size_inches())
    corners = Image.new("L", (4 * width, 4 * height))
    ImageDraw.Draw(corners).rounded_rectangle((0, 0, 4 * width - 1, 4 * height - 1), 64, fill=255)
    corners = corners.resize((width, height), Image.Resampling.LANCZOS)
    images = []
    for _ in moves:
        figure.canvas.draw()
        images.append(Image.fromarray(np.asarray(figure.canvas.buffer_rgba()).copy()))
        images[-1].putalpha(corners)
    plt.close(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    images[0].save(path, save_all=True, append_images=images[1:], duration=pace, loop=0, quality=quality, method=6)
