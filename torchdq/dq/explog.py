"""Exponential and logarithm of dual quaternions as programs: accurate to rounding at every angle, with derivatives.

Their coefficients are entire functions of squares. Near the singular points they are summed as series, elsewhere they
are closed formulas; the switch sits far from the singular point, where both sides are accurate. Both are computed, the
one that is not taken from harmless arguments, and a mask of ones and zeros picks.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
from torch import Tensor

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.quaternion import Pure
from torchdq.backends import choice as backends
from torchdq.backends import run
from torchdq.numbers.functions import absolute, arctangent, at_least, below, maximum, minimum, pick, polynomial, sqrt
from torchdq.program.program import Argument, Program, record

Value = Any
_TERMS = 11
_COS = [(-1) ** k / math.factorial(2 * k) for k in range(_TERMS)]
_SINC = [(-1) ** k / math.factorial(2 * k + 1) for k in range(_TERMS)]
_K = [(-1) ** (k + 1) * (2 * k + 2) / math.factorial(2 * k + 3) for k in range(_TERMS)]
_ATAN = [(-1) ** k / (2 * k + 1) for k in range(_TERMS + 2)]
_ATAN_K = [(-1) ** (k + 1) * (2 * k + 2) / (2 * k + 3) for k in range(_TERMS + 2)]


def length_defect(a: Pure, h: Value, split: float) -> Value:
    """|a| - h for a rounded length h, to twice the working precision (Dekker 1971).

    Every number is the sum of two with half its digits, whose products are exact.
    """
    squares, errors = [], []
    for x in (*a, h):
        shifted = x * split
        high = shifted - (shifted - x)
        low, square = x - high, x * x
        squares.append(square)
        errors.append(((high * high - square) + 2.0 * high * low) + low * low)
    (x2, y2, z2, h2), (ex, ey, ez, eh) = squares, errors
    xy = x2 + y2
    kept = xy - x2
    e1 = (x2 - (xy - kept)) + (y2 - kept)
    xyz = xy + z2
    kept = xyz - xy
    e2 = (xy - (xyz - kept)) + (z2 - kept)
    return ((xyz - h2) + (((ex + ey) + (ez - eh)) + (e1 + e2))) / (2.0 * h)


def entire(a: Pure, split: float) -> tuple[Value, Value, Value]:
    """C = cos |a|, S = sin |a|/|a|, K = (C - S)/|a|^2, with every derivative finite at a = 0.

    Beyond the series, the rounding of |a| would cost an ulp per radian; it is measured and made good.
    """
    x = quat.norm2(a)
    near = below(x, 1.0)
    x_near, x_far = minimum(x, 1.0), maximum(x, 1.0)
    h = sqrt(x_far)
    defect = (1.0 - near) * length_defect(a, h, split)
    sin, cos = h.sin(), h.cos()
    c, s = cos - defect * sin, (sin + defect * (cos - sin / h)) / h
    return (
        pick(near, polynomial(_COS, x_near), c),
        pick(near, polynomial(_SINC, x_near), s),
        pick(near, polynomial(_K, x_near), (c - s) / x_far),
    )


def angle(w: Value, n2: Value, single: bool) -> tuple[Value, Value]:
    """f = atan2(n, w)/n and g = (w/(w^2 + n2) - f)/n2, n = sqrt n2, with every derivative finite at n = 0, w > 0."""
    near = below(0.0, w) * below(n2, 0.05 * (w * w))
    w_near = pick(near, w, 1.0)
    y = pick(near, n2, 0.0) / (w_near * w_near)
    n2_far = pick(maximum(near, full_turn(w, n2)), 1.0, n2)
    n = sqrt(n2_far)
    f = arctangent(n, w, single) / n
    return (
        pick(near, polynomial(_ATAN, y) / w_near, f),
        pick(near, polynomial(_ATAN_K, y) / (w_near * w_near * w_near), (w / (w * w + n2_far) - f) / n2_far),
    )


def full_turn(w: Value, n2: Value) -> Value:
    """1 where no line is left to turn about, though the turn is not none."""
    return at_least(0.0, n2) * below(w, 0.0)


def exp(a: Sequence[Value], single: bool) -> dict[str, Sequence[Value]]:
    """Dual quaternion of a pure one."""
    split = 2.0**12 + 1.0 if single else 2.0**27 + 1.0
    p, d = screw.exp((tuple(a[:3]), tuple(a[3:])), lambda v: entire(v, split))
    return {"x": [*p, *d]}


def log(x: Sequence[Value], single: bool) -> dict[str, Sequence[Value]]:
    """Pure dual quaternion of a unit one; at a full turn, about the line along the displacement, or along x."""
    (w, *v), b = x[:4], tuple(x[5:])
    p, d = screw.log((tuple(x[:4]), tuple(x[4:])), lambda w, n2: angle(w, n2, single))
    turned = full_turn(w, quat.norm2(tuple(v)))
    size = absolute(b[0]) + absolute(b[1]) + absolute(b[2])
    slides = turned * below(0.0, size)
    line = [pick(slides, e, 1.0) / pick(slides, size, 1.0) for e in b]
    length = sqrt(quat.norm2(tuple(line)))
    along = [pick(slides, e / length, at) for e, at in zip(line, (1.0, 0.0, 0.0), strict=True)]
    return {
        "a": [
            *(pick(turned, math.pi * e, y) for e, y in zip(along, p, strict=True)),
            *(pick(turned, -e, y) for e, y in zip(b, d, strict=True)),
        ]
    }


@cache
def program(formula: Callable[..., dict[str, Sequence[Value]]], width: int, single: bool) -> Program:
    """Program of one of the two."""
    return record(formula.__name__, [Argument("x", width)], lambda row: formula(row, single))


def mapped(formula: Callable[..., dict[str, Sequence[Value]]], x: Tensor) -> Tensor:
    """Results [..., k] of one of the two for a tensor [..., width]."""
    rows = x.reshape(-1, x.shape[-1]) if x.ndim != 2 else x
    recorded = program(formula, x.shape[-1], x.dtype != torch.float64)
    # only these two have kernels; a graph that is traced fuses torch's operations by itself
    plain = x.dtype not in (torch.float32, torch.float64) or torch.compiler.is_compiling()
    chosen = run.eager if plain or backends.choose(None, x.device.type) == "eager" else run.compiled
    (found,) = chosen(recorded, [rows])
    return found if x.ndim == 2 else found.reshape(*x.shape[:-1], found.shape[-1])
