"""Exponential and logarithm of dual quaternions as programs: accurate to rounding at every angle, with derivatives.

Their coefficients are entire functions of squares. Near the singular points they are power series, elsewhere closed
formulas; the switch lies far from the singular point, where both are accurate. Both are computed and a mask selects;
the one that is not selected is computed at an argument where it is finite.

Near a full turn the axis of a motion is in few digits of its dual quaternion, (-1, small): there the logarithm is that
of a dual quaternion within rounding of the given one, and may differ by eps over the distance to the full turn.
`log_shortest` never comes there.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.quaternion import Number, Pure
from torchdq.algebra.screw import Screw
from torchdq.base.checks import DTYPES
from torchdq.dq.formulas import computed
from torchdq.numbers.functions import absolute, arctangent, at_least, below, maximum, minimum, polynomial, select, sqrt

_TERMS = 11
_COS = [(-1) ** k / math.factorial(2 * k) for k in range(_TERMS)]
_SINC = [(-1) ** k / math.factorial(2 * k + 1) for k in range(_TERMS)]
_K = [(-1) ** (k + 1) * (2 * k + 2) / math.factorial(2 * k + 3) for k in range(_TERMS)]
_ATAN = [(-1) ** k / (2 * k + 1) for k in range(_TERMS + 2)]
_ATAN_K = [(-1) ** (k + 1) * (2 * k + 2) / (2 * k + 3) for k in range(_TERMS + 2)]


def length_defect(a: Pure, h: Number, split: float) -> Number:
    """Error |a| - h of a rounded length h, to twice the working precision (Dekker 1971)."""
    (x2, ex), (y2, ey), (z2, ez), (h2, eh) = (_square(x, split) for x in (*a, h))
    xy, e1 = _sum(x2, y2)
    xyz, e2 = _sum(xy, z2)
    return ((xyz - h2) + (((ex + ey) + (ez - eh)) + (e1 + e2))) / (2.0 * h)


def _square(x: Number, split: float) -> tuple[Number, Number]:
    """Rounded square and its error, from two parts of x with half of its digits, whose products are exact."""
    shifted = x * split
    high = shifted - (shifted - x)
    low, square = x - high, x * x
    return square, ((high * high - square) + 2.0 * high * low) + low * low


def _sum(a: Number, b: Number) -> tuple[Number, Number]:
    """Rounded sum and its error."""
    total = a + b
    kept = total - a
    return total, (a - (total - kept)) + (b - kept)


def entire(a: Pure, split: float | None) -> tuple[Number, Number, Number]:
    """C = cos |a|, S = sin |a|/|a|, K = (C - S)/|a|^2, with every derivative finite at a = 0.

    Outside the series, the rounding error of |a| would cost one ulp per radian; it is computed and corrected, unless
    `split` is None.
    """
    x = quat.norm2(a)
    near = below(x, 1.0)
    x_near, x_far = minimum(x, 1.0), maximum(x, 1.0)
    h = sqrt(x_far)
    defect = 0.0 if split is None else select(near, 0.0, length_defect(a, h, split))
    sin, cos = h.sin(), h.cos()
    c, s = cos - defect * sin, (sin + defect * (cos - sin / h)) / h
    return (
        select(near, polynomial(_COS, x_near), c),
        select(near, polynomial(_SINC, x_near), s),
        select(near, polynomial(_K, x_near), (c - s) / x_far),
    )


def angle(w: Number, n2: Number, single: bool) -> tuple[Number, Number]:
    """f = atan2(n, w)/n and g = (w/(w^2 + n2) - f)/n2, n = sqrt n2, with every derivative finite at n = 0, w > 0."""
    near = below(0.0, w) * below(n2, 0.05 * (w * w))
    w_near = select(near, w, 1.0)
    y = select(near, n2, 0.0) / (w_near * w_near)
    n2_far = select(maximum(near, full_turn(w, n2)), 1.0, n2)
    n = sqrt(n2_far)
    f = arctangent(n, w, single) / n
    return (
        select(near, polynomial(_ATAN, y) / w_near, f),
        select(near, polynomial(_ATAN_K, y) / (w_near * w_near * w_near), (w / (w * w + n2_far) - f) / n2_far),
    )


def full_turn(w: Number, n2: Number) -> Number:
    """1 at a full turn, w < 0 and n2 = 0, where the axis is undefined; otherwise 0."""
    return at_least(0.0, n2) * below(w, 0.0)


def exp(a: Screw, single: bool) -> DualQuaternion:
    """Unit dual quaternion x = exp(a) of a pure one."""
    split = 2.0**12 + 1.0 if single else 2.0**27 + 1.0
    return screw.exp(a, lambda v: entire(v, split))


def log(x: DualQuaternion, single: bool) -> Screw:
    """Logarithm a of a unit dual quaternion x; the axis of a full turn is along the displacement, or along x."""
    (w, *v), (scalar, *b) = x
    p, d = screw.log(x, lambda w, n2: angle(w, n2, single))
    # a dual part that is not finite must not be replaced
    turned = full_turn(w, quat.norm2(tuple(v))) * below(absolute(scalar), math.inf)
    size = absolute(b[0]) + absolute(b[1]) + absolute(b[2])
    slides = turned * below(0.0, size)
    line = [select(slides, e, 1.0) / select(slides, size, 1.0) for e in b]
    length = sqrt(quat.norm2(tuple(line)))
    along = [select(slides, e / length, at) for e, at in zip(line, (1.0, 0.0, 0.0), strict=True)]
    return (
        tuple([select(turned, math.pi * e, y) for e, y in zip(along, p, strict=True)]),
        tuple([select(turned, -e, y) for e, y in zip(b, d, strict=True)]),
    )


# by whether the program runs in single precision
EXP, LOG = ({single: partial(formula, single=single) for single in (False, True)} for formula in (exp, log))


def mapped(formula: Mapping[bool, Callable[..., Any]], x: Tensor) -> Tensor:
    """Result [..., k] of `EXP` or `LOG` for a tensor [..., width]; half precision is computed in single precision."""
    wide = x if x.dtype in DTYPES else x.float()
    found = computed(formula[wide.dtype == torch.float32], x=wide)
    return found if wide is x else found.to(x.dtype)
