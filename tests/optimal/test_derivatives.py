"""Gradients of solutions: equal to differences of minima that Newton's method polishes; torques at limits are held."""

import pytest
import torch
from helpers import double, random
from messages import refused
from robots import on_free_base

import torchdq
from torchdq import Scene, effects, optimal
from torchdq.errors import ArgumentError
from torchdq.optimal import derivatives
from torchdq.scene.integrators import RungeKutta4

BACKEND = "auto"
STEPS = 10
ARM = torchdq.robots.load("two_link")
PARAMETERS = {
    "goal": double(1.2, 0.4),
    "weight": double(3e-2),
    "friction": double(0.3, 0.2),
    "q": double(0.3, -0.2),
    "limit": double(12.0, 5.0),
}


def reach(goal, weight, friction, q, limit, limited=True):
    scene = Scene(ARM, (effects.Gravity(), effects.Viscous(friction)), dt=0.03)
    goal = torch.cat([goal, goal.new_zeros(*goal.shape[:-1], 1)], -1)
    costs = [optimal.Torques(weight), optimal.Speeds(1e-2)]
    final = [optimal.Point("tip", goal, 1e2), optimal.Speeds(1.0)]
    return optimal.Problem(scene, STEPS, costs, final, (-limit, limit) if limited else None), scene.start(q)


def curvature(problem, state, torque):
    """Hessian of the cost in torques, of reverse mode."""
    return torch.autograd.functional.hessian(lambda u: problem.cost(state, u), torque).view(torque.numel(), -1)


def polished(problem, state, torque):
    """Torques of the minimum to rounding errors, by Newton's method."""
    limits = problem.limits(state.q) or (double(-torch.inf), double(torch.inf))
    free = ((torque > limits[0] + 1e-9) & (torque < limits[1] - 1e-9)).flatten()
    torque = torque.clamp(*limits).detach()
    for _ in range(3):
        u = torque.clone().requires_grad_()
        slope = torch.autograd.grad(problem.cost(state, u), u)[0].flatten()
        change = torch.zeros_like(slope)
        change[free] = -torch.linalg.solve(curvature(problem, state, torque)[free][:, free], slope[free])
        torque = torque + change.view_as(torque)
    return torque


@pytest.mark.parametrize("limited", [False, True])
def test_gradients_of_costs_and_torques_are_differences_of_minima(limited):
    given = {name: x.clone().requires_grad_() for name, x in PARAMETERS.items()}
    problem, state = reach(**given, limited=limited)
    plan = optimal.solve(problem, state, tolerance=1e-16, iterations=300)
    at = plan.torque.abs() >= PARAMETERS["limit"] - 1e-12
    assert plan.converged and (not limited or at.sum() > 3)
    near = optimal.differentiable(problem, state, plan)
    plan = optimal.differentiable(problem, state, plan._replace(torque=polished(problem, state, plan.torque)))
    C, names = random(STEPS, 2, seed=1), [name for name in given if limited or name != "limit"]
    of = [given[name] for name in names]
    by_cost = torch.autograd.grad(plan.cost, of, retain_graph=True)
    by_motion, as_solved = (torch.autograd.grad((C * x.torque).sum() + x.states.q[-1].sum(), of) for x in (plan, near))

    def values(name, x):
        problem, state = reach(**{**PARAMETERS, name: x}, limited=limited)
        u = plan.torque.detach()
        u = polished(problem, state, torch.where(at, u.sign() * x, u) if name == "limit" else u)
        return problem.cost(state, u), (C * u).sum() + problem.scene.rollout(state, u).q[-1].sum()

    for name, slope, motion, rough in zip(names, by_cost, by_motion, as_solved, strict=True):
        x, h = PARAMETERS[name], 1e-4 * PARAMETERS[name].abs().max()
        assert (rough - motion).abs().max() <= 1e-5 * motion.abs().max()
        for k, unit in enumerate(torch.eye(x.numel()).double()):
            above, below = (values(name, x + s * h * unit.view_as(x)) for s in (1, -1))
            for a, b, found in zip(above, below, (slope, motion), strict=True):
                expected = (a - b) / (2 * h)
                assert abs(found.flatten()[k] - expected) <= 1e-6 * max(1.0, found.abs().max()), name


def lagging():
    goal = double(0.4, -0.3).requires_grad_()
    scene = Scene(ARM, (effects.Gravity(), effects.FirstOrderLag(0.05)), integrator=RungeKutta4(), dt=0.03)
    return optimal.Problem(scene, 6, [optimal.Torques(0.1)], [optimal.Posture(goal, 10.0)]), double(0.1, 0.2), goal


def floating():
    X = torchdq.dq.exp(double(0.1, 0.2, 0.3, 0.1, 0.2, 0.0)[None] / 2)[0].requires_grad_()
    scene = Scene(on_free_base(ARM), (effects.Viscous(0.1),), dt=0.1)
    costs = [optimal.Torques(0.1), optimal.BasePose(X, 5.0), optimal.BaseVelocity(0.1)]
    return optimal.Problem(scene, 6, costs), double(0.3, 0.4), X


@pytest.mark.parametrize("case", [lagging, floating])
def test_torques_follow_by_the_exact_hessian_wherever_they_are(case):
    problem, q, x = case()
    state = problem.scene.start(q)
    torque, C = 0.5 * random(6, 2), random(6, 2, seed=1)
    plan = optimal.solve(problem, state, iterations=1)._replace(torque=torque)
    (found,) = torch.autograd.grad((C * optimal.differentiable(problem, state, plan).torque).sum(), x)
    w = torch.linalg.solve(curvature(problem, state, torque), C.flatten()).view_as(C)
    u = torque.clone().requires_grad_()
    (slope,) = torch.autograd.grad(problem.cost(state, u), u, create_graph=True)
    (expected,) = torch.autograd.grad(-(w * slope).sum(), x)
    assert (found - expected).abs().max() <= 1e-8 * expected.abs().max() > 0


def test_rows_of_a_batch_have_gradients_of_their_own():
    goals = (PARAMETERS["goal"] + 0.1 * random(3, 2)).requires_grad_()
    problem, state = reach(**{**PARAMETERS, "goal": goals, "q": PARAMETERS["q"].expand(3, 2)})
    plan = optimal.differentiable(problem, state, optimal.solve(problem, state, tolerance=1e-14))
    (whole,) = torch.autograd.grad(plan.torque.square().sum(), goals)
    for k in range(3):
        goal = goals.detach()[k].requires_grad_()
        problem, state = reach(**{**PARAMETERS, "goal": goal})
        one = optimal.differentiable(problem, state, optimal.solve(problem, state, tolerance=1e-14))
        (own,) = torch.autograd.grad(one.torque.square().sum(), goal)
        assert (whole[k] - own).abs().max() <= 1e-9 * own.abs().max()


def test_weights_are_found_from_a_motion_that_they_made():
    """Inverse optimal control: of how much speeds cost, by gradients of the motion."""

    def motion(weight, gradients):
        problem = optimal.Problem(
            Scene(ARM, (effects.Gravity(), effects.Viscous(0.1)), dt=0.03),
            STEPS,
            [optimal.Torques(3e-2), optimal.Speeds(weight)],
            [optimal.Point("tip", double(1.2, 0.4, 0.0), 1e2), optimal.Speeds(1.0)],
            None,
        )
        state = problem.scene.start(PARAMETERS["q"])
        plan = optimal.solve(problem, state)
        return (optimal.differentiable(problem, state, plan) if gradients else plan).states.q

    seen, guess = motion(double(0.8), False), double(0.0).requires_grad_()
    optimiser = torch.optim.LBFGS([guess], lr=0.5, max_iter=15)

    def loss():
        optimiser.zero_grad()
        value = 1e4 * (motion(guess.exp(), True) - seen).square().sum()
        value.backward()
        return value

    optimiser.step(loss)
    assert guess.exp().item() == pytest.approx(0.8, rel=1e-4)


def test_the_gradient_of_a_cost_needs_no_second_derivatives(monkeypatch):
    monkeypatch.setattr(derivatives, "curvature", None)
    given = {name: x.clone().requires_grad_() for name, x in PARAMETERS.items()}
    problem, state = reach(**given)
    optimal.differentiable(problem, state, optimal.solve(problem, state)).cost.backward()
    assert given["weight"].grad > 0


def test_second_derivatives_and_plans_of_other_starts_are_refused():
    given = {name: x.clone().requires_grad_() for name, x in PARAMETERS.items()}
    problem, state = reach(**given)
    plan = optimal.differentiable(problem, state, optimal.solve(problem, state))
    for of in (plan.cost, plan.torque.sum(), plan.states.q.sum()):
        with refused(ArgumentError):
            torch.autograd.grad(of, given["goal"], create_graph=True)
    with refused(ArgumentError):
        optimal.differentiable(problem, problem.scene.start(double(0.3, -0.1)), plan)


def test_a_plan_of_samples_is_no_minimum():
    problem, state = reach(**PARAMETERS)
    plan = optimal.solve(problem, state, method=optimal.MPPI(16), iterations=1)
    with refused(ArgumentError):
        optimal.differentiable(problem, state, plan)
