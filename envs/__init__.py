"""Scenes and gymnasium environments of torchdq; imported as `torchdq.envs`, never as `envs`."""

from torchdq.envs import controllers, effects, integrators
from torchdq.envs.scene import Scene, State

__all__ = ["Scene", "State", "controllers", "effects", "integrators"]
