"""C99 text of a long program in functions of bounded length, because compilers take too long over long ones.

The functions pass values on in an array, the slots. They write outputs before others read the arguments, so no output
may be the array of an argument.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from torchdq.export import c99
from torchdq.export.c99 import Array, Library, Placed
from torchdq.program.autograd import per_sample
from torchdq.program.program import Program, outputs
from torchdq.program.schedule import schedule

LONGEST = 250  # operations of a function in C


class SampleText(NamedTuple):
    """Text around the statements of one sample, and the places of its numbers."""

    place: Placed
    parameter: Callable[[Array, bool, bool], str]  # array, whether it is only read, whether samples share it
    body: Callable[[Sequence[str]], str]  # statements of a function
    root: str  # name of the function for square roots


class ProgramParts(NamedTuple):
    """Functions of a program, which share some arrays of their own."""

    text: str
    calls: list[tuple[str, list[Array]]]  # names of the functions in their order, and what is passed to each
    own: list[Array]  # slots, if there is more than one function; and the sum of all sines: see `c99.angles`


def parts(program: Program, name: str, single: bool, library: Library, written_as: SampleText) -> ProgramParts:
    """Functions of a program, which are named after it."""
    plan = schedule(per_sample(program), LONGEST)
    printer = c99.Printer(program, single, library, written_as.place, written_as.root)
    taken, given = c99.arrays(program)
    arguments = dict(zip((k for k, a in enumerate(program.arguments) if a.width), taken, strict=True))
    results = list(zip(given, [r.values for r in outputs(program) if r.values], strict=True))
    slots, angles = Array("slots", plan.slots), Array("angles", 1)
    texts: list[str] = []
    calls: list[tuple[str, list[Array]]] = []
    for k, part in enumerate(plan.parts):
        values = set(part.values)
        read = sorted({program.ops[i].payload[0] for i in values if program.ops[i].code == "in"})
        lines = [f"const {printer.scalar} x{i} = {written_as.place(slots, slot, False)};" for i, slot in part.loaded]
        lines += printer.computed(part.values)
        written = []
        for array, numbers in results:
            here = {j: v for j, v in enumerate(numbers) if (k == 0 if isinstance(v, float) else v[0] in values)}
            lines += printer.written(array, here)
            written += [array] if here else []
        lines += [f"{written_as.place(slots, slot, False)} = x{i};" for i, slot in part.stored]
        passes = [slots] if part.loaded or part.stored else []
        if sines := c99.angles(program, library, values):
            begun = any(angles in arrays for _, arrays in calls)
            lines.append(f"{written_as.place(angles, 0, False)} {'+' if begun else ''}= {sines};")
            passes.append(angles)
        parameters = [written_as.parameter(arguments[i], True, program.arguments[i].uniform) for i in read]
        parameters += [written_as.parameter(array, False, False) for array in (*written, *passes)]
        called = name if len(plan.parts) == 1 else f"{name}{k}"
        texts.append(f"static void {called}({', '.join(parameters) or 'void'})\n{{\n{written_as.body(lines)}}}\n")
        calls.append((called, [*(arguments[i] for i in read), *written, *passes]))
    own = [array for array in (slots, angles) if any(array in arrays for _, arrays in calls)]
    return ProgramParts("\n".join(texts), calls, own)


def _parameter(array: Array, read: bool, shared: bool) -> str:
    return f"{'const ' if read else ''}double {array.name}[{array.size}]"


def function(program: Program, name: str, library: Library) -> str:
    """Text of the function of a program in double precision, in parts, without `c99.preamble`.

    Its status does not report results that are not finite: its callers check them.
    """
    whole = parts(
        program,
        f"{name}_part",
        False,
        library,
        SampleText(c99.in_rows, _parameter, c99.indented, c99.root(False, library)),
    )
    if len(whole.calls) == 1:
        return f"static {c99.function(program, name, False, library, finite=False)}"
    taken, given = c99.arrays(program)
    passed = {array for _, arrays in whole.calls for array in arrays}
    lines = [f"(void){array.name};" for array in taken if array not in passed]
    lines += [f"double {array.name}[{array.size}];" for array in whole.own]
    lines += [f"{called}({', '.join(array.name for array in arrays)});" for called, arrays in whole.calls]
    growth = f"{given[-1].name}[0]" if program.growth is not None else ""
    sines = "angles[0]" if c99.angles(program, library) else ""
    lines.append(f"return {c99.status(False, growth, sines)};")
    return f"{whole.text}\nstatic {c99.declaration(program, name, False)}\n{{\n{c99.indented(lines)}}}\n"
