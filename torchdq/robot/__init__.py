"""Robots: their frozen description, its sources (URDF, screws, Denavit-Hartenberg), and its physical consistency."""

from torchdq.robot.robot import Frame, Limits, Robot

__all__ = ["Frame", "Limits", "Robot"]
