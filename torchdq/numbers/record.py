"""A number that records what is done to it: run an algorithm on it, and what is left is straight-line arithmetic.

Equal operations get one value (value numbering), constants are folded, and a negation is never an operation: a number
is a value and a sign, and the sign is worked into the additions around it. Arithmetic on what is known in advance is
done in Python's floats and never reaches the tape.
"""

from __future__ import annotations

import math
from typing import NamedTuple


class Op(NamedTuple):
    """One operation; `a` and `b` are indices of earlier values, or an input's position, or `a` a constant."""

    # "in", "const", "add", "sub", "mul", "div", "sin", "cos", "sqrt", "exp", "log", "floor", "max", "min", "ge"
    code: str
    a: float = -1
    b: int = -1


class Tape:
    """A growing list of operations, each the value of its index."""

    def __init__(self) -> None:
        self.ops: list[Op] = []
        self.growths: list[Number | float] = []  # factors by which rounding errors are magnified
        self._index: dict[Op, int] = {}

    def value(self, code: str, a: float = -1, b: int = -1) -> int:
        """Index of the value of an operation, recorded once."""
        op = Op(code, a, b)
        index = self._index.get(op)
        if index is None:
            index = self._index[op] = len(self.ops)
            self.ops.append(op)
        return index

    def input(self, argument: int, component: int) -> Number:
        """Number that stands for a component of an argument."""
        return Number(self, self.value("in", argument, component), False)

    def constant(self, x: float) -> Number:
        """Number that stands for a constant; its sign is kept apart, so that x and -x are one value."""
        return Number(self, self.value("const", abs(x)), math.copysign(1.0, x) < 0)


class Number:
    """A recorded value, or its negative."""

    __slots__ = ("index", "negative", "tape")

    def __init__(self, tape: Tape, index: int, negative: bool):
        self.tape, self.index, self.negative = tape, index, negative

    def __neg__(self) -> Number:
        return Number(self.tape, self.index, not self.negative)

    def __add__(self, other: Number | float) -> Number | float:
        if not isinstance(other, Number):
            if other == 0:
                return self
            other = self.tape.constant(other)
        return _sum(self, other)

    __radd__ = __add__

    def __sub__(self, other: Number | float) -> Number | float:
        return self + (-other)

    def __rsub__(self, other: Number | float) -> Number | float:
        return (-self) + other

    def __mul__(self, other: Number | float) -> Number | float:
        if not isinstance(other, Number):
            if other == 0:
                return 0.0
            if other in (1, -1):
                return self if other > 0 else -self
            other = self.tape.constant(other)
        a, b = sorted((self.index, other.index))
        return Number(self.tape, self.tape.value("mul", a, b), self.negative != other.negative)

    __rmul__ = __mul__

    def __truediv__(self, other: Number | float) -> Number | float:
        if not isinstance(other, Number):
            return self * (1.0 / other)
        return Number(self.tape, self.tape.value("div", self.index, other.index), self.negative != other.negative)

    def __rtruediv__(self, other: float) -> Number | float:
        return 0.0 if other == 0 else self.tape.constant(other) / self

    def sin(self) -> Number:
        """Sine."""
        return Number(self.tape, self.tape.value("sin", self.index), self.negative)

    def cos(self) -> Number:
        """Cosine."""
        return Number(self.tape, self.tape.value("cos", self.index), False)

    def sqrt(self) -> Number:
        """Square root."""
        return Number(self.tape, self.tape.value("sqrt", self._signed()), False)

    def exp(self) -> Number:
        """Exponential."""
        return Number(self.tape, self.tape.value("exp", self._signed()), False)

    def log(self) -> Number:
        """Natural logarithm."""
        return Number(self.tape, self.tape.value("log", self._signed()), False)

    def floor(self) -> Number:
        """Largest whole number that is not above."""
        return Number(self.tape, self.tape.value("floor", self._signed()), False)

    def maximum(self, other: Number | float) -> Number:
        """The larger of two numbers; this one if they are equal."""
        a, b, negative = self._alike(other)
        index = a if a == b else self.tape.value("min" if negative else "max", a, b)
        return Number(self.tape, index, negative)

    def minimum(self, other: Number | float) -> Number:
        """The smaller of two numbers; this one if they are equal."""
        a, b, negative = self._alike(other)
        index = a if a == b else self.tape.value("max" if negative else "min", a, b)
        return Number(self.tape, index, negative)

    def note_growth(self, growth: Number | float) -> None:
        """Have the tape remember that rounding errors on the way to this number are magnified."""
        self.tape.growths.append(growth)

    def at_least(self, other: Number | float) -> Number:
        """1 if this number is at least the other, or else 0."""
        a, b, negative = self._alike(other)
        return Number(self.tape, self.tape.value("ge", *((b, a) if negative else (a, b))), False)

    def _signed(self) -> int:
        """Index of the value that the number is, its sign worked in."""
        if not self.negative:
            return self.index
        op = self.tape.ops[self.index]
        if op.code == "const":
            return self.tape.value("const", 0.0 - op.a)
        return self.tape.value("sub", self.tape.constant(0.0).index, self.index)

    def _alike(self, other: Number | float) -> tuple[int, int, bool]:
        """Indices of the values of two numbers, and the sign that both have."""
        if not isinstance(other, Number):
            # a constant can be had with either sign; a sum with 0.0 is a float and never -0.0
            return self.index, self.tape.value("const", 0.0 + (-other if self.negative else other)), self.negative
        if self.negative == other.negative:
            return self.index, other.index, self.negative
        return self._signed(), other._signed(), False


def _sum(x: Number, y: Number) -> Number | float:
    """x + y with the signs worked in: an addition if they agree, a subtraction if they do not."""
    tape = x.tape
    if x.negative == y.negative:
        a, b = sorted((x.index, y.index))
        return Number(tape, tape.value("add", a, b), x.negative)
    if x.index == y.index:
        return 0.0
    # one order of every difference, so that a - b and b - a are one value
    negative = x.negative
    a, b = x.index, y.index
    if a > b:
        a, b, negative = b, a, not negative
    return Number(tape, tape.value("sub", a, b), negative)
