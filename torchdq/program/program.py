"""A program: arguments, operations and results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

from torchdq.numbers import functions
from torchdq.numbers.functions import maximum
from torchdq.numbers.record import Number, Op, Tape

Value = Any  # a recorded number, or one that is known


class Largest(NamedTuple):
    """What a program's growth of errors may be in single and in double precision."""

    single: float
    double: float


# half of the digits in single precision; all but six bits in double
LARGEST_GROWTH = Largest(2.0**10, 2.0**46)

# operations that are neither arithmetic nor a sine or cosine
FUNCTIONS: Mapping[str, Callable[..., Value]] = {
    "sqrt": functions.sqrt,
    "exp": functions.exp,
    "log": functions.log,
    "floor": functions.floor,
    "max": functions.maximum,
    "min": functions.minimum,
    "ge": functions.at_least,
}


class Argument(NamedTuple):
    """An input of a program: a row of numbers per sample, or one row for all samples."""

    name: str
    width: int
    uniform: bool = False


class Result(NamedTuple):
    """An output of a program: a row of numbers per sample, or the sum of the rows over all samples."""

    name: str
    values: tuple[tuple[int, bool] | float, ...]  # (index, negative), or a constant
    summed: bool = False


class Count(NamedTuple):
    """Operations of a program."""

    multiplications: int
    additions: int
    divisions: int
    sines: int
    roots: int = 0
    exponentials: int = 0
    comparisons: int = 0

    @property
    def total(self) -> int:
        """All operations, a sine, a cosine or another function counting once."""
        return sum(self)


@dataclass(frozen=True, eq=False)
class Program:
    """Straight-line arithmetic on rows of numbers, the same for every sample."""

    name: str
    arguments: tuple[Argument, ...]
    ops: tuple[Op, ...]
    results: tuple[Result, ...]
    growth: tuple[int, bool] | float | None = None  # factor by which it magnifies rounding errors, where it says so

    def count(self) -> Count:
        """Operations per sample; negations are free.

        Subtractions count as additions, cosines as sines, logarithms as exponentials, and the larger or smaller of two
        numbers and the whole part of one as comparisons.
        """
        codes = Counter(op.code for op in self.ops)
        return Count(
            multiplications=codes["mul"],
            additions=codes["add"] + codes["sub"],
            divisions=codes["div"],
            sines=codes["sin"] + codes["cos"],
            roots=codes["sqrt"],
            exponentials=codes["exp"] + codes["log"],
            comparisons=codes["max"] + codes["min"] + codes["ge"] + codes["floor"],
        )

    def __str__(self) -> str:
        sign = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
        shown = [f"{a.name}[{a.width}]{' uniform' if a.uniform else ''}" for a in self.arguments]
        lines = [f"{self.name}({', '.join(shown)})"]
        for i, op in enumerate(self.ops):
            if op.code == "in":
                text = f"{self.arguments[int(op.a)].name}[{op.b}]"
            elif op.code == "const":
                text = repr(op.a)
            elif op.code in sign:
                text = f"x{op.a} {sign[op.code]} x{op.b}"
            else:
                text = " ".join([op.code, *(f"x{k}" for k in operands(op))])
            lines.append(f"  x{i} = {text}")
        for result in self.results:
            row = ", ".join(map(_shown, result.values))
            lines.append(f"  {result.name} = [{row}]{' summed over samples' if result.summed else ''}")
        if self.growth is not None:
            lines.append(f"  growth of errors = {_shown(self.growth)}")
        return "\n".join(lines)


def record(
    name: str,
    arguments: Sequence[Argument],
    algorithm: Callable[..., Mapping[str, Sequence[Value]]],
    summed: Sequence[str] = (),
) -> Program:
    """Program of an algorithm that takes a tuple of numbers per argument and returns named tuples of numbers."""
    tape = Tape()
    inputs = [tuple(tape.input(k, j) for j in range(a.width)) for k, a in enumerate(arguments)]
    return finish(name, arguments, tape, algorithm(*inputs), summed)


def finish(
    name: str,
    arguments: Sequence[Argument],
    tape: Tape,
    results: Mapping[str, Sequence[Value]],
    summed: Sequence[str] = (),
) -> Program:
    """Program of what a tape holds, without the operations that no result needs."""
    growth = reduce(maximum, tape.growths) if tape.growths else 1.0
    wanted = [v.index for values in (*results.values(), [growth]) for v in values if isinstance(v, Number)]
    live, stack = set(wanted), list(wanted)
    while stack:
        for operand in operands(tape.ops[stack.pop()]):
            if operand not in live:
                live.add(operand)
                stack.append(operand)
    renumbered = {old: new for new, old in enumerate(sorted(live))}
    ops = tuple(_renumber(tape.ops[old], renumbered) for old in sorted(live))

    def value(v: Value | None) -> tuple[int, bool] | float:
        return (renumbered[v.index], v.negative) if isinstance(v, Number) else float(v or 0.0)

    return Program(
        name,
        tuple(arguments),
        ops,
        tuple(Result(key, tuple(map(value, values)), key in summed) for key, values in results.items()),
        None if isinstance(growth, float) and growth <= LARGEST_GROWTH.single else value(growth),
    )


def _shown(v: tuple[int, bool] | float) -> str:
    return repr(v) if isinstance(v, float) else f"{'-' if v[1] else ''}x{v[0]}"


def operands(op: Op) -> tuple[int, ...]:
    """Indices of the values an operation reads."""
    if op.code in ("in", "const"):
        return ()
    return (int(op.a),) if op.b < 0 else (int(op.a), op.b)


def _renumber(op: Op, renumbered: dict[int, int]) -> Op:
    if op.code in ("in", "const"):
        return op
    return Op(op.code, renumbered[int(op.a)], renumbered[op.b] if op.b >= 0 else -1)


def replay(program: Program, tape: Tape | None, inputs: Sequence[Sequence[Value]]) -> list[Value]:
    """Every value of a program, run on other numbers; the tape, if there is one, learns how far errors grow."""
    values: list[Value] = []
    for op in program.ops:
        if op.code == "in":
            values.append(inputs[int(op.a)][op.b])
        elif op.code == "const":
            values.append(op.a)
        elif op.code == "sin" or op.code == "cos":
            values.append(getattr(values[int(op.a)], op.code)())
        elif op.code in FUNCTIONS:
            values.append(FUNCTIONS[op.code](*(values[k] for k in operands(op))))
        else:
            a, b = values[int(op.a)], values[op.b]
            values.append(
                a + b if op.code == "add" else a - b if op.code == "sub" else a * b if op.code == "mul" else a / b
            )
    if tape is not None and program.growth is not None:
        tape.growths.append(_picked(program.growth, values))
    return values


def results(program: Program, values: Sequence[Value]) -> dict[str, list[Value]]:
    """Named results of a program from its values."""
    return {result.name: [_picked(v, values) for v in result.values] for result in program.results}


def _picked(v: tuple[int, bool] | float, values: Sequence[Value]) -> Value:
    if isinstance(v, float):
        return v
    return -values[v[0]] if v[1] else values[v[0]]
