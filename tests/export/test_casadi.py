"""Programs in CasADi: values, derivatives and their places are those of the robot, and a failure is told.

Functions of all knots are compared with CasADi's `map` of the same program, whose sine and cosine are those of the C
library; second derivatives with differences of gradients, and with torch's.
"""

import ctypes
import re
import shutil
from functools import cache
from importlib import import_module

import numpy as np
import pytest
import torch
from exporting import F64, PROGRAMS, STRICT, run
from helpers import all_in_one, exhaustive, thinned
from messages import refused

import torchdq
from torchdq.errors import ArgumentError

ca = pytest.importorskip("casadi", reason="programs in CasADi need casadi")
pytestmark = pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler")

EPS = 2.0**-52


SMALL = list(PROGRAMS)[: list(PROGRAMS).index("scene") + 1]
# the results of the others are among those of these, or are as short; those of an arm take long
FEW = (
    "forward dynamics",
    "closed form",
    "jacobian",
    "energy",
    "gradient",
    "derivatives",
    "parameters",
    "floating base",
)
EACH = pytest.mark.parametrize("name", thinned(SMALL, FEW))


def built(compiled, folder, name="f", library="math.h", **options):
    """Function in CasADi, built by the command in the file, but quickly, and in strict C99."""
    made = compiled.export(folder, name, library, language="casadi", **options)
    command = re.search(r"cc -shared .*", made.source.read_text()).group().replace("-O2", "-O0").split()
    run(*command, *STRICT, cwd=folder)
    return ca.external(name, str(folder / f"{name}.so"))


KNOTS = 11  # they are no whole number of blocks
compiled_once = cache(lambda name: PROGRAMS[name]())


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    """Program and its function in CasADi by the name of the program, built once."""
    return cache(lambda name: (compiled_once(name), built(compiled_once(name), tmp_path_factory.mktemp("casadi"))))


@pytest.fixture(scope="module")
def all_knots(tmp_path_factory):
    """Function of all knots in CasADi by the name of the program, built once."""
    return cache(lambda name: built(compiled_once(name), tmp_path_factory.mktemp("knots"), "every", knots=KNOTS))


def rows(compiled, seed=0):
    """Arguments near 1, where masses and inertias are positive."""
    generator = torch.Generator().manual_seed(seed)
    return [1 + 0.5 * torch.rand(a.width, generator=generator, dtype=F64) for a in compiled.program.arguments]


def wide(x):
    """Arguments that CasADi has: those with a width."""
    return [v.numpy() for v in x if v.numel()]


def listed(found):
    return list(found) if isinstance(found, tuple | list) else [found]


def jacobians(function, x):
    """Jacobians in CasADi at a state, result by result and argument by argument."""
    return listed(function.jacobian()(*x, *[0] * function.n_out()))


# --- values ----------------------------------------------------------------------------------------------------------


@EACH
def test_values_are_those_of_the_program_in_the_shape_of_the_function(name, ready):
    compiled, function = ready(name)
    x = rows(compiled)
    expected = [y for y in listed(compiled(*x)) if y.numel()]
    axes = [axes for axes, y in zip(compiled.axes, listed(compiled(*x)), strict=True) if y.numel()]
    found = [y.full() for y in listed(function(*wide(x)))]
    assert len(found) == len(expected)
    for y, at, shape in zip(found, expected, axes, strict=True):
        table = at.reshape(shape if len(shape) == 2 else (-1, 1)).numpy()
        assert y.shape == table.shape
        assert np.abs(y - table).max() <= 64 * EPS * (1 + np.abs(table).max())


def test_sine_and_cosine_may_be_its_own(tmp_path):
    compiled = PROGRAMS["computed torque"]()
    function = built(compiled, tmp_path, "f", "own")
    x = rows(compiled)
    assert np.abs(function(*wide(x)).full()[:, 0] - compiled(*x).numpy()).max() <= 1e-12


POINTERS = ctypes.POINTER(ctypes.c_double)


def needed(library, function):
    """Numbers of arguments, of results and of the work space of a function in a library."""
    sizes = [ctypes.c_longlong() for _ in range(4)]
    assert getattr(library, f"{function}_work")(*map(ctypes.byref, sizes)) == 0
    return [sizes[k].value for k in (0, 1, 3)]


def test_missing_arguments_are_zero_and_missing_results_are_left_out(ready, tmp_path):
    compiled, _ = ready("closed form")
    built(compiled, tmp_path)
    library = ctypes.CDLL(str(tmp_path / "f.so"))
    arg, res, work = needed(library, "f")
    guard = 17.0
    w = (ctypes.c_double * (work + 16))(*[guard] * (work + 16))
    c, q = (ctypes.c_double * 2)(guard, guard), (ctypes.c_double * 2)(0.3, -0.4)
    given, wanted = (POINTERS * arg)(q, None), (POINTERS * res)(None, None, c, None)
    assert library.f(given, wanted, None, w, 0) == 0
    at_rest = torch.tensor([0.3, -0.4], dtype=F64), torch.zeros(2, dtype=F64)
    g = torchdq.closed_form(torchdq.robots.load("two_link"), *at_rest)[2]
    assert np.allclose(list(c), g.numpy(), rtol=1e-14) and all(x == guard for x in w[work:])


def differences(function, x, j, h=1e-5):
    """Derivatives of all results by each number of argument j, by differences of four values."""
    for k in range(len(x[j])):
        ends = []
        for way in (-2, -1, 1, 2):
            moved = [*x]
            moved[j] = moved[j].copy()
            moved[j][k] += way * h
            ends.append([y.full().reshape(-1, order="F") for y in listed(function(*moved))])
        yield [(a - 8 * b + 8 * c - d) / (12 * h) for a, b, c, d in zip(*ends, strict=True)]


# --- Jacobians -------------------------------------------------------------------------------------------------------


@EACH
def test_jacobians_are_the_limits_of_differences(name, ready):
    compiled, function = ready(name)
    x = wide(rows(compiled))
    found = iter(jacobians(function, x))
    for i, y in enumerate(listed(function(*x))):
        for j in range(len(x)):
            exact = next(found).full()
            for k, slopes in enumerate(differences(function, x, j)):
                assert np.abs(exact[:, k] - slopes[i]).max() <= 1e-9 * (1 + np.abs(y.full()).max())


@EACH
def test_jacobians_store_the_places_that_are_not_always_zero(name, ready):
    """All of them, and no other but two that cancel: at four states every stored place is not zero in one."""
    compiled, function = ready(name)
    derivative = function.jacobian()
    largest = [np.zeros(derivative.size_out(k)) for k in range(derivative.n_out())]
    for seed in range(4):
        x = wide(rows(compiled, seed))
        for k, y in enumerate(jacobians(function, x)):
            largest[k] = np.maximum(largest[k], np.abs(y.full()))
    for k, seen in enumerate(largest):
        pattern = np.zeros(seen.shape, bool)
        pattern[tuple(map(list, derivative.sparsity_out(k).get_triplet()))] = True
        assert not (~pattern & (seen > 0)).any(), derivative.name_out(k)
        # arms of one link that are added and taken away again, of joints with parallel axes
        assert (pattern & (seen == 0)).sum() <= (2 if name == "jacobian" else 0), derivative.name_out(k)


def test_places_of_known_zeros_are_left_out(ready):
    _, function = ready("closed form")
    assert function.name_in() == ["q", "qd"] and function.name_out() == ["M", "c", "g", "Jt"]
    assert [function.jacobian().nnz_out(k) for k in (1, 5, 7)] == [0, 0, 0]  # M, g and Jt do not depend on qd


@exhaustive
def test_places_of_a_joint_along_gravity_are_left_out(ready):
    _, function = ready("inverse dynamics")
    assert function.jacobian().size_out(0) == (7, 7)
    stored = function.jacobian().sparsity_out(0)
    assert stored.nnz() == 42 and stored.colind()[:2] == [0, 0]


# --- second derivatives ----------------------------------------------------------------------------------------------


def seeded(function, x, seed=0):
    """Arguments of the gradient of a function: its own, results that are not read, and seeds."""
    rng = np.random.default_rng(seed)
    seeds = [rng.uniform(-1, 1, function.size_out(k)) for k in range(function.n_out())]
    return [*x, *[0] * function.n_out(), *seeds]


@EACH
def test_second_derivatives_are_the_limits_of_differences(name, ready):
    """Jacobians of the gradient in the arguments, and in the seeds: the transposed Jacobians."""
    compiled, function = ready(name)
    gradient = function.reverse(1)
    arguments = seeded(function, wide(rows(compiled)))
    second = gradient.jacobian()
    found = dict(zip(second.name_out(), listed(second(*arguments, *[0] * gradient.n_out())), strict=True))
    largest = [np.abs(y.full()).max() for y in listed(gradient(*arguments))]
    for j in range(function.n_in()):
        for k, slopes in enumerate(differences(gradient, arguments, j)):
            for i, slope in enumerate(slopes):
                exact = found[f"jac_adj_{function.name_in(i)}_{function.name_in(j)}"].full()
                assert np.abs(exact[:, k] - slope).max() <= 1e-8 * (1 + np.abs(slope).max() + largest[i])
    first = iter(jacobians(function, wide(rows(compiled))))
    for r in range(function.n_out()):
        for i in range(function.n_in()):
            exact = found[f"jac_adj_{function.name_in(i)}_adj_{function.name_out(r)}"].full()
            at = next(first).full().T
            assert np.abs(exact - at).max(initial=0.0) <= 1e-13 * (1 + np.abs(at).max(initial=0.0))


@pytest.mark.parametrize("name", thinned(["inverse dynamics", "forward dynamics"], ("forward dynamics",)))
def test_a_hessian_in_casadi_is_that_of_torchdq(name, ready):
    compiled, function = ready(name)
    x, width = rows(compiled), function.numel_in(0)
    weights = torch.linspace(1.0, -2.0, function.numel_out(0), dtype=F64)
    z = ca.MX.sym("z", 3 * width)
    objective = ca.dot(ca.DM(weights.numpy()), function(*ca.vertsplit(z, width)))
    found = ca.Function("H", [z], [ca.hessian(objective, z)[0]])(torch.cat(x).numpy()).full()
    exact = torch.autograd.functional.hessian(lambda y: compiled(*y.split(width)) @ weights, torch.cat(x)).numpy()
    assert np.abs(found - exact).max() <= 1e-11 * (1 + np.abs(exact).max())
    assert (found == found.T).all()  # a pair is computed once


def test_second_derivatives_may_be_left_out(tmp_path):
    compiled = PROGRAMS["energy"]()
    without = compiled.export(tmp_path, "f", language="casadi", derivatives=1).source.read_text()
    assert "jac_f" in without and "adj1_f" not in without
    assert len(without) < len(compiled.export(tmp_path, "f", language="casadi").source.read_text())


# --- all knots -------------------------------------------------------------------------------------------------------


def columns(compiled, knots=KNOTS):
    """Arguments of all knots, a column each."""
    return [np.stack(same, 1) for same in zip(*[wide(rows(compiled, k)) for k in range(knots)], strict=True)]


KNOTTED = ["inverse dynamics", "forward dynamics", "closed form", "jacobian", "gradient", "parameters", "scene"]


@pytest.mark.parametrize("name", thinned(KNOTTED, ("closed form", "scene")))
def test_functions_of_all_knots_are_maps(name, ready, all_knots):
    """Shapes, values, Jacobians, gradients and second derivatives, and their stored places, are those of `map`."""
    (compiled, function), every = ready(name), all_knots(name)
    mapped, x = function.map(KNOTS), columns(compiled)
    for k in range(every.n_in()):
        assert every.size_in(k) == mapped.size_in(k) and every.name_in(k) == function.name_in(k)
    arguments = seeded(mapped, x)
    for f, g, at in (
        (every, mapped, x),
        (every.jacobian(), mapped.jacobian(), [*x, *[0] * every.n_out()]),
        (every.reverse(1), mapped.reverse(1), arguments),
    ):
        for y, expected in zip(listed(f(*at)), listed(g(*at)), strict=True):
            assert y.size() == expected.size()
            assert np.abs((y - expected).full()).max(initial=0) <= 1e-12 * (1 + np.abs(expected.full()).max(initial=0))
    of_one = function.jacobian()
    for k in range(of_one.n_out()):
        assert every.jacobian().sparsity_out(k) == ca.diagcat(*[of_one.sparsity_out(k)] * KNOTS)
    second, of_one = every.reverse(1).jacobian(), function.reverse(1).jacobian()
    found = listed(second(*arguments, *[0] * every.n_in()))
    for knot in (0, 7, 8, KNOTS - 1):
        at = [v if np.isscalar(v) else np.split(v, KNOTS, axis=1)[knot] for v in arguments]
        for k, expected in enumerate(listed(of_one(*at, *[0] * every.n_in()))):
            rows_, columns_ = expected.size()
            block = found[k][knot * rows_ : (knot + 1) * rows_, knot * columns_ : (knot + 1) * columns_]
            assert block.sparsity() == expected.sparsity() and found[k].nnz() == KNOTS * expected.nnz()
            worst = np.abs((block - expected).full()).max(initial=0)
            assert worst <= 1e-11 * (1 + np.abs(expected.full()).max(initial=0))


@pytest.mark.parametrize("knots", thinned([1, 8, 9], (8, 9)))
def test_any_number_of_knots_is_exact_to_the_last(knots, ready, tmp_path):
    compiled, function = ready("computed torque")
    every = built(compiled, tmp_path, "every", knots=knots)
    x = columns(compiled, knots)
    expected = function.map(knots)(*x).full()
    assert np.abs(every(*x).full() - expected).max() <= 1e-12 * (1 + np.abs(expected).max())
    exact = every.jacobian()(*x, 0)[0].full()[-2:, -2:]
    alone = jacobians(function, [v[:, -1] for v in x])[0].full()
    assert np.abs(exact - alone).max() <= 1e-12 * (1 + np.abs(alone).max())


@pytest.mark.parametrize("knot", [0, 7, 8, KNOTS - 1])
def test_what_is_not_a_number_at_a_knot_stays_there(knot, all_knots):
    every = all_knots("computed torque")
    x = columns(compiled_once("computed torque"))
    expected = every(*x).full()
    x[1][:, knot] = np.nan
    found = every(*x).full()
    others = [k for k in range(KNOTS) if k != knot]
    assert (found[:, others] == expected[:, others]).all() and np.isnan(found[:, knot]).any()


# an angle out of reach, and a mass matrix that is not positive
FAULTS = {
    "computed torque": {"q": [0, 2e5]},
    "parameters": {"mass": [1.0, -1.0], "inertia": 0.0},
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_failure_at_a_knot_is_that_of_the_function(name, all_knots):
    every = all_knots(name)
    for function in (every, every.jacobian(), every.reverse(1)):
        for knot in (0, KNOTS - 1):
            x = columns(compiled_once(name))
            rest = [0] * (function.n_in() - len(x))
            function(*x, *rest)
            for argument, column in FAULTS[name].items():
                x[every.index_in(argument)][:, knot] = column
            with pytest.raises(RuntimeError, match="Evaluation failed"):
                function(*x, *rest)


@pytest.mark.parametrize("library", thinned(["math.h", "own"], ("own",)))
def test_a_failure_is_told_whatever_is_wanted(library, tmp_path):
    """The growth of errors is not overwritten by results that are not wanted."""
    robot = torchdq.robots.load("panda")  # whose memory is larger than that of its results
    compiled = torchdq.compile(robot.replace(mass=robot.mass), "forward_dynamics")
    built(compiled, tmp_path, "f", library, derivatives=1)
    library = ctypes.CDLL(str(tmp_path / "f.so"))
    for function, results in (("f", 1), ("jac_f", 4)):
        arg, res, work = needed(library, function)
        for masses, status in (([1.0] * 7, 0), ([1.0] * 6 + [-1e3], 1)):
            given = (POINTERS * arg)(*[None] * 3, (ctypes.c_double * 7)(*masses))
            wanted, room = (POINTERS * res)(*[None] * results), (ctypes.c_double * work)()
            assert getattr(library, function)(given, wanted, None, room, 0) == status


# --- use in CasADi ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("way", [("serial",), ("thread", 2), ("unroll",)], ids=lambda way: way[0])
def test_a_map_over_samples_is_the_function_on_each(way, ready):
    compiled, function = ready("computed torque")
    samples = 9
    x = columns(compiled, samples)
    mapped = function.map(samples, *way)
    for k, y in enumerate(ca.horzsplit(mapped(*x))):
        assert (y.full() == function(*[v[:, k] for v in x]).full()).all()
    exact = mapped.jacobian()(*x, 0)[0].full()
    alone = jacobians(function, [v[:, 3] for v in x])[0].full()
    assert (exact[6:8, 6:8] == alone).all() and not exact[6:8, :6].any()


def test_a_function_fails_where_rounding_errors_are_too_large(ready):
    """As the C function returns 1: the mass matrix is not positive definite."""
    _, function = ready("parameters")
    arguments = {"q": [0.1, 0.2], "qd": [0, 0], "tau": [1, 1], "mass": [1, -1], "inertia": [0] * 12}
    given = [arguments[name] for name in function.name_in()]
    for call in (lambda: function(*given), lambda: jacobians(function, given)):
        with pytest.raises(RuntimeError, match="Evaluation failed"):
            call()


def test_a_solver_steps_back_from_where_a_function_fails(ready):
    """The least of the objective is at a mass of -30 kg, to where the solver's first step leads."""
    _, function = ready("parameters")
    inertia = torchdq.robots.load("two_link").inertia.reshape(-1).numpy()
    mass = ca.MX.sym("mass")
    acceleration = function(q=[0.1, 0.2], qd=[0, 0], tau=[40, 3], mass=ca.vertcat(1, mass), inertia=inertia)["qdd"]
    problem = {"x": mass, "f": ((mass + 30) * (mass - 0.5)) ** 2 + mass, "g": acceleration}
    quiet = {"ipopt.print_level": 0, "print_time": False, "ipopt.hessian_approximation": "limited-memory"}
    solver = ca.nlpsol("solver", "ipopt", problem, quiet)
    found = float(solver(x0=3.0)["x"])
    assert solver.stats()["success"] and abs(found - 0.5) < 1e-3


# --- the file --------------------------------------------------------------------------------------------------------


def test_the_file_has_no_memory_loops_or_branches_and_says_how_it_is_built(tmp_path):
    made = PROGRAMS["mass matrix"]().export(tmp_path, "arm_masses", language="casadi")
    about, text = made.source.read_text().split("*/", 1)
    assert not re.search(r"\b(for|while|goto|malloc|switch)\b", text)
    assert all(line.split()[1] in ("const", "int") for line in re.findall(r"static .*", text))  # no state
    assert 'casadi.external("arm_masses", "./arm_masses.so")' in about
    assert "in   q[2]  joint positions [rad or m]" in about and "out  M[2, 2]  mass matrix [kg m^2" in about
    assert made.header is None and [file.name for file in tmp_path.iterdir()] == ["arm_masses.c"]


REFUSED = {
    **{f"name {name}": {"name": name} for name in ("arm__torques", "_arm", "jac", "null", "two words", "double")},
    "language": {"language": "fortran"},
    "knots in C": {"language": "c", "knots": 4},
    "knots below zero": {"knots": -1},
    "half a knot": {"knots": 2.5},
    "knots that are true": {"knots": True},
    "derivatives": {"derivatives": 3},
    "single precision": {"dtype": "float32"},
}


@all_in_one(REFUSED)
def test_other_names_and_options_are_refused(name, tmp_path):
    options = {"language": "casadi", "dtype": "float64", **REFUSED[name]}
    with refused(ArgumentError):
        PROGRAMS["energy"](options.pop("dtype")).export(tmp_path, **options)


# --- the example -----------------------------------------------------------------------------------------------------


@exhaustive
def test_an_arm_swings_up_as_planned(capsys):
    pytest.importorskip("tyro", reason="the examples need the extra 'examples'")
    example = import_module("14_casadi")
    found = example.main(example.Args())
    assert found["iterations"] < 30 and found["violation"] < 1e-8  # more than 40 with the Hessian of Gauss and Newton
    assert found["accelerations"] < 1e-10 and found["miss"] < 1e-3
    assert "Solve_Succeeded" in capsys.readouterr().out
