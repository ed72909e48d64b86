"""Folder with a program in C: source, header, a test with golden vectors, and a CMake file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.backends.choice import choose
from torchdq.export import c99
from torchdq.export.c99 import Array, Library
from torchdq.export.meaning import described
from torchdq.program.program import Program, outputs

CASES = 8  # golden vectors of a test
CPU = torch.device("cpu")


class Exported(NamedTuple):
    """Files of an exported program, and the name of its function; None: the language has no such file."""

    function: str
    source: Path
    header: Path | None = None
    spans: Path | None = None
    test: Path | None = None
    cmake: Path | None = None


class Export(NamedTuple):
    """A program as it is exported."""

    program: Program
    name: str  # name of its function
    single: bool
    functions: Library  # where sine, cosine and roots come from
    about: tuple[str, ...]  # lines about the robot

    def source(self) -> str:
        """Source file in C99."""
        about = [*self.about, "", "Strict C99. Without fused multiplication and addition, results have the same bits."]
        before = c99.preamble(self.program, self.single, self.functions)
        function = c99.function(self.program, self.name, self.single, self.functions)
        return f'{c99.comment(about)}#include "{self.name}.h"\n{before}\n{function}'

    def header(self) -> str:
        """Header in C99, which C++ can include."""
        taken, given = c99.arrays(self.program)
        names = [a.name for a in self.program.arguments if a.width], [r.name for r in outputs(self.program) if r.values]
        count = self.program.count()._asdict()
        growth = self.program.growth is not None
        about = [
            *self.about,
            "",
            *described([f"{a.name}[{a.size}]" for a in taken], names[0], "in "),
            *described([f"{a.name}[{a.size}]" for a in given], names[1], "out"),
            "",
            f"{', '.join(f'{number} {kind}' for kind, number in count.items() if number) or 'no operations'}.",
            "Outputs may be the arrays of inputs.",
            "Returns 1 where the rounding errors are too large, else 0." if growth else "Returns 0.",
        ]
        guard = f"{self.name.upper()}_H"
        declared = c99.declaration(self.program, self.name, self.single)
        return (
            f"{c99.comment(about)}#ifndef {guard}\n#define {guard}\n\n"
            f'#ifdef __cplusplus\nextern "C" {{\n#endif\n\n{declared};\n\n#ifdef __cplusplus\n}}\n#endif\n\n#endif\n'
        )

    def spans(self) -> str:
        """Header in C++20 whose function takes spans of fixed size."""
        scalar = "float" if self.single else "double"
        taken, given = c99.arrays(self.program)
        parameters = [f"std::span<const {scalar}, {a.size}> {a.name}" for a in taken]
        parameters += [f"std::span<{scalar}, {a.size}> {a.name}" for a in given]
        passed = ", ".join(f"{a.name}.data()" for a in (*taken, *given))
        return (
            f"/* {self.name}.h with spans in the place of pointers */\n#include <span>\n"
            f'#include "{self.name}.h"\n\nnamespace torchdq {{\n\n'
            f"inline int {self.name}({', '.join(parameters)})\n{{\n    return ::{self.name}({passed});\n}}\n\n}}\n"
        )

    def test(self, examples: Mapping[str, Tensor]) -> str:
        """Program in C99 that compares the function with the results of this machine, and returns 1 if they differ."""
        dtype = torch.float32 if self.single else torch.float64
        inputs = [_example(a.name, a.width, examples, k).to(dtype) for k, a in enumerate(self.program.arguments)]
        given = [x[0].contiguous() if a.uniform else x for x, a in zip(inputs, self.program.arguments, strict=True)]
        found = choose(None, CPU).kernel(self.program, dtype, CPU)(given, CASES)
        taken, results = c99.arrays(self.program)
        rows = [x for x, a in zip(inputs, self.program.arguments, strict=True) if a.width]
        ends = [y for y, r in zip(found, outputs(self.program), strict=True) if r.values]
        scalar, f = ("float", "f") if self.single else ("double", "")
        tables = [self._table(f"in_{a.name}", a, x) for a, x in zip(taken, rows, strict=True)]
        tables += [self._table(f"out_{a.name}", a, y) for a, y in zip(results, ends, strict=True)]
        locals_ = " ".join(f"{scalar} {a.name}[{a.size}];" for a in results)
        passed = ", ".join([*(f"in_{a.name}[k]" for a in taken), *(a.name for a in results)])
        checks = "\n".join(f"        compare({a.name}, out_{a.name}[k], {a.size}, &worst);" for a in results)
        return (
            f"/* {self.name} against golden vectors; returns 0 if they agree to {_bound(self.single)} */\n"
            f'#include <math.h>\n#include <stdio.h>\n#include "{self.name}.h"\n\n{"".join(tables)}\n'
            f"static void compare(const {scalar} *found, const {scalar} *expected, int size, {scalar} *worst)\n{{\n"
            f"    {scalar} largest = 0;\n    int j;\n"
            f"    for (j = 0; j < size; j++) largest = fmax{f}(largest, fabs{f}(expected[j]));\n"
            f"    for (j = 0; j < size; j++) {{\n"
            f"        const {scalar} difference = fabs{f}(found[j] - expected[j]) / (largest > 0 ? largest : 1);\n"
            f"        if (!(difference <= *worst)) *worst = difference;\n    }}\n}}\n\n"
            f"int main(void)\n{{\n    {scalar} worst = 0;\n    int k;\n    for (k = 0; k < {CASES}; k++) {{\n"
            f"        {locals_}\n        (void){self.name}({passed});\n{checks}\n    }}\n"
            f'    printf("{self.name}: largest relative difference %g\\n", (double)worst);\n'
            f"    return worst <= {_bound(self.single)} ? 0 : 1;\n}}\n"
        )

    def _table(self, name: str, array: Array, rows: Tensor) -> str:
        scalar = "float" if self.single else "double"
        full = rows.expand(CASES, array.size) if rows.ndim == 1 else rows
        lines = [", ".join(c99.literal(x, self.single) for x in row) for row in full.tolist()]
        listed = ",\n".join(f"    {{{line}}}" for line in lines)
        return f"static const {scalar} {name}[{CASES}][{array.size}] = {{\n{listed}\n}};\n"

    def cmake(self) -> str:
        """CMake file with the function as a library, and its test."""
        math = "\nif(UNIX)\n  target_link_libraries({0} PUBLIC m)\nendif()" if self.functions == "math.h" else ""
        return (
            f"cmake_minimum_required(VERSION 3.13)\nproject({self.name} C)\n"
            "set(CMAKE_C_STANDARD 99)\nset(CMAKE_C_EXTENSIONS OFF)\nset(CMAKE_C_STANDARD_REQUIRED ON)\n"
            f"add_library({self.name} {self.name}.c)\n"
            f"target_include_directories({self.name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}}){math.format(self.name)}\n"
            f"enable_testing()\nadd_executable(test_{self.name} test_{self.name}.c)\n"
            f"target_link_libraries(test_{self.name} {self.name} m)\n"
            f"add_test(NAME {self.name} COMMAND test_{self.name})\n"
        )

    def write(self, folder: Path, examples: Mapping[str, Tensor]) -> Exported:
        """Files in a folder, which is made if it is not there."""
        texts = {
            f"{self.name}.c": self.source(),
            f"{self.name}.h": self.header(),
            f"{self.name}.hpp": self.spans(),
            f"test_{self.name}.c": self.test(examples),
            "CMakeLists.txt": self.cmake(),
        }
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="ascii")
        return Exported(self.name, *[folder / name for name in texts])


def _bound(single: bool) -> str:
    return "1e-5f" if single else "1e-12"


def _example(name: str, width: int, examples: Mapping[str, Tensor], seed: int) -> Tensor:
    """Rows for an argument in a test: given ones, or random numbers."""
    if name in examples:
        return examples[name].detach().double().cpu().reshape(-1, width).expand(CASES, width).clone()
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(CASES, width, generator=generator, dtype=torch.float64)
    if name == "noise":
        return x
    x = 2 * x - 1
    if name == "X_WB":  # a unit dual quaternion
        r = x[:, :4] / x[:, :4].norm(dim=-1, keepdim=True)
        return torch.cat([r, x[:, 4:] - (x[:, 4:] * r).sum(-1, keepdim=True) * r], -1)
    return x
