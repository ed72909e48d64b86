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

    code: str  # "in", "const", "add", "sub", "mul", "div", "sin", "cos"
    a: float = -1
    b: int = -1


class Tape:
    """A growing list of operations, each the value of its index."""

    def __init__(self) -> None:
        self.ops: list[Op] = []
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
