"""C99 text of a program behind CasADi's interface for external functions, with first and second derivatives.

CasADi asks a library for NAME, for NAME_n_in, NAME_sparsity_in and so on, and for derivatives in the same
way: jac_NAME, the Jacobians of every result in every argument; adj1_NAME, the gradient of the results weighted with
seeds; and jac_adj1_NAME, its Jacobians, which are the second derivatives that Ipopt takes. A missing argument stands
for zeros, a missing result is not wanted. Numbers are stored column by column; of a Jacobian, only those that are not
zero for every argument.

Several knots are the columns of every matrix, as of `map` in CasADi; matrices stand side by side, and Jacobians have a
block for every knot.

Source: CasADi's user guide, "Calling CasADi functions from other software" and "external", and its file
`function_internal.cpp`; checked with CasADi 3.8.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from torchdq.errors import ArgumentError
from torchdq.export import batch, c99, names, parts
from torchdq.export.c99 import CFunction, Library
from torchdq.export.files import Exported, write
from torchdq.export.meaning import described
from torchdq.program.autodiff import jacobian, vjp, vjp_jacobian
from torchdq.program.autograd import per_sample
from torchdq.program.program import Program, Result, outputs


class Stored(NamedTuple):
    """Argument or result of a function in CasADi."""

    name: str
    rows: int
    columns: int
    stored: tuple[int, ...]  # places that are stored, counted down one column after the other

    def side_by_side(self, knots: int) -> Stored:
        """Matrices of several knots side by side."""
        size = self.rows * self.columns
        stored = tuple(k * size + place for k in range(knots) for place in self.stored)
        return self._replace(columns=self.columns * knots, stored=stored)

    def on_a_diagonal(self, knots: int) -> Stored:
        """Matrices of several knots on the diagonal of one."""
        rows, columns = self.rows * knots, self.columns * knots
        places = [divmod(place, self.rows) for place in self.stored]
        stored = tuple((k * self.columns + j) * rows + k * self.rows + i for k in range(knots) for j, i in places)
        return Stored(self.name, rows, columns, stored)

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
    inputs: tuple[Stored, ...]  # those without stored places are not arguments of the program
    outputs: tuple[Stored, ...]
    diagonal: bool = False  # whether the results of several knots are blocks on a diagonal

    def of_knots(self, knots: int) -> tuple[tuple[Stored, ...], tuple[Stored, ...]]:
        """Arguments and results of several knots."""
        found = [m.on_a_diagonal(knots) if self.diagonal else m.side_by_side(knots) for m in self.outputs]
        return tuple(m.side_by_side(knots) for m in self.inputs), tuple(found)

    def text(self, library: Library, knots: int, patterns: Mapping[tuple[int, ...], str]) -> str:
        """Functions in C that CasADi asks for.

        Args:
            library: source of sine, cosine and roots.
            knots: number of knots; 0: one, with sine and cosine of the library.
            patterns: names of the arrays of the codes of stored places.
        """
        name = self.name
        inputs, results = self.of_knots(max(knots, 1))
        function = CFunction(self.program, f"{name}_numbers", False, library)
        numbers = batch.text(function, "static ", finite=False) if knots else parts.text(function)
        called = f"{name}_numbers_batch({knots}, " if knots else f"{name}_numbers("
        room = max(knots, 1) * (max(len(r.values) for r in outputs(self.program)) + 1)
        return (
            f"{numbers}\n"
            f"int {name}(const double **arg, double **res, long long *iw, double *w, int mem)\n{{\n"
            f"    (void)iw;\n    (void)mem;\n    return {called}{self._passed(max(knots, 1))});\n}}\n\n"
            f"int {name}_work(long long *arg, long long *res, long long *iw, long long *w)\n{{\n"
            f"    if (arg) *arg = {len(inputs)};\n    if (res) *res = {len(results)};\n"
            f"    if (iw) *iw = 0;\n    if (w) *w = {room};\n    return 0;\n}}\n"
            + "".join(
                f"\nlong long {name}_n_{way}(void)\n{{\n    return {len(matrices)};\n}}\n\n"
                f"const char *{name}_name_{way}(long long i)\n{{\n"
                f"    static const char *const names[] = {{{quoted}}};\n"
                f"    return 0 <= i && i < {len(matrices)} ? names[i] : 0;\n}}\n\n"
                f"const long long *{name}_sparsity_{way}(long long i)\n{{\n"
                f"    static const long long *const patterns[] = {{{listed}}};\n"
                f"    return 0 <= i && i < {len(matrices)} ? patterns[i] : 0;\n}}\n"
                for way, matrices in (("in", inputs), ("out", results))
                for listed in [", ".join(patterns[m.sparsity()] for m in matrices)]
                for quoted in [", ".join(f'"{m.name}"' for m in matrices)]
            )
        )

    def _passed(self, knots: int) -> str:
        """Arguments of the function of the program; what is not wanted goes to the work array, the growth behind it."""
        passed = [f"arg[{k}] ? arg[{k}] : zeros" for k, matrix in enumerate(self.inputs) if matrix.stored]
        passed += [f"res[{k}] ? res[{k}] : w" for k, matrix in enumerate(self.outputs) if matrix.stored]
        widest = max(len(r.values) for r in outputs(self.program))
        return ", ".join([*passed, *([f"w + {knots * widest}"] if self.program.growth else [])])


class CasadiExport(NamedTuple):
    """A program as it is exported to CasADi, in double precision."""

    program: Program
    axes: tuple[tuple[int, ...], ...]  # trailing axes of its results
    name: str  # name of its function
    functions: Library  # where sine, cosine and roots come from
    about: tuple[str, ...]  # lines about the robot
    knots: int = 0  # number of knots of every call; 0: one, with sine and cosine of the library
    second: bool = True  # whether there are second derivatives

    def source(self) -> str:
        """Source file in C99."""
        values = self.values()
        functions = [values, self.derivatives(values)]
        if self.second:
            gradient = self.gradient(values)
            functions += [gradient, self.second_derivatives(values, gradient)]
        matrices = [m for f in functions for side in f.of_knots(max(self.knots, 1)) for m in side]
        patterns = {code: f"pattern{k}" for k, code in enumerate(dict.fromkeys(m.sparsity() for m in matrices))}
        widest = max(m.rows for m in values.inputs) * max(self.knots, 1)
        # all have the same preamble, or some have none
        before = [CFunction(f.program, f.name, False, self.functions, self.knots > 0).preamble() for f in functions]
        pieces = [
            "#include <stddef.h>\n" if self.knots else "",
            max(before, key=len),
            batch.copies([f.program for f in functions], False) if self.knots else "",
            f"static const double zeros[{widest}] = {{0}};\n",
            "".join(
                f"static const long long {name}[] = {{{', '.join(map(str, code))}}};\n"
                for code, name in patterns.items()
            ),
            *(f.text(self.functions, self.knots, patterns) for f in functions),
        ]
        return c99.comment(self._comment(values)) + "\n".join(piece for piece in pieces if piece)

    def _comment(self, values: Interface) -> list[str]:
        """Lines about arguments, results, building and failures."""
        names = [a.name for a in self.program.arguments if a.width], [r.name for r in self.program.results if r.values]
        taken, given = values.of_knots(max(self.knots, 1))
        several = self.knots > 0
        shown = [f"{m.name}[{m.rows}{f', {m.columns}' if several else ''}]" for m in taken]
        lines = described(shown, names[0], "in ")
        lines += described([f"{m.name}[{m.rows}, {m.columns}]" for m in given], names[1], "out")
        flags = "-O2 -ftree-vectorize -march=native -fno-math-errno" if several else "-O2"
        derived = f"jac_{self.name} has its Jacobians" + (
            f", adj1_{self.name} and jac_adj1_{self.name} its second derivatives" if self.second else ""
        )
        about = [
            *self.about,
            "",
            *(line.replace(", row by row", "") for line in lines),
            *([f"One column for each of {self.knots} knots, matrices side by side."] if several else []),
            "",
            f"    cc -shared -fPIC {flags} {self.name}.c -o {self.name}.so -lm",
            f'    f = casadi.external("{self.name}", "./{self.name}.so")',
            "",
            f"{derived}; CasADi finds them by itself. No heap, no state: threads may share it.",
        ]
        causes = ["rounding errors are too large"] if self.program.growth else []
        function = CFunction(values.program, self.name, False, self.functions, several)
        causes += ["an angle is NaN or beyond 1e5 rad"] if function.angles() else []
        if causes:
            where = " at any knot" if several else ""
            about.append(f"Fails where {' or '.join(causes)}{where}: a call raises, a solver takes a shorter step.")
        return about

    def values(self) -> Interface:
        """Function with dense results, those with two axes as matrices."""
        wide = [(r, axes) for r, axes in zip(self.program.results, self.axes, strict=True) if r.values]
        shapes = [axes if len(axes) == 2 else (len(r.values), 1) for r, axes in wide]
        results = [_by_columns(r, *shape) for (r, _), shape in zip(wide, shapes, strict=True)]
        program = per_sample(replace(self.program, results=tuple(results)))
        taken, given = c99.arrays(program)
        inputs = tuple(_dense(a.name, a.size, 1) for a in taken.values())
        found = tuple(_dense(a.name, *shape) for a, shape in zip(given.values(), shapes, strict=False))  # no growth
        return Interface(self.name, program, inputs, found)

    def derivatives(self, values: Interface) -> Interface:
        """Jacobians of the numbers of every result in every argument."""
        return _jacobians(values, jacobian(values.program, _wide(values.program)))

    def gradient(self, values: Interface) -> Interface:
        """Gradient of the results, weighted with seeds, in every argument."""
        program = vjp(values.program, _wide(values.program))
        seeds = [m._replace(name=f"adj_{m.name}") for m in values.outputs]
        found = tuple(m._replace(name=f"adj_{m.name}") for m in values.inputs)
        return Interface(f"adj1_{values.name}", program, (*values.inputs, *_unread(values), *seeds), found)

    def second_derivatives(self, values: Interface, gradient: Interface) -> Interface:
        """Jacobians of the gradient in every argument and seed."""
        return _jacobians(gradient, vjp_jacobian(values.program, _wide(values.program)))

    def write(self, folder: Path) -> Exported:
        """File in a folder, which is made if it is not there."""
        return Exported(self.name, *write(folder, {f"{self.name}.c": self.source()}))


def _wide(program: Program) -> list[int]:
    """Positions of the arguments that have numbers."""
    return [k for k, a in enumerate(program.arguments) if a.width]


def _unread(function: Interface) -> tuple[Stored, ...]:
    """Results of a function as arguments of its derivatives, which do not read them."""
    return tuple(Stored(f"out_{m.name}", m.rows, m.columns, ()) for m in function.outputs)


def _jacobians(function: Interface, derived: Program) -> Interface:
    """Jacobians of the numbers of every result of a function in every argument.

    `derived`: program that returns, argument by argument, those of every result.
    """
    read = [k for k, m in enumerate(function.inputs) if m.stored]
    matrices, results = [], []
    for i, result in enumerate(function.outputs):
        for j, argument in enumerate(function.inputs):
            name = f"jac_{result.name}_{argument.name}"
            rows, columns = len(result.stored), argument.rows * argument.columns
            kept: list[int] = []
            if argument.stored:
                whole = _by_columns(derived.results[read.index(j) * len(function.outputs) + i], rows, columns)
                kept = [k for k, v in enumerate(whole.values) if v != 0.0]
                results.append(whole._replace(name=name, values=tuple(whole.values[k] for k in kept)))
            matrices.append(Stored(name, rows, columns, tuple(kept)))
    program = replace(derived, results=tuple(results))
    inputs = (*function.inputs, *_unread(function))
    return Interface(f"jac_{function.name}", program, inputs, tuple(matrices), diagonal=True)


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
