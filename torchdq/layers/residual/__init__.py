"""Rigid-body dynamics with a network for the residual torques."""

from torchdq.layers.residual.dynamics import ResidualDynamics

__all__ = ["ResidualDynamics"]
