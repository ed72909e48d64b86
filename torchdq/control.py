"""Computed torque control: feedback linearisation by the inverse dynamics, equations (73)-(78)."""

from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.errors import ArgumentError
from torchdq.functional import check, inverse_dynamics
from torchdq.robot import Robot


def computed_torque(
    robot: Robot,
    q: Tensor,
    qd: Tensor,
    q_des: Tensor,
    qd_des: Tensor,
    qdd_des: Tensor,
    kp: Tensor | float,
    kd: Tensor | float,
    f_tip: Tensor | None = None,
    backend: BackendName | None = None,
) -> Tensor:
    """Torques tau [..., n] under which the tracking error e = q_des - q obeys e'' + kd e' + kp e = 0.

        tau = M a + c + g + J^T f_tip,   a = qdd_des + kd (qd_des - qd) + kp (q_des - q)

    that is inverse dynamics with the acceleration a, gravity of the robot included. If the model is wrong, the error
    does not vanish, but is bounded by the model error divided by the gains.

    Args:
        robot: the model of the robot that is controlled.
        q, qd: measured positions [rad or m] and velocities, shape [..., n].
        q_des, qd_des, qdd_des: desired positions, velocities and accelerations, shape [..., n].
        kp: position gain [1/s^2], a number or shape [..., n].
        kd: velocity gain [1/s], a number or shape [..., n]; 2 sqrt(kp) is critical damping.
        f_tip: wrench the end effector exerts on the environment [N, N m], shape [..., 6], in the tip frame.

    Source: (73)-(78); departure: erratum 75.
    """
    for name, gain in (("kp", kp), ("kd", kd)):
        if not isinstance(gain, Tensor | float | int):
            raise ArgumentError(f"{name} must be a number or a tensor, found {type(gain).__name__}")
    gains = {name: gain for name, gain in (("kp", kp), ("kd", kd)) if isinstance(gain, Tensor) and gain.ndim}
    check(robot, ("f_tip",), q=q, qd=qd, q_des=q_des, qd_des=qd_des, qdd_des=qdd_des, f_tip=f_tip, **gains)
    acceleration = qdd_des + kd * (qd_des - qd) + kp * (q_des - q)  # (75)-(78), erratum 75
    return inverse_dynamics(robot, q, qd, acceleration, f_tip=f_tip, backend=backend)  # (73), (74)
