"""C99 text of a program for a batch: blocks of samples, in loops that compilers turn into vector instructions.

A block is copied from rows to lanes, q[component][lane]; one loop over its lanes computes all outputs, in which every
operation takes neighbouring numbers; and the outputs are copied back. Sine and cosine are the polynomials of
`c99`, because compilers have no vectors of those of math.h; the status is 1 where an angle is out of their reach. The
last block repeats its last sample, so that the result of a sample does not depend on its place.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchdq.export import c99, parts
from torchdq.export.c99 import Array, CFunction
from torchdq.export.parts import SampleText
from torchdq.program.program import Program, outputs

_ROWS_TO_LANES = """
static void rows_to_lanes(const S *rows, size_t width, size_t here, S *lanes)
{
    size_t i, j;
    if (here == LANES) {
        for (i = 0; i < LANES; i++)
            for (j = 0; j < width; j++) lanes[j * LANES + i] = rows[i * width + j];
    } else {
        for (i = 0; i < LANES; i++)
            for (j = 0; j < width; j++) lanes[j * LANES + i] = rows[(i < here ? i : here - 1) * width + j];
    }
}
"""
_LANES_TO_ROWS = """
static void lanes_to_rows(const S *lanes, size_t width, size_t here, S *rows)
{
    size_t i, j;
    if (here == LANES) {
        for (i = 0; i < LANES; i++)
            for (j = 0; j < width; j++) rows[i * width + j] = lanes[j * LANES + i];
    } else {
        for (i = 0; i < here; i++)
            for (j = 0; j < width; j++) rows[i * width + j] = lanes[j * LANES + i];
    }
}
"""
_ADDED = """
static void added(const S *lanes, size_t width, size_t here, S *sums)
{
    size_t i, j;
    for (j = 0; j < width; j++)
        for (i = 0; i < here; i++) sums[j * LANES + i] += lanes[j * LANES + i];
}
"""


def lanes(single: bool) -> int:
    """Samples of a block: the numbers of the widest vector."""
    return 16 if single else 8


def stack(function: CFunction) -> int:
    """Memory of the blocks [bytes]."""
    numbers = sum(a.size for a in function.taken if not a.shared)
    numbers += sum(a.size * (2 if a.shared else 1) for a in function.given)
    numbers += sum(a.size for a in parts.parts(function._replace(vectors=True), _IN_LANES).own)
    return numbers * lanes(function.single) * (4 if function.single else 8)


def _place(array: Array, component: int, shared: bool) -> str:
    return f"{array.name}[{component}]{'' if shared else '[lane]'}"


def _parameter(number: str, array: Array, shared: bool) -> str:
    return f"const S *{array.name}" if shared else f"S {array.name}[restrict {array.size}][LANES]"


def _body(lines: Sequence[str]) -> str:
    return f"    int lane;\n    for (lane = 0; lane < LANES; lane++) {{\n{c99.indented(lines, 8)}    }}\n"


_IN_LANES = SampleText(_place, _parameter, _body)


def copies(programs: Sequence[Program], single: bool) -> str:
    """Text of the functions that copy blocks, for the functions of programs."""
    results = [r for program in programs for r in outputs(program) if r.values]
    several, summed = any(not r.summed for r in results), any(r.summed for r in results)
    texts = [_ROWS_TO_LANES, _LANES_TO_ROWS if several else "", _ADDED if summed else ""]
    return f"enum {{ LANES = {lanes(single)} }};\n{''.join(texts)}\n"


def text(function: CFunction, linkage: str = "", finite: bool = True) -> str:
    """Text of the function for batches, and of its parts, without preamble and `copies`.

    `linkage`: words before its declaration; `finite`: whether its status reports results that are not.
    """
    given, several = function.given, [a for a in function.taken if not a.shared]
    block = parts.parts(function._replace(name=f"{function.name}_block", vectors=True), _IN_LANES)
    local = {a.name: f"lanes_of_{a.name}" for a in (*several, *given)}  # names in the function for batches
    sums = [a for a in given if a.shared]
    declared = [f"S lanes_of_{a.name}[{a.size}][LANES];" for a in (*several, *given)]
    declared += [f"S {a.name}[{a.size}][LANES];" for a in block.own]
    declared += [f"S sum_of_{a.name}[{a.size}][LANES] = {{{{0}}}};" for a in sums]
    steps = [f"rows_to_lanes({a.name} + {a.size} * first, {a.size}, here, lanes_of_{a.name}[0]);" for a in several]
    steps += [f"{part}({', '.join(local.get(a.name, a.name) for a in arrays)});" for part, arrays in block.calls]
    for a in given:
        steps.append(
            f"added(lanes_of_{a.name}[0], {a.size}, here, sum_of_{a.name}[0]);"
            if a.shared
            else f"lanes_to_rows(lanes_of_{a.name}[0], {a.size}, here, {a.name} + {a.size} * first);"
        )
    sines = any(a.name == "angles" for a in block.own)
    growth = function.growth("lanes_of_{}[0][lane]")
    if growth or sines:
        good = function.status(growth, "angles[0][lane]" if sines else "")
        steps.append(f"for (lane = 0; lane < here; lane++) status |= {good};")
    results = given[: len(given) - bool(growth)] if finite else []
    steps += [
        f"for (place = 0; place < {a.size}; place++)\n"
        f"            for (lane = 0; lane < here; lane++)\n"
        f"                status |= lanes_of_{a.name}[place][lane] - lanes_of_{a.name}[place][lane] == 0 ? 0 : 1;"
        for a in results
    ]
    end = [
        f"for (first = 0; first < {a.size}; first++)\n"
        f"        for ({a.name}[first] = 0, lane = 0; lane < LANES; lane++)\n"
        f"            {a.name}[first] += sum_of_{a.name}[first][lane];"
        for a in sums
    ]
    counters = [name for name, used in (("lane", growth or sines or sums or results), ("place", results)) if used]
    return (
        f"{block.text}\n"
        f"{linkage}{function.declaration('batch')}\n{{\n    size_t {', '.join(['first', *counters])};\n"
        f"    int status = 0;\n{c99.indented(declared, 4)}"
        f"    for (first = 0; first < samples; first += LANES) {{\n"
        f"        const size_t here = samples - first < LANES ? samples - first : LANES;\n"
        f"{c99.indented(steps, 8)}    }}\n"
        f"{c99.indented(end, 4)}    return status;\n}}\n"
    )
