"""Friction of a joint, on numbers or on tensors."""

from torchdq.algebra.quaternion import Number
from torchdq.numbers.functions import sqrt


def smooth_sign(qd: Number, width: Number) -> Number:
    """Smooth sign qd / sqrt(qd^2 + width^2) of a velocity, the direction of Coulomb friction."""
    return qd / sqrt(qd * qd + width * width)


def friction_torque(qd: Number, viscous: Number, coulomb: Number, width: Number) -> Number:
    """Torque viscous qd + coulomb qd / sqrt(qd^2 + width^2) that overcomes friction."""
    return viscous * qd + coulomb * smooth_sign(qd, width)
