"""Kernels of the backend "c" stay within their arrays and within C, under gcc's sanitizers.

Every array is allocated to its last number, and begins behind a number or two that do not belong to it, so that no row
is aligned; the batches end inside of vectors, inside of blocks and with them.
"""

import shutil
import subprocess
from dataclasses import replace

import pytest
from helpers import thinned

import torchdq
from torchdq.backends.c_loop import source, taken_as
from torchdq.numbers.functions import cos, exp, floor, log, maximum, sin, sqrt
from torchdq.program.loop import Loop, adjoint, with_states
from torchdq.program.program import Argument, outputs, record

SANITIZED = ("-O0", "-g", "-march=native", "-w", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
BATCHES = (0, 1, 2, 3, 5, 7, 8, 9, 15, 16, 17, 31, 33, 63, 64, 65, 100)
OFFSETS = (0, 1, 3)
STEPS = (3, 0, 1)  # of a loop, with each offset


def rows():
    """Program of rows with one number and more, with a uniform row and a sum."""

    def algorithm(a, b, c, u, *rows):
        x = a[0] + b[1] * c[2] + u[0]
        return {
            "one": [sin(x) + cos(200000.0 * x)],
            "two": [exp(x), log(maximum(x, 0.1))],
            "three": [sqrt(x * x), floor(c[0]), u[1]],
            "sum": [x, b[0] * u[0]],
            **{f"{len(row)} reversed": row[::-1] for row in rows},
        }

    arguments = [Argument("a", 1), Argument("b", 2), Argument("c", 3), Argument("u", 2, uniform=True)]
    arguments += [Argument(f"x{width}", width) for width in (4, 5, 7, 8, 9, 12, 15, 16, 17, 20)]
    return record("rows", arguments, algorithm, ("sum",))


def gradient():
    robot = torchdq.robots.load("two_link")
    return torchdq.compile(robot.replace(mass=robot.mass), "inverse_dynamics").vjp().program


def scene():
    return torchdq.Scene(torchdq.robots.load("two_link"), integrator=torchdq.scene.integrators.RungeKutta4()).program()


def loop():
    """Loop of rows of one number and more, which are carried, given or kept; with totals and a sum over samples."""
    widths = (1, 3, 9)  # all others are those of `rows`

    def algorithm(u, *rows):
        carried, given = rows[:3], rows[3:]
        pairs = list(zip(carried, given, strict=True))
        found = {f"x{len(x)}": [a * u[0] + b for a, b in zip(x, y, strict=True)] for x, y in pairs}
        found |= {f"kept {len(y)}": y[::-1] for y in given}
        found |= {f"total {len(x)}": [a * b for a, b in zip(x, y, strict=True)] for x, y in pairs}
        return {**found, "sum": [sin(x[0]) for x in carried]}

    rows = [Argument(f"{kind}{width}", width) for kind in "xy" for width in widths]
    body = record("loop", [Argument("u", 1, uniform=True), *rows], algorithm, ("sum",))
    return Loop(body, ((1, 0), (2, 1), (3, 2)), (4, 5, 6), (1, 3, 4, 5))  # of one width all states are kept


def adjoint_loop():
    """Adjoint of the loop; the cotangent of the uniform row is a sum, instead of its own."""
    whole = with_states(loop())
    sums = [r._replace(summed=False) for r in whole.body.results]
    return adjoint(replace(whole, body=replace(whole.body, results=tuple(sums))), (0, *whole.stepped))


PROGRAMS = {
    "a loop": loop,
    "its adjoint": adjoint_loop,
    "rows of any width": rows,
    "inverse dynamics": lambda: torchdq.compile(torchdq.robots.load("panda"), "inverse_dynamics").program,
    "forward dynamics": lambda: torchdq.compile(torchdq.robots.load("panda"), "forward_dynamics").program,
    "sums over samples": gradient,
    "a step of a scene": scene,
}
QUICK = [
    ("a loop", "double"),
    ("rows of any width", "float"),
    ("sums over samples", "double"),
]


def arrays(what):
    """Numbers of the arrays of a program's or a loop's arguments, and of those of its outputs, as text in C."""
    over = what if isinstance(what, Loop) else Loop(what, ())
    states = {r for _, r in over.carried}
    taken = [f"{a.width}" if a.uniform else f"{a.width} * n" for a in over.arguments]
    taken = [f"{size} * steps" if k in over.given else size for k, size in enumerate(taken)]
    given = [f"{len(r.values)}" if r.summed else f"{len(r.values)} * n" for r in outputs(over.body)]
    given = [f"{size} * (steps + {int(r in states)})" if r in over.kept else size for r, size in enumerate(given)]
    return taken, given


def harness(what, scalar):
    """C program that runs a kernel on arrays of exact sizes."""
    taken, given = arrays(what)
    sizes, plan, starts = [*taken, *given], "0", dict[int, str]()
    if isinstance(what, Loop):
        plan = f"(const long[]){{steps, n, {', '.join(map(str, taken_as(what)))}}}"
        states = [(r, f" + {what.body.arguments[k].width} * n") for k, r in what.carried if r in what.kept]
        starts = {} if what.backwards else {len(taken) + r: size for r, size in states}  # the caller writes the start
    made = "\n".join(
        f"    {scalar} *block{k} = malloc(sizeof({scalar}) * (offset + {size})), *x{k} = block{k} + offset;\n"
        f"    for (j = 0; j < {size}; j++) x{k}[j] = ({scalar})(0.5 + 0.4 * ((j * 7 + {k}) % 11) / 11);"
        for k, size in enumerate(sizes)
    )
    passed = ", ".join(f"x{k}{starts.get(k, '')}" for k in range(len(sizes)))
    freed = " ".join(f"free(block{k});" for k in range(len(sizes)))
    parameters = ", ".join([f"const {scalar} *"] * len(taken) + [f"{scalar} *"] * len(given))
    batches, offsets, steps = (", ".join(map(str, x)) for x in (BATCHES, OFFSETS, STEPS))
    return (
        f"#include <stdlib.h>\nvoid run(long, const long *, {parameters});\n"
        f"static void once(long n, long offset, long steps)\n{{\n    long j;\n{made}\n"
        f"    run(n, {plan}, {passed});\n    {freed}\n}}\n"
        f"int main(void)\n{{\n    const long batches[] = {{{batches}}}, offsets[] = {{{offsets}}};\n"
        f"    const long steps[] = {{{steps}}};\n"
        f"    for (int i = 0; i < {len(BATCHES)}; i++)\n"
        f"        for (int k = 0; k < {len(OFFSETS)}; k++) once(batches[i], offsets[k], steps[k]);\n    return 0;\n}}\n"
    )


@pytest.mark.skipif(not shutil.which("gcc"), reason="no gcc")
@pytest.mark.parametrize(("name", "scalar"), thinned([(x, y) for x in PROGRAMS for y in ("double", "float")], QUICK))
def test_a_kernel_stays_within_its_arrays(name, scalar, tmp_path):
    program = PROGRAMS[name]()
    (tmp_path / "kernel.c").write_text(source(program, scalar == "float"))
    (tmp_path / "main.c").write_text(harness(program, scalar))
    for command in (["gcc", *SANITIZED, "kernel.c", "main.c", "-o", "main", "-lm"], ["./main"]):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr
