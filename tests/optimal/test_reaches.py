"""Reaches of a Panda cost what those of Crocoddyl 3.2.1 do, of the same model, steps and weights, or less under limits.

`python benchmarks/optimal.py` compares more of them, and times.
"""

import oracles
import pytest
import torch
from helpers import double

import torchdq
from torchdq import Scene, effects, optimal
from torchdq.scene.integrators import SemiImplicitEuler

BACKEND = "auto"
STEPS, DT, TIP = 50, 0.02, "panda_hand_tcp"
ONE = double(0.08217701565829368, -0.6381279772303903, -0.2754158965823272, -2.290083430209762)
ONE = torch.cat([ONE, double(0.18796215098910798, 1.747653356207493, 0.8639814680027029)])
TWO = double(0.13779327333337896, -0.6946066353714372, 0.21790736206879222, -1.9751232668620324)
TWO = torch.cat([TWO, double(-0.12017287045280978, 1.4536123308753148, 0.5169917914415425)])
START = torch.stack([ONE, TWO])
TO_ONE = double(0.3465949990067642, 0.3347051404841621, 0.7964155339333784)
TO_TWO = double(0.5308317244731413, -0.15906457188792417, 0.6061453059830506)
GOAL = torch.stack([TO_ONE, TO_TWO])
FDDP, BOX_FDDP = double(0.033060509663, 0.036238525061), double(0.033264333807, 0.037230753035)


@pytest.mark.parametrize(("scale", "costs"), [(None, FDDP), (0.3, BOX_FDDP)], ids=["free", "limits"])
def test_the_costs_are_those_of_crocoddyl(scale, costs):
    joints = [f"panda_joint{k}" for k in range(1, 8)]
    robot = torchdq.Robot.from_urdf(oracles.urdf_paths()["panda"], joints=joints, tip=TIP)
    scene = Scene(robot, (effects.Gravity(),), integrator=SemiImplicitEuler(), dt=DT)
    on = torch.ones(STEPS, 1, 1).double()
    on[-1] = 0.0
    running = [optimal.Torques(DT * 1e-4), optimal.Speeds(DT * 1e-2 * on), optimal.Posture(START, DT * 1e-2 * on)]
    final = [optimal.Point(TIP, GOAL, 1e3), optimal.Speeds(10.0)]
    effort = robot.limits.effort
    problem = optimal.Problem(scene, STEPS, running, final, scale and (-scale * effort, scale * effort))
    plan = optimal.solve(problem, scene.start(START))
    assert plan.converged.all() and (plan.cost / costs - 1).max() <= 1e-6
    if scale is None:
        assert (plan.cost / costs - 1).min() >= -1e-6
    else:  # where Crocoddyl may end at another minimum
        assert (plan.torque.abs() <= scale * effort).all() and (plan.torque.abs() == scale * effort).any()
