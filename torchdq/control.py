"""Computed torque control: feedback linearisation by the inverse dynamics, equations (73)-(78)."""

from contextlib import suppress
from numbers import Real
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.base.checks import require_number, require_tensor
from torchdq.errors import ArgumentError
from torchdq.functional import function_of
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

    that is inverse dynamics with the acceleration a, gravity of the robot included, as one program. If the model is
    wrong, the error does not vanish, but is bounded by the model error divided by the gains.

    Args:
        robot: the model of the robot that is controlled.
        q, qd: measured positions [rad or m] and velocities [rad/s or m/s], shape [..., n].
        q_des, qd_des, qdd_des: desired positions, velocities and accelerations, shape [..., n].
        kp: position gain [1/s^2], a number or shape [..., n].
        kd: velocity gain [1/s], a number or shape [..., n]; 2 sqrt(kp) is critical damping.
        f_tip: wrench the end effector exerts on the environment [N, N m], shape [..., 6], in the tip frame.

    Source: (73)-(78); departure: erratum 75.

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.zeros(2, dtype=torch.float64)
    >>> tau = computed_torque(robot, q, q, q + 0.1, q, q, kp=100.0, kd=20.0)
    >>> torchdq.forward_dynamics(robot, q, q, tau)  # kp times the error
    tensor([10.0000, 10.0000], dtype=torch.float64)
    """
    require_tensor("q", q)
    given = {"q": q, "qd": qd, "q_des": q_des, "qd_des": qd_des, "qdd_des": qdd_des}
    gains = {"kp": _gain("kp", kp, q), "kd": _gain("kd", kd, q)}
    single = tuple([name for name, gain in gains.items() if not gain.ndim])
    return function_of("computed_torque", robot, {**given, **gains, "f_tip": f_tip}, backend, single)[0]


def _gain(name: str, gain: Tensor | float, q: Tensor) -> Tensor:
    """Gain as a tensor, a single number in the dtype of q."""
    if isinstance(gain, Tensor) and gain.ndim:
        return gain
    if isinstance(gain, Tensor):
        if gain.is_complex() or gain.dtype == torch.bool:
            raise ArgumentError(f"{name} must be a real number, found {gain}")
        return gain.to(q)
    if not isinstance(gain, Real):
        cure = "; use torch.as_tensor" if isinstance(gain, list | tuple | np.ndarray) else ""
        raise ArgumentError(f"{name} must be a number or a tensor, found {type(gain).__name__}{cure}")
    require_number(name, gain)
    if gain < 0:
        raise ArgumentError(f"{name} must not be negative, found {gain!r}")
    return torch.tensor(gain, dtype=q.dtype, device=q.device)


def constant_gain(name: str, gain: Any, n: int) -> Tensor:
    """Gain as float64 numbers, one or n; raises unless they are real, finite and not negative."""
    with suppress(TypeError, ValueError):  # words, and rows of different lengths
        x = gain if isinstance(gain, Tensor) else torch.from_numpy(np.array(gain))
        real = x.dtype != torch.bool and not x.is_complex()
        if real and x.shape in ((), (n,)) and bool((x.isfinite() & (x >= 0)).all()):
            return x.double()
    raise ArgumentError(f"{name} must be a number or {n} numbers, real, finite and not negative, found {gain!r}")
