"""Desired acceleration of a tracking controller, on numbers or on tensors."""

from torchdq.algebra.quaternion import Number


def commanded(q: Number, qd: Number, q_des: Number, qd_des: Number, qdd_des: Number, kp: Number, kd: Number) -> Number:
    """Acceleration qdd_des + kd (qd_des - qd) + kp (q_des - q), the desired one with the errors fed back."""
    return qdd_des + kd * (qd_des - qd) + kp * (q_des - q)  # (75)-(78), erratum 75
