"""Exported programs are strict C99 that computes what the programs compute, bit for bit, outside of Python."""

import ctypes
import dataclasses
import math
import re
import shutil
import subprocess
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from exporting import COMPILERS, F64, PROGRAMS, STRICT, TWO, loaded, needs, passes_its_test, run
from helpers import thinned
from messages import refused

import torchdq
from torchdq import Scene, effects
from torchdq.errors import ArgumentError
from torchdq.export import c99
from torchdq.functions.compile import CompiledProgram
from torchdq.numbers.functions import exp, sqrt
from torchdq.program.program import Argument, outputs, record, replay
from torchdq.scene import controllers

GCC = needs("gcc")


# one of each kind: of an arm, with numbers that all samples share, on a base that moves, with comparisons and roots
KINDS = ("inverse dynamics", "gradient in parameters", "floating base", "scene with limits")
BUILDS = list(product(PROGRAMS, ("float64", "float32"), ("gcc", "clang")))


@pytest.mark.parametrize(
    ("name", "dtype", "compiler"),
    thinned(
        BUILDS,
        [
            *product(("scene with limits", "derivatives", "a trained layer"), ("float64",), ("gcc",)),
            ("gradient in parameters", "float32", "gcc"),
            *product(KINDS, ("float64",), ("clang",)),
        ],
    ),
)
def test_files_are_strict_c99_and_their_test_of_a_sample_and_of_a_batch_passes(name, dtype, compiler, tmp_path):
    if not shutil.which(compiler):
        pytest.skip(f"no {compiler}")
    made = PROGRAMS[name](dtype).export(tmp_path, "exported", batch=True)
    assert "largest relative difference" in passes_its_test(made, "-O2", compiler=compiler)


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("name", thinned(["computed torque of an arm", "computed torque"], ("computed torque",)))
def test_the_loop_over_samples_becomes_vector_instructions(name, compiler, tmp_path):
    made = PROGRAMS[name]("float64").export(tmp_path, "exported", batch=True)
    said = {"gcc": "-fopt-info-vec-optimized", "clang": "-Rpass=loop-vectorize"}[compiler]
    # for the processor that the compiler assumes: wider ones have more instructions, and no loop that needs them
    flags = ("-std=c99", "-O3", said, "-I", str(tmp_path), "-c", "-o", str(tmp_path / "f.o"))
    done = subprocess.run([compiler, *flags, str(made.source)], capture_output=True, text=True, timeout=300)
    line = 1 + made.source.read_text().split("\n").index("    for (lane = 0; lane < LANES; lane++) {")
    assert re.search(rf"exported\.c:{line}:.*vectorized", done.stderr), done.stderr


@GCC
@pytest.mark.parametrize("name", thinned(PROGRAMS, KINDS[1:]))
def test_nothing_is_read_or_written_out_of_bounds(name, tmp_path):
    made = PROGRAMS[name]("float64").export(tmp_path, "exported", "own", batch=True)
    passes_its_test(made, "-O0", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g")


def called(made, program, rows):
    """Status and outputs of an exported function on one sample."""
    function = getattr(loaded(made), made.function)
    given = [(ctypes.c_double * len(row))(*row) for row in rows]
    found = [(ctypes.c_double * len(r.values))() for r in outputs(program) if r.values]
    return function(*given, *found), [list(x) for x in found]


def replayed(program, rows):
    """Results of a program in Python's arithmetic."""
    values = replay(program, rows)
    return [
        [v if isinstance(v, float) else 0.0 - values[v[0]] if v[1] else values[v[0]] for v in result.values]
        for result in outputs(program)
        if result.values
    ]


@GCC
@pytest.mark.parametrize("name", thinned(PROGRAMS, (*KINDS, "operational space")))
def test_results_are_those_of_the_program_in_pythons_arithmetic_bit_for_bit(name, tmp_path):
    compiled = PROGRAMS[name]("float64")
    made = compiled.export(tmp_path, "exported")
    program = compiled.program
    generator = torch.Generator().manual_seed(1)
    rows = [(torch.rand(a.width, generator=generator, dtype=F64) + 0.1).tolist() for a in program.arguments]
    status, found = called(made, program, rows)
    assert status == 0 and found == replayed(program, rows)


@GCC
def test_an_angle_out_of_reach_is_nan_and_told_by_the_status(tmp_path):
    compiled = torchdq.compile(TWO, "forward_kinematics", options=("tip",))
    made = compiled.export(tmp_path, "exported", "own", batch=True)
    for q in ([0.3, -0.7], [1e4, -9e4], [1e5, -1e5]):
        status, (found,) = called(made, compiled.program, [q])
        (row,) = replayed(compiled.program, [q])
        assert status == 0
        assert max(abs(a - b) for a, b in zip(found, row, strict=True)) <= 4 * 2.0**-52 * max(map(abs, row))
    for far in ([1e6, 1e6], [0.1, -1e6], [math.nan, 0.0], [0.0, math.inf]):
        status, (found,) = called(made, compiled.program, [far])
        assert status == 1 and math.isnan(found[0])
    told = "Returns 1 where a result is not finite or an angle is NaN or beyond 1e5 rad, else 0."
    assert told in made.header.read_text()
    batch = loaded(made).exported_batch
    for samples in (1, 16, 37):
        q, X = (ctypes.c_double * (2 * samples))(), (ctypes.c_double * (8 * samples))()
        assert batch(ctypes.c_size_t(samples), q, X) == 0
        q[2 * samples - 1] = 1e6
        assert batch(ctypes.c_size_t(samples), q, X) == 1


def hard_roots(single):
    """Squares, neighbours of squares, of powers of two and of midpoints, the largest and smallest, and random ones."""
    real, digits = (np.float32, 24) if single else (np.float64, 53)
    info, rng = np.finfo(real), np.random.default_rng(0)
    roots = rng.integers(2 ** (digits // 2 - 1), 2 ** (digits // 2), 2000).astype(real)
    powers = real(2.0) ** np.arange(info.minexp, info.maxexp, dtype=real)
    # near a midpoint between two numbers y and y + u: squares of (y + u/2)
    halves = ((1 + rng.random(2000)).astype(real).astype(np.longdouble) + info.eps / np.longdouble(2)) ** 2
    x = np.concatenate([roots**2, powers, halves.astype(real), (1 + 3 * rng.random(4000)).astype(real)])
    with np.errstate(over="ignore"):
        x = np.concatenate([x, x * real(2.0) ** rng.integers(-60, 60, x.size).astype(real)])
        x = np.concatenate([np.nextafter(x, real(0)), x, np.nextafter(x, real(np.inf))])
    ends = [info.max, np.nextafter(info.max, real(0)), info.tiny, info.smallest_subnormal, 0.0, 1e-40]
    return np.concatenate([x[np.isfinite(x)], np.array(ends, real)])


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("flags", ["-std=c99 -O2 -ffp-contract=off", "-O3 -march=native -ffp-contract=fast"])
@pytest.mark.parametrize("compiler", COMPILERS)
def test_own_roots_are_within_an_ulp_and_correctly_rounded_but_close_to_midpoints(flags, compiler, dtype, tmp_path):
    single = dtype == "float32"
    program = record("roots", [Argument("x", 1)], lambda x: {"y": (sqrt(x[0]),)})
    made = CompiledProgram(program, getattr(torch, dtype), ((1,),)).export(tmp_path, "exported", "own", batch=True)
    assert "math.h" not in made.source.read_text()
    library = loaded(made, *flags.split(), *STRICT[1:], compiler=compiler)
    real = ctypes.c_float if single else ctypes.c_double
    x = hard_roots(single)
    for batch in (True, False):
        y = np.zeros_like(x)
        given = [v.ctypes.data_as(ctypes.POINTER(real)) for v in (x, y)]
        if batch:
            assert library.exported_batch(ctypes.c_size_t(len(x)), *given) == 0
        else:
            for k in range(0, len(x), 17):
                at = [ctypes.cast(ctypes.byref(p.contents, k * x.itemsize), type(p)) for p in given]
                assert library.exported(*at) == 0
        expected = np.sqrt(x)
        off = np.abs(y - expected)[:: 1 if batch else 17] / np.spacing(expected)[:: 1 if batch else 17]
        assert off.max() <= 1 and (off == 0).mean() > 0.95
    for odd, root in ((math.inf, math.inf), (0.0, 0.0), (-0.0, -0.0), (-1.0, math.nan), (math.nan, math.nan)):
        x, y = real(odd), real(5.0)
        library.exported(ctypes.byref(x), ctypes.byref(y))
        assert str(y.value) == str(root)


RUBBED = torchdq.ComputedTorque(TWO, 25.0, 10.0, friction=(effects.Viscous(0.2), effects.Coulomb(0.5)))
TOLD = {
    "a controller with friction": lambda: torchdq.compile(RUBBED.program()),
    "a step": PROGRAMS["scene with limits"],
    "computed torque": lambda: torchdq.compile(TWO, controllers.ComputedTorque(9.0, 6.0)),
}
LIBRARIES = list(product(TOLD, ("math.h", "own")))


@GCC
@pytest.mark.parametrize(("name", "library"), thinned(LIBRARIES, [*LIBRARIES[::2], ("a step", "own")]))
def test_what_is_not_a_number_stays_so_and_is_told_by_the_status(name, library, tmp_path):
    compiled = TOLD[name]()
    made, program = compiled.export(tmp_path, "exported", library, batch=True), compiled.program
    assert "Returns 1 where a result is not finite" in made.header.read_text()
    functions, wide = loaded(made, "-std=c99", "-O0"), [a for a in program.arguments if a.width]
    sizes = [len(r.values) for r in outputs(program) if r.values]
    for k, a in enumerate(wide):
        for bad in (math.nan, math.inf, 0.1):
            rows = [(ctypes.c_double * a.width)(*[0.2] * a.width) for a in wide]
            rows[k][a.width - 1] = bad
            found = [(ctypes.c_double * size)() for size in sizes]
            status = functions.exported(*rows, *found)
            assert status == (0 if bad == 0.1 else 1)
            assert all(math.isfinite(x) for row in found for x in row) == (bad == 0.1)
            many = [(ctypes.c_double * (11 * a.width))(*[0.2] * (11 * a.width)) for a in wide]
            many[k][9 * a.width - 1] = bad  # in the second block
            room = [(ctypes.c_double * (11 * size))() for size in sizes]
            assert functions.exported_batch(ctypes.c_size_t(11), *many, *room) == status


def test_a_header_has_the_numbers_of_controller_and_friction(tmp_path):
    learned = torchdq.DQRNEA(TWO, learn="friction")
    learned.viscous = torch.tensor([0.25, 0.5], dtype=F64)
    layer = torchdq.ComputedTorque(learned, torch.tensor([25.0, 16.0]), 10.0)
    step = Scene(TWO, (effects.Viscous((0.1, 0.2)), effects.Coulomb(torch.ones(2))), controllers.PD(9.0, 1.5)).program()
    none = torchdq.DQRNEA(TWO, friction=(effects.Coulomb(0.0),)).program()
    nothing = Scene(TWO, (effects.Coulomb(0.0), effects.Viscous(0.1))).program()
    programs = {"layer": layer.program(), "arguments": layer.program(parameters="arguments"), "step": step}
    programs |= {"none": none, "nothing": nothing}
    text = {
        name: torchdq.compile(program).export(tmp_path / name, "f").header.read_text()
        for name, program in {**programs, "pd": controllers.PD(9.0, (1.5, 2.0)).program(TWO)}.items()
    }
    for line in (
        "kp = 25, 16: gains of the position errors [1/s^2]",
        "kd = 10: gains of the velocity errors [1/s]",
        "gravity = 0, -9.81, 0: gravitational acceleration in the base frame [m/s^2]",
        "friction: Viscous(coefficient=(0.25, 0.5))",
        "friction at rest = 0.01 [N m or N]",
        "friction at 1 rad/s or m/s = 0.26, 0.51 [N m or N]",
    ):
        assert f" * {line}\n" in text["layer"]
    assert " * friction: none\n" in text["none"] and "Coulomb" not in text["none"] + text["nothing"]
    assert " * effect 1: Viscous(coefficient=0.1)\n * friction at rest = 0 [N m or N]\n" in text["nothing"]
    assert "friction at" not in text["arguments"] + text["step"]  # whose friction is not known
    assert "coefficient=argument)" in text["arguments"] and "in   viscous[2]  viscous friction" in text["arguments"]
    assert "effect 0: Viscous(coefficient=(0.1, 0.2))" in text["step"]
    assert "coulomb=argument" in text["step"] and "controller: PD(kp=9, kd=1.5)" in text["step"]
    assert "PD(kp=9, kd=(1.5, 2))\n * friction: none\n" in text["pd"]
    assert all("joints in the order of q: joint1, joint2" in x for x in text.values())


def test_a_header_of_rigid_bodies_has_their_gravity_and_says_that_friction_is_left_out(tmp_path):
    robot = TWO.replace(damping=torch.tensor([0.1, 0.2], dtype=F64)).bake()
    functions = ["inverse_dynamics", "regressor", "computed_torque", "mass_matrix"]
    made = {name: torchdq.compile(robot, name).export(tmp_path / name, "f") for name in functions}
    text = {name: one.header.read_text() for name, one in made.items()}
    left = "friction: none; that of the description is left out"
    assert all((left in x) == (name != "mass_matrix") for name, x in text.items())
    gravity = "gravity = 0, -9.81, 0: gravitational acceleration in the base frame [m/s^2]"
    assert gravity in text["inverse_dynamics"] and gravity in text["regressor"] and "gravity" not in text["mass_matrix"]


def test_a_full_disk_leaves_the_files_of_before(tmp_path, monkeypatch):
    compiled = torchdq.compile(TWO, "inverse_dynamics")
    before = {path: path.read_text() for path in compiled.export(tmp_path, "f")[1:]}
    calls, write = [], Path.write_bytes

    def full(path, data):
        calls.append(path)
        if len(calls) == 3:
            raise OSError(28, "No space left on device")
        write(path, data)

    monkeypatch.setattr(Path, "write_bytes", full)
    with refused(ArgumentError):
        compiled.export(tmp_path, "f", "own", batch=True)
    assert {path: path.read_text() for path in before} == before
    assert {*tmp_path.iterdir()} == {*before, tmp_path / "exported_f.cmake"}


FLAGS = (
    "-O3 -ffast-math",
    "-O3 -funsafe-math-optimizations",
    "-O2 -fassociative-math -fno-signed-zeros -fno-trapping-math",
    "-O2 -ffinite-math-only",
    "-O2 -mfpmath=387",
    "-O2 -freciprocal-math",
    "-O3 -ffp-contract=fast -march=native",
)


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize(
    ("flags", "dtype"),
    thinned(
        list(product(FLAGS, ("float64", "float32"))),
        [*product(FLAGS, ("float64",)), *product((FLAGS[0], FLAGS[-1]), ("float32",))],
    ),
)
def test_flags_that_break_sine_and_cosine_are_refused_or_harmless(flags, dtype, compiler, tmp_path):
    compiled = torchdq.compile(TWO, "forward_kinematics", dtype, options=("tip",))
    made = compiled.export(tmp_path, "exported", "own", batch=True)
    compiled_file, library = (str(tmp_path / f"exported.{kind}") for kind in ("o", "so"))
    build = (compiler, *flags.split(), "-fPIC", "-I", str(tmp_path), "-c", str(made.source), "-o", compiled_file)
    done = subprocess.run(build, capture_output=True, text=True, timeout=300)
    if done.returncode:
        assert "compile this file" in done.stderr or "387" in done.stderr, done.stderr
        return
    # linked without these flags, with which gcc would turn off subnormal numbers in the process of the tests
    run(compiler, "-shared", compiled_file, "-o", library, "-lm")
    functions, real = ctypes.CDLL(library), ctypes.c_double if dtype == "float64" else ctypes.c_float
    eps = 2.0**-52 if dtype == "float64" else 2.0**-23
    angles = [0.3, -0.7, 3.0, 1234.5, 3999.0, -2000.25]
    for far in (False, True):
        q = (real * 6)(*angles[:5], 1e6 if far else angles[5])
        X, status = (real * 24)(), functions.exported_batch
        assert status(ctypes.c_size_t(3), q, X) == far
    for k in (0, 2, 4):
        q, X = (real * 2)(*angles[k : k + 2]), (real * 8)()
        assert functions.exported(q, X) == 0
        # the arm turns about z: the pose is a turn by the sum of the angles
        half = (q[0] + q[1]) / 2
        assert abs(abs(X[0]) - abs(math.cos(half))) <= 16 * eps and abs(abs(X[3]) - abs(math.sin(half))) <= 16 * eps


def test_the_panda_fits_in_sixty_kilobytes(tmp_path):
    made = [
        PROGRAMS[x]("float64").export(tmp_path, x.replace(" ", "_"))
        for x in ("inverse dynamics", "computed torque of an arm")
    ]
    assert sum(one.source.stat().st_size for one in made) <= 60_000


def test_everything_in_a_header_has_words_and_the_joints_have_an_order(tmp_path):
    for name in thinned(PROGRAMS, (*KINDS[1:], "closed form", "control of a frame", "a trained layer")):
        compiled = PROGRAMS[name]("float64")
        for k, one in enumerate((compiled, compiled.vjp())):
            text = one.export(tmp_path / f"{name}{k}", "exported", batch=True).header.read_text()
            described = re.findall(r"^ \* (?:in |out)  (\S+)(.*)$", text, re.MULTILINE)
            assert described and all(words.strip() for _, words in described), (name, described)
            assert "joints in the order of q: " in text and "of robot " in text


ARM = ("arm-none-eabi-gcc", "-mcpu=cortex-m7", "-mthumb", "-mfpu=fpv5-d16", "-mfloat-abi=hard", "-Wdouble-promotion")


@needs(ARM[0])
@pytest.mark.parametrize("library", ["math.h", "own"])
def test_torques_and_controller_of_the_panda_fit_into_a_cortex_m7(library, tmp_path):
    total = 0
    for name in ("inverse dynamics", "computed torque of an arm"):
        made = PROGRAMS[name]("float32").export(tmp_path / name, "f", library)
        built = str(tmp_path / "f.o")
        run(*ARM, *STRICT, "-I", str(tmp_path / name), "-c", str(made.source), "-o", built)
        text, data, bss = map(int, run("arm-none-eabi-size", built).splitlines()[1].split()[:3])
        assert data == bss == 0  # no memory of its own
        total += text
        wanted = set(run("arm-none-eabi-nm", "-u", built).split()) - {"U"}
        assert wanted == ({"sinf", "cosf"} if library == "math.h" else set())
    assert total <= 32 * 1024


@GCC
def test_a_mass_matrix_that_is_not_positive_is_told_by_the_status(tmp_path):
    compiled = PROGRAMS["parameters"]()
    made = compiled.export(tmp_path, "exported")
    rows = {"q": [0.1, 0.2], "qd": [0.0, 0.0], "tau": [1.0, 1.0], "mass": [1.0, -1.0], "inertia": [0.0] * 12}
    status, _ = called(made, compiled.program, [rows[a.name] for a in compiled.program.arguments])
    assert status == 1


NAMES = ("two words", "double", "1st", "größe", "class", "tgamma", "printf", "step", "fmaxf", "SIN", "ROUND", "math")
GROWING = record("growing", [Argument("x", 1)], lambda x: {"y": (exp(x[0]),)})
MISUSE = {
    **{
        f"name {name}": lambda folder, name=name: torchdq.compile(TWO, "inverse_dynamics").export(folder, name)
        for name in (*NAMES, "in_q", "worst", "found_tau")
    },
    "a step with the name of a state": lambda folder: PROGRAMS["scene"]().export(folder, "q"),
    "what its own library lacks": lambda folder: CompiledProgram(GROWING, F64, ((1,),)).export(folder, "f", "own"),
    "a function of a program": lambda folder: torchdq.compile(PROGRAMS["scene"]().program, "inverse_dynamics"),
}


def test_what_cannot_be_exported_is_refused_and_nothing_is_written(tmp_path):
    for name, export in MISUSE.items():
        with refused(ArgumentError):
            export(tmp_path)
        assert not list(tmp_path.iterdir()), name


@GCC
@pytest.mark.parametrize("name", thinned(["tau", "q", "expected", "first_", "largest", "x1"], ["tau", "expected"]))
def test_a_function_may_have_the_name_of_an_argument_or_a_result(name, tmp_path):
    passes_its_test(torchdq.compile(TWO, "inverse_dynamics").export(tmp_path, name, "own", batch=True), "-O0")


ODD = ("größe", "Δ*/int", "/* x", "line\nbreak", "x??/", "end\\", "\u202eabc", "%s%n")


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize("language", ["c", "casadi"])
def test_any_names_of_joints_and_robots_make_files_in_ascii_that_build(language, compiler, tmp_path):
    lines = [line for name in ODD for line in (f"robot {name}", f"joints in the order of q: {name}, {name}")]
    compiled = dataclasses.replace(torchdq.compile(TWO, "inverse_dynamics"), about=tuple(lines))
    made = compiled.export(tmp_path, "exported", language=language)
    assert made.source.read_bytes().isascii()
    run(compiler, *STRICT, "-I", str(tmp_path), "-c", str(made.source), "-o", str(tmp_path / "f.o"))
    assert r"robot gr\xf6\xdfe" in c99.comment(["robot größe"])


@needs("cmake")
def test_functions_in_one_folder_are_built_and_tested_together_also_if_cmake_reserves_their_names(tmp_path):
    compiled = torchdq.compile(TWO, "inverse_dynamics")
    names = thinned(("torques", "test", "all", "install"), ("torques", "test"))
    for name in names:
        made = compiled.export(tmp_path, name, "own" if name == "torques" else "math.h", batch=True)
    assert made.cmake == tmp_path / "CMakeLists.txt"
    for build in thinned((tmp_path / "build", tmp_path), (tmp_path,)):  # also in the folder itself
        run("cmake", "-S", str(tmp_path), "-B", str(build))
        run("cmake", "--build", str(build))
        assert (build / "libtorques.a").is_file()
    said = run("ctest", "--test-dir", str(tmp_path))
    assert "100% tests passed" in said and f"out of {len(names)}" in said


def test_a_function_has_no_memory_loops_or_branches_and_its_header_says_order_shapes_and_units(tmp_path):
    made = PROGRAMS["inverse dynamics"]("float64").export(tmp_path)
    code = re.sub(r"(?m)^#.*$", "", made.source.read_text().split("*/", 1)[1])  # without lines of the preprocessor
    assert not re.search(r"\b(static|for|while|if|goto|malloc|switch)\b", code)
    text = made.header.read_text()
    assert "panda_joint1, panda_joint2" in text and "qdd[7]  joint accelerations [rad/s^2 or m/s^2]" in text
    assert made.function == "inverse_dynamics_panda"
    assert 'extern "C"' in text and "int inverse_dynamics_panda(const double q[7]," in text


def cpp(made, text, standard="-std=c++20"):
    """Output of a program in C++ with an exported function."""
    folder = made.source.parent
    (folder / "main.cpp").write_text(f'#include "{made.spans.name}"\n#include "{made.spans.name}"\n{text}\n')
    run("gcc", *STRICT, "-c", "-I", str(folder), str(made.source), "-o", str(folder / "f.o"))
    flags = (standard, "-Wall", "-Wextra", "-Wpedantic", "-Werror", "-I", str(folder))
    run("g++", *flags, str(folder / "main.cpp"), str(folder / "f.o"), "-o", str(folder / "main"), "-lm")
    return run(str(folder / "main"))


@needs("g++")
def test_spans_of_cpp_call_the_function(tmp_path):
    made = PROGRAMS["closed form"]("float64").export(tmp_path, "exported")
    arrays = re.findall(r"std::span<(?:const )?double, (\d+)>", made.spans.read_text())
    declared = "".join(f"double x{k}[{size}]={{}};" for k, size in enumerate(arrays))
    passed = ",".join(f"std::span<double,{size}>(x{k})" for k, size in enumerate(arrays))
    cpp(made, f"int main(){{{declared} return torchdq::exported({passed});}}")


@needs("g++")
def test_spans_of_a_batch_that_are_too_short_are_refused(tmp_path):
    made = torchdq.compile(TWO, "inverse_dynamics").export(tmp_path, "exported", batch=True)
    text = (
        "#include <cassert>\n"
        "int main(){double q[6]={},v[6]={},a[6]={},t[6]={},s[5]={};using torchdq::exported_batch;\n"
        "assert(exported_batch(3,q,v,a,t)==0);assert(exported_batch(3,s,v,a,t)==2);assert(exported_batch(3,q,v,a,s)==2);\n"
        "assert(exported_batch(static_cast<std::size_t>(-1),q,v,a,t)==2);return 0;}"
    )
    cpp(made, text)
    with pytest.raises(AssertionError, match=r"exported\.hpp needs C\+\+20"):
        cpp(made, text, "-std=c++17")
