"""C99 text of a program: a function of one sample, in straight lines, without memory of its own.

It has no heap, no static state, no recursion and no loop, and takes the same operations whatever the data. Everything
is read before anything is written, so an output may be the array of an input.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from typing import Literal, NamedTuple

import numpy as np

from torchdq.backends.c_constants import SINES_DOUBLE, SINES_FLOAT
from torchdq.errors import ArgumentError
from torchdq.export.names import distinct
from torchdq.numbers.ops import OPS
from torchdq.program.order import TOGETHER, pairs, recorded
from torchdq.program.program import LARGEST_GROWTH, Output, Program, outputs

Library = Literal["math.h", "own"]

# operations in C; those with an infix need no entry
_CALLS = {
    "sqrt": "{root}({0})",
    "exp": "exp{f}({0})",
    "log": "log{f}({0})",
    "tanh": "tanh{f}({0})",
    "floor": "floor{f}({0})",
    "max": "({0} >= {1} || {0} != {0}) ? {0} : {1}",
    "min": "({0} <= {1} || {0} != {0}) ? {0} : {1}",
    "ge": "({0} >= {1}) ? {one} : {zero}",
    "select": "({0} != {zero}) ? {1} : {2}",
}
_OF_MATH = ("sqrt", "exp", "log", "tanh", "floor")

# with which compilers leave out the check of results
_WITH_NAN = """#if defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__
#error "NaN is not noticed with -ffinite-math-only or -ffast-math; compile this file without it"
#endif
"""

# rounding by adding and subtracting a large number, and pi/2 in parts, are removed by compilers with these options;
# clang has no macro for them, and a pragma that forbids it; 16 is 0 on processors that have half precision, too
_EXACT = """#include <float.h>
#if defined(__FAST_MATH__) || defined(__ASSOCIATIVE_MATH__) || defined(_M_FP_FAST)
#error "sines and roots are wrong with -ffast-math or -fassociative-math; compile this file without it"
#endif
#if FLT_EVAL_METHOD != 0 && FLT_EVAL_METHOD != 16
#error "sines and roots are wrong if numbers are kept in a wider type; compile this file for SSE2: -mfpmath=sse -msse2"
#endif
#if defined(__clang__) && __clang_major__ >= 13
#pragma clang fp reassociate(off)
#endif
"""

# sine and cosine by the polynomials of the compiled programs, to the last bit; NaN beyond LARGEST
_SINE_AND_COSINE = """
static void sine_and_cosine(S x, S *s, S *c)
{
    const S t = x * TWO_OVER_PI + ROUND, k = t - ROUND;
    const S r = ((x - k * HALF_PI_1) - k * HALF_PI_2) - k * HALF_PI_3, z = r * r;
    const S sr = r + r * z * SIN(z), h = z * (S)0.5, w = 1 - h, cr = w + (((1 - w) - h) + z * z * COS(z));
    const S zero = 0, none = zero / zero;
    const int inside = x <= LARGEST && x >= -LARGEST;
    const int q = inside ? (int)k : 0;
    const S a = (q & 1) ? cr : sr, b = (q & 1) ? sr : cr;
    *s = inside ? ((q & 2) ? -a : a) : none;
    *c = inside ? (((q + 1) & 2) ? -b : b) : none;
}
"""

# square root by exact scaling, Newton's method, and one corrected step. The first guess of 1/sqrt(x) has half of the
# exponent's bits of x (Lomont 2003, "Fast inverse square root"); Newton's steps double its digits. The remainder
# x - y^2 of the root y found is computed with y in two parts, whose products are exact (Dekker 1971), so the last step
# leaves an error of little more than half a unit in the last place, with fused multiplications and without.
_ROOT = """
static {inline}S root(S x)
{{
    union {{ S number; {bits} bits; }} guess, upper;
    const int tiny = x < (S)0x1p-{far}, huge = x > (S)0x1p+{far};
    const S z = x * (tiny ? (S)0x1p+{scale} : huge ? (S)0x1p-{scale} : 1);
    const S back = tiny ? (S)0x1p-{half} : huge ? (S)0x1p+{half} : 1;
    const S zero = 0, none = zero / zero;
    S r, y, lower;
    guess.number = z;
    guess.bits = {guess} - (guess.bits >> 1);
    r = guess.number;
{steps}    y = z * r;
    upper.number = y;
    upper.bits &= {mask};
    lower = y - upper.number;
    y = y + (S)0.5 * r * (((z - upper.number * upper.number) - 2 * upper.number * lower) - lower * lower);
    return x > 0 && x <= {largest} ? y * back : x < 0 ? none : x;
}}
"""
_NEWTON = "    r = r * ((S)1.5 - ((S)0.5 * z * r) * r);\n"
# by precision: integer, guess, upper half of the digits, scaling of numbers that are far from one, Newton's steps
_ROOT_CONSTANTS = {
    False: {
        **{"bits": "uint64_t", "guess": "UINT64_C(0x5fe6eb50c7b537a9)", "mask": "~UINT64_C(0x7ffffff)"},
        **{"far": 700, "scale": 400, "half": 200, "largest": "DBL_MAX", "steps": 4 * _NEWTON},
    },
    True: {
        **{"bits": "uint32_t", "guess": "UINT32_C(0x5f375a86)", "mask": "~UINT32_C(0xfff)"},
        **{"far": 90, "scale": 60, "half": 30, "largest": "FLT_MAX", "steps": 3 * _NEWTON},
    },
}


class Array(NamedTuple):
    """Argument or output of a function in C."""

    name: str
    size: int
    shared: bool = False  # whether it is one row for all samples: a uniform argument, or a sum


def arrays(program: Program) -> tuple[list[Array], list[Array]]:
    """Arguments and outputs of the function of a program, in its order."""
    wide = [a for a in program.arguments if a.width]
    results = [r for r in outputs(program) if r.values]
    names = distinct([*(a.name for a in wide), *(f"{r.name}" for r in results)])
    rest = [*((a.width, a.uniform) for a in wide), *((len(r.values), r.summed) for r in results)]
    found = [Array(name, size, shared) for name, (size, shared) in zip(names, rest, strict=True)]
    return found[: len(wide)], found[len(wide) :]


def declaration(program: Program, name: str, single: bool) -> str:
    """Declaration of the function of a program, without the semicolon."""
    scalar = "float" if single else "double"
    taken, given = arrays(program)
    parameters = [f"const {scalar} {a.name}[{a.size}]" for a in taken] + [f"{scalar} {a.name}[{a.size}]" for a in given]
    return f"int {name}({', '.join(parameters) or 'void'})"


def literal(x: float, single: bool) -> str:
    """Shortest C literal that is read as this number."""
    if not np.isfinite(x):
        scalar = "float" if single else "double"
        zero = f"({scalar})0"
        return f"({zero} / {zero})" if x != x else f"({'-' if x < 0 else ''}({scalar})1 / {zero})"
    text = repr(float(x)) if not single else str(np.float32(x))
    text = text if any(mark in text for mark in ".e") else f"{text}.0"
    return f"{text}f" if single else text


def comment(lines: Iterable[str]) -> str:
    """Comment of several lines, in ASCII, whatever the names in it are."""
    plain = [line.encode("unicode_escape").decode("ascii") for line in lines]
    for mark in ("*/", "/*", "??"):  # ends of comments, and trigraphs
        plain = [line.replace(mark, " ".join(mark)) for line in plain]
    return "/*\n" + "\n".join(f" * {line}".rstrip() for line in plain) + "\n */\n"


def indented(lines: Iterable[str], by: int = 4) -> str:
    """Text of lines."""
    return "".join(f"{' ' * by}{line}\n" for line in lines)


def preamble(program: Program, single: bool, library: Library, batch: bool = False) -> str:
    """Text in front of the functions of programs: what it includes, and its own sine, cosine and root if it has them.

    `batch`: whether one of them is that of `torchdq.export.batch`.
    """
    codes = {op.code for op in program.ops}
    wanted, angles = sorted(codes & set(_OF_MATH)), bool(codes & set(TOGETHER))
    lacks = [code for code in wanted if code != "sqrt"]
    if library == "own" and lacks:
        raise ArgumentError(
            f"library must be 'math.h' for {program.name}, which takes {', '.join(lacks)}; 'own' has sine, cosine and "
            "square root"
        )
    included = "#include <math.h>\n" if library == "math.h" and (wanted or angles) else ""
    scalar, constants = ("float", SINES_FLOAT) if single else ("double", SINES_DOUBLE)
    sines, root = angles and (library == "own" or batch), library == "own" and "sqrt" in codes
    kind = f"typedef {scalar} S;\n" if sines or root or batch else ""
    included += "#include <stdint.h>\n" if root else ""
    included += _WITH_NAN
    included += _EXACT if sines or root else ""
    # gcc makes vectors of a loop only if nothing in it is called
    function = _SINE_AND_COSINE.replace("static", "static inline") if batch else _SINE_AND_COSINE
    functions = f"{constants.strip()}\n{function}" if sines else ""
    own = _ROOT.format(inline="inline " * batch, **_ROOT_CONSTANTS[single]) if root else ""
    return f"{included}{kind}{functions}{own}"


# which values of a program stand where: array, component, and whether it is the same for all samples
Placed = Callable[[Array, int, bool], str]


class Printer(NamedTuple):
    """Statements in C of one sample of a program."""

    program: Program
    single: bool
    sines: Library  # where sine and cosine come from
    place: Placed
    root: str  # name of the function for square roots

    @property
    def scalar(self) -> str:
        """Type of a number."""
        return "float" if self.single else "double"

    def computed(self, values: Iterable[int]) -> list[str]:
        """Statements that compute values of the program, each from those before it."""
        program, single, scalar = self.program, self.single, self.scalar
        suffix = "f" if single else ""
        taken, _ = arrays(program)
        by_position = dict(zip((k for k, a in enumerate(program.arguments) if a.width), taken, strict=True))
        together = pairs(program)
        words: Mapping[str, str] = {
            "f": suffix,
            "root": self.root,
            "one": literal(1.0, single),
            "zero": literal(0.0, single),
        }
        lines = []
        for i in values:
            op = program.ops[i]
            if op.code == "in":
                argument, component = op.payload
                where = self.place(by_position[argument], component, program.arguments[argument].uniform)
                lines.append(f"const {scalar} x{i} = {where};")
            elif op.code in TOGETHER and self.sines == "own":
                if i == together[i][0]:
                    known = {program.ops[k].code: f"x{k}" for k in together[i]}
                    s, c = known.get("sin", f"x{i}_"), known.get("cos", f"x{i}_")
                    lines.append(f"{scalar} {s}, {c}; sine_and_cosine({self._at(op.operands[0])}, &{s}, &{c});")
            elif op.code in TOGETHER:
                lines.append(f"const {scalar} x{i} = {op.code}{suffix}({self._at(op.operands[0])});")
            else:
                sign, operands = OPS[op.code].infix, [self._at(k) for k in op.operands]
                text = f" {sign} ".join(operands) if sign else _CALLS[op.code].format(*operands, **words)
                lines.append(f"const {scalar} x{i} = {text};")
        return lines

    def written(self, array: Array, numbers: Mapping[int, Output]) -> list[str]:
        """Statements that write numbers of an output, by their place in it."""
        return [f"{self.place(array, j, False)} = {self._shown(v)};" for j, v in numbers.items()]

    def _at(self, i: int) -> str:
        op = self.program.ops[i]
        return literal(op.payload, self.single) if op.code == "const" else f"x{i}"

    def _shown(self, v: Output) -> str:
        if isinstance(v, float):
            return literal(v, self.single)
        index, negative = v
        return f"{literal(0.0, self.single)} - {self._at(index)}" if negative else self._at(index)


def root(single: bool, library: Library) -> str:
    """Name of the function for square roots."""
    return "root" if library == "own" else "sqrtf" if single else "sqrt"


def angles(program: Program, library: Library, among: Container[int] | None = None) -> str:
    """Sum of the sines among some values, which is NaN if an angle is out of reach; "": there are none, or none can be.

    `among`: the values; None: all of the program.
    """
    if library != "own":
        return ""
    first = [k for k, same in pairs(program).items() if k == same[0] and (among is None or k in among)]
    return " + ".join(f"x{k}" if program.ops[k].code == "sin" else f"x{k}_" for k in first)


def in_rows(array: Array, component: int, uniform: bool) -> str:
    """Place of a number of one sample."""
    return f"{array.name}[{component}]"


def function(program: Program, name: str, single: bool, library: Library = "math.h", finite: bool = True) -> str:
    """Text of the function of a program, without `preamble`; its status reports results that are not `finite`."""
    taken, given = arrays(program)
    printer = Printer(program, single, library, in_rows, root(single, library))
    read = {op.payload[0] for op in program.ops if op.code == "in"}
    wide = [k for k, a in enumerate(program.arguments) if a.width]
    lines = [f"(void){array.name};" for k, array in zip(wide, taken, strict=True) if k not in read]
    lines += printer.computed(recorded(program, {i for i, op in enumerate(program.ops) if op.code == "const"}))
    for array, result in zip(given, [r for r in outputs(program) if r.values], strict=True):
        lines += printer.written(array, dict(enumerate(result.values)))
    if sines := angles(program, library):
        lines.append(f"const {printer.scalar} angles = {sines};")
    wrong = " + ".join(f"(x{k} - x{k})" for k in computed_results(program)) if finite else ""
    if wrong:
        lines.append(f"const {printer.scalar} wrong = {wrong};")
    growth = f"{given[-1].name}[0]" if program.growth is not None else ""
    lines.append(f"return {status(single, growth, 'angles' if sines else '', 'wrong' if wrong else '')};")
    return f"{declaration(program, name, single)}\n{{\n{indented(lines)}}}\n"


def computed_results(program: Program) -> list[int]:
    """Values of a program that are results and no constants, each once."""
    found = (v[0] for r in program.results for v in r.values if not isinstance(v, float))
    return [k for k in dict.fromkeys(found) if program.ops[k].code != "const"]


def status(single: bool, growth: str, angles: str, wrong: str = "") -> str:
    """Expression for what a function returns: 1 where a result is not to be used, or 0.

    Names, or "" where there is none: of the error growth, of the sum of `angles`, which is NaN if one is out of reach,
    and of a number that is NaN if a result is wrong.
    """
    limit = literal(LARGEST_GROWTH.single if single else LARGEST_GROWTH.double, single)
    good = [*([f"{growth} <= {limit}"] if growth else []), *([f"{x} == {x}" for x in (angles, wrong) if x])]
    return f"({' && '.join(good)}) ? 0 : 1" if good else "0"
