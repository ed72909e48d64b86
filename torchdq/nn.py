"""Dynamics as modules of torch, with quantities that may be learned and stay physical.

InverseDynamics   joint torques of a motion; `DQRNEA` is its name after the paper's algorithm
ForwardDynamics   joint accelerations under torques
FloatingInverseDynamics, FloatingForwardDynamics
                  the same for robots with a floating base
ComputedTorque    tracking controller, of a robot or of a trained layer
MomentumObserver  torques and forces of contacts, from motions and torques of the motors
OperationalSpaceControl, CartesianImpedance
                  control of a frame, likewise
ResidualDynamics  inverse dynamics and a network for the residual torques
RobotModule       base of those of a robot alone
"""

from torchdq.layers.computed_torque import ComputedTorque
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
from torchdq.layers.task_control import CartesianImpedance, OperationalSpaceControl

__all__ = [
    "DQRNEA",
    "CartesianImpedance",
    "ComputedTorque",
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
