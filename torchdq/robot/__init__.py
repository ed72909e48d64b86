"""Robot descriptions: what a robot is made of, where the numbers come from, and whether they can be true."""

from torchdq.robot.robot import Frame, Limits, Robot

__all__ = ["Frame", "Limits", "Robot"]
