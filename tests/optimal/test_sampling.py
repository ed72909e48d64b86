"""Sampling methods: costs fall under the limits, and lost samples do not count."""

import pytest
import torch
from helpers import double

import torchdq
from torchdq import Scene, effects, optimal

BACKEND = "auto"
ARM = Scene(torchdq.robots.load("two_link"), (effects.Gravity(), effects.Viscous(0.1)), dt=0.02)
GOAL, STEPS = double(0.3, -0.2), 20
COSTS = [optimal.Torques(1e-4), optimal.Posture(GOAL, 10.0), optimal.Speeds(0.1)]
PROBLEM = optimal.Problem(ARM, STEPS, COSTS, torques=(-60.0, 60.0))
METHODS = {
    "mppi": optimal.MPPI(256, spread=2.0, temperature=0.05),
    "cem": optimal.CEM(256, spread=10.0, knots=6),
}


@pytest.mark.parametrize("method", METHODS.values(), ids=METHODS)
def test_a_sampling_method_comes_near_the_cost_of_iterative_lqr_within_the_limits(method):
    state = ARM.start(double(0.0, 0.1).expand(3, 2))
    best, begin = optimal.solve(PROBLEM, state), PROBLEM.cost(state, PROBLEM.holding(state))
    plan = optimal.solve(PROBLEM, state, method=method, iterations=40)
    assert (plan.cost <= best.cost + 0.1 * (begin - best.cost)).all() and (plan.cost >= best.cost - 1e-9).all()
    assert plan.torque.abs().max() <= 60.0 and plan.gain is None and plan.states.q.shape == (STEPS + 1, 3, 2)
    assert torch.allclose(PROBLEM.cost(state, plan.torque), plan.cost, rtol=1e-12)
    assert torch.equal(optimal.solve(PROBLEM, state, method=method, iterations=40).torque, plan.torque)
    warm = optimal.solve(PROBLEM, state, plan.torque)
    assert (warm.cost - best.cost).abs().max() <= 1e-6


def test_samples_that_are_lost_do_not_count():
    state = ARM.start(double(torch.nan, 0.1).expand(2, 2)).q
    state[1] = 0.1
    plan = optimal.solve(PROBLEM, ARM.start(state), method=METHODS["mppi"], iterations=2)
    assert plan.status.tolist() == [3, 1] and plan.torque[:, 1].isfinite().all()
