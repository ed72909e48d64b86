"""Receding horizons: disturbances are corrected, lost rows heal, and each row is as alone."""

import pytest
import torch
from helpers import double
from robots import one_joint

import torchdq
from torchdq import Scene, effects, optimal
from torchdq.errors import ArgumentError

BACKEND = "auto"
ARM = Scene(torchdq.robots.load("two_link"), (effects.Gravity(), effects.Viscous(0.1)), dt=0.02)
GOAL, STEPS = double(0.3, -0.2), 20
COSTS = [optimal.Torques(1e-4), optimal.Posture(GOAL, 10.0), optimal.Speeds(0.1)]
PROBLEM = optimal.Problem(ARM, STEPS, COSTS, torques=(-60.0, 60.0))


@pytest.mark.parametrize("batch", [(), (3,)])
def test_a_receding_horizon_brings_an_arm_to_its_goal_against_a_heavier_load(batch):
    mpc, state = optimal.Receding(PROBLEM), ARM.start(torch.zeros(*batch, 2).double())
    real = ARM.replace(robot=ARM.robot.replace(mass=1.1 * ARM.robot.mass))
    for _ in range(60):
        torque, gain = mpc(state)
        assert torque.shape == (*batch, 2) and gain.shape == (*batch, 2, 4)
        assert torque.abs().max() <= 60.0
        state = real.step(state, torque)
    assert (state.q - GOAL).abs().max() < 0.08
    mpc.problem = mpc.problem.replace(costs=[*COSTS[:1], optimal.Posture(-GOAL, 10.0), *COSTS[2:]])
    for _ in range(60):
        state = real.step(state, mpc(state)[0])
    assert (state.q + GOAL).abs().max() < 0.08


def test_ticks_without_disturbances_converge_to_the_plan_of_a_solution():
    mpc, state = optimal.Receding(PROBLEM, iterations=2), ARM.start(double(0.1, 0.1))
    for _ in range(8):
        state = ARM.step(state, mpc(state)[0])
    torque, _ = mpc(state)
    assert (torque - optimal.solve(PROBLEM, state).torque[0]).abs().max() <= 1e-3 * torque.abs().max()


def test_a_receding_horizon_may_be_one_of_samples():
    slide = Scene(one_joint([0.0, 0, 0, 1, 0, 0]), dt=0.1)
    problem = optimal.Problem(slide, 10, [optimal.Posture(double(0.5), 1.0), optimal.Speeds(0.1)])
    mpc, state = (
        optimal.Receding(problem, method=optimal.MPPI(128, spread=10.0, temperature=0.02)),
        slide.start(double(0.0)),
    )
    for _ in range(40):
        torque, gain = mpc(state)
        state = slide.step(state, torque)
    assert gain is None and abs(state.q - 0.5) < 0.1


def test_a_row_that_is_lost_gets_no_torque_and_goes_on_with_its_plan():
    q = torch.tensor([[0.1, 0.1], [0.1, -0.2], [torch.nan, 0.0]], dtype=torch.float64)
    mpc, alone = optimal.Receding(PROBLEM), optimal.Receding(PROBLEM)
    state, other = ARM.start(q.nan_to_num(0.1)), ARM.start(q[:1])
    for lost in ([2], [1], [], [], []):
        seen = state.q.clone()
        seen[lost], before = torch.nan, mpc.plan
        torque, _ = mpc(ARM.start(seen, state.qd))
        assert torch.equal(torque.isnan(), seen.isnan().any(-1, keepdim=True).expand(3, 2))
        if lost == [1]:
            assert torch.equal(mpc.plan.torque[:-1, 1], before.torque[1:, 1])
        by_itself, _ = alone(other)
        assert torch.equal(torque[:1], by_itself)
        state, other = ARM.step(state, torque.nan_to_num(0.0)), ARM.step(other, by_itself)
    best = optimal.solve(PROBLEM, ARM.start(seen, mpc.plan.states.qd[0]))
    assert (mpc.plan.cost <= 1.001 * best.cost).all()


def test_a_receding_horizon_goes_on_from_a_plan_that_is_assigned():
    state, mpc = ARM.start(double(0.1, 0.1)), optimal.Receding(PROBLEM)
    plan = optimal.solve(PROBLEM, state)
    mpc.plan = plan
    state = ARM.step(state, plan.torque[0])
    other = optimal.Receding(PROBLEM)
    other(ARM.start(double(0.1, 0.1)))
    for left, right in zip(mpc(state), other(state), strict=True):
        assert torch.equal(left, right)
    mpc.plan = plan._replace(gain=None)
    with pytest.raises(ArgumentError, match="gains"):
        mpc(state)
