"""C source of a program: one sample per lane of the compiler's vector type; rows [batch, n] are read and written."""

from collections.abc import Iterable, Sequence

from torchdq.numbers.ops import OPS, Operation
from torchdq.program.order import TOGETHER
from torchdq.program.program import Output, Program, outputs
from torchdq.program.schedule import Part, schedule

LONGEST = 1500  # operations of a C function; compile time grows faster than its length
PIECE = "%PIECES==PIECE"  # condition of a function that one of several processes compiles


def pieces_of(source: str) -> int:
    """Number of pieces that a source can be compiled in: it is one file, of which -DPIECES=n -DPIECE=k is piece k."""
    return max(1, source.count(PIECE))


def _literal(x: float) -> str:
    """Exact C literal of a constant."""
    if x != x:
        return '(S)__builtin_nan("")'
    if abs(x) == float("inf"):
        return "(S)__builtin_inf()" if x > 0 else "(S)-__builtin_inf()"
    return f"(S){float(x).hex()}"


def _applied(row: Operation, function: str, operands: Iterable[str]) -> str:
    """Expression for an operation."""
    return row.infix.join(operands) if row.infix else function.format(*operands)


class Printer:
    """Text of the values of a program, and of the program."""

    def __init__(self, program: Program, single: bool, first: int = 0):
        self.program, self.single, self.first = program, single, first  # the number of the first part
        self.schedule = schedule(program, LONGEST)
        self.home = {i: part for part in self.schedule.parts for i in part.values}

    # --- values ---

    def name(self, i: int) -> str:
        """Expression for a value that has been computed."""
        op = self.program.ops[i]
        if op.code == "const":
            return f"({_literal(op.payload)})"
        return f"u[{i}]" if self.schedule.uniform[i] else f"x{i}"

    def vector(self, i: int) -> str:
        """Vector expression for a value that has been computed; a uniform value is the same in all lanes."""
        return f"(T){{}}+({self.name(i)})" if self.schedule.uniform[i] else self.name(i)

    def output(self, v: Output) -> str:
        """Expression for a number of a result."""
        if isinstance(v, float):
            return f"(T){{}}+{_literal(v)}"
        index, negative = v
        # a difference, so that the negative of zero is no -0
        return f"(T){{}}-({self.vector(index)})" if negative else self.vector(index)

    # --- statements ---

    def prelude(self) -> list[str]:
        """Statements for the values that are the same for all samples."""
        lines, copied = list[str](), 0  # numbers that the last statement copies
        for i in self.schedule.prelude:
            op = self.program.ops[i]
            if op.code != "in":
                right = _applied(OPS[op.code], OPS[op.code].c_single, map(self.name, op.operands))
                lines.append(f"u[{i}]={right};")
                copied = 0
                continue
            k, j = op.payload
            follows = copied and self.program.ops[i - 1] == op._replace(payload=(k, j - 1))
            copied = copied + 1 if follows else 1
            i, j = i - copied + 1, j - copied + 1
            lines = lines[: len(lines) - bool(follows)]
            lines.append(f"for(int j=0;j<{copied};j++)u[{i}+j]=in{k}[{j}+j];" if follows else f"u[{i}]=in{k}[{j}];")
        return [f"S u[{len(self.program.ops)}];", *lines] if lines else []

    def statements(self, part: Part) -> list[str]:
        """Statements on vectors; one call, at the first of the two, computes sine and cosine of the same angle."""
        lines = []
        for i in part.values:
            op = self.program.ops[i]
            if op.code == "in":
                lines.append("const T x{}=I{}[{}];".format(i, *op.payload))
            elif op.code in TOGETHER:
                pair = self.schedule.pairs[i]
                if i == pair[0]:
                    names = {self.program.ops[k].code: f"x{k}" for k in pair}
                    sine, cosine = names.get("sin", f"unused{i}"), names.get("cos", f"unused{i}")
                    lines.append(f"T {sine},{cosine};sincos_({self.name(op.operands[0])},&{sine},&{cosine});")
            else:
                row = OPS[op.code]
                operands = map(self.name if row.infix else self.vector, op.operands)
                lines.append(f"const T x{i}={_applied(row, row.c, operands)};")
        return lines

    def results(self, part: Part | None) -> list[str]:
        """Statements that write the results among a part's values; None: those that are the same for all samples."""
        return [
            f"O{k}[{j}]={self.output(v)};"
            for k, result in enumerate(outputs(self.program))
            for j, v in enumerate(result.values)
            if (None if isinstance(v, float) else self.home.get(v[0])) is part
        ]

    def body(self, rows: Sequence[tuple[int, int]]) -> tuple[list[str], list[str]]:
        """Functions, and the statements of the loop over samples that compute the results.

        A long program is functions of bounded length that pass their values in an array.
        """
        parts = self.schedule.parts
        if len(parts) == 1:
            return [], [*self.statements(parts[0]), *self.results(parts[0]), *self.results(None)]
        arrays = [*(f"I{k}" for k, _ in rows), *(f"O{k}" for k in range(len(outputs(self.program))))]
        parameters = ",".join(["T*v", "const S*u", *(f"{'const ' * (x[0] == 'I')}T*{x}" for x in arrays)])
        arguments = ",".join(["v", "u" if self.schedule.prelude else "0", *arrays])
        functions = ["#ifndef PIECES", "#define PIECES 1", "#define PIECE 0", "#endif"]
        functions += [
            f'__attribute__((noinline,visibility("hidden"))) void part{self.first + k}({parameters});'
            for k in range(len(parts))
        ]
        calls = [f"T v[{max(self.schedule.slots, 1)}];"]
        for k, part in enumerate(parts, self.first):
            functions += [f"#if {k}{PIECE}", f"void part{k}({parameters}){{"]
            functions += [f"const T x{i}=v[{slot}];" for i, slot in part.loaded]
            functions += [*self.statements(part), *self.results(part)]
            functions += [f"v[{slot}]=x{i};" for i, slot in part.stored]
            functions += ["}", "#endif"]
            calls.append(f"part{k}({arguments});")
        return functions, [*calls, *self.results(None)]
