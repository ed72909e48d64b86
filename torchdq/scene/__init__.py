"""Scenes: a robot with the effects, the integrator and the step that its simulation asks for."""

from torchdq.scene import controllers, integrators, policies
from torchdq.scene.scene import Scene
from torchdq.scene.state import State

__all__ = ["Scene", "State", "controllers", "integrators", "policies"]
