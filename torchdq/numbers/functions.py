"""Functions of numbers of any type: floats, recorded numbers, and other types that have these functions as methods.

For floats they agree with programs, infinities and NaN included, where functions of `math` raise an error.
"""

import math
from collections.abc import Sequence

from torchdq.numbers.ops import Value, apply


def sqrt(x: Value) -> Value:
    """Square root; NaN below zero."""
    return apply("sqrt", x)


def sin(x: Value) -> Value:
    """Sine."""
    return apply("sin", x)


def cos(x: Value) -> Value:
    """Cosine."""
    return apply("cos", x)


def exp(x: Value) -> Value:
    """Exponential."""
    return apply("exp", x)


def log(x: Value) -> Value:
    """Natural logarithm; NaN below zero."""
    return apply("log", x)


def tanh(x: Value) -> Value:
    """Hyperbolic tangent."""
    return apply("tanh", x)


def floor(x: Value) -> Value:
    """Largest integer that is not greater."""
    return apply("floor", x)


def maximum(a: Value, b: Value) -> Value:
    """The larger of two numbers, the first if they are equal; NaN if one of them is."""
    return apply("max", a, b)


def minimum(a: Value, b: Value) -> Value:
    """The smaller of two numbers, the first if they are equal; NaN if one of them is."""
    return apply("min", a, b)


def at_least(a: Value, b: Value) -> Value:
    """1 if a >= b, otherwise 0; 0 if one of them is NaN."""
    return apply("ge", a, b)


def below(a: Value, b: Value) -> Value:
    """1 if a < b, otherwise 0; 0 if one of them is NaN."""
    return select(at_least(a, b), 0.0, at_least(b, a))


def select(mask: Value, a: Value, b: Value) -> Value:
    """a where the mask is not 0, b where it is 0; the value and the gradient do not depend on the other."""
    if isinstance(mask, float | int):
        return a if mask != 0 else b
    return apply("select", mask, a, b)


def polynomial(coefficients: Sequence[float], x: Value) -> Value:
    """Polynomial in x with these coefficients, the constant first."""
    total: Value = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total


# fdlibm's polynomial of the arc tangent on [0, 7/16] (Sun Microsystems 1993)
_ARCTANGENT = (
    3.33333333333329318027e-01,
    -1.99999999998764832476e-01,
    1.42857142725034663711e-01,
    -1.11111104054623557880e-01,
    9.09088713343650656196e-02,
    -7.69187620504482999495e-02,
    6.66107313738753120669e-02,
    -5.83357013379057348645e-02,
    4.97687799461593236017e-02,
    -3.65315727442169155270e-02,
    1.62858201153657823623e-02,
)
_EIGHTH = math.tan(math.pi / 8)


def arctangent(y: Value, x: Value, single: bool) -> Value:
    """Angle in [0, pi] of the point (x, y), y positive, within two units in the last place.

    Args:
        single: whether the program runs in single precision, where pi has another rounding error.
    """
    size = absolute(x)
    t = minimum(y, size) / maximum(y, size)
    steep = at_least(t, _EIGHTH)
    u = select(steep, (t - 1.0) / (t + 1.0), t)
    z = u * u
    high = float.fromhex("0x1.921fb6p+1") if single else math.pi
    low = math.pi - high if single else 1.2246467991473532e-16  # the rounding error of pi
    r = 0.25 * high * steep + ((u - u * (z * polynomial(_ARCTANGENT, z))) + 0.25 * low * steep)
    r = select(below(size, y), 0.5 * high - (r - 0.5 * low), r)
    return select(below(x, 0.0), high - (r - low), r)


def absolute(x: Value) -> Value:
    """Absolute value."""
    return maximum(x, -x)


def clip(x: Value, lower: Value, upper: Value) -> Value:
    """Number limited to the interval between two bounds."""
    return minimum(maximum(x, lower), upper)
