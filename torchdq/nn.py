"""Dynamics as modules of torch, with quantities that may be learned and stay physical.

InverseDynamics   joint torques of a motion; `DQRNEA` is its name after the paper's algorithm
ForwardDynamics   joint accelerations under torques
ComputedTorque    tracking controller, of a robot or of a trained layer
ResidualDynamics  inverse dynamics and a network for the residual torques
PredictedTorques  torques of a `ResidualDynamics` with their standard errors and intervals
RobotModule       base of the first three
"""

from torchdq.layers.computed_torque import ComputedTorque
from torchdq.layers.dynamics import DQRNEA, ForwardDynamics, InverseDynamics
from torchdq.layers.residual import PredictedTorques, ResidualDynamics
from torchdq.layers.robot_module import RobotModule

__all__ = [
    "DQRNEA",
    "ComputedTorque",
    "ForwardDynamics",
    "InverseDynamics",
    "PredictedTorques",
    "ResidualDynamics",
    "RobotModule",
]
