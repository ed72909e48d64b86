"""Knots that are too large for one program: products of torch find what the program of a whole knot finds.

Through contact the expected change of the cost is that of differences; a free body has the gains of a Riccati recursion
of numpy on the linearization of its step.
"""

import numpy as np
import pytest
import torch
from helpers import double, random
from robots import on_free_base

import torchdq
from torchdq import Scene, dq, effects, optimal
from torchdq.optimal import problem as passes
from torchdq.scene import linearize

BACKEND = "auto"
ARM = Scene(torchdq.robots.load("two_link"), (effects.Gravity(), effects.Viscous(0.1)), dt=0.02)
FREE = on_free_base(torchdq.robots.load("two_link"))
UP = double(0.5**0.5, 0.5**0.5, 0, 0)  # the leg is in a vertical plane
ON_GROUND = effects.Contact("tip", height=-1.36)
LEG = Scene(FREE, (effects.Gravity(double(0, 0, -9.81)), effects.Viscous(0.1), ON_GROUND), dt=0.01)
STEPS = 20


@pytest.fixture(params=[0, 10**9], ids=["by columns", "whole"])
def large(request, monkeypatch):
    """Every knot is too large for one program."""
    monkeypatch.setattr(passes, "LARGEST", 0)
    monkeypatch.setattr(linearize, "LARGEST", request.param)


def swing(limit, scene=ARM):
    final = [optimal.Point("tip", double(1.2, 0.4, 0.0), 1e3), optimal.Speeds(10.0)]
    bounds = None if limit is None else (-limit, limit)
    return optimal.Problem(scene, STEPS, [optimal.Torques(1e-3), optimal.Speeds(1e-2)], final, bounds)


def hop():
    X = dq.from_pose(UP, double(0.0, 0.0, 0.1))
    costs = [optimal.Torques(1e-3), optimal.Speeds(1e-2), optimal.BaseVelocity(0.1)]
    return optimal.Problem(LEG, STEPS, costs, [optimal.BasePose(X, 10.0), optimal.Posture(double(-0.6, -0.5), 1.0)])


def standing(*rows):
    q, qd, X = (
        double(-0.5, -0.6) + 0.01 * random(*rows, 2),
        0.1 * random(*rows, 2, seed=1),
        dq.from_pose(UP, 0 * UP[:3]),
    )
    return LEG.start(q, qd, X_WB=X)


def of(state, k):
    return state._make(None if x is None else x[k] for x in state)


@pytest.mark.parametrize("limit", [None, 20.0])
def test_plans_are_those_of_knots_that_are_one_program(limit, large, monkeypatch):
    problem, state = swing(limit), ARM.start(0.5 * random(3, 2))
    straight = ARM.start(torch.linspace(1, 0, STEPS + 1).double()[:, None, None] * state.q)  # which no torques lead to
    found, led = (optimal.solve(problem, state, states=x, iterations=99 if x is None else 1) for x in (None, straight))
    monkeypatch.undo()
    plan, other = (optimal.solve(problem, state, states=x, iterations=99 if x is None else 1) for x in (None, straight))
    assert (led.torque - other.torque).abs().max() <= 1e-9 * other.torque.abs().max()
    assert plan.converged.all() and torch.equal(found.iterations, plan.iterations)
    assert (found.torque - plan.torque).abs().max() <= 1e-9 * plan.torque.abs().max()
    assert (found.gain - plan.gain).abs().max() <= 1e-9 * plan.gain.abs().max()
    if limit is not None:
        assert (plan.torque.abs() == limit).any()


def test_a_row_in_contact_has_the_same_plan_in_every_batch_beside_rows_that_are_lost(large, monkeypatch):
    """But for rounding: torch's products of matrices depend on where in memory they are."""
    problem, state = hop(), standing(5)
    state.q[3, 1] = torch.nan
    whole = optimal.solve(problem, state, iterations=5)
    assert whole.status.tolist().count(3) == 1 and whole.cost[[0, 1, 2, 4]].isfinite().all()
    monkeypatch.setattr(passes, "TOGETHER", 2 * STEPS * (24 + 2) ** 2)  # two rows at a time
    for rows in ([0, 1, 2, 3, 4], [2]):
        few = optimal.solve(problem, of(state, rows), iterations=5)
        for name in ("torque", "gain"):
            found, expected = getattr(few, name), getattr(whole, name)[:, rows]
            assert torch.allclose(found, expected, 0.0, 1e-9 * float(expected.nan_to_num().abs().max()), equal_nan=True)


def test_the_expected_change_of_the_cost_is_its_derivative_through_contact(large):
    problem, state = hop(), standing(4)
    own = passes.Passes.of(problem, state.q, {})
    states, torque, _ = own.forward(state.rows(), 0.1 * random(STEPS, 4, 2, seed=2))
    pressed = LEG.contacts(state._make(states.get(name, [None] * STEPS)[STEPS // 2] for name in state._fields))
    assert (pressed.normal_force > 0).any()
    gain, change, terms = own.backward(states, torque, torch.zeros(4).double())
    follow, h = (gain, passes.joined(states)[:-1]), 1e-5
    _, _, up = own.forward(state.rows(), torque + h * change, follow)
    _, _, down = own.forward(state.rows(), torque - h * change, follow)
    assert ((up - down) / (2 * h) / terms[:, 0] - 1).abs().max() <= 1e-5


def test_gains_of_a_free_body_are_those_of_the_riccati_recursion_of_its_linearization(large):
    scene = Scene(FREE, (effects.Viscous(0.1),), dt=0.05)
    weights = {"base": 2.0, "q": 3.0, "twist": 0.2, "qd": 0.1, "torque": 0.5}
    state, rest = scene.start(double(0.3, 0.4)), dq.from_pose(double(1, 0, 0, 0), torch.zeros(3).double())
    costs = [optimal.BasePose(rest, weights["base"]), optimal.Posture(state.q, weights["q"])]
    costs += [optimal.BaseVelocity(weights["twist"]), optimal.Speeds(weights["qd"]), optimal.Torques(weights["torque"])]
    plan = optimal.solve(optimal.Problem(scene, STEPS, costs, torques=None), state)
    A, B = (x.numpy() for x in scene.linearize(state))
    order, sizes = ("base", "q", "twist", "qd"), (6, 2, 6, 2)
    Q, R = np.diag(np.repeat([weights[x] for x in order], sizes)), weights["torque"] * np.eye(2)
    V = Q
    for k in reversed(range(STEPS)):
        K = -np.linalg.solve(R + B.T @ V @ B, B.T @ V @ A)
        assert np.abs(plan.gain[k].numpy() - K).max() <= 1e-9 * np.abs(K).max()
        V = Q + A.T @ V @ (A + B @ K)
    assert plan.converged and plan.cost <= 1e-20


@pytest.mark.parametrize("backend", ["torch products", "one program"])
def test_targets_of_servos_are_planned(backend, monkeypatch):
    if backend == "torch products":
        monkeypatch.setattr(passes, "LARGEST", 0)
        monkeypatch.setattr(linearize, "LARGEST", 0)
    robot = ARM.robot.replace(limits=ARM.robot.limits._replace(lower=double(-0.5, -1.5), upper=double(0.35, 1.5)))
    scene = Scene(robot, (effects.Gravity(), effects.Servo(double(200.0, 80.0), double(20.0, 8.0))), dt=0.02)
    problem = swing(None, scene).replace(torques="limits", control="target")
    state = scene.start(double(0.1, 0.2))
    plan = optimal.solve(problem, state)
    targets = plan.torque.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(problem.cost(state, targets), targets)
    at_limit = (plan.torque == robot.limits.upper) | (plan.torque == robot.limits.lower)
    assert plan.converged and at_limit.any() and not at_limit.all()
    assert gradient[~at_limit].abs().max() <= 1e-4 * gradient.abs().max()
    near = state._replace(q=state.q + 0.02)
    followed, blind = (
        scene.rollout(near, steps=STEPS, **x).q[-1] for x in ({"policy": plan.policy}, {"target": plan.torque})
    )
    called = scene.rollout(near, steps=STEPS, policy=plan.policy, done=lambda s: torch.tensor(False))
    assert (called.q[-1] - followed).abs().max() <= 1e-12
    assert (followed - plan.states.q[-1]).abs().max() < (blind - plan.states.q[-1]).abs().max()


def test_a_quadruped_recovers_from_a_push_and_takes_off():
    """A row each; their torques are beside servos that hold the stand."""
    robot, stand, steps = torchdq.robots.load("go2"), double(0.0, 0.8, -1.6).repeat(4), 60
    servo = effects.Servo(torch.full((12,), 40.0).double(), torch.ones(12).double(), robot.limits.effort)
    scene = Scene(robot, (effects.Gravity(), effects.RotorInertia(0.01), servo, effects.Contact("*_foot")), dt=0.005)
    hold = stand.expand(200, 12)
    X = dq.from_pose(double(1, 0, 0, 0), double(0.0, 0.0, 0.3))
    state = scene.rollout(scene.start(stand, X_WB=X), steps=200, target=hold).last
    weights = [[2, 2, 2, 2, 2, 2.0], [2, 2, 2, 0, 0, 0.0]], [[400] * 6, [200] * 3 + [0] * 3]
    moving = [[0.1] * 6, [0.1] * 3 + [0] * 3], [[40] * 6, [40] * 3 + [100] * 3]
    goal = double([0] * 6, [0] * 5 + [1.5])

    def costs(k, posture, speeds):
        found = [optimal.BasePose(state.X_WB, double(*weights[k])), optimal.BaseVelocity(double(*moving[k]), goal)]
        return [*found, optimal.Posture(stand, posture), optimal.Speeds(speeds)]

    problem = optimal.Problem(scene, steps, [*costs(0, 0.05, 1e-3), optimal.Torques(1e-4)], costs(1, 1.0, 0.01))
    start = state._replace(**{name: x.expand(2, -1) for name, x in state.rows().items()})
    start = start._replace(V_WB_B=start.V_WB_B + double([0, 0, 0, 0, 0.6, 0], [0] * 6))
    held = problem.cost(start, torch.zeros(steps, 2, 12).double(), target=hold[:steps, None].expand(-1, 2, -1))
    plan = optimal.solve(problem, start, iterations=2, target=hold[:steps, None].expand(-1, 2, -1))
    assert (plan.cost < 0.1 * held).all()
    assert plan.states.V_WB_B[-1, 0].abs().max() < 0.05 and plan.states.V_WB_B[-1, 1, 5] > 1.4
    assert (plan.torque.abs() <= robot.limits.effort).all()
