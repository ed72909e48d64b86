"""Dynamics as modules of torch, with quantities that may be learned and stay physical.

InverseDynamics   joint torques of a motion; `DQRNEA` is its name after the paper's algorithm
ForwardDynamics   joint accelerations under torques
FloatingInverseDynamics, FloatingForwardDynamics
                  the same for robots with a floating base
Control           any control law of `torchdq.scene.controllers`, of a robot or of a trained layer
ComputedTorque, OperationalSpaceControl, CartesianImpedance
                  those of tracking, and of a frame
MomentumObserver  torques and forces of contacts, from motions and torques of the motors
ResidualDynamics  inverse dynamics and a network for the residual torques
RobotModule       base of those of a robot alone
"""

from torchdq.layers.control import CartesianImpedance, ComputedTorque, Control, OperationalSpaceControl
from torchdq.layers.dynamics import (
    DQRNEA,
    FloatingForwardDynamics,
    FloatingInverseDynamics,
    ForwardDynamics,
    InverseDynamics,
)
from torchdq.layers.momentum_observer import MomentumObserver, ObserverState
from torchdq.layers.residual import ResidualDynamics
from torchdq.layers.robot_module import RobotModule

__all__ = [
    "DQRNEA",
    "CartesianImpedance",
    "ComputedTorque",
    "Control",
    "FloatingForwardDynamics",
    "FloatingInverseDynamics",
    "ForwardDynamics",
    "InverseDynamics",
    "MomentumObserver",
    "ObserverState",
    "OperationalSpaceControl",
    "ResidualDynamics",
    "RobotModule",
]
