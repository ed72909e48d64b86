"""Simulation of a robot under a controller that acts continuously; for the other examples."""

from collections.abc import Callable, Iterable

import torch
from torch import Tensor

import torchdq


def simulated(
    robot: torchdq.Robot,
    torque: Callable[[Tensor, Tensor, Tensor], Tensor],
    x: Tensor,
    times: Iterable[Tensor],
    h: float,
) -> Tensor:
    """States before and after steps of the classical Runge-Kutta method, shape [steps + 1, 2, ..., n].

    Args:
        robot: the robot.
        torque: torques [..., n] at a time and the state q, qd of it.
        x: initial state, q and qd, shape [2, ..., n].
        times: start of every step [s].
        h: duration of a step [s].
    """

    def rate(t: Tensor, x: Tensor) -> Tensor:
        q, qd = x
        return torch.stack([qd, torchdq.forward_dynamics(robot, q, qd, torque(t, q, qd))])

    states = [x]
    for t in times:
        k1 = rate(t, x)
        k2 = rate(t + h / 2, x + h / 2 * k1)
        k3 = rate(t + h / 2, x + h / 2 * k2)
        k4 = rate(t + h, x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states.append(x)
    return torch.stack(states)
