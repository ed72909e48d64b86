"""C99 text of a square root that needs no library: exact scaling, Newton's method, and one corrected step.

The first guess of 1/sqrt(x) has half of the exponent's bits of x; Newton's steps double its digits. The remainder
x - y^2 of the root y found is computed with y in two parts, whose products are exact, so the last step leaves an error
of little more than half a unit in the last place, with fused multiplications and without.

Source: the guess is that of Lomont (2003), "Fast inverse square root"; parts and remainder are those of Dekker (1971).
"""

from __future__ import annotations

# width of the integer, guess, upper half of the digits, scaling of numbers that are far from one, steps
_DOUBLE = ("uint64_t", "UINT64_C(0x5fe6eb50c7b537a9)", "~UINT64_C(0x7ffffff)", "700", "400", "200", "DBL_MAX", 4)
_FLOAT = ("uint32_t", "UINT32_C(0x5f375a86)", "~UINT32_C(0xfff)", "90", "60", "30", "FLT_MAX", 3)

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


def text(single: bool, inline: bool) -> str:
    """Function `root` of the type S, which is in single or double precision; `inline`: for loops."""
    bits, guess, mask, far, scale, half, largest, steps = _FLOAT if single else _DOUBLE
    return _ROOT.format(
        inline="inline " if inline else "",
        bits=bits,
        guess=guess,
        mask=mask,
        far=far,
        scale=scale,
        half=half,
        largest=largest,
        steps="    r = r * ((S)1.5 - ((S)0.5 * z * r) * r);\n" * steps,
    )
