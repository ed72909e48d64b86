"""A number that records the operations on it: running an algorithm on it gives straight-line arithmetic.

Equal operations get one value (value numbering), and a negation is never an operation: a number is a value and a sign,
and the sign turns additions into subtractions. Arithmetic on constants alone is done in Python's floats and is not
recorded.

A program has no branches: every sample takes the same operations. A truth test, a comparison or a conversion of a
recorded number would make one sample's value a constant of the program, so all of them raise `NumberError`.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from numbers import Real
from typing import Any, NamedTuple, NoReturn

from torchdq.errors import NumberError
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
            other = _constant(other)
            if other == 0:
                return self
            other = self.tape.constant(other)
        return _sum(self, other)

    __radd__ = __add__

    def __sub__(self, other: Recorded | float) -> Recorded | float:
        return self + (-other if isinstance(other, Recorded) else -_constant(other))

    def __rsub__(self, other: Recorded | float) -> Recorded | float:
        return (-self) + other

    def __mul__(self, other: Recorded | float) -> Recorded | float:
        if not isinstance(other, Recorded):
            other = _constant(other)
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
            return self * (1.0 / _constant(other))
        quotient = self.tape.value("div", (self.index, other.index))
        return Recorded(self.tape, quotient, self.negative != other.negative)

    def __rtruediv__(self, other: float) -> Recorded | float:
        other = _constant(other)
        return 0.0 if other == 0 else self.tape.constant(other) / self

    @classmethod
    def __torch_function__(cls, function: Callable[..., Any], *_: Any) -> NoReturn:
        name = getattr(function, "__name__", str(function))
        raise NumberError(f"a recorded number cannot be a tensor, found one in torch.{name}; {FUNCTIONS}")

    def __array_ufunc__(self, function: Any, method: str, *x: Any, **_: Any) -> Recorded | float:
        arithmetic = _ARITHMETIC.get(function.__name__)
        if arithmetic is None:
            raise NumberError(
                f"a recorded number cannot be an array, found one in numpy.{function.__name__}; {FUNCTIONS}"
            )
        a, b = (v if isinstance(v, Recorded) else _constant(v) for v in x)
        return arithmetic(a, b)  # a number of numpy on the left

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
        row.require(code, len(x))
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


_ARITHMETIC: dict[str, Callable[[Any, Any], Any]] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
}
FUNCTIONS = "use the functions of torchdq.numbers.functions: " + ", ".join(
    ("sqrt", "sin", "cos", "exp", "log", "tanh", "floor", "absolute", "maximum", "minimum", "clip")
)
_REFUSED = {
    "be tested for truth": (
        ("bool",),
        "its value differs from sample to sample; use select(below(a, b), x, y) of torchdq.numbers.functions",
    ),
    "be compared": (
        ("eq", "ne", "lt", "le", "gt", "ge"),
        "use below(a, b) or at_least(a, b) of torchdq.numbers.functions, which give 1 or 0, and select(mask, x, y)",
    ),
    "be an index, a key, or a number of Python or numpy": (
        ("index", "hash", "int", "float", "complex", "array", "round", "trunc", "floor", "ceil"),
        FUNCTIONS,
    ),
    "be taken to a power, divided with remainder, or made positive by abs": (
        ("pow", "rpow", "mod", "rmod", "floordiv", "rfloordiv", "divmod", "rdivmod", "abs"),
        "use x * x, floor(x / y) and absolute(x); " + FUNCTIONS,
    ),
}


def _refusal(what: str, remedy: str) -> Callable[..., NoReturn]:
    def refuse(self: Recorded, *_: Any, **__: Any) -> NoReturn:
        raise NumberError(f"a recorded number cannot {what}: {remedy}")

    return refuse


for _what, (_names, _remedy) in _REFUSED.items():
    for _name in _names:
        setattr(Recorded, f"__{_name}__", _refusal(_what, _remedy))


def _constant(x: Any) -> float:
    """Constant operand of a recorded number."""
    if isinstance(x, float | int | Real):
        return float(x)
    raise NumberError(
        f"a recorded number takes part in arithmetic with numbers, found {type(x).__name__}; tensors must be arguments "
        f"or parameters of what is recorded"
    )


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
