"""Friction of a joint, on numbers or on tensors."""

from torchdq.algebra.quaternion import Number
from torchdq.numbers.functions import sqrt


def smooth_speed(qd: Number, width: Number) -> Number:
    """Smooth absolute value sqrt(qd^2 + width^2) of a velocity, which is never zero."""
    return sqrt(qd * qd + width * width)


def smooth_sign(qd: Number, width: Number) -> Number:
    """Smooth sign qd / sqrt(qd^2 + width^2) of a velocity, the direction of Coulomb friction."""
    return qd / smooth_speed(qd, width)


def friction_torque(qd: Number, viscous: Number, coulomb: Number, width: Number) -> Number:
    """Torque viscous qd + coulomb qd / sqrt(qd^2 + width^2) that overcomes friction."""
    return viscous * qd + coulomb * smooth_sign(qd, width)
