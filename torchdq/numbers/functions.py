"""Functions of numbers of any kind: floats, recorded numbers, and others as far as they or Python offer it.

Floats give what programs give, infinities and NaN included, where Python's own functions would raise an error.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

Value = Any  # a number of any kind


def sqrt(x: Value) -> Value:
    """Square root; NaN below zero."""
    return _of_one("sqrt", lambda v: math.sqrt(v) if v >= 0 else math.nan, x)


def exp(x: Value) -> Value:
    """Exponential."""
    return _of_one("exp", _exp, x)


def log(x: Value) -> Value:
    """Natural logarithm; NaN below zero."""
    return _of_one("log", lambda v: math.log(v) if v > 0 else -math.inf if v == 0 else math.nan, x)


def floor(x: Value) -> Value:
    """Largest whole number that is not above."""
    return _of_one("floor", lambda v: float(math.floor(v)) if math.isfinite(v) else v, x)


def maximum(a: Value, b: Value) -> Value:
    """The larger of two numbers, the first if they are equal; NaN if one of them is."""
    if hasattr(a, "maximum"):
        return a.maximum(b)
    if hasattr(b, "maximum"):
        return b.maximum(a)
    return a if a >= b or a != a else b


def minimum(a: Value, b: Value) -> Value:
    """The smaller of two numbers, the first if they are equal; NaN if one of them is."""
    if hasattr(a, "minimum"):
        return a.minimum(b)
    if hasattr(b, "minimum"):
        return b.minimum(a)
    return a if a <= b or a != a else b


def at_least(a: Value, b: Value) -> Value:
    """1 if a is at least b, or else 0, also if one of them is NaN."""
    if hasattr(a, "at_least"):
        return a.at_least(b)
    if hasattr(b, "at_least"):
        return (-b).at_least(-a)
    return 1.0 if a >= b else 0.0


def note_growth(results: Iterable[Value], growth: Value) -> None:
    """Say by what factor the way to some results magnifies rounding errors, if they are of a kind that notes it."""
    for x in results:
        if hasattr(x, "note_growth"):
            x.note_growth(growth)
            return


def absolute(x: Value) -> Value:
    """Distance from zero."""
    return maximum(x, -x)


def clip(x: Value, lower: Value, upper: Value) -> Value:
    """The number where it is within two bounds, or else the bound it is beyond, exactly."""
    return minimum(maximum(x, lower), upper)


def _exp(x: float) -> float:
    try:
        return math.exp(x)
    except OverflowError:
        return math.inf


def _of_one(name: str, of_float: Callable[[float], float], x: Value) -> Value:
    """Function of one number: its own method, or that of floats."""
    # the kind is asked, not the number: mpmath's exp is an exponent, and torch.compile can trace no other question
    if callable(getattr(type(x), name, None)):
        return getattr(x, name)()
    if isinstance(x, float | int):
        return of_float(float(x))
    raise TypeError(f"{name} is not known for numbers of kind {type(x).__name__}")
