"""Folder with a program in C: source, header, a test with golden vectors, and a CMake file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from torchdq.export import batch, c99, golden
from torchdq.export.c99 import Library
from torchdq.export.meaning import described
from torchdq.program.program import Program, outputs


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
    batch: bool = False  # whether there is a function for batches, too

    def source(self) -> str:
        """Source file in C99."""
        about = [*self.about, "", "Strict C99. Without fused multiplication and addition, results have the same bits."]
        before = c99.preamble(self.program, self.single, self.functions, self.batch)
        functions = [c99.function(self.program, self.name, self.single, self.functions)]
        if self.batch:
            functions.append(batch.function(self.program, self.name, self.single))
        text = "\n".join(functions)
        return f'{c99.comment(about)}#include "{self.name}.h"\n{before}\n{text}'

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
            *(self._about_batches() if self.batch else ()),
        ]
        guard = f"{self.name.upper()}_H"
        declared = f"{c99.declaration(self.program, self.name, self.single)};"
        if self.batch:
            declared += f"\n{batch.declaration(self.program, self.name, self.single)};"
        included = "#include <stddef.h>\n\n" if self.batch else ""
        return (
            f"{c99.comment(about)}#ifndef {guard}\n#define {guard}\n\n{included}"
            f'#ifdef __cplusplus\nextern "C" {{\n#endif\n\n{declared}\n\n#ifdef __cplusplus\n}}\n#endif\n\n#endif\n'
        )

    def _about_batches(self) -> list[str]:
        """Lines about the function for batches."""
        taken, given = batch.rows(self.program)
        shared = [a.name for a in taken if a.shared]
        sums = [a.name for a in given if a.shared]
        growth = self.program.growth is not None
        reach = "4e3 rad" if self.single else "1e5 rad"
        return [
            "",
            f"{self.name}_batch takes the rows of all samples one after the other, q[samples][n], and writes likewise.",
            *([f"One row for all samples: {', '.join(shared)}."] if shared else []),
            *([f"Sums over the samples: {', '.join(sums)}."] if sums else []),
            "Compilers make vector instructions of it at -O3 with -march=native and -fno-math-errno; it is faster with",
            f"-ffp-contract=fast. It has sine and cosine of its own, which are NaN beyond {reach}, and takes",
            f"{batch.stack(self.program, self.single)} bytes of stack. An output may be the array of an input of its",
            f"size.{' Returns 1 if any sample would.' if growth else ''}",
        ]

    def spans(self) -> str:
        """Header in C++20 whose functions take spans."""
        scalar = "float" if self.single else "double"
        taken, given = batch.rows(self.program)
        every = (*taken, *given)
        passed = ", ".join(f"{a.name}.data()" for a in every)

        def spans(extents: Sequence[str]) -> str:
            kinds = [f"const {scalar}"] * len(taken) + [scalar] * len(given)
            return ", ".join(
                f"std::span<{kind}{extent}> {a.name}" for kind, extent, a in zip(kinds, extents, every, strict=True)
            )

        fixed = [f", {a.size}" for a in every]
        text = f"inline int {self.name}({spans(fixed)})\n{{\n    return ::{self.name}({passed});\n}}\n\n"
        if self.batch:
            text += (
                f"inline int {self.name}_batch(std::size_t samples, "
                f"{spans([x if a.shared else '' for x, a in zip(fixed, every, strict=True)])})\n{{\n"
                f"    return ::{self.name}_batch(samples, {passed});\n}}\n\n"
            )
        return (
            f"/* {self.name}.h with spans in the place of pointers */\n#include <cstddef>\n#include <span>\n"
            f'#include "{self.name}.h"\n\nnamespace torchdq {{\n\n{text}}}\n'
        )

    def cmake(self) -> str:
        """CMake file with the function as a library, and its test."""
        math = "\nif(UNIX)\n  target_link_libraries({0} PUBLIC m)\nendif()" if self.functions == "math.h" else ""
        vectors = (
            'if(CMAKE_C_COMPILER_ID MATCHES "GNU|Clang")\n'
            f"  target_compile_options({self.name} PRIVATE -O3 -fno-math-errno)\nendif()\n"
            if self.batch
            else ""
        )
        return (
            f"cmake_minimum_required(VERSION 3.13)\nproject({self.name} C)\n"
            "set(CMAKE_C_STANDARD 99)\nset(CMAKE_C_EXTENSIONS OFF)\nset(CMAKE_C_STANDARD_REQUIRED ON)\n"
            f"add_library({self.name} {self.name}.c)\n"
            f"target_include_directories({self.name} PUBLIC ${{CMAKE_CURRENT_SOURCE_DIR}}){math.format(self.name)}\n"
            f"{vectors}"
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
            f"test_{self.name}.c": golden.test(self.program, self.name, self.single, self.batch, examples),
            "CMakeLists.txt": self.cmake(),
        }
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (folder / name).write_text(text, encoding="ascii")
        return Exported(self.name, *[folder / name for name in texts])
