"""Costs: each is the formula of its docstring, of torch on the states of a rollout; poses have derivatives at goals."""

import pytest
import torch
from helpers import double, random
from robots import on_free_base

import torchdq
from torchdq import Scene, dq, effects, optimal
from torchdq.numbers.functions import sqrt
from torchdq.objects import Box

ROBOT = torchdq.robots.load("two_link")
SCENE = Scene(ROBOT, (effects.Gravity(),), dt=0.02)
STEPS = 6
LIMITED = ROBOT.replace(limits=ROBOT.limits._replace(lower=double(-0.3, -torch.inf), upper=double(0.4, 0.1)))


def pose(*xi):
    return dq.exp(double(*xi)[None] / 2)[0]


def squares(r, weight=2.0):
    return 0.5 * (weight * r.square()).sum((0, -1))


def at(q, frame="tip"):
    return torchdq.forward_kinematics(ROBOT, q, frame)


def error(X_D, X):
    return (dq.Pose(X_D).inverse() @ dq.Pose(X)).log()


def beyond(q):
    return torch.stack([torch.maximum(-0.25 - q[..., 0], q[..., 0] - 0.35), q[..., 1] - 0.05], -1).clamp(min=0)


def near(view, goal):
    return [sqrt(1.0 + (a - b) * (a - b)) for a, b in zip(view.q, goal, strict=True)]


GOAL, TIP, X_D = double(0.1, -0.2), double(1.0, 0.3, 0.1), pose(0.1, 0.2, -0.3, 0.5, 0.1, 0.2)
BOX = Box("box", mass=1.0, size=(0.5, 0.5, 0.5))
X_WO = dq.from_pose(double(1, 0, 0, 0), double(1.8, 0.2, 0.0))


def turned(view):
    return [x for e in view.frame("tip").axes for x in e[:2]]


def velocity(view):
    return view.velocity("tip")


COSTS = {
    "axes": (
        optimal.Residuals(turned, 2.0),
        lambda s, u: dq.to_matrix(at(s.q))[..., :2, :3].mT.flatten(-2),
    ),
    "velocity": (
        optimal.Residuals(velocity, 2.0),
        lambda s, u: torch.autograd.functional.jvp(lambda q: dq.translation(at(q)), s.q, s.qd)[1],
    ),
    "torques": (optimal.Torques(2.0, GOAL), lambda s, u: u - GOAL),
    "speeds": (optimal.Speeds(2.0), lambda s, u: s.qd),
    "posture": (optimal.Posture(GOAL, 2.0), lambda s, u: s.q - GOAL),
    "point": (optimal.Point("tip", TIP, 2.0), lambda s, u: dq.translation(at(s.q)) - TIP),
    "pose": (optimal.Pose("tip", X_D, 2.0), lambda s, u: error(X_D, at(s.q))),
    "limits": (optimal.JointLimits(2.0), lambda s, u: beyond(s.q)),
    "spheres": (
        optimal.Spheres(2.0, None, (BOX,), X_WO[None], height=-0.5, margin=0.6),
        lambda s, u: (0.6 - torchdq.distances(ROBOT, s.q, "tip", (BOX,), X_WO[None], height=-0.5).distance).clamp(
            min=0
        ),
    ),
    "own": (optimal.Residuals(near, 2.0, goal=GOAL), lambda s, u: (1 + (s.q - GOAL).square()).sqrt()),
}


@pytest.mark.parametrize("name", COSTS)
def test_a_cost_is_its_formula(name):
    cost, residual = COSTS[name]
    scene = SCENE.replace(robot=LIMITED)
    state, torque = scene.start(0.3 * random(3, 2)), random(STEPS, 3, 2, seed=1)
    states = scene.rollout(state, torque)
    found = optimal.Problem(scene, STEPS, [cost], torques=None).cost(state, torque)
    assert torch.allclose(found, squares(residual(states, torque)), rtol=1e-12) and found.min() > 0
    twice = optimal.Problem(scene, STEPS, [cost], [cost], torques=None)
    last = squares(residual(states, torque)[-1:])
    assert torch.allclose(twice.cost(state, torque), found + last, rtol=1e-12)


def test_costs_of_a_floating_base_are_their_formulas():
    scene = Scene(on_free_base(ROBOT), dt=0.02)
    V, torque = double(0.1, 0.2, 0.3, -0.1, 0.0, 0.2), random(STEPS, 2, seed=1)
    state = scene.start(GOAL, V_WB_B=V)
    states = scene.rollout(state, torque)
    costs = [optimal.BasePose(X_D, 2.0), optimal.BaseVelocity(2.0, V / 2), optimal.Residuals(velocity, 2.0)]
    found = optimal.Problem(scene, STEPS, costs).cost(state, torque)

    def tip(t):
        moved = dq.mul(states.X_WB, dq.exp(t * states.V_WB_B / 2))
        return dq.translation(dq.mul(moved, at(states.q + t * states.qd)))

    of_tip = torch.autograd.functional.jvp(tip, double(0.0), double(1.0))[1]
    expected = squares(error(X_D, states.X_WB)) + squares(states.V_WB_B - V / 2) + squares(of_tip)
    assert torch.allclose(found, expected, rtol=1e-12)


def test_a_pose_that_is_reached_has_derivatives():
    q = double(0.4, -0.7)
    problem = optimal.Problem(SCENE.replace(effects=()), 5, [optimal.Pose("tip", at(q), 1.0), optimal.Torques(0.1)])
    plan = optimal.solve(problem, SCENE.start(q))
    assert plan.converged and plan.cost == 0 and plan.gain.isfinite().all()


def test_weights_of_every_residual_and_step_count():
    weight = random(STEPS, 3, 2).abs()
    state, torque = SCENE.start(random(3, 2)), random(STEPS, 3, 2, seed=1)
    states = SCENE.rollout(state, torque)
    problem = optimal.Problem(SCENE, STEPS, [optimal.Speeds(weight)], [optimal.Speeds(double(1.0, 5.0))])
    expected = squares(states.qd, weight) + squares(states.qd[-1:], double(1.0, 5.0))
    assert torch.allclose(problem.cost(state, torque), expected, rtol=1e-12)
