"""Optimal control: torques of many steps that cost least, of batches of problems, in the loops of rollouts.

    final = [optimal.Point("tip", goal, 1e3), optimal.Speeds(10.0)]
    problem = optimal.Problem(scene, 50, [optimal.Torques(1e-4)], final)
    plan = optimal.solve(problem, scene.start(q))

`solve` is iterative LQR with limits of the torques, or a sampling method; `Receding` plans again at every tick.
"""

from torchdq.optimal.costs import (
    BasePose,
    BaseVelocity,
    JointLimits,
    Point,
    Pose,
    Posture,
    Residuals,
    Speeds,
    Spheres,
    Torques,
)
from torchdq.optimal.derivatives import differentiable
from torchdq.optimal.ilqr import solve
from torchdq.optimal.problem import STATUS, Plan, Problem
from torchdq.optimal.receding import Receding
from torchdq.optimal.sampling import CEM, MPPI

__all__ = [
    "CEM",
    "MPPI",
    "STATUS",
    "BasePose",
    "BaseVelocity",
    "JointLimits",
    "Plan",
    "Point",
    "Pose",
    "Posture",
    "Problem",
    "Receding",
    "Residuals",
    "Speeds",
    "Spheres",
    "Torques",
    "differentiable",
    "solve",
]
