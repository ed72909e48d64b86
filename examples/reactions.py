"""Torques that move the joints of a robot with a floating base; for the other examples."""

import torch
from torch import Tensor

import torchdq
from torchdq import floating
from torchdq.scene import State


def torques(robot: torchdq.Robot, state: State, qdd: Tensor) -> Tensor:
    """Joint torques [..., n] of joint accelerations [..., n]: no wrench acts on the base, which reacts by moving."""
    M, c, g = floating.closed_form(robot, state.X_WB, state.q, state.V_WB_B, state.qd)
    bias = c + g
    A = torch.linalg.solve(M[..., :6, :6], -bias[..., :6] - (M[..., :6, 6:] @ qdd[..., None])[..., 0])
    return (M[..., 6:, :] @ torch.cat([A, qdd], -1)[..., None])[..., 0] + bias[..., 6:]


def followed(state: State, q: Tensor, qd: Tensor, qdd: Tensor, stiffness: float = 400.0) -> Tensor:
    """Joint accelerations of a desired motion, its errors fed back with critical damping."""
    return qdd + 2 * stiffness**0.5 * (qd - state.qd) + stiffness * (q - state.q)


def smooth(t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Way from 0 to 1 in the times 0 to 1, at rest at both ends, with its two derivatives."""
    t = t.clamp(0, 1)
    return 10 * t**3 - 15 * t**4 + 6 * t**5, 30 * t**2 * (1 - t) ** 2, 60 * t * (1 - t) * (1 - 2 * t)
