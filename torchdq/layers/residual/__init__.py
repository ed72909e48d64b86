"""Rigid-body dynamics with a network for the residual torques.

dynamics   the model and the network together
gate       scales of the network's inputs and outputs, and the bounds within which it acts
domain     the states that the network was trained on
posterior  errors of the torques
networks   small perceptrons side by side
recorded   torques as a function of torques that change the acceleration, for simulation
smooth     steps and limits without a jump in their derivatives
"""

from torchdq.layers.residual.dynamics import ResidualDynamics
from torchdq.layers.residual.posterior import PredictedTorques

__all__ = ["PredictedTorques", "ResidualDynamics"]
