"""C99 text of a program: a function of one sample, in straight lines, without memory of its own.

It has no heap, no static state, no recursion and no loop, and takes the same operations whatever the data. Everything
is read before anything is written, so an output may be the array of an input.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping
from typing import Literal, NamedTuple

import numpy as np

from torchdq.backends.c_constants import SINES_DOUBLE, SINES_FLOAT, TURN
from torchdq.backends.emitter import Dialect, Emitter, functions
from torchdq.errors import ArgumentError
from torchdq.export.names import distinct
from torchdq.program.order import TOGETHER, pairs, recorded
from torchdq.program.program import LARGEST_GROWTH, Output, Program, outputs

Library = Literal["math.h", "own"]
MANY = {"batch": "samples", "rollout": "steps"}  # functions of many rows, and their number

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
@TURN@    const S zero = 0, none = zero / zero;
    const S quarter = k - 4 * ((k * (S)0.25 + ROUND) - ROUND);
    const int odd = (quarter == 1) | (quarter == -1), half = (quarter == 2) | (quarter == -2);
    const int inside = (x <= LARGEST) & (x >= -LARGEST);
    const S a = odd ? cr : sr, b = odd ? sr : cr;
    *s = inside ? ((half | (quarter == -1)) ? -a : a) : none;
    *c = inside ? ((half | (quarter == 1)) ? -b : b) : none;
}
""".replace("@TURN@", TURN.replace("  T ", "    const S "))

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


# place of a number: array, component, and whether it is the same for all samples
Placed = Callable[[Array, int, bool], str]


def in_rows(array: Array, component: int, uniform: bool) -> str:
    """Place of a number of one sample."""
    return f"{array.name}[{component}]"


def arrays(program: Program) -> tuple[dict[int, Array], dict[int, Array]]:
    """Arguments and outputs of the function of a program, by their positions; those without numbers are left out."""
    taken = {k: Array(a.name, a.width, a.uniform) for k, a in enumerate(program.arguments) if a.width}
    given = {k: Array(r.name, len(r.values), r.summed) for k, r in enumerate(outputs(program)) if r.values}
    names = iter(distinct(a.name for side in (taken, given) for a in side.values()))
    taken, given = ({k: a._replace(name=next(names)) for k, a in side.items()} for side in (taken, given))
    return taken, given


class CFunction(NamedTuple):
    """Program as a function of one sample in C99."""

    program: Program
    name: str
    single: bool
    functions: Library  # where sine, cosine and roots come from
    vectors: bool = False  # whether sine and cosine are its own in any case, since compilers have no vectors of others

    @property
    def own_sines(self) -> bool:
        """Whether sine and cosine are its own."""
        return self.functions == "own" or self.vectors

    @property
    def number(self) -> str:
        """Type of a number."""
        return "float" if self.single else "double"

    @property
    def taken(self) -> list[Array]:
        """Arguments, but for those without numbers."""
        return list(arrays(self.program)[0].values())

    @property
    def given(self) -> list[Array]:
        """Outputs, but for those without numbers."""
        return list(arrays(self.program)[1].values())

    @property
    def dialect(self) -> Dialect:
        """Dialect of C99."""
        number, zero, f, own = self.number, f"({self.number})0", "f" * self.single, self.functions == "own"
        return Dialect(
            number,
            lambda x: f"{np.float32(x)!s}f" if f else repr(x),  # the shortest that is read as this number
            nan=f"({zero} / {zero})",
            infinite=f"({number})1 / {zero}",
            call=lambda code: "root" if own and code == "sqrt" else f"{code}{f}",
            turn=f"{number} {{sin}}, {{cos}}; sine_and_cosine({{angle}}, &{{sin}}, &{{cos}});" * self.own_sines,
        )

    def declaration(self, many: str = "") -> str:
        """Declaration without the semicolon, of one sample or of `MANY` rows, the arrays one after the other."""
        shown = "{0} *{1.name}" if many else "{0} {1.name}[{1.size}]"
        parameters = [f"size_t {MANY[many]}"] if many else []
        parameters += [shown.format(f"const {self.number}", a) for a in self.taken]
        parameters += [shown.format(self.number, a) for a in self.given]
        return f"int {self.name}{f'_{many}' if many else ''}({', '.join(parameters) or 'void'})"

    def emitter(self, place: Placed = in_rows) -> Emitter:
        """Printer of its values; `place` is where numbers of its arguments stand."""
        taken, _ = arrays(self.program)
        return Emitter(self.program, self.dialect, lambda k, j: place(taken[k], j, taken[k].shared))

    def preamble(self) -> str:
        """Text in front of such functions: what they include, and their own sine, cosine and root if they have them."""
        single, own, codes = self.single, self.functions == "own", {op.code for op in self.program.ops}
        wanted = [code for code in functions() if code in codes]
        lacks = sorted(set(wanted) - {"sqrt", *TOGETHER})
        if own and lacks:
            raise ArgumentError(
                f"library must be 'math.h' for {self.program.name}, which takes {', '.join(lacks)}; 'own' has sine, "
                "cosine and square root"
            )
        sines, root = self.own_sines and not codes.isdisjoint(TOGETHER), own and "sqrt" in codes
        # gcc makes vectors of a loop only if nothing in it is called
        inline = "inline " * self.vectors
        texts = [
            "#include <math.h>\n" if wanted and not own else "",
            "#include <stdint.h>\n" if root else "",
            _WITH_NAN,
            _EXACT if sines or root else "",
            f"typedef {self.number} S;\n" if sines or root or self.vectors else "",
            f"{(SINES_FLOAT if single else SINES_DOUBLE).strip()}\n" if sines else "",
            _SINE_AND_COSINE.replace("static ", f"static {inline}") if sines else "",
            _ROOT.format(inline=inline, **_ROOT_CONSTANTS[single]) if root else "",
        ]
        return "".join(texts)

    def text(self, finite: bool = True) -> str:
        """Text of the function, without `preamble`; its status reports results that are not `finite`."""
        program, (taken, given), emitter = self.program, arrays(self.program), self.emitter()
        read = {op.payload[0] for op in program.ops if op.code == "in"}
        lines = [f"(void){array.name};" for k, array in taken.items() if k not in read]
        lines += emitter.statements(recorded(program))
        for k, array in given.items():
            lines += written(emitter, in_rows, array, dict(enumerate(outputs(program)[k].values)))
        if sines := self.angles():
            lines.append(f"const {self.number} angles = {sines};")
        wrong = " + ".join(f"(x{k} - x{k})" for k in computed_results(program)) if finite else ""
        if wrong:
            lines.append(f"const {self.number} wrong = {wrong};")
        lines.append(f"return {self.status(self.growth(), 'angles' * bool(sines), 'wrong' * bool(wrong))};")
        return f"{self.declaration()}\n{{\n{indented(lines)}}}\n"

    def angles(self, among: Container[int] | None = None) -> str:
        """Sum of the own sines among some values, which is NaN if an angle is out of reach; "" if there are none.

        `among`: the values; None: all of the program.
        """
        if not self.own_sines:
            return ""
        first = [k for k, same in pairs(self.program).items() if k == same[0] and (among is None or k in among)]
        return " + ".join(f"x{k}" if self.program.ops[k].code == "sin" else f"x{k}_" for k in first)

    def growth(self, place: str = "{}[0]") -> str:
        """Place of the error growth; "": there is none."""
        return "" if self.program.growth is None else place.format(self.given[-1].name)

    def status(self, growth: str, angles: str, wrong: str = "") -> str:
        """Expression for what a function returns: 1 where a result is not to be used, or 0.

        Names, or "" where there is none: of the error growth, of the sum of `angles`, which is NaN if one is out of
        reach, and of a number that is NaN if a result is wrong.
        """
        limit = self.dialect.literal(LARGEST_GROWTH.single if self.single else LARGEST_GROWTH.double)
        good = [*([f"{growth} <= {limit}"] if growth else []), *([f"{x} == {x}" for x in (angles, wrong) if x])]
        return f"({' && '.join(good)}) ? 0 : 1" if good else "0"


def written(emitter: Emitter, place: Placed, array: Array, numbers: Mapping[int, Output]) -> list[str]:
    """Statements that write numbers of an output, by their place in it."""
    return [f"{place(array, j, False)} = {emitter.output(v)};" for j, v in numbers.items()]


def computed_results(program: Program) -> list[int]:
    """Values of a program that are results and no constants, each once."""
    found = (v[0] for r in program.results for v in r.values if not isinstance(v, float))
    return [k for k in dict.fromkeys(found) if program.ops[k].code != "const"]


def comment(lines: Iterable[str]) -> str:
    """Comment of several lines, in ASCII, whatever the names in it are."""
    plain = [line.encode("unicode_escape").decode("ascii") for line in lines]
    for mark in ("*/", "/*", "??"):  # ends of comments, and trigraphs
        plain = [line.replace(mark, " ".join(mark)) for line in plain]
    return "/*\n" + "\n".join(f" * {line}".rstrip() for line in plain) + "\n */\n"


def indented(lines: Iterable[str], by: int = 4) -> str:
    """Text of lines."""
    return "".join(f"{' ' * by}{line}\n" for line in lines)
