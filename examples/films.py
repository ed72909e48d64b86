"""Common style of the films of the README: dark cards with round corners, and bodies under a light."""

import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import pyplot as plt
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image, ImageDraw
from torch import Tensor

from torchdq import dq
from torchdq.envs.bodies import Surface
from torchdq.envs.canvas import FINE, Canvas

LIGHT = np.array([-0.4, -0.5, 0.77])  # direction to it
CARD, FOG, SLOW, FAST, CHOSEN, INK, QUIET = "#0d1b2a", "#1b2f45", "#5f8fb8", "#d3ecff", "#ffa62b", "#e6eef6", "#8fa3b8"


def card(width: int, height: int, title: str, subtitle: str) -> Figure:
    """Figure of that size [pixels]."""
    figure = plt.figure(figsize=(width / 100, height / 100), dpi=100, facecolor=CARD)
    figure.text(0.025, 1.0 - 28.6 / height, title, size=15, weight="bold", color=INK, va="center")
    figure.text(0.025, 1.0 - 55.0 / height, subtitle, size=10, color=QUIET, va="center")
    return figure


class Bodies:
    """Bodies that are seen by a camera, and their shadows on the ground.

    Args:
        figure: figure that is covered from its lower left corner on.
        size: width and height of what is drawn [pixels].
        project: pixels [..., 2] and distances [...] of positions [..., 3], seen by the camera.
        eye: position of the camera [m].
        focus: pixels of a metre at the distance 1.
    """

    def __init__(
        self,
        figure: Figure,
        size: tuple[int, int],
        project: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]],
        eye: np.ndarray,
        focus: float,
    ):
        self.size, self.project, self.eye, self.focus = size, project, eye, focus
        self._picture = figure.figimage(np.zeros((size[1], size[0], 4), np.uint8), zorder=1)
        self._canvas = Canvas(size)
        self._clouds: dict[tuple[int, float], tuple[np.ndarray, np.ndarray]] = {}

    def add(self, surfaces: Sequence[Surface], X: Tensor, at: np.ndarray, colours: np.ndarray) -> None:
        """Draw surfaces at poses [k, surfaces, 8] seen from places [k, 3], in colours [k, 3]."""
        turns = dq.rotate(dq.rotation(X)[..., None, :], torch.eye(3, dtype=X.dtype)).numpy().astype(np.float32)
        shifts = (dq.translation(X).numpy() + at[:, None]).astype(np.float32)
        spacings = 1.2 * self.project(shifts)[1].min(1) / (FINE * self.focus)
        for turn, shift, spacing, colour in zip(turns, shifts, spacings, colours, strict=True):
            clouds = [self._cloud(surface, 2.0 ** (0.5 * math.floor(2.0 * math.log2(spacing)))) for surface in surfaces]
            p = np.concatenate([p @ R + x for (p, _), R, x in zip(clouds, turn, shift, strict=True)])
            n = np.concatenate([n @ R for (_, n), R in zip(clouds, turn, strict=True)])
            seen = ((self.eye - p) * n).sum(-1) > 0
            pixels, depth = self.project(p[seen])
            self._canvas.add(pixels, -depth, 0.1 + 0.9 * (n[seen] @ LIGHT), tuple(255 * colour))
            pixels, depth = self.project(p[seen] * (1.0, 1.0, 0.0))
            shadow = tuple(255 * 0.55 * x for x in to_rgb(CARD))
            self._canvas.add(pixels, -1e3 - depth, np.ones(len(depth)), shadow)

    def _cloud(self, surface: Surface, spacing: float) -> tuple[np.ndarray, np.ndarray]:
        """Points of a surface and the normals there, kept for the images that follow."""
        key = (id(surface), spacing)
        if key not in self._clouds:
            self._clouds[key] = surface.points(spacing)
        return self._clouds[key]

    def show(self, step: float) -> None:
        """Show what was drawn, with dark lines around what is nearer by a step, and begin anew."""
        dark = tuple(255 * x for x in to_rgb(CARD))
        self._picture.set_data(self._canvas.image(step, -1e3, dark))
        self._canvas = Canvas(self.size)


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
