"""The study of accuracy against time: its references agree, and what it concludes from points follows from them."""

import importlib
import sys

import numpy as np
import pytest
import torch
from helpers import double
from places import ROOT

from torchdq.scene import integrators

BENCHMARKS = ROOT / "benchmarks"


@pytest.fixture(scope="module")
def study():
    """Modules of the study by name."""
    sys.path.insert(0, str(BENCHMARKS))
    try:
        yield lambda name: importlib.import_module(f"accuracy.{name}")
    finally:
        sys.path.remove(str(BENCHMARKS))


def point(error, time, **others):
    return {"error_max": error, "nanoseconds": time, **others}


# --- references ------------------------------------------------------------------------------------------------------


def test_elliptic_functions_and_extrapolation_agree(study):
    references, case = study("references"), study("scenes").pendulum()
    state, meshes = references.flown(study("rows").Formulas(case), case)
    assert all(sum(mesh) == case.horizon / 4 for mesh in meshes)
    assert study("fits").relative(state, references.elliptic(case)).max() < 1e-15


@pytest.mark.parametrize("name", ["double_pendulum", "arm7", "servo", "tumbling", "rough"])
def test_a_textbook_and_the_formulas_agree_on_accelerations(study, name):
    case = study("scenes").CASES[name]()
    q, qd, torque = (x.numpy().astype(np.longdouble) for x in (case.q, case.qd, case.torque[0]))
    found, expected = (of(q, qd, torque) for of in (study("rows").Formulas(case), study("textbook").Textbook.of(case)))
    assert np.abs(found - expected).max() <= 1e4 * np.finfo(np.longdouble).eps * np.abs(expected).max()


def test_collocation_has_the_accuracy_of_extrapolation(study):
    integration = study("integration")
    y = np.array([[1.0, 0.0]], np.longdouble)

    def slope(y):
        return np.stack([y[..., 1], -y[..., 0]], -1)

    end, mesh = integration.extrapolated(slope, y, 4.0, 0.5)
    exact = np.array([np.cos(np.longdouble(4)), -np.sin(np.longdouble(4))])
    assert np.abs(end - exact).max() < 1e-15
    assert np.abs(integration.collocated(slope, y, mesh) - exact).max() < 1e-15


# --- methods ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["rough", "double_pendulum"])
@pytest.mark.parametrize("integrator", ["RungeKutta4", "LinearlyImplicit"])
def test_a_step_is_that_of_the_scene(study, name, integrator):
    """Whose duration is a constant."""
    methods, case, h = study("methods"), study("scenes").CASES[name](), 2.0**-7
    state, torques, others = methods.initial(case, "float64")
    program = methods.program_of(case, integrator, "float64")
    found = methods.stepper(program, "float64", [*others, double(h).expand(1)], methods.eager)(state, torques[0])
    scene = case.scene.replace(integrator=getattr(integrators, integrator)(), dt=h, backend="eager")
    expected = scene.step(scene.start(*state), torques[0])
    for a, b in zip(found, expected[:2], strict=True):
        assert torch.allclose(a, b, rtol=1e-13, atol=1e-13)


def test_a_compensated_sum_keeps_what_rounding_took(study):
    a, b = torch.tensor(1.0), torch.tensor(3e-9)
    total, rest = study("methods").two_sum(a, b)
    assert total == 1.0
    assert rest == b


# --- other packages --------------------------------------------------------------------------------------------------


def test_runge_kutta_steps_of_all_packages_are_the_same(study):
    peers, case = study("peers"), study("scenes").arm7()
    runs = [peers.torchdq_run(case, 16, 1), peers.pinocchio_run(case, 16), peers.mujoco_run(case, "MuJoCo RK4", 16)]
    ours, *theirs = (run.end() for run in runs)
    assert all(np.abs(other - ours).max() < 1e-11 for other in theirs)


def test_gradients_chained_from_steps_of_other_packages_agree(study):
    peers, case = study("peers"), study("scenes").arm7()
    x = np.concatenate([case.q, case.qd, case.torque[0]], -1)[:1]
    exact, differences = peers.by_pinocchio(x, 8, 2.0**-8), peers.by_mujoco(x, 8, 2.0**-8, 1e-4)
    assert study("fits").relative(differences, exact).max() < 1e-8


# --- conclusions -----------------------------------------------------------------------------------------------------


def test_the_front_holds_what_nothing_beats(study):
    points = [point(1e-2, 1), point(1e-3, 3), point(2e-3, 4), point(1e-6, 9), point(1e-6, 10), point(1e-1, 1)]
    assert study("fits").front(points) == [points[0], points[1], points[3]]


def test_a_dominated_point_loses_in_both_by_the_margin(study):
    good, close, worse = point(1e-3, 10), point(1.05e-3, 10.5), point(2e-3, 20)
    assert study("fits").dominated([good, close, worse]) == [(worse, good)]


@pytest.mark.parametrize("order", [1, 2, 4])
def test_slope_and_plateau_of_a_line_that_ends_in_rounding(study, order):
    fits, sizes = study("fits"), 0.5 ** np.arange(1, 20)
    errors = sizes**order + 1e-9
    bottom = fits.plateau(sizes, errors, order)
    assert (bottom is None) == (order == 1)  # which has not come down to it
    assert fits.slope(sizes, errors, 30 * (bottom or 0), 0.1).slope == pytest.approx(order, abs=0.05)


def test_a_slope_needs_two_points_above_rounding(study):
    fits = study("fits")
    assert fits.slope([0.1, 0.2], [1e-3, 4e-3], 0.0, 1.0) == (pytest.approx(2.0), 2)
    assert fits.slope([0.05, 0.1, 0.2], [2e-3, 1e-3, 4e-3], 2e-3, 1.0) is None


def test_a_thinned_front_holds_no_small_gains(study):
    points = [point(1e-2, 1), point(9e-3, 2), point(4e-3, 3), point(3e-3, 4), point(1e-6, 5)]
    assert study("fits").thinned(points) == [points[0], points[2], points[4]]


RESULTS = {
    "trajectories": [
        {
            "scene": "arm7",
            "horizon": 1.0,
            "limit": 0.1,
            "slopes": [],
            "points": [
                point(5e-4, 100, integrator="RungeKutta4", precision="float32", steps=10, size=0.1, per_step=10),
                point(1e-6, 400, integrator="RungeKutta4", precision="float64", steps=40, size=0.025, per_step=10),
                point(5e-4, 900, integrator="ExplicitEuler", precision="float32", steps=90, size=0.01, per_step=10),
                point(0.5, 1, integrator="ExplicitEuler", precision="float32", steps=1, size=1.0, per_step=1),
                point(1e-9, None, integrator="RungeKutta4", precision="mixed", steps=80, size=0.0125, per_step=None),
            ],
        }
    ],
    "gradients": {
        "points": [
            {**point(3e-7, 1), "way": "compiled reverse", "precision": "float32", "measured": True, "floor": 1e-14},
            {**point(3e-15, 1), "way": "compiled reverse", "precision": "float64", "measured": False, "floor": 1e-14},
        ]
    },
}


def test_the_table_names_the_cheapest_setting_that_is_accurate_enough(study):
    rows = study("table").advice(RESULTS).splitlines()
    assert rows[2].split(" | ")[1:] == ["float32 RungeKutta4, 100 ms", "5e-04", "10 ns", "3e-07 |"]
    assert rows[3].split(" | ")[1:] == ["float64 RungeKutta4, 25 ms", "1e-06", "10 ns", "below 1e-14 |"]
    assert "nothing that was tried" in rows[4]


def test_what_is_dominated_and_where_settings_cross_is_said(study):
    table = study("table")
    assert table.dominated(RESULTS) == ["float32 ExplicitEuler: arm7 (1 of 1 points)"]
    assert table.crossovers(RESULTS) == [
        "arm7: below 5e-04, float64 RungeKutta4 takes over from float32 RungeKutta4, which does not get there"
    ]
