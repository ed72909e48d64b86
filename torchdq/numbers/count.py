"""A number that counts the operations on it: running a formula on it gives the cost of the formula as written.

Rules:

* A multiplication or division counts one, an addition or subtraction counts one; a negation is free.
* Multiplying by the constants 0, 1 and -1 and adding the constant 0 are free; every other constant is an operand.
* Python's own numbers are constants: operations on constants alone are not counted. 2 a is written a + a.
* Sines and cosines are inputs. An expression that is computed twice counts twice; a recorded program has it once.
* `cost` counts the operations that results depend on, `executed` all operations of a formula.

`dense` replaces zeros and ones by counted numbers, so that every product of full matrices is counted in full.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from contextvars import ContextVar
from typing import Any, NamedTuple


class Cost(NamedTuple):
    """Operations of a formula, and the number of its inputs (79)."""

    multiplications: int
    additions: int
    storage: int


_ledger: ContextVar[Counter[str] | None] = ContextVar("ledger", default=None)


class Counted:
    """A number without a value, known only by the operations that produce it."""

    __slots__ = ("kind", "operands")

    def __init__(self, kind: str = "input", *operands: Any):
        self.kind, self.operands = kind, [x for x in operands if isinstance(x, Counted)]
        ledger = _ledger.get()
        if ledger is not None:
            ledger[kind] += 1

    def __mul__(self, other: Counted | float) -> Counted | float:
        if isinstance(other, int | float) and other in (0, 1, -1):
            return 0.0 if other == 0 else self if other == 1 else -self
        return Counted("multiplication", self, other)

    def __truediv__(self, other: Counted | float) -> Counted | float:
        return self * (1.0 / other) if isinstance(other, int | float) else Counted("multiplication", self, other)

    def __add__(self, other: Counted | float) -> Counted:
        if isinstance(other, int | float) and other == 0:
            return self
        return Counted("addition", self, other)

    def __sub__(self, other: Counted | float) -> Counted:
        return self + (-other)

    def __rsub__(self, other: Counted | float) -> Counted:
        return (-self) + other

    def __neg__(self) -> Counted:
        return Counted("negation", self)

    __rmul__, __radd__ = __mul__, __add__


def cost(results: Any) -> Cost:
    """Cost of results, in tuples or lists of any depth."""
    seen: dict[int, Counted] = {}
    pending = list(_flat(results))
    while pending:
        number = pending.pop()
        if id(number) not in seen:
            seen[id(number)] = number
            pending.extend(number.operands)
    kinds = Counter(number.kind for number in seen.values())
    return Cost(kinds["multiplication"], kinds["addition"], kinds["input"])


def executed(formula: Callable[[], Any]) -> Cost:
    """Cost of all operations that a formula executes, and the number of inputs that it creates."""
    ledger: Counter[str] = Counter()
    token = _ledger.set(ledger)
    try:
        formula()
    finally:
        _ledger.reset(token)
    return Cost(ledger["multiplication"], ledger["addition"], ledger["input"])


def dense(numbers: Any) -> Any:
    """Nested tuples with every number, zeros and ones included, replaced by a counted number."""
    if isinstance(numbers, list | tuple):
        return tuple(dense(x) for x in numbers)
    return numbers if isinstance(numbers, Counted) else Counted()


def _flat(results: Any) -> Iterable[Counted]:
    if isinstance(results, Counted):
        yield results
    elif isinstance(results, list | tuple):
        for x in results:
            yield from _flat(x)
