"""Printer of the operations of a program, one for all languages.

A dialect is data: the words of a language for numbers, functions, sine and cosine. One walk over the operations prints
them in any dialect, from the rows of `numbers.ops`. An operation without sign or expression there is a function of
math.h of its own name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

from torchdq.numbers.ops import OPS
from torchdq.program.order import TOGETHER, pairs
from torchdq.program.program import Output, Program


def functions() -> list[str]:
    """Operations that are functions of math.h."""
    return [code for code, row in OPS.items() if not (row.infix or row.c)]


class Dialect(NamedTuple):
    """Language in which operations are printed: its words for them."""

    number: str  # type of a number
    finite: Callable[[float], str]  # exact constant
    nan: str
    infinite: str
    call: Callable[[str], str]  # name of the function of an operation
    turn: str = ""  # statements for the {sin} and {cos} of an {angle}; "": a call for each of them
    spread: str = ""  # vector of equal numbers {0}; "": there are no vectors, and comparisons are expressions

    def literal(self, x: float) -> str:
        """Exact constant, which may be infinite or NaN."""
        if x != x:
            return self.nan
        if abs(x) == float("inf"):
            return f"({'-' * (x < 0)}{self.infinite})"
        return self.finite(float(x))

    def applied(self, code: str, operands: Sequence[str]) -> str:
        """Expression for an operation."""
        row = OPS[code]
        if row.infix:
            return f" {row.infix} ".join(operands)
        return row.c.format(*operands) if row.c and not self.spread else f"{self.call(code)}({', '.join(operands)})"


class Emitter:
    """Text of the values of a program: constants, elements of an array u for `shared` values, and variables."""

    def __init__(
        self, program: Program, dialect: Dialect, read: Callable[[int, int], str], shared: Sequence[bool] = ()
    ):
        self.program, self.dialect = program, dialect
        self.read = read  # expression for a number of an argument
        self.shared, self.pairs = shared, pairs(program) if dialect.turn else {}

    def name(self, i: int) -> str:
        """Expression for a value that has been computed."""
        op = self.program.ops[i]
        if op.code == "const":
            return self.dialect.literal(op.payload)
        return f"u[{i}]" if self.shared and self.shared[i] else f"x{i}"

    def spread(self, i: int, text: str) -> str:
        """Text of a value, as a vector if the dialect has vectors and the value is the same in all lanes."""
        return self.dialect.spread.format(text) if self.dialect.spread and self.shared[i] else text

    def output(self, v: Output) -> str:
        """Expression for a number of a result; a difference, so that the negative of zero is no -0."""
        if isinstance(v, float):
            text = self.dialect.literal(v)
            return self.dialect.spread.format(text) if self.dialect.spread else text
        index, negative = v
        return self.spread(index, f"{self.dialect.literal(0.0)} - {self.name(index)}" if negative else self.name(index))

    def statements(self, values: Iterable[int]) -> list[str]:
        """Statements for values, each after its operands; one call computes sine and cosine of the same angle."""
        lines, done = list[str](), set[int]()
        for i in values:
            code, operands, payload = self.program.ops[i]
            if code == "const" or i in done:
                continue
            if code in TOGETHER and self.dialect.turn:
                names = {self.program.ops[k].code: f"x{k}" for k in self.pairs[i]}
                words = {name: names.get(name, f"x{i}_") for name in TOGETHER}
                lines.append(self.dialect.turn.format(angle=self.name(operands[0]), **words))
                done.update(self.pairs[i])
                continue
            if code == "in":
                value = self.read(*payload)
            elif OPS[code].infix:
                value = self.dialect.applied(code, [self.name(k) for k in operands])
            else:
                value = self.dialect.applied(code, [self.spread(k, self.name(k)) for k in operands])
            defined = "" if self.shared and self.shared[i] else f"const {self.dialect.number} "
            lines.append(f"{defined}{self.name(i)} = {value};")
        return lines
