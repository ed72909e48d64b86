"""Friction of a joint, on numbers or on tensors."""

from torchdq.algebra.quaternion import Number
from torchdq.numbers.functions import sqrt


def smooth_speed(qd: Number, width: Number) -> Number:
    """Smooth absolute value sqrt(qd^2 + width^2) of a velocity, which is never zero."""
    return sqrt(qd * qd + width * width)


def smooth_sign(qd: Number, width: Number) -> Number:
    """Smooth sign qd / sqrt(qd^2 + width^2) of a velocity, the direction of Coulomb friction."""
    return qd / smooth_speed(qd, width)
