"""Friction of a joint, on numbers or on tensors."""

from torchdq.algebra.quaternion import Number
from torchdq.numbers.functions import sqrt

SPEEDS = (0.0, 0.1, 1.0)  # at which reports state friction [rad/s or m/s]; zero: when the joint begins to slide
STATED = "friction at rest, and at 0.1 and 1 rad/s or m/s [N m or N]"
COLUMNS = ("joint", "at rest", "at 0.1", "at 1")


def smooth_speed(qd: Number, width: Number) -> Number:
    """Smooth absolute value sqrt(qd^2 + width^2) of a velocity, which is never zero."""
    return sqrt(qd * qd + width * width)


def smooth_sign(qd: Number, width: Number) -> Number:
    """Smooth sign qd / sqrt(qd^2 + width^2) of a velocity, the direction of Coulomb friction."""
    return qd / smooth_speed(qd, width)
