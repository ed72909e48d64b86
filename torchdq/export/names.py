"""Names in exported files: which a function may have, and names for the arguments and results of a program."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable

from torchdq.errors import ArgumentError

_WORDS = (
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while "
    "bool catch class delete explicit export false friend mutable namespace new operator private protected public "
    "template this throw true try typename using virtual main "
)
_USED = (
    "S LANES samples steps first here lane status sine_and_cosine rows_to_lanes lanes_to_rows added angles slots wrong "
    "place zeros root HALF_PI_1 HALF_PI_2 HALF_PI_3 TWO_OVER_PI ROUND LARGEST SIN COS NAN INFINITY HUGE_VAL EOF NULL "
)
KEYWORDS = frozenset((_WORDS + _USED).split())  # words of C, of C++ and of the text here, which cannot be names

# functions of C's standard library (C99, section 7.1.3 reserves them); those of math.h have one for each precision
_MATH = (
    "acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh erf erfc exp exp2 expm1 fabs fdim floor fma "
    "fmax fmin fmod frexp hypot ilogb ldexp lgamma llrint llround log log10 log1p log2 logb lrint lround modf nan "
    "nearbyint nextafter nexttoward pow remainder remquo rint round scalbln scalbn sin sinh sqrt tan tanh tgamma trunc "
    "cabs cacos cacosh carg casin casinh catan catanh ccos ccosh cexp cimag clog conj cpow cproj creal csin csinh "
    "csqrt ctan ctanh"
)
_LIBRARY = (
    "clearerr fclose feof ferror fflush fgetc fgetpos fgets fopen fprintf fputc fputs fread freopen fscanf fseek "
    "fsetpos ftell fwrite getc getchar gets perror printf putc putchar puts remove rename rewind scanf setbuf setvbuf "
    "snprintf sprintf sscanf tmpfile tmpnam ungetc vfprintf vfscanf vprintf vscanf vsnprintf vsprintf vsscanf "
    "abort abs atexit atof atoi atol atoll bsearch calloc div exit free getenv labs ldiv llabs lldiv malloc mblen "
    "mbstowcs mbtowc qsort rand realloc srand strtod strtof strtol strtold strtoll strtoull strtoul system wcstombs "
    "wctomb memchr memcmp memcpy memmove memset strcat strchr strcmp strcoll strcpy strcspn strerror strlen strncat "
    "strncmp strncpy strpbrk strrchr strspn strstr strtok strxfrm isalnum isalpha isblank iscntrl isdigit isgraph "
    "islower isprint ispunct isspace isupper isxdigit tolower toupper asctime clock ctime difftime gmtime localtime "
    "mktime strftime time signal raise setjmp longjmp localeconv setlocale "
    # of glibc, which a call from a shared library would find first
    "step advance "
    # macros, and types
    "FILE BUFSIZ offsetof size_t ptrdiff_t stdin stdout stderr errno assert isfinite "
    "isinf isnan isnormal signbit fpclassify isgreater isless isunordered "
    # headers, whose place a header of the same name would take
    "complex ctype fenv inttypes iso646 limits locale math setjmp stdarg stdbool stddef stdint stdio stdlib string "
    "tgmath wchar wctype"
)
_MATH_NAMES = frozenset(f"{name}{kind}" for name in _MATH.split() for kind in ("", "f", "l"))
_LIBRARY_NAMES = _MATH_NAMES | set(_LIBRARY.split())
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)


def identifier(name: str, what: str, variables: Collection[str] = ()) -> str:
    """Name of a function that C and C++ accept, apart from variables of the files; raises with `what` if it is none."""
    if not isinstance(name, str) or not _IDENTIFIER.fullmatch(name) or name in KEYWORDS:
        raise ArgumentError(f"{what} must be a name that C accepts, such as arm_torques, found {name!r}")
    if name in _LIBRARY_NAMES:
        raise ArgumentError(f"{what} must not be a name of C's standard library, found {name!r}; take another")
    if name in variables:
        raise ArgumentError(f"{what} must differ from variables of the exported files, found {name!r}; take another")
    return name


def distinct(names: Iterable[str]) -> list[str]:
    """Names that C accepts instead of those of a program, all different, and none of a function that may be called."""
    found: list[str] = []
    for name in names:
        last = name.rpartition(".")[2].replace("'", "_bar")
        plain = re.sub(r"\W", "_", last, flags=re.ASCII).strip("_") or "x"
        taken = plain in KEYWORDS or plain in _MATH_NAMES or re.fullmatch(r"\d.*|x\d+", plain)
        plain = f"{plain}_" if taken else plain
        number, unique = 2, plain
        while unique in found:
            unique, number = f"{plain}_{number}", number + 1
        found.append(unique)
    return found
