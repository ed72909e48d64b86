"""Iterative LQR: linear problems are solved by scipy, others have the costs that scipy's minimisers find.

A row of a batch is a problem of its own, to the bit; limits hold and are met; starts need not be feasible.
"""

import numpy as np
import pytest
import scipy
import torch
from helpers import double, random
from messages import refused
from robots import on_free_base, one_joint

import torchdq
from torchdq import Scene, effects, optimal
from torchdq.optimal.knot import box_qp
from torchdq.scene.integrators import RungeKutta4

BACKEND = "auto"
ARM = Scene(torchdq.robots.load("two_link"), (effects.Gravity(), effects.Viscous(0.1)), dt=0.02)
SERVO = ARM.replace(effects=(effects.Gravity(), effects.Servo(100.0, 10.0)))
SLIDE = Scene(one_joint([0.0, 0, 0, 1, 0, 0], mass=[2.0]), dt=0.1)
GOAL = double(1.2, 0.4, 0.0)
STEPS, ROWS = 30, 7


def swing(torques=None, **changes):
    """Problem of the arm, whose tip is brought to a point and to rest."""
    costs, final = (
        [optimal.Torques(1e-3), optimal.Speeds(1e-2)],
        [optimal.Point("tip", GOAL, 1e3), optimal.Speeds(10.0)],
    )
    return optimal.Problem(
        **{"scene": ARM, "steps": STEPS, "costs": costs, "final": final, "torques": torques, **changes}
    )


def starts(*rows, seed=0):
    return ARM.start(0.5 * random(*rows, 2, seed=seed))


def of(state, k):
    """Row of a state."""
    return state._make(None if x is None else x[k] for x in state)


# --- optimality ------------------------------------------------------------------------------------------------------


def test_a_linear_problem_takes_one_iteration_and_its_first_gain_is_that_of_the_riccati_equation():
    weights = {"R": 0.3, "q": 2.0, "qd": 0.5}
    costs = [optimal.Torques(weights["R"]), optimal.Posture(double(0.0), weights["q"]), optimal.Speeds(weights["qd"])]
    problem = optimal.Problem(SLIDE, 300, costs)
    state = SLIDE.start(double(1.0), double(-0.3))
    once, plan = (optimal.solve(problem, state, iterations=k) for k in (1, 9))
    assert plan.converged and int(plan.iterations) == 1
    assert (once.torque - plan.torque).abs().max() <= 1e-12 and abs(once.cost - plan.cost) <= 1e-12
    apart = SLIDE.start(random(301, 1, seed=1), random(301, 1, seed=2))  # states that no torques lead to
    apart = optimal.solve(problem, state, plan.torque + 1.0, apart, iterations=1)
    assert (apart.torque - plan.torque).abs().max() <= 1e-10
    A, B = (x.numpy() for x in SLIDE.linearize(state))
    Q, R = np.diag([weights["q"], weights["qd"]]), np.array([[weights["R"]]])
    P = scipy.linalg.solve_discrete_are(A, B, Q, R)
    K = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    assert np.abs(plan.gain[0].numpy() - K).max() <= 1e-9
    x = np.array([1.0, -0.3])
    assert float(plan.cost) == pytest.approx(0.5 * (x @ P @ x - x @ Q @ x), rel=1e-9)  # the start costs nothing here


@pytest.mark.parametrize("limit", [None, 9.0])
def test_the_cost_is_that_of_a_minimiser_of_scipy_that_knows_gradients_alone(limit):
    problem, state = swing(None if limit is None else (-limit, limit)), starts()
    plan = optimal.solve(problem, state)

    def cost(u):
        u = torch.from_numpy(u).reshape(STEPS, 2).requires_grad_()
        value = problem.cost(state, u)
        value.backward()
        return value.item(), u.grad.numpy().ravel()

    bounds = None if limit is None else [(-limit, limit)] * (2 * STEPS)
    options = {"maxiter": 2000, "maxfun": 4000, "ftol": 1e-15, "gtol": 1e-9, "maxcor": 40}
    found = scipy.optimize.minimize(
        cost, plan.torque.numpy().ravel() * 0.9, jac=True, method="L-BFGS-B", bounds=bounds, options=options
    )
    assert plan.converged and float(plan.cost) == pytest.approx(found.fun, rel=1e-6)
    assert float(plan.cost) == float(problem.cost(state, plan.torque))
    if limit is not None:
        assert (plan.torque.abs().max(), (plan.torque.abs() == limit).sum() > 3) == (limit, True)


def test_the_box_qp_is_that_of_scipy():
    rng, exact = np.random.default_rng(0), []
    for _ in range(100):
        m = int(rng.integers(1, 6))
        J = rng.normal(size=(m + 3, m))
        H, g = J.T @ J, rng.normal(size=m) * 3
        lower, upper = -rng.uniform(0, 1, m), rng.uniform(0, 1, m)
        x, _ = box_qp(H.tolist(), g.tolist(), lower.tolist(), upper.tolist())
        x = np.array(x)
        assert ((lower <= x) & (x <= upper)).all() and 0.5 * x @ H @ x + g @ x <= 1e-12
        best = scipy.optimize.lsq_linear(J, -np.linalg.pinv(J).T @ g, (lower, upper), tol=1e-14).x
        exact.append(np.abs(x - best).max() <= 1e-6)
        free, solved = box_qp(H.tolist(), g.tolist())
        assert np.allclose(free, -np.linalg.solve(H, g)) and np.allclose(solved(g.tolist()), np.linalg.solve(H, g))
        x, _ = box_qp(H.tolist(), g.tolist(), lower.tolist(), upper.tolist(), rounds=1)
        assert 0.5 * np.array(x) @ H @ x + np.dot(x, g) <= 1e-12  # whatever is clipped
        k = int(rng.integers(m))
        lower[k] = 0.0  # torques that begin at a limit follow no state
        x, solved = box_qp(H.tolist(), g.tolist(), lower.tolist(), upper.tolist())
        assert solved(g.tolist())[k] == 0.0
    assert np.mean(exact) >= 0.9  # of the three Newton steps that are recorded


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_torques_that_miss_their_limits_by_rounding_are_at_them(dtype):
    problem, state = swing((-6.0, 2.0)), starts(50).to(dtype)
    at = torch.where(random(STEPS, 50, 2, seed=1, dtype=dtype) > 0, 2.0, -6.0).to(dtype)
    inside = torch.nextafter(at, torch.zeros_like(at))
    path = ARM.rollout(state, at)
    path = state._make(None if x is None else torch.cat([y[None], x]) for x, y in zip(path, state, strict=True))
    left, right = (optimal.solve(problem, state, x, path, iterations=1) for x in (at, inside))
    far = (left.torque - right.torque).abs().amax((0, 2))
    assert (far <= 1e3 * torch.finfo(dtype).eps * 6.0).all()


def test_gains_are_those_of_the_optimal_torques_of_other_starts():
    problem = swing((-200.0, 200.0))
    state = starts()
    plan = optimal.solve(problem, state)
    change = 1e-5 * torch.eye(4).double()
    others = ARM.start(state.q + change[:, :2], state.qd + change[:, 2:])
    near = optimal.solve(problem, others, tolerance=1e-14).torque[0] - plan.torque[0]
    assert (near.mT / 1e-5 - plan.gain[0]).abs().max() <= 0.15 * plan.gain[0].abs().max()  # those leave out curvatures


# --- batches ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("limit", [None, 6.0])
def test_a_row_has_the_same_plan_in_every_batch_to_the_bit_beside_rows_that_are_lost(limit):
    problem, state = swing(None if limit is None else (-limit, limit)), starts(ROWS)
    state.q[3, 1] = torch.nan
    whole = optimal.solve(problem, state)
    assert whole.status.tolist().count(3) == 1 and "diverged" in whole.why()
    for rows in ([0], [5], [1, 2, 4, 6]):
        few = optimal.solve(problem, of(state, rows))
        assert torch.equal(few.torque, whole.torque[:, rows]) and torch.equal(few.gain, whole.gain[:, rows])
        assert few.iterations.tolist() == whole.iterations[rows].tolist()
    one = optimal.solve(problem, of(state, 5))
    assert torch.equal(one.torque, whole.torque[:, 5]) and one.cost.shape == () and one.states.q.shape == (STEPS + 1, 2)


def test_goals_weights_limits_and_parameters_are_those_of_each_row_and_step():
    goals, weight = double(1.2, 0.4, 0.0) + 0.1 * random(2, 3, 3), double(1e-3, 1e-2, 1e-1)[:, None]
    limit = double(30.0, 20.0).expand(2, 1, 2)
    speeds = torch.linspace(0.0, 1.0, STEPS).double().reshape(STEPS, 1, 1, 1)
    friction = torch.full((2, 3, 2), 0.1).double() * double(1.0, 2.0, 3.0)[:, None]
    scene = ARM.replace(effects=(effects.Gravity(), effects.Viscous(friction)))

    def problem(at=...):
        own = scene if at is ... else ARM.replace(effects=(effects.Gravity(), effects.Viscous(friction[at])))
        pick = (lambda x: x) if at is ... else (lambda x: x.expand(2, 3, -1)[at])
        costs = [optimal.Torques(pick(weight)), optimal.Speeds(speeds if at is ... else speeds[:, 0, 0])]
        bounds = tuple(pick(s * limit.expand(2, 3, 2)) for s in (-1, 1))
        return optimal.Problem(own, STEPS, costs, [optimal.Point("tip", pick(goals), 1e3)], bounds)

    state = starts(2, 3)
    plan = optimal.solve(problem(), state)
    assert plan.torque.shape == (STEPS, 2, 3, 2) and plan.converged.all()
    for at in ((0, 0), (1, 2)):
        alone = optimal.solve(problem(at), of(state, at))
        assert torch.equal(alone.torque, plan.torque[(slice(None), *at)])


def test_every_backend_finds_the_same():
    problem = optimal.Problem(SLIDE, 10, [optimal.Torques(0.1), optimal.Posture(double(0.2), 1.0)], torques=(-0.5, 0.5))
    state = SLIDE.start(random(3, 1))
    eager = optimal.Problem(SLIDE.replace(backend="eager"), 10, problem.costs, torques=(-0.5, 0.5))
    a, b = (optimal.solve(x, state) for x in (problem, eager))
    assert (a.torque - b.torque).abs().max() <= 1e-9 and torch.equal(a.status, b.status)


# --- starts ----------------------------------------------------------------------------------------------------------


def test_starts_may_be_torques_or_states_that_no_torques_lead_to_and_a_plan_is_its_own_start():
    problem, state = swing(), starts(3)
    plan = optimal.solve(problem, state)
    straight = torch.linspace(0, 1, STEPS + 1).double()[:, None, None] * (plan.states.q[-1] - state.q) + state.q
    by_states = optimal.solve(problem, state, states=ARM.start(straight))
    by_torques = optimal.solve(problem, state, 0.9 * plan.torque)
    for other in (by_states, by_torques):
        assert other.converged.all() and (other.cost - plan.cost).abs().max() <= 1e-6 * plan.cost.max()
    again = optimal.solve(problem, state, plan.torque, plan.states)
    assert again.iterations.max() <= 1 and (again.cost - plan.cost).abs().max() <= 1e-8


def test_a_policy_follows_the_plan_from_another_start_within_the_limits():
    plan = optimal.solve(swing((-40.0, 40.0)), starts())
    begin = ARM.start(plan.states.q[0] + 0.02)
    followed = ARM.rollout(begin, policy=plan.policy, steps=STEPS)
    blind = ARM.rollout(begin, plan.torque)
    off = [(s.q[-1] - plan.states.q[-1]).abs().max() for s in (followed, blind)]
    assert off[0] <= 0.2 * off[1]


def test_what_is_not_solved_says_why():
    state = starts(4)
    plan = optimal.solve(swing(), state, iterations=2)
    assert plan.status.tolist() == [1] * 4 and "largest number of iterations" in plan.why()


# --- scenes ----------------------------------------------------------------------------------------------------------


def test_a_floating_base_is_turned_by_its_joints():
    robot = on_free_base(torchdq.robots.load("two_link"))
    scene = Scene(robot, (effects.Viscous(0.1),), dt=0.05)
    X = torchdq.dq.exp(double(0.0, 0.0, 0.15, 0.0, 0.0, 0.0)[None] / 2)[0]
    final = [optimal.BasePose(X, double(1, 1, 1, 0, 0, 0)), optimal.BaseVelocity(0.1), optimal.Speeds(0.1)]
    problem = optimal.Problem(scene, 20, [optimal.Torques(1e-4)], [*final])
    state = scene.start(double(0.3, 0.4))
    plan = optimal.solve(problem, state)
    turn = (torchdq.dq.Pose(X).inverse() @ torchdq.dq.Pose(plan.states.X_WB[-1])).log()[:3].norm()
    assert plan.converged and turn < 0.03
    other = state._replace(q=state.q + 0.05)
    recorded, called = (
        scene.rollout(other, policy=policy, steps=20).X_WB for policy in (plan.policy, lambda s, k: plan.policy(s, k))
    )
    assert (recorded - called).abs().max() <= 1e-12


def test_memory_of_effects_and_other_integrators_are_planned_for():
    scene = ARM.replace(effects=(effects.Gravity(), effects.FirstOrderLag(0.05)), integrator=RungeKutta4())
    problem = swing(scene=scene)
    plan = optimal.solve(problem, scene.start(double(0.1, 0.2)))
    assert plan.converged and plan.gain.shape == (STEPS, 2, 6)
    end = torchdq.dq.translation(torchdq.forward_kinematics(scene.robot, plan.states.q[-1], "tip"))
    assert (end - GOAL).norm() < 0.1


def test_single_precision_is_enough_for_a_plan():
    plan = optimal.solve(swing(), starts(3).to(torch.float32))
    wide = optimal.solve(swing(), starts(3))
    assert plan.torque.dtype == torch.float32 and (plan.cost / wide.cost - 1).abs().max() < 1e-4


# --- misuse ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "call",
    [
        lambda: optimal.Problem(ARM, 0, [optimal.Torques(1.0)]),
        lambda: optimal.Problem(ARM.robot, 5, [optimal.Torques(1.0)]),
        lambda: optimal.Problem(ARM, 5, []),
        lambda: optimal.Problem(ARM, 5, [1.0]),
        lambda: swing("efforts"),
        lambda: swing((1.0, -1.0)),
        lambda: swing((1.0,)),
        lambda: swing(scene=ARM.replace(effects=(effects.Gravity(), effects.Noise(0.1)))),
        lambda: swing(scene=ARM.replace(substeps=2, unroll=False)),
        lambda: optimal.solve(ARM, starts()),
        lambda: optimal.solve(swing(), starts(), method="ddp"),
        lambda: optimal.solve(swing(), starts(), torch.zeros(3, 2).double()),
        lambda: optimal.solve(swing(), starts(), tolerance=-1.0),
        lambda: optimal.solve(swing(), starts(), push=torch.zeros(STEPS, 2).double()),
        lambda: optimal.solve(swing(costs=[optimal.Torques(double(1, 2, 3))]), starts()),
        lambda: optimal.solve(swing(costs=[optimal.Torques(torch.zeros(4, 1).double())]), starts()),
        lambda: optimal.solve(swing(costs=[optimal.BasePose(torch.zeros(8).double(), 1.0)]), starts()),
        lambda: optimal.solve(swing(final=[optimal.Speeds(torch.zeros(STEPS, 1).double())]), starts()),
        lambda: optimal.solve(swing(final=[optimal.Point("elbow", GOAL, 1.0)]), starts()),
        lambda: optimal.Residuals(3.0, 1.0),
        lambda: optimal.solve(swing(), starts(), method=optimal.MPPI(4)).policy,
        lambda: swing(control="target"),
        lambda: swing(control="speed"),
        lambda: optimal.solve(swing(scene=SERVO, control="target"), starts(), target=torch.zeros(STEPS, 2).double()),
    ],
)
def test_misuse_is_refused(call):
    with refused(torchdq.TorchdqError):
        call()
