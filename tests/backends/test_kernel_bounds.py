"""Kernels of the backend "c" stay within their arrays and within C, under gcc's sanitizers.

Every array is allocated to its last number, and begins behind a number or two that do not belong to it, so that no row
is aligned; the batches end inside of vectors, inside of blocks and with them.
"""

import shutil
import subprocess

import pytest
import torch

import torchdq
from torchdq.backends.c_source import source
from torchdq.numbers.functions import cos, exp, floor, log, maximum, sin, sqrt
from torchdq.program.program import Argument, outputs, record

SANITIZED = ("-O1", "-g", "-march=native", "-w", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
BATCHES = (0, 1, 2, 3, 5, 7, 8, 9, 15, 16, 17, 31, 33, 63, 64, 65, 100)
OFFSETS = (0, 1, 3)


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
    return torchdq.envs.Scene(
        torchdq.robots.load("two_link"), integrator=torchdq.scene.integrators.RungeKutta4()
    ).program()


PROGRAMS = {
    "rows of any width": rows,
    "inverse dynamics": lambda: torchdq.compile(torchdq.robots.load("panda"), "inverse_dynamics").program,
    "forward dynamics": lambda: torchdq.compile(torchdq.robots.load("panda"), "forward_dynamics").program,
    "sums over samples": gradient,
    "a step of a scene": scene,
}
QUICK = ("rows of any width", "inverse dynamics", "sums over samples")


def harness(program, scalar):
    """C program that runs a kernel on arrays of exact sizes."""
    taken = [("in", a.width, a.uniform) for a in program.arguments]
    given = [("out", len(r.values), r.summed) for r in outputs(program)]
    arrays = [*taken, *given]
    sizes = [f"{width}" if once else f"{width} * n" for _, width, once in arrays]
    made = "\n".join(
        f"    {scalar} *block{k} = malloc(sizeof({scalar}) * (offset + {size})), *x{k} = block{k} + offset;\n"
        f"    for (j = 0; j < {size}; j++) x{k}[j] = ({scalar})(0.5 + 0.4 * ((j * 7 + {k}) % 11) / 11);"
        for k, size in enumerate(sizes)
    )
    passed = ", ".join(f"x{k}" for k in range(len(arrays)))
    freed = " ".join(f"free(block{k});" for k in range(len(arrays)))
    parameters = ", ".join([f"const {scalar} *"] * len(taken) + [f"{scalar} *"] * len(given))
    batches, offsets = (", ".join(map(str, x)) for x in (BATCHES, OFFSETS))
    return (
        f"#include <stdlib.h>\nvoid run(long samples, {parameters});\n"
        f"static void once(long n, long offset)\n{{\n    long j;\n{made}\n    run(n, {passed});\n    {freed}\n}}\n"
        f"int main(void)\n{{\n    const long batches[] = {{{batches}}}, offsets[] = {{{offsets}}};\n"
        f"    for (int i = 0; i < {len(BATCHES)}; i++)\n"
        f"        for (int k = 0; k < {len(OFFSETS)}; k++) once(batches[i], offsets[k]);\n    return 0;\n}}\n"
    )


@pytest.mark.skipif(not shutil.which("gcc"), reason="no gcc")
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.exhaustive) for name in PROGRAMS]
)
def test_a_kernel_stays_within_its_arrays(name, dtype, tmp_path):
    program, single = PROGRAMS[name](), dtype == torch.float32
    (tmp_path / "kernel.c").write_text(source(program, single))
    (tmp_path / "main.c").write_text(harness(program, "float" if single else "double"))
    for command in (
        ["gcc", *SANITIZED, "kernel.c", "main.c", "-o", "main", "-lm"],
        ["./main"],
    ):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stdout + done.stderr
