"""C source of a program: one sample per lane of the compiler's vector type; rows [batch, n] are read and written."""

from collections.abc import Sequence

from torchdq.backends import c_prelude
from torchdq.backends.emitter import Emitter
from torchdq.program.program import Program, outputs
from torchdq.program.schedule import Part, schedule

LONGEST = 1500  # operations of a C function; compile time grows faster than its length
PIECE = "%PIECES==PIECE"  # condition of a function that one of several processes compiles


def pieces_of(source: str) -> int:
    """Number of pieces that a source can be compiled in: it is one file, of which -DPIECES=n -DPIECE=k is piece k."""
    return max(1, source.count(PIECE))


class Printer:
    """Text of the values of a program, and of the program."""

    def __init__(self, program: Program, single: bool, first: int = 0):
        self.program, self.single, self.first = program, single, first  # the number of the first part
        self.schedule = schedule(program, LONGEST)
        self.home = {i: part for part in self.schedule.parts for i in part.values}
        uniform = self.schedule.uniform
        self.vectors = Emitter(program, c_prelude.VECTORS, lambda k, j: f"I{k}[{j}]", uniform)
        self.shared = Emitter(program, c_prelude.SINGLE, lambda k, j: f"in{k}[{j}]", uniform)

    # --- statements ---

    def prelude(self) -> list[str]:
        """Statements for the values that are the same for all samples."""
        ops, lines, copied = self.program.ops, list[str](), 0  # numbers that the last statement copies
        for i in self.schedule.prelude:
            k, j = ops[i].payload or (0, 0)
            follows = copied and ops[i - 1] == ops[i]._replace(payload=(k, j - 1))
            copied = copied + 1 if follows else int(ops[i].code == "in")
            if follows:
                lines[-1] = f"for(int j=0;j<{copied};j++)u[{i - copied + 1}+j]=in{k}[{j - copied + 1}+j];"
            else:
                lines += self.shared.statements([i])
        return [f"S u[{len(ops)}];", *lines] if lines else []

    def statements(self, part: Part) -> list[str]:
        """Statements on vectors."""
        return self.vectors.statements(part.values)

    def results(self, part: Part | None) -> list[str]:
        """Statements that write the results among a part's values; None: those that are the same for all samples."""
        return [
            f"O{k}[{j}]={self.vectors.output(v)};"
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
