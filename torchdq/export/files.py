"""Folder with programs in C: each has source, headers, a test with golden vectors, and its part of a CMake project."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from os import PathLike
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from torchdq.base.files import write_atomically
from torchdq.errors import ArgumentError
from torchdq.export import batch, c99, golden, rollout
from torchdq.export.c99 import Array, CFunction
from torchdq.export.meaning import described
from torchdq.program.loop import Loop
from torchdq.program.program import Program, outputs

# one for all functions that are exported into a folder
_CMAKE = """cmake_minimum_required(VERSION 3.13)
project(exported C)
enable_testing()
file(GLOB functions ${CMAKE_CURRENT_SOURCE_DIR}/exported_*.cmake)
foreach(function ${functions})
  include(${function})
endforeach()
"""


class Exported(NamedTuple):
    """Files of an exported program, and the name of its function; None: the language has no such file."""

    function: str
    source: Path
    header: Path | None = None
    spans: Path | None = None
    test: Path | None = None
    cmake: Path | None = None


def path_of(folder: str | PathLike[str]) -> Path:
    """Path of a folder to write to."""
    if not isinstance(folder, str | PathLike):
        raise ArgumentError(f"folder must be a path, found {type(folder).__name__}")
    return Path(folder)


def write(folder: Path, contents: Mapping[str, str | bytes]) -> list[Path]:
    """Paths of files with bytes or texts in ASCII, by name, in a folder, which is made if it is not there.

    Neither a full disk nor a killed process leaves a part of a file, and a build that runs meanwhile reads old files or
    new ones.

    Raises:
        ArgumentError: the folder is a file, or nothing can be written there.
    """
    files: dict[Path, str | bytes] = {}
    for name, content in contents.items():
        files[folder / name] = content.encode("ascii") if isinstance(content, str) else content
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(files)
    except OSError as error:
        cause = error.strerror or error
        raise ArgumentError(f"folder must be writable, found {str(folder)!r}: {cause}") from error
    return list(files)


class Export(NamedTuple):
    """A program as it is exported."""

    function: CFunction
    about: tuple[str, ...]  # lines about the robot
    batch: bool = False  # whether there is a function for batches, too

    @property
    def program(self) -> Program:
        """Program of the function."""
        return self.function.program

    @property
    def name(self) -> str:
        """Name of the function."""
        return self.function.name

    @property
    def steps(self) -> Loop | None:
        """Loop over the program, if it is a step."""
        return rollout.loop(self.program)

    def source(self) -> str:
        """Source file in C99."""
        about = [
            *self.about,
            "",
            "Strict C99. Every operation is rounded as IEEE 754 says, so the results have the same bits everywhere",
            "if the compiler fuses no multiplication with an addition (-ffp-contract=off). Calls from Python fuse them",
            "and differ in the last bits.",
        ]
        before = self.function._replace(vectors=self.batch).preamble()
        functions = [self.function.text()]
        if self.steps:
            functions.append(rollout.text(self.steps, self.function))
        if self.batch:
            functions.append(batch.copies([self.program], self.function.single) + batch.text(self.function))
        text = "\n".join(functions)
        return f'{c99.comment(about)}#include "{self.name}.h"\n{before}\n{text}'

    def header(self) -> str:
        """Header in C99, which C++ can include."""
        taken, given = c99.arrays(self.program)
        count = self.program.count()._asdict()
        about = [
            *self.about,
            "",
            *described([_shown(a) for a in taken.values()], [self.program.arguments[k].name for k in taken], "in "),
            *described([_shown(a) for a in given.values()], [outputs(self.program)[k].name for k in given], "out"),
            "",
            f"{', '.join(f'{number} {kind}' for kind, number in count.items() if number) or 'no operations'}.",
            "An output may be the same array as an input.",
            self._returned(self.function),
            *(rollout.about(self.steps, self.name) if self.steps else ()),
            *(self._about_batches() if self.batch else ()),
        ]
        many = ["rollout"] * bool(self.steps) + ["batch"] * self.batch
        declared = "\n".join(f"{self.function.declaration(kind)};" for kind in ("", *many))
        return header(self.name, about, "#include <stddef.h>\n\n" * bool(many), declared)

    def _about_batches(self) -> list[str]:
        """Lines about the function for batches."""
        taken, given = ([a.name for a in side if a.shared] for side in (self.function.taken, self.function.given))
        return [
            "",
            f"{self.name}_batch takes the rows of all samples one after the other, q[samples][n], and writes likewise.",
            *([f"One row for all samples: {', '.join(taken)}."] if taken else []),
            *([f"Sums over the samples: {', '.join(given)}."] if given else []),
            "Compilers make vector instructions of it at -O3 with -march=native and -fno-math-errno; it is faster with",
            f"-ffp-contract=fast. It takes {batch.stack(self.function)} bytes of stack. Its sine and",
            f"cosine are its own, and NaN where an angle is beyond {self._reach()}. An output may be the whole array",
            "of an input whose rows have the same size.",
            self._returned(self.function._replace(vectors=True)).replace(" where ", " where, in any sample, "),
        ]

    def _reach(self) -> str:
        """Largest angle that the own sine and cosine take."""
        return "4e3 rad" if self.function.single else "1e5 rad"

    def _returned(self, function: CFunction) -> str:
        """Sentence on the status that a function returns."""
        causes = ["a result is not finite"] if c99.computed_results(self.program) else []
        causes += ["the rounding errors are too large"] if self.program.growth is not None else []
        causes += [f"an angle is NaN or beyond {self._reach()}"] if function.angles() else []
        return f"Returns 1 where {' or '.join(causes)}, else 0." if causes else "Returns 0."

    def spans(self) -> str:
        """Header in C++20 whose functions take spans."""
        taken, given, number = self.function.taken, self.function.given, self.function.number
        passed = ", ".join(f"{a.name}.data()" for a in (*taken, *given))

        def spans(any_size: bool) -> str:
            """Parameters, of any size but for rows that all samples share."""
            kinds = [*((f"const {number}", a) for a in taken), *((number, a) for a in given)]
            extents = ["" if any_size and not a.shared else f", {a.size}" for _, a in kinds]
            return ", ".join(f"std::span<{kind}{x}> {a.name}" for (kind, a), x in zip(kinds, extents, strict=True))

        text = f"inline int {self.name}({spans(False)})\n{{\n    return ::{self.name}({passed});\n}}\n\n"
        if self.batch:
            short = " || ".join(f"{a.name}.size() / {a.size} < samples" for a in (*taken, *given) if not a.shared)
            text += (
                "/* Returns 2, and does nothing, if a span is shorter than the rows of all samples. */\n"
                f"inline int {self.name}_batch(std::size_t samples, {spans(True)})\n{{\n"
                f"{f'    if ({short}) return 2;{chr(10)}' if short else ''}"
                f"    return ::{self.name}_batch(samples, {passed});\n}}\n\n"
            )
        guard = f"{self.name.upper()}_HPP"
        return (
            f"/* {self.name}.h with spans instead of pointers */\n#ifndef {guard}\n#define {guard}\n\n"
            "#include <cstddef>\n#include <span>\n#ifndef __cpp_lib_span\n"
            f'#error "{self.name}.hpp needs C++20; compile with -std=c++20"\n#endif\n'
            f'#include "{self.name}.h"\n\nnamespace torchdq {{\n\n{text}}}\n\n#endif\n'
        )

    def write(self, folder: Path, examples: Mapping[str, Tensor]) -> Exported:
        """Files in a folder, which is made if it is not there."""
        test = golden.test(self.function, self.batch, examples)
        return write_project(folder, self.function, self.source(), self.header(), test, self.spans(), self.batch)


def _shown(array: Array) -> str:
    return f"{array.name}[{array.size}]"


def header(name: str, about: Iterable[str], included: str, declared: str) -> str:
    """Header in C99, which C++ can include."""
    guard = f"{name.upper()}_H"
    return (
        f"{c99.comment(about)}#ifndef {guard}\n#define {guard}\n\n{included}"
        f'#ifdef __cplusplus\nextern "C" {{\n#endif\n\n{declared}\n\n#ifdef __cplusplus\n}}\n#endif\n\n#endif\n'
    )


def write_project(
    folder: Path, function: CFunction, source: str, header: str, test: str, spans: str = "", vectors: bool = False
) -> Exported:
    """Files of a function, and of those beside it, in a folder with a CMake project of all that are there.

    `spans`: header for C++, "" if there is none; `vectors`: whether compilers shall make vector instructions of it.
    """
    name = function.name
    texts = {f"{name}.c": source, f"{name}.h": header, f"{name}.hpp": spans, f"test_{name}.c": test}
    texts |= {"CMakeLists.txt": _CMAKE, f"exported_{name}.cmake": _cmake(function, vectors)}
    there = {file: text for file, text in texts.items() if text}
    paths = dict(zip(there, write(folder, there), strict=True))
    return Exported(name, *[paths.get(file) for file in [*texts][:-1]])  # type: ignore[arg-type]  # source is there


def _cmake(function: CFunction, vectors: bool) -> str:
    """CMake file with the function as a library, and its test."""
    name, math = function.name, " m" if function.functions == "math.h" else ""
    library, test = f"exported_{name}", f"test_exported_{name}"  # a bare name may be one that CMake reserves
    optimised = (
        'if(CMAKE_C_COMPILER_ID MATCHES "GNU|Clang")\n'
        f"  target_compile_options({library} PRIVATE -O3 -fno-math-errno)\nendif()\n"
        if vectors
        else ""
    )
    return (
        f"add_library({library} ${{CMAKE_CURRENT_LIST_DIR}}/{name}.c)\n"
        f"add_executable({test} ${{CMAKE_CURRENT_LIST_DIR}}/test_{name}.c)\n"
        f"set_target_properties({library} PROPERTIES OUTPUT_NAME {name})\n"
        f"set_target_properties({library} {test} PROPERTIES\n"
        "  C_STANDARD 99 C_EXTENSIONS OFF C_STANDARD_REQUIRED ON)\n"
        f"target_include_directories({library} PUBLIC ${{CMAKE_CURRENT_LIST_DIR}})\n"
        f"target_link_libraries({test} {library})\n"
        f"if(UNIX)\n  target_link_libraries({library} PUBLIC{math})\n  target_link_libraries({test} m)\nendif()\n"
        f"{optimised}add_test(NAME {name} COMMAND {test})\n"
    )
