"""Fourier series that start and end at rest, within limits of position, velocity and acceleration by construction.

A trigonometric polynomial p of degree H, looked at in N evenly spaced points of its period, stays below

    max |p| <= max over the points |p| / cos(pi H / N),   N > 2 H

everywhere (H. Ehlich, K. Zeller, "Schwankung von Polynomen zwischen Gitterpunkten", Mathematische Zeitschrift 86
(1964)), so that a shape of any size can be scaled until it just fits, between the points as in them.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.learning.excitation.limits import Bounds

POINTS = 24  # points of the period per harmonic where peaks are looked for: they are missed by less than 1 %
DTYPE = torch.float64


class Series(NamedTuple):
    """Motion of joints, q(t) = centre + sum over k = 1 ... H of sine_k sin(k w t) + cosine_k cos(k w t)."""

    centre: Tensor  # [..., n] [rad or m]
    sine: Tensor  # [..., n, H] [rad or m]
    cosine: Tensor  # [..., n, H] [rad or m]
    rate: Tensor  # [...] w [rad/s]

    def at(self, phase: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Positions, velocities and accelerations [..., points, n] at phases w t [points]."""
        k = torch.arange(1, self.sine.shape[-1] + 1, dtype=DTYPE)
        w = self.rate[..., None, None]
        both = torch.cat([self.sine, self.cosine], -1).mT
        sin, cos = (phase[:, None] * k).sin(), (phase[:, None] * k).cos()
        q = self.centre[..., None, :] + torch.cat([sin, cos], -1) @ both
        qd = w * (torch.cat([k * cos, -k * sin], -1) @ both)
        qdd = -w.square() * (torch.cat([k * k * sin, k * k * cos], -1) @ both)
        return q, qd, qdd

    def shrunk(self, size: Tensor) -> "Series":
        """Motion of a part [...] of the size, about the same centre: slower, and within the same limits."""
        return self._replace(sine=size[..., None, None] * self.sine, cosine=size[..., None, None] * self.cosine)


class Family:
    """Motions within bounds, of free numbers [..., n, 2 H]: 2 (H - 1) of a joint's shape, its size and its centre."""

    def __init__(self, bounds: Bounds, harmonics: int):
        self.bounds, self.harmonics = bounds, harmonics
        k = torch.arange(1, harmonics + 1, dtype=DTYPE)
        self._sines, self._cosines = _orthogonal(k), _orthogonal(k * k)  # at rest, qd = qdd = 0
        self._phases = grid(POINTS * harmonics)

    def start(self, rows: int, generator: torch.Generator) -> Tensor:
        """Numbers [rows, n, 2 H] of random motions."""
        x = torch.randn(rows, len(self.bounds.lower), 2 * self.harmonics, dtype=DTYPE, generator=generator)
        x[..., -2] += 2.0  # most of the largest size
        return x

    def motions(self, x: Tensor, rate: Tensor) -> Series:
        """Motions of numbers [..., n, 2 H], with base frequencies `rate` [...] [rad/s]."""
        lower, upper, velocity, acceleration = self.bounds[:4]
        shapes, size, centre = x[..., :-2], x[..., -2], x[..., -1]
        H = self.harmonics
        sine, cosine = shapes[..., : H - 1] @ self._sines, shapes[..., H - 1 :] @ self._cosines
        shape = Series(torch.zeros_like(centre), sine, cosine, rate)
        missed = math.cos(math.pi * H / len(self._phases))
        q, qd, qdd = shape.at(self._phases)
        top, bottom = q.amax(-2), q.amin(-2)
        half, reach = (top - bottom) / 2 / missed, (upper - lower) / 2
        used = half / reach, qd.abs().amax(-2) / velocity / missed, qdd.abs().amax(-2) / acceleration / missed
        scale = size.sigmoid() / torch.stack(used).amax(0)
        middle = (upper + lower) / 2 + centre.tanh() * (reach - scale * half)
        return Series(middle - scale * (top + bottom) / 2, scale[..., None] * sine, scale[..., None] * cosine, rate)


def grid(points: int) -> Tensor:
    """Even phases [points] of one period, from 0 on."""
    return torch.arange(points, dtype=DTYPE) * (2 * math.pi / points)


def _orthogonal(weights: Tensor) -> Tensor:
    """Basis [H - 1, H] of the amplitudes whose weighted sum is zero, of about the same speed each."""
    H = len(weights)
    k = torch.arange(1, H + 1, dtype=DTYPE)
    normal = weights / k  # amplitudes are in units of 1 / k
    basis = torch.linalg.qr(torch.cat([normal[:, None], torch.eye(H, dtype=DTYPE)[:, : H - 1]], 1)).Q[:, 1:]
    return basis.T / k
