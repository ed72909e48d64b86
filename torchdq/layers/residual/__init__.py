"""Rigid-body dynamics with a network for the residual torques."""

from torchdq.layers.residual.dynamics import ResidualDynamics
from torchdq.layers.residual.posterior import PredictedTorques

__all__ = ["PredictedTorques", "ResidualDynamics"]
