"""Robots: their frozen description, its sources (URDF, screws, Denavit-Hartenberg), and its physical consistency."""

from torchdq.robot.contact_points import ContactPoint
from torchdq.robot.description import Frame, Limits
from torchdq.robot.robot import Robot

__all__ = ["ContactPoint", "Frame", "Limits", "Robot"]
