"""C99 text of a program behind CasADi's interface for external functions, with its Jacobian.

CasADi asks a library for NAME, for NAME_n_in, NAME_sparsity_in and so on beside it, and for jac_NAME with the same
beside it, the Jacobians of every result in every argument. A missing argument stands for zeros, a missing result is
not wanted. Numbers are stored column by column; of a Jacobian, only those that are not zero for every argument.

Source: CasADi's user guide, "Calling CasADi functions from other software" and "external"; checked with CasADi 3.8.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from torchdq.errors import ArgumentError
from torchdq.export import c99, names
from torchdq.export.c99 import Library
from torchdq.export.files import Exported
from torchdq.export.meaning import described
from torchdq.program.autodiff import jacobian
from torchdq.program.program import Program, Result, outputs


class Stored(NamedTuple):
    """Argument or result of a function in CasADi."""

    name: str
    rows: int
    columns: int
    stored: tuple[int, ...]  # places that are stored, counted down one column after the other

    def sparsity(self) -> tuple[int, ...]:
        """CasADi's code of the stored places: size, where the columns begin, rows; or the size and 1 for all places."""
        if len(self.stored) == self.rows * self.columns:
            return self.rows, self.columns, 1
        begins = [bisect_left(self.stored, k * self.rows) for k in range(self.columns + 1)]
        return self.rows, self.columns, *begins, *(place % self.rows for place in self.stored)


class Interface(NamedTuple):
    """Function in CasADi: a program, and how its arguments and results are stored."""

    name: str
    program: Program  # its results hold the stored numbers
    inputs: tuple[Stored, ...]  # those beyond the arguments of the program are not read
    outputs: tuple[Stored, ...]

    def text(self, library: Library) -> str:
        """Functions in C that CasADi asks for."""
        name, number = self.name, "const long long"
        largest = max(len(r.values) for r in outputs(self.program))
        return (
            f"static {c99.function(self.program, f'{name}_numbers', False, library)}\n"
            f"int {name}(const double **arg, double **res, long long *iw, double *w, int mem)\n{{\n"
            f"    (void)iw;\n    (void)mem;\n    return {name}_numbers({self._passed()});\n}}\n\n"
            f"int {name}_work(long long *arg, long long *res, long long *iw, long long *w)\n{{\n"
            f"    if (arg) *arg = {len(self.inputs)};\n    if (res) *res = {len(self.outputs)};\n"
            f"    if (iw) *iw = 0;\n    if (w) *w = {largest};\n    return 0;\n}}\n"
            + "".join(
                f"\nlong long {name}_n_{way}(void)\n{{\n    return {len(matrices)};\n}}\n\n"
                f"const char *{name}_name_{way}(long long i)\n{{\n"
                f"    static const char *const names[] = {{{_quoted(matrices)}}};\n"
                f"    return 0 <= i && i < {len(matrices)} ? names[i] : 0;\n}}\n\n"
                f"{number} *{name}_sparsity_{way}(long long i)\n{{\n{_patterns(matrices)}"
                f"    static {number} *const patterns[] = {{{', '.join(f's{k}' for k in range(len(matrices)))}}};\n"
                f"    return 0 <= i && i < {len(matrices)} ? patterns[i] : 0;\n}}\n"
                for way, matrices in (("in", self.inputs), ("out", self.outputs))
            )
        )

    def _passed(self) -> str:
        """Arguments of the function of the program; what is not wanted goes to the work array."""
        taken, _ = c99.arrays(self.program)
        passed = [f"arg[{k}] ? arg[{k}] : zeros" for k in range(len(taken))]
        passed += [f"res[{k}] ? res[{k}] : w" for k, matrix in enumerate(self.outputs) if matrix.stored]
        return ", ".join([*passed, *(["w"] if self.program.growth else [])])


class CasadiExport(NamedTuple):
    """A program as it is exported to CasADi, in double precision."""

    program: Program
    axes: tuple[tuple[int, ...], ...]  # trailing axes of its results
    name: str  # name of its function
    functions: Library  # where sine, cosine and roots come from
    about: tuple[str, ...]  # lines about the robot

    def source(self) -> str:
        """Source file in C99."""
        values = self.values()
        derivatives = self.derivatives(values)
        taken, given = values.inputs, values.outputs
        names = [a.name for a in self.program.arguments if a.width], [r.name for r in self.program.results if r.values]
        lines = described([f"{m.name}[{m.rows}]" for m in taken], names[0], "in ")
        lines += described([f"{m.name}[{m.rows}, {m.columns}]" for m in given], names[1], "out")
        about = [
            *self.about,
            "",
            *(line.replace(", row by row", "") for line in lines),
            "",
            f"    cc -shared -fPIC -O2 {self.name}.c -o {self.name}.so -lm",
            f'    f = casadi.external("{self.name}", "./{self.name}.so")',
            "",
            f"jac_{self.name} is its Jacobian, which CasADi finds by itself. No heap, no state: threads may share it.",
        ]
        causes = ["rounding errors are too large"] if self.program.growth else []
        causes += ["an angle is NaN or beyond 1e5 rad"] if c99.angles(values.program, self.functions) else []
        if causes:
            about.append(f"Fails where {' or '.join(causes)}: a call raises, a solver takes a shorter step.")
        widest = max(m.rows for m in taken)
        # both have the same preamble, or one has none
        before = max([c99.preamble(f.program, False, self.functions) for f in (values, derivatives)], key=len)
        parts = [before, f"static const double zeros[{widest}] = {{0}};\n"]
        parts += [f.text(self.functions) for f in (values, derivatives)]
        return c99.comment(about) + "\n".join(part for part in parts if part)

    def values(self) -> Interface:
        """Function with dense results, those with two axes as matrices."""
        wide = [(r, axes) for r, axes in zip(self.program.results, self.axes, strict=True) if r.values]
        shapes = [axes if len(axes) == 2 else (len(r.values), 1) for r, axes in wide]
        results = [_by_columns(r, *shape) for (r, _), shape in zip(wide, shapes, strict=True)]
        program = replace(self.program, results=tuple(results))
        taken, given = c99.arrays(program)
        inputs = tuple(_dense(a.name, a.size, 1) for a in taken)
        found = tuple(_dense(a.name, *shape) for a, shape in zip(given, shapes, strict=False))  # without the growth
        return Interface(self.name, program, inputs, found)

    def derivatives(self, values: Interface) -> Interface:
        """Jacobians of the numbers of every result in every argument; results beyond the arguments are not read."""
        wrt = [k for k, a in enumerate(values.program.arguments) if a.width]
        derived = jacobian(values.program, wrt)
        matrices, results = [], []
        for i, result in enumerate(values.outputs):
            for j, argument in enumerate(values.inputs):
                rows, columns = len(result.stored), argument.rows
                whole = _by_columns(derived.results[j * len(values.outputs) + i], rows, columns)
                kept = [k for k, v in enumerate(whole.values) if v != 0.0]
                matrices.append(Stored(f"jac_{result.name}_{argument.name}", rows, columns, tuple(kept)))
                results.append(whole._replace(values=tuple(whole.values[k] for k in kept)))
        unread = [Stored(f"out_{m.name}", m.rows, m.columns, ()) for m in values.outputs]
        program = replace(derived, results=tuple(results))
        return Interface(f"jac_{values.name}", program, (*values.inputs, *unread), tuple(matrices))

    def write(self, folder: Path) -> Exported:
        """File in a folder, which is made if it is not there."""
        folder.mkdir(parents=True, exist_ok=True)
        source = folder / f"{self.name}.c"
        source.write_text(self.source(), encoding="ascii")
        return Exported(self.name, source)


def identifier(name: str) -> str:
    """Name that CasADi accepts for a function; raises if it is none."""
    if "__" in names.identifier(name, "name") or not re.match("[A-Za-z]", name) or name in ("null", "jac", "hess"):
        raise ArgumentError(
            f"name must be one that CasADi accepts, found {name!r}: a letter first, no two underscores in a row, and "
            "none of null, jac and hess"
        )
    return name


def _dense(name: str, rows: int, columns: int) -> Stored:
    return Stored(name, rows, columns, tuple(range(rows * columns)))


def _by_columns(result: Result, rows: int, columns: int) -> Result:
    """Result that is a matrix, row by row, in the order of its columns."""
    return result._replace(values=tuple(result.values[i * columns + j] for j in range(columns) for i in range(rows)))


def _quoted(matrices: Sequence[Stored]) -> str:
    return ", ".join(f'"{m.name}"' for m in matrices)


def _patterns(matrices: Sequence[Stored]) -> str:
    codes = [", ".join(map(str, matrix.sparsity())) for matrix in matrices]
    return "".join(f"    static const long long s{k}[] = {{{code}}};\n" for k, code in enumerate(codes))
