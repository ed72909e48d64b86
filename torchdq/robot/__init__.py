"""Robots: their frozen description, its sources (URDF, screws, Denavit-Hartenberg), and its physical consistency."""

from torchdq.robot.description import Frame, Limits
from torchdq.robot.robot import Robot

__all__ = ["Frame", "Limits", "Robot"]
