"""Robots: their frozen description, its sources (URDF, screws, Denavit-Hartenberg), and its physical consistency."""

from torchdq.robot.contact_points import ContactPoint
from torchdq.robot.description import Closure, Frame, Limits
from torchdq.robot.robot import Robot

__all__ = ["Closure", "ContactPoint", "Frame", "Limits", "Robot"]
