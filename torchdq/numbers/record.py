"""A number that records the operations on it: running an algorithm on it gives straight-line arithmetic.

Equal operations get one value (value numbering), and a negation is never an operation: a number is a value and a sign,
and the sign turns additions into subtractions. Arithmetic on constants alone is done in Python's floats and is not
recorded.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from torchdq.numbers.ops import OPS


class Op(NamedTuple):
    """Operation on earlier values, or a leaf: an input or a constant."""

    code: str  # "in", "const", or a row of `ops.OPS`
    operands: tuple[int, ...] = ()  # indices of earlier values
    payload: Any = None  # positions of an input's argument and component, or a constant's number


class Tape:
    """List of recorded operations; the index of an operation stands for its value."""

    def __init__(self) -> None:
        self.ops: list[Op] = []
        self._index: dict[Op, int] = {}

    def value(self, code: str, operands: tuple[int, ...] = (), payload: Any = None) -> int:
        """Index of the value of an operation, recorded once."""
        if len(operands) > 1 and OPS[code].commutes:
            operands = tuple(sorted(operands))
        op = Op(code, operands, payload)
        index = self._index.get(op)
        if index is None:
            index = self._index[op] = len(self.ops)
            self.ops.append(op)
        return index

    def input(self, argument: int, component: int) -> Recorded:
        """Recorded number for a component of an argument."""
        return Recorded(self, self.value("in", payload=(argument, component)), False)

    def constant(self, x: float) -> Recorded:
        """Recorded number for a constant; its sign is kept apart, so that x and -x are one value."""
        return Recorded(self, self.value("const", payload=abs(x)), math.copysign(1.0, x) < 0)


class Recorded:
    """A recorded value, or its negative."""

    __slots__ = ("index", "negative", "tape")

    def __init__(self, tape: Tape, index: int, negative: bool):
        self.tape, self.index, self.negative = tape, index, negative

    def __neg__(self) -> Recorded:
        return Recorded(self.tape, self.index, not self.negative)

    def __add__(self, other: Recorded | float) -> Recorded | float:
        if not isinstance(other, Recorded):
            if other == 0:
                return self
            other = self.tape.constant(other)
        return _sum(self, other)

    __radd__ = __add__

    def __sub__(self, other: Recorded | float) -> Recorded | float:
        return self + (-other)

    def __rsub__(self, other: Recorded | float) -> Recorded | float:
        return (-self) + other

    def __mul__(self, other: Recorded | float) -> Recorded | float:
        if not isinstance(other, Recorded):
            if other == 0:
                return 0.0
            if other in (1, -1):
                return self if other > 0 else -self
            other = self.tape.constant(other)
        product = self.tape.value("mul", (self.index, other.index))
        return Recorded(self.tape, product, self.negative != other.negative)

    __rmul__ = __mul__

    def __truediv__(self, other: Recorded | float) -> Recorded | float:
        if not isinstance(other, Recorded):
            return self * (1.0 / other)
        quotient = self.tape.value("div", (self.index, other.index))
        return Recorded(self.tape, quotient, self.negative != other.negative)

    def __rtruediv__(self, other: float) -> Recorded | float:
        return 0.0 if other == 0 else self.tape.constant(other) / self

    def sin(self) -> Recorded:
        """Sine."""
        return self.applied("sin", (self,))

    def cos(self) -> Recorded:
        """Cosine."""
        return self.applied("cos", (self,))

    @staticmethod
    def applied(code: str, x: Sequence[Recorded | float]) -> Recorded:
        """Value of an operation other than + - * /; at least one of its operands is recorded."""
        row = OPS[code]
        tape = next(v.tape for v in x if isinstance(v, Recorded))
        signed = [v for k, v in enumerate(x) if k not in row.even]
        signs = {v.negative for v in signed if isinstance(v, Recorded)}
        negative = row.mirror is not None and signs == {True}
        operands = [
            v.index if k in row.even and isinstance(v, Recorded) else _with_sign(tape, v, negative)
            for k, v in enumerate(x)
        ]
        own = {i for k, i in enumerate(operands) if k not in row.even}
        if row.idempotent and len(own) == 1:
            return Recorded(tape, own.pop(), negative)
        if row.mirror is None or not negative:
            return Recorded(tape, tape.value(code, tuple(operands)), False)
        operands = operands[::-1] if row.mirror.reverse else operands
        return Recorded(tape, tape.value(row.mirror.code, tuple(operands)), row.mirror.negative)


def _with_sign(tape: Tape, x: Recorded | float, negative: bool) -> int:
    """Index of the value of x, or of -x if `negative`."""
    if not isinstance(x, Recorded):
        # recorded with its sign; adding 0.0 makes it a float and never -0.0
        return tape.value("const", payload=0.0 + (-x if negative else x))
    if x.negative == negative:
        return x.index
    op = tape.ops[x.index]
    if op.code == "const":
        return tape.value("const", payload=0.0 - op.payload)
    return tape.value("sub", (tape.constant(0.0).index, x.index))


def _sum(x: Recorded, y: Recorded) -> Recorded | float:
    """x + y: recorded as an addition if the signs agree, otherwise as a subtraction."""
    tape = x.tape
    if x.negative == y.negative:
        return Recorded(tape, tape.value("add", (x.index, y.index)), x.negative)
    if x.index == y.index:
        return 0.0
    # operands in one order, so that a - b and b - a are one value
    negative = x.negative
    a, b = x.index, y.index
    if a > b:
        a, b, negative = b, a, not negative
    return Recorded(tape, tape.value("sub", (a, b)), negative)
