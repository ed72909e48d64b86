"""Hard cases of time: energy over long times, with programs compiled as they are shipped."""

import math

import numpy as np
import pytest
import torch
from helpers import called, double, exhaustive, thinned
from oracles import EPS
from precisions import compiled
from scenes import ARM, swinging, trace

from torchdq import Scene, effects
from torchdq.scene import State
from torchdq.scene.integrators import (
    DormandPrince,
    ExplicitEuler,
    LinearlyImplicit,
    RungeKutta4,
    SemiImplicitEuler,
    StoermerVerlet,
)

AS_SHIPPED = True  # rounding decides where chaotic motions go: slopes are those of the shipped flags


def drift(integrator, backend, h, steps, dtype=torch.float64, substeps=10):
    """Error of the energy at every tenth step, relative to that of the swing, and its slope per step."""
    scene = Scene(ARM, (effects.Gravity(),), integrator=integrator, dt=substeps * h, substeps=substeps, backend=backend)
    with torch.no_grad():
        states = trace(scene, swinging(dtype), steps // substeps)
        energy = scene.energy(State(states.q.double(), states.qd.double())).sum(-1)
        lowest = scene.energy(State(double(-math.pi / 2, 0.0), double(0.0, 0.0))).sum()
    error = ((energy - energy[0]) / (energy[0] - lowest)).numpy()
    return error, np.polyfit(substeps * np.arange(len(error)), error, 1)[0]


# the step, the slope of the relative energy per step that was measured, and what may become of it
DRIFT = {
    ExplicitEuler(): (2e-3, 1.45e-4),
    SemiImplicitEuler(): (2e-3, 3.0e-6),
    LinearlyImplicit(): (2e-3, 3.0e-6),
    RungeKutta4(): (5e-3, 1.9e-12),
    StoermerVerlet(): (5e-3, 1e-10),
}


@pytest.mark.case("T2")
@compiled
@pytest.mark.parametrize("integrator", thinned(DRIFT, (StoermerVerlet(),)), ids=called)
def test_the_energy_of_a_double_pendulum_drifts_as_stated_over_1e5_steps(integrator, backend, margin):
    h, slope = DRIFT[integrator]
    error, found = drift(integrator, backend, h, 100_000)
    if isinstance(integrator, StoermerVerlet):
        margin(abs(found), 1e-9, "slope of the energy per step, StoermerVerlet")
        margin(np.abs(error).max(), 1.5e-4, "band of the energy, StoermerVerlet")
    else:  # those that are not symplectic drift, and neither more nor less than they did
        margin(abs(found), 1.5 * slope, f"slope of the energy per step, {called(integrator)}")
        assert abs(found) > slope / 1.5
        assert (found > 0) == (not isinstance(integrator, RungeKutta4))


@exhaustive
@pytest.mark.case("T2")
@compiled
def test_the_energy_of_adaptive_steps_is_kept_to_tolerance(backend, margin):
    error, _ = drift(DormandPrince(1e-9, 1e-12), backend, 0.5, 8, substeps=1)
    margin(np.abs(error).max(), 20 * 1e-9, "energy over 4 s, DormandPrince")


@exhaustive
@pytest.mark.case("T2")
@compiled
def test_in_single_precision_the_band_is_as_narrow_and_wanders_by_rounding(backend, margin):
    error, found = drift(StoermerVerlet(), backend, 5e-3, 100_000, torch.float32)
    margin(abs(found), 0.2 * EPS[torch.float32], "slope of the energy per step")
    margin(np.abs(error).max(), 1.5e-4 + 0.1 * EPS[torch.float32] * 100_000, "band of the energy")
