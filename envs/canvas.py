"""Images of points: of those on one pixel the nearest is seen, and ink goes around what is before other things."""

from __future__ import annotations

import numpy as np

FINE = 2  # points of an image in a pixel, along each axis
LEVELS = 16  # of brightness
DARKEST = 0.6  # brightness of what the light passes by


def spread(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers u and v from 0 to 1 [count] that are spread evenly over a square, as are the first of them."""
    k = np.arange(count)
    return (0.5 + k * 0.7548776662) % 1.0, (0.5 + k * 0.5698402910) % 1.0


class Canvas:
    """Image with the nearness of what is on it.

    Args:
        size: width and height [pixels].
    """

    def __init__(self, size: tuple[int, int]):
        self.width, self.height = (FINE * x for x in size)
        self._nearness = np.full(self.width * self.height, -np.inf, np.float32)
        self._shade = np.zeros(self.width * self.height, np.int32)  # 0: nothing
        self._colours = [np.zeros(3)]

    def add(self, pixels: np.ndarray, nearness: np.ndarray, light: np.ndarray, colour: tuple[int, ...]) -> None:
        """Draw points [p, 2] that are counted from the lower left corner; light [p] is from 0 to 1."""
        left, up = (FINE * pixels.T - 0.5).astype(np.float32)
        inside = (left >= 0) & (left < self.width - 1) & (up >= 0) & (up < self.height - 1) & np.isfinite(nearness)
        first = (self.height - 1 - up[inside].astype(np.int32)) * self.width + left[inside].astype(np.int32)
        near, levels = nearness[inside].astype(np.float32), np.clip(light[inside], 0.0, 1.0) * (LEVELS - 1) + 0.5
        shade = len(self._colours) + levels.astype(np.int32)
        self._colours += [np.array(colour) * x for x in np.linspace(DARKEST, 1.0, LEVELS)]
        for step in (0, 1, -self.width, 1 - self.width):  # a point covers four, so that there are no holes
            at = first + step
            np.maximum.at(self._nearness, at, near)
            seen = near >= self._nearness[at]
            self._shade[at[seen]] = shade[seen]

    def image(self, step: float, least: float, ink: tuple[int, ...]) -> np.ndarray:
        """Image [height, width, 4], uint8, transparent where there is nothing.

        Ink goes around what is nearer than its surroundings by a step; what is not nearer than `least` has none.
        """
        near = self._nearness.reshape(self.height, self.width)
        around = near.copy()
        for axis, shift in ((0, 1), (1, 1), (0, 1), (1, 1)):
            moved = [np.roll(around, k * shift, axis) for k in (-1, 1)]
            around = np.maximum(np.maximum(*moved), around)
        rim = (around > near + step) & (around > least)
        colours = np.array([(*colour, 255.0 * (k > 0)) for k, colour in enumerate(self._colours)], np.float32)
        rgba = colours[self._shade].reshape(self.height, self.width, 4)
        rgba[rim] = (*ink, 255.0)
        rgba[..., :3] *= rgba[..., 3:] / 255.0
        mean = rgba.reshape(self.height // FINE, FINE, self.width // FINE, FINE, 4).mean((1, 3))
        mean[..., :3] /= np.maximum(mean[..., 3:] / 255.0, 1e-6)
        return np.round(mean).astype(np.uint8)
