"""A program: arguments, operations and results."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

from torchdq.base.progress import Progress
from torchdq.errors import NumberError
from torchdq.numbers.functions import maximum
from torchdq.numbers.ops import OPS, Count, apply
from torchdq.numbers.record import FUNCTIONS, Op, Recorded, Tape

Value = Any  # a recorded number or a constant


class Largest(NamedTuple):
    """Largest accepted error growth in single and in double precision."""

    single: float
    double: float


# half of the digits are left in single precision, six bits in double
LARGEST_GROWTH = Largest(2.0**10, 2.0**46)
GROWTH = "growth of errors"  # name of the growths among the rows of an algorithm


class Argument(NamedTuple):
    """Input of a program: a row of numbers per sample, or one row for all samples."""

    name: str
    width: int
    uniform: bool = False


Output = tuple[int, bool] | float  # index of a value and whether it is negated; or a constant


class Result(NamedTuple):
    """Output of a program: a row of numbers per sample, or the sum of the rows over all samples."""

    name: str
    values: tuple[Output, ...]
    summed: bool = False


@dataclass(frozen=True, eq=False)
class Program:
    """Straight-line arithmetic on rows of numbers, without branches: every sample takes the same operations."""

    name: str
    arguments: tuple[Argument, ...]
    ops: tuple[Op, ...]
    results: tuple[Result, ...]
    growth: Result | None = None  # factor by which rounding errors are magnified; None: always below the limits
    about: tuple[str, ...] = ()  # lines for a reader of exported files

    def count(self) -> Count:
        """Operations per sample; negations are free.

        Subtractions count as additions, cosines as sines, logarithms as exponentials; maximum, minimum, selection and
        floor count as comparisons.
        """
        return Count(**Counter(OPS[op.code].cost for op in self.ops if op.code in OPS))

    def heading(self) -> str:
        """Name and arguments with their widths, as in "f(x[2], m[1] uniform)"."""
        shown = [f"{a.name}[{a.width}]{' uniform' if a.uniform else ''}" for a in self.arguments]
        return f"{self.name}({', '.join(shown)})"

    def __str__(self) -> str:
        lines = [self.heading()]
        for i, op in enumerate(self.ops):
            if op.code == "in":
                argument, component = op.payload
                text = f"{self.arguments[argument].name}[{component}]"
            elif op.code == "const":
                text = repr(op.payload)
            else:
                sign, names = OPS[op.code].infix, [f"x{k}" for k in op.operands]
                text = f" {sign} ".join(names) if sign else " ".join([op.code, *names])
            lines.append(f"  x{i} = {text}")
        for result in outputs(self):
            row = ", ".join(map(_shown, result.values))
            lines.append(f"  {result.name} = [{row}]{' summed over samples' if result.summed else ''}")
        return "\n".join(lines)


# functions, not methods: torch.compile can read the fields of a constant program, but cannot call its methods


def outputs(program: Any) -> tuple[Result, ...]:
    """All outputs of a program, or a chain of programs: the results, and the error growth if there is one."""
    return program.results if program.growth is None else (*program.results, program.growth)


def samples_of(program: Program, inputs: Sequence[Any]) -> int:
    """Number of samples in the tensors for a program's arguments."""
    for x, argument in zip(inputs, program.arguments, strict=True):
        if not argument.uniform:
            return x.shape[0]
    return 1


def record(
    name: str,
    arguments: Sequence[Argument],
    algorithm: Callable[..., Mapping[str, Sequence[Value]]],
    summed: Sequence[str] = (),
) -> Program:
    """Program of an algorithm that takes a tuple of numbers per argument and returns named tuples of numbers.

    Numbers named `GROWTH` are not results, but factors by which rounding errors of the results are magnified.
    """
    with recording(name) as tape:
        try:
            found = dict(algorithm(*inputs(tape, arguments)))
        except TypeError as error:
            if Recorded.__name__ not in str(error) or isinstance(error, NumberError):
                raise
            raise NumberError(f"a recorded number is not accepted by this function: {error}; {FUNCTIONS}") from error
        factors = found.pop(GROWTH, ())
        return with_half_angles(finish(name, arguments, tape, found, summed, factors))


@contextmanager
def recording(name: str) -> Iterator[Tape]:
    """Tape for a program; what takes long is announced, with the number of operations so far."""
    tape = Tape()
    with Progress(f"recording {name}") as notice:
        notice.at(lambda: f"{len(tape.ops)} operations")
        yield tape


def with_half_angles(program: Program) -> Program:
    """Program in which an angle and its half have one sine and one cosine; the program itself if none do.

    Poses as dual quaternions take those of half of a joint's angle, everything else those of the angle, which follow:

        sin x = 2 sin(x/2) cos(x/2),   cos x = 1 - 2 sin(x/2)^2
    """
    ops = program.ops
    angles = {op.operands[0] for op in ops if op.code in ("sin", "cos")}
    half_of = {
        whole: i
        for i in angles
        if ops[i].code == "mul"
        for whole, factor in (ops[i].operands, ops[i].operands[::-1])
        if whole in angles and ops[factor].code == "const" and ops[factor].payload == 0.5
    }
    if not half_of:
        return program

    def from_half(op: Op, *x: Value) -> Value:
        if op.code not in ("sin", "cos") or op.operands[0] not in half_of:
            return apply(op.code, *x)
        half = 0.5 * x[0]
        s, c = apply("sin", half), apply("cos", half)
        return (s + s) * c if op.code == "sin" else 1.0 - (s + s) * s

    with recording(program.name) as tape:
        values = replay(program, inputs(tape, program.arguments), from_half)
        summed = [r.name for r in program.results if r.summed]
        return finish(program.name, program.arguments, tape, results(program, values), summed, growths(program, values))


def finish(
    name: str,
    arguments: Sequence[Argument],
    tape: Tape,
    results: Mapping[str, Sequence[Value]],
    summed: Sequence[str] = (),
    growths: Sequence[Value] = (),
) -> Program:
    """Program from the operations on a tape, without those that no result depends on.

    `growths` are factors by which rounding errors in the results are magnified.
    """
    growth = reduce(maximum, growths or [1.0])
    wanted = [v.index for values in (*results.values(), [growth]) for v in values if isinstance(v, Recorded)]
    live, stack = set(wanted), list(wanted)
    while stack:
        for operand in tape.ops[stack.pop()].operands:
            if operand not in live:
                live.add(operand)
                stack.append(operand)
    renumbered = {old: new for new, old in enumerate(sorted(live))}

    def moved(op: Op) -> Op:
        return op._replace(operands=tuple([renumbered[k] for k in op.operands]))

    def value(v: Value | None) -> Output:
        return (renumbered[v.index], v.negative) if isinstance(v, Recorded) else float(v or 0.0)

    return Program(
        name,
        tuple(arguments),
        tuple(moved(tape.ops[old]) for old in sorted(live)),
        tuple(Result(key, tuple(map(value, values)), key in summed) for key, values in results.items()),
        None if isinstance(growth, float) and growth <= LARGEST_GROWTH.single else Result("growth", (value(growth),)),
    )


def _shown(v: Output) -> str:
    return repr(v) if isinstance(v, float) else f"{'-' if v[1] else ''}x{v[0]}"


def inputs(tape: Tape, arguments: Sequence[Argument]) -> list[tuple[Recorded, ...]]:
    """Row of recorded numbers for every argument."""
    return [tuple(tape.input(k, j) for j in range(a.width)) for k, a in enumerate(arguments)]


def replay(
    program: Program,
    rows: Sequence[Sequence[Value]],
    operation: Callable[..., Value] = lambda op, *x: apply(op.code, *x),
) -> list[Value]:
    """Values of all operations of a program, evaluated on other numbers; `operation(op, *operands)` is one value."""
    values: list[Value] = []
    for op in program.ops:
        if op.code == "in":
            argument, component = op.payload
            values.append(rows[argument][component])
        elif op.code == "const":
            values.append(op.payload)
        else:
            values.append(operation(op, *[values[k] for k in op.operands]))
    return values


def results(program: Program, values: Sequence[Value]) -> dict[str, list[Value]]:
    """Named results of a program from its values."""
    return {result.name: picked(result, values) for result in program.results}


def picked(result: Result, values: Sequence[Value]) -> list[Value]:
    """Numbers of a result from the values of its program."""
    return [v if isinstance(v, float) else -values[v[0]] if v[1] else values[v[0]] for v in result.values]


def growths(program: Program, values: Sequence[Value]) -> list[Value]:
    """Factors by which a program magnifies rounding errors, from its values; empty if it has no such output."""
    return [] if program.growth is None else picked(program.growth, values)
