"""C99 text of a long program in functions of bounded length, because compilers take too long over long ones.

The functions pass values on in an array, the slots. They write outputs before others read the arguments, so no output
may be the array of an argument.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from torchdq.export import c99
from torchdq.export.c99 import Array, CFunction, Placed
from torchdq.program.autograd import per_sample
from torchdq.program.program import outputs
from torchdq.program.schedule import schedule

LONGEST = 250  # operations of a function in C


class SampleText(NamedTuple):
    """Text around the statements of one sample, and the places of its numbers."""

    place: Placed = c99.in_rows
    parameter: Callable[[str, Array, bool], str] = lambda number, array, shared: f"{number} {array.name}[{array.size}]"
    body: Callable[[Sequence[str]], str] = c99.indented  # statements of a function


class ProgramParts(NamedTuple):
    """Functions of a program, which share some arrays of their own."""

    text: str
    calls: list[tuple[str, list[Array]]]  # names of the functions in their order, and what is passed to each
    own: list[Array]  # slots, if there is more than one function; and the sum of all sines: see `CFunction.angles`


def parts(whole: CFunction, written_as: SampleText) -> ProgramParts:
    """Functions of a program, which are named after it."""
    program, emitter, place = whole.program, whole.emitter(written_as.place), written_as.place
    plan = schedule(per_sample(program), LONGEST)
    taken, given = c99.arrays(program)
    slots, angles = Array("slots", plan.slots), Array("angles", 1)
    texts: list[str] = []
    calls: list[tuple[str, list[Array]]] = []
    for k, part in enumerate(plan.parts):
        values = set(part.values)
        lines = [f"const {whole.number} x{i} = {place(slots, slot, False)};" for i, slot in part.loaded]
        lines += emitter.statements(part.values)
        written = []
        for r, array in given.items():
            numbers = enumerate(outputs(program)[r].values)
            here = {j: v for j, v in numbers if (k == 0 if isinstance(v, float) else v[0] in values)}
            lines += c99.written(emitter, place, array, here)
            written += [array] if here else []
        lines += [f"{place(slots, slot, False)} = x{i};" for i, slot in part.stored]
        passes = [slots] if part.loaded or part.stored else []
        if sines := whole.angles(values):
            begun = any(angles in arrays for _, arrays in calls)
            lines.append(f"{place(angles, 0, False)} {'+' if begun else ''}= {sines};")
            passes.append(angles)
        read = [taken[i] for i in sorted({program.ops[i].payload[0] for i in values if program.ops[i].code == "in"})]
        parameters = [written_as.parameter(f"const {whole.number}", array, array.shared) for array in read]
        parameters += [written_as.parameter(whole.number, array, False) for array in (*written, *passes)]
        called = whole.name if len(plan.parts) == 1 else f"{whole.name}{k}"
        texts.append(f"static void {called}({', '.join(parameters) or 'void'})\n{{\n{written_as.body(lines)}}}\n")
        calls.append((called, [*read, *written, *passes]))
    own = [array for array in (slots, angles) if any(array in arrays for _, arrays in calls)]
    return ProgramParts("\n".join(texts), calls, own)


def text(function: CFunction) -> str:
    """Text of the function of a program, in parts, without its preamble.

    Its status does not report results that are not finite: its callers check them.
    """
    whole = parts(function._replace(name=f"{function.name}_part"), SampleText())
    if len(whole.calls) == 1:
        return f"static {function.text(finite=False)}"
    passed = {array for _, arrays in whole.calls for array in arrays}
    lines = [f"(void){array.name};" for array in function.taken if array not in passed]
    lines += [f"{function.number} {array.name}[{array.size}];" for array in whole.own]
    lines += [f"{called}({', '.join(array.name for array in arrays)});" for called, arrays in whole.calls]
    sines = "angles[0]" if any(array.name == "angles" for array in whole.own) else ""
    lines.append(f"return {function.status(function.growth(), sines)};")
    return f"{whole.text}\nstatic {function.declaration()}\n{{\n{c99.indented(lines)}}}\n"
