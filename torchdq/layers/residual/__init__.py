"""Rigid-body dynamics with a network for what is left: what it sees, where it may act, how far it may be off.

networks   small perceptrons side by side
smooth     steps and limits without a jump in their derivatives
domain     the states that a network was trained on
posterior  errors of the torques
line       torques as a function of torques that change the acceleration, for simulation
dynamics   the model and the network together
"""

from torchdq.layers.residual.domain import Domain
from torchdq.layers.residual.dynamics import ResidualDynamics
from torchdq.layers.residual.networks import Joined, Perceptrons
from torchdq.layers.residual.posterior import Posterior, PredictedTorques

__all__ = ["Domain", "Joined", "Perceptrons", "Posterior", "PredictedTorques", "ResidualDynamics"]
