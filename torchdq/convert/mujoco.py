"""Conventions of MuJoCo; bodies with a free joint come first in its rows."""

import torch
from torch import Tensor

from torchdq import dq
from torchdq.convert.rows import cross, parts, row, to_base
from torchdq.dq.components import unit


def to_mujoco(x: Tensor) -> tuple[Tensor, Tensor]:
    """Position [..., 3] of B's origin in A [m] and unit quaternion (w, x, y, z) [..., 4] of the pose x = X_AB [..., 8].

    >>> import torch
    >>> position, rotation = to_mujoco(torch.tensor([1.0, 0, 0, 0, 0, 0.5, 1, 1.5]))
    >>> position, rotation
    (tensor([1., 2., 3.]), tensor([1., 0., 0., 0.]))
    """
    return dq.translation(x), dq.rotation(x)


def from_mujoco(position: Tensor, rotation: Tensor) -> Tensor:
    """Pose X_AB [..., 8] from MuJoCo's position and quaternion, with A the world.

    >>> import torch
    >>> from_mujoco(torch.tensor([1.0, 2, 3]), torch.tensor([1.0, 0, 0, 0]))
    tensor([1.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.5000, 1.0000, 1.5000])
    """
    # MuJoCo's arrays are views into its state: a copy keeps the pose from changing with the next step
    position, rotation = (v if isinstance(v, Tensor) else torch.tensor(v) for v in (position, rotation))
    return dq.from_pose(rotation, position)


def configuration_to_mujoco(X_WB: Tensor, q: Tensor) -> Tensor:
    """`qpos` [..., 7 + n] of MuJoCo.

    >>> import torch
    >>> configuration_to_mujoco(
    ...     torch.tensor([1.0, 0, 0, 0, 0, 0.5, 1, 1.5]), torch.tensor([0.7])
    ... )
    tensor([1.0000, 2.0000, 3.0000, 1.0000, 0.0000, 0.0000, 0.0000, 0.7000])
    """
    return row(*to_mujoco(X_WB), q)


def configuration_from_mujoco(qpos: Tensor) -> tuple[Tensor, Tensor]:
    """Pose X_WB [..., 8] of the base and joint positions q [..., n], from `qpos` [..., 7 + n].

    Raises:
        ArgumentError: a quaternion is not unit; `torchdq.dq.normalize` makes it so.

    >>> import torch
    >>> from torchdq import dq
    >>> X_WB, q = configuration_from_mujoco(torch.tensor([1.0, 2, 3, 1, 0, 0, 0, 0.7]))
    >>> dq.translation(X_WB), q
    (tensor([1., 2., 3.]), tensor([0.7000]))
    """
    position, rotation, q = parts("qpos", qpos, 3, 4)
    return from_mujoco(position, unit("qpos", rotation)), q


def velocity_to_mujoco(X_WB: Tensor, V_WB_B: Tensor, qd: Tensor) -> Tensor:
    """`qvel` [..., 6 + n] of MuJoCo.

    >>> import torch
    >>> quarter = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # about z
    >>> V_WB_B = torch.tensor([1.0, 0, 0, 1, 0, 0])
    >>> velocity_to_mujoco(quarter, V_WB_B, torch.tensor([5.0])).round(decimals=4)
    tensor([0., 1., 0., 1., 0., 0., 5.])
    """
    w, v = parts("V_WB_B", V_WB_B, 3, 3)[:2]
    return row(dq.rotate(dq.rotation(X_WB), v), w, qd)


def velocity_from_mujoco(X_WB: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
    """Twist V_WB_B [..., 6] of the base and qd [..., n], from `qvel` [..., 6 + n].

    >>> import torch
    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> velocity_from_mujoco(X_WB, torch.tensor([0.0, 1, 0, 0, 0, 2, 5]))[0].round(decimals=4)
    tensor([0., 0., 2., 1., 0., 0.])
    """
    v, w, qd = parts("qvel", qvel, 3, 3)
    return row(w, to_base(X_WB, v)), qd


def acceleration_to_mujoco(X_WB: Tensor, V_WB_B: Tensor, A_WB_B: Tensor, qdd: Tensor) -> Tensor:
    """`qacc` [..., 6 + n]: rates of `qvel`; the velocity in world axes also changes as the base turns.

    >>> import torch
    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> turning, still = torch.tensor([0.0, 0, 2, 1, 0, 0]), torch.zeros(6)
    >>> # v turns with the base
    >>> acceleration_to_mujoco(X_WB, turning, still, torch.zeros(1)).round(decimals=4)
    tensor([-2.,  0.,  0.,  0.,  0.,  0.,  0.])
    """
    (w, v), (wd, vd) = (parts(*x, 3, 3)[:2] for x in (("V_WB_B", V_WB_B), ("A_WB_B", A_WB_B)))
    return row(dq.rotate(dq.rotation(X_WB), vd + cross(w, v)), wd, qdd)


def acceleration_from_mujoco(X_WB: Tensor, V_WB_B: Tensor, qacc: Tensor) -> tuple[Tensor, Tensor]:
    """Rate A_WB_B [..., 6] of the base's twist and qdd [..., n], from `qacc` [..., 6 + n].

    >>> import torch
    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> turning = torch.tensor([0.0, 0, 2, 1, 0, 0])
    >>> A_WB_B, qdd = acceleration_from_mujoco(X_WB, turning, torch.tensor([-2.0, *6 * [0]]))
    >>> A_WB_B.abs().max() < 1e-6
    tensor(True)
    """
    w, v = parts("V_WB_B", V_WB_B, 3, 3)[:2]
    vd, wd, qdd = parts("qacc", qacc, 3, 3)
    return row(wd, to_base(X_WB, vd) - cross(w, v)), qdd


def forces_to_mujoco(X_WB: Tensor, F_B: Tensor, tau: Tensor) -> Tensor:
    """`qfrc_applied` or `qfrc_inverse` [..., 6 + n] of MuJoCo.

    >>> import torch
    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> F = torch.tensor([1.0, 0, 0, 4, 5, 6])
    >>> forces_to_mujoco(X_WB, F, torch.tensor([7.0])).round(decimals=4)
    tensor([0., 1., 0., 4., 5., 6., 7.])
    """
    force, moment = parts("F_B", F_B, 3, 3)[:2]
    return row(dq.rotate(dq.rotation(X_WB), force), moment, tau)


def forces_from_mujoco(X_WB: Tensor, qfrc: Tensor) -> tuple[Tensor, Tensor]:
    """Wrench F_B [..., 6] on the base and torques tau [..., n], from generalised forces [..., 6 + n] of MuJoCo.

    >>> import torch
    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> forces_from_mujoco(X_WB, torch.tensor([0.0, 1, 0, 4, 5, 6, 7]))[0].round(decimals=4)
    tensor([1., 0., 0., 4., 5., 6.])
    """
    force, moment, tau = parts("qfrc", qfrc, 3, 3)
    return row(to_base(X_WB, force), moment), tau
