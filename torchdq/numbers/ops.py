"""Table of the operations of programs: cost, value, derivatives, torch and C of each, in one row.

The recorder, the derivatives, the torch backend and the printer of all languages read this table. By name they know
only the four operations of arithmetic, whose signs the recorder simplifies, and sine and cosine, which are computed
together. A new operation is a new row and nothing else; formulas call it through `apply`.
"""

import math
import operator
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from torchdq.errors import ArgumentError

Value = Any  # a number of any type


class Mirror(NamedTuple):
    """Identity for negated operands: f(-a, -b) as an operation g on a and b."""

    code: str  # g
    negative: bool = False  # whether f(-a, -b) = -g
    reverse: bool = False  # whether g takes the operands in reverse order


class Count(NamedTuple):
    """Operation counts of a program, by class of cost."""

    multiplications: int = 0
    additions: int = 0
    divisions: int = 0
    sines: int = 0
    roots: int = 0
    exponentials: int = 0
    comparisons: int = 0

    @property
    def total(self) -> int:
        """Number of all operations; a sine or another function counts as one."""
        return sum(self)


class Operation(NamedTuple):
    """Row of the table.

    The partial derivatives are formulas for numbers of any type. Each takes a factor, the value of the operation and
    its operands, and returns the factor times the derivative by one operand; None: the derivative is zero. A common
    divisor of all partial derivatives is kept apart, so that there is only one division.
    """

    cost: str  # class of cost, a field of `Count`
    value: Callable[..., Value]  # on plain numbers
    partials: tuple[Callable[..., Value] | None, ...]
    c: str = ""  # expression in C, of single numbers; "": `infix`, or the function of math.h with the operation's name
    divisor: Callable[..., Value] | None = None  # common divisor of the partial derivatives, from value and operands
    tensor: Callable[..., Any] | None = None  # on tensors, the module `torch` is handed over first; None: `value`
    infix: str = ""  # operator between the operands, in C and in printed programs
    commutes: bool = False
    even: tuple[int, ...] = ()  # positions of operands whose sign does not matter
    mirror: Mirror | None = None  # None: there is no identity for negated operands
    idempotent: bool = False  # whether f(a, a) = a, operands of `even` left out

    def require(self, code: str, operands: int) -> None:
        """Raise unless it has a derivative for each of so many operands, and its cost is counted."""
        if len(self.partials) != operands:
            raise ArgumentError(
                f"operation {code!r} must have as many operands as `partials` in its row of the table, "
                f"{len(self.partials)}, found {operands}"
            )
        if self.cost not in Count._fields:
            known = ", ".join(Count._fields)
            raise ArgumentError(f"cost of operation {code!r} must be among {known}, found {self.cost!r}")


def apply(code: str, *x: Value) -> Value:
    """Value of an operation on numbers of any type; recorded and similar types have a method `applied`."""
    row = OPS[code]
    if not row.infix:
        for number in x:
            # looked up on the type, not on the number: torch.compile can trace only that
            applied = getattr(type(number), "applied", None)
            if applied is not None:
                return applied(code, x)
    return row.value(*x)


def _own(name: str, of_floats: Callable[..., float]) -> Callable[..., Value]:
    """Function of numbers: the method of the first, or that of floats."""

    def value(x: Value, *others: Value) -> Value:
        if callable(getattr(type(x), name, None)):
            return getattr(x, name)(*others)
        if isinstance(x, float | int):
            return of_floats(float(x), *others)
        raise TypeError(f"{name} is not defined for numbers of type {type(x).__name__}; it needs a method {name}()")

    return value


# infinity or NaN, as in programs, where functions of `math` raise an error


def _exp(x: float) -> float:
    try:
        return math.exp(x)
    except OverflowError:
        return math.inf


def _finite(function: Callable[[float], float]) -> Callable[[float], float]:
    """Function that is NaN for arguments that are not finite."""
    return lambda x: function(x) if math.isfinite(x) else math.nan


def _select(mask: Value, a: Value, b: Value) -> Value:
    return apply("select", mask, a, b)


def _gate(larger: bool) -> tuple[Callable[..., Value], ...]:
    """Partial derivatives of the larger or the smaller of two numbers: 1 for the one that is taken, 0 for the other."""

    def first(x: Value, z: Value) -> Value:
        return apply("ge", x, z) if larger else apply("ge", z, x)

    return lambda g, y, a, b: _select(first(a, b), g, 0.0), lambda g, y, a, b: _select(first(a, b), 0.0, g)


OPS: Mapping[str, Operation] = {
    "add": Operation(
        cost="additions",
        value=operator.add,
        partials=(lambda g, y, a, b: g, lambda g, y, a, b: g),
        infix="+",
        commutes=True,
    ),
    "sub": Operation(
        cost="additions",
        value=operator.sub,
        partials=(lambda g, y, a, b: g, lambda g, y, a, b: -g),
        infix="-",
    ),
    "mul": Operation(
        cost="multiplications",
        value=operator.mul,
        partials=(lambda g, y, a, b: g * b, lambda g, y, a, b: a * g),
        infix="*",
        commutes=True,
    ),
    "div": Operation(
        cost="divisions",
        value=operator.truediv,
        partials=(lambda g, y, a, b: g, lambda g, y, a, b: -(g * y)),
        divisor=lambda y, a, b: b,
        infix="/",
    ),
    "sin": Operation(
        cost="sines",
        value=_own("sin", _finite(math.sin)),
        partials=(lambda g, y, x: g * apply("cos", x),),
        mirror=Mirror("sin", negative=True),
    ),
    "cos": Operation(
        cost="sines",
        value=_own("cos", _finite(math.cos)),
        partials=(lambda g, y, x: -(g * apply("sin", x)),),
        even=(0,),
    ),
    "sqrt": Operation(
        cost="roots",
        value=_own("sqrt", lambda x: math.sqrt(x) if x >= 0 else math.nan),
        partials=(lambda g, y, x: g,),
        divisor=lambda y, x: 2.0 * y,
    ),
    "exp": Operation(
        cost="exponentials",
        value=_own("exp", _exp),
        partials=(lambda g, y, x: g * y,),
    ),
    "log": Operation(
        cost="exponentials",
        value=_own("log", lambda x: math.log(x) if x > 0 else -math.inf if x == 0 else math.nan),
        partials=(lambda g, y, x: g,),
        divisor=lambda y, x: x,
    ),
    "tanh": Operation(
        cost="exponentials",
        value=_own("tanh", math.tanh),
        partials=(lambda g, y, x: g * (1.0 - y * y),),
        mirror=Mirror("tanh", negative=True),
    ),
    "floor": Operation(
        cost="comparisons",
        value=_own("floor", lambda x: float(math.floor(x)) if math.isfinite(x) else x),
        partials=(None,),  # constant wherever it has a derivative
    ),
    # maximum and minimum: the first if both are equal, NaN if one is NaN; torch.maximum would share the gradient among
    # equal numbers
    "max": Operation(
        cost="comparisons",
        value=lambda a, b: a if a >= b or a != a else b,
        partials=_gate(larger=True),
        tensor=lambda torch, a, b: torch.where((a >= b) | (a != a), a, b),
        c="({0} >= {1} || {0} != {0}) ? {0} : {1}",
        mirror=Mirror("min", negative=True),
        idempotent=True,
    ),
    "min": Operation(
        cost="comparisons",
        value=lambda a, b: a if a <= b or a != a else b,
        partials=_gate(larger=False),
        tensor=lambda torch, a, b: torch.where((a <= b) | (a != a), a, b),
        c="({0} <= {1} || {0} != {0}) ? {0} : {1}",
        mirror=Mirror("max", negative=True),
        idempotent=True,
    ),
    # 1 if the first is at least the second, otherwise 0; 0 if one is NaN
    "ge": Operation(
        cost="comparisons",
        value=lambda a, b: 1.0 if a >= b else 0.0,
        partials=(None, None),
        tensor=lambda torch, a, b: (a >= b).to(a.dtype),
        c="({0} >= {1}) ? 1 : 0",
        mirror=Mirror("ge", reverse=True),
    ),
    # the second where the first is not 0, otherwise the third; value and gradient do not depend on the one not taken
    "select": Operation(
        cost="comparisons",
        value=lambda mask, a, b: a if mask != 0 else b,
        partials=(None, lambda g, y, mask, a, b: _select(mask, g, 0.0), lambda g, y, mask, a, b: _select(mask, 0.0, g)),
        tensor=lambda torch, mask, a, b: torch.where(mask != 0, a, b),
        c="({0} != 0) ? {1} : {2}",
        even=(0,),
        mirror=Mirror("select", negative=True),
        idempotent=True,
    ),
}
