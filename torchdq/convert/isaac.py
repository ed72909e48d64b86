"""Root states of Isaac: velocities and accelerations in world axes."""

from typing import Literal

from torch import Tensor

from torchdq import dq
from torchdq.base.checks import require_choice
from torchdq.convert.rows import cross, from_xyzw, parts, row, to_base, to_xyzw
from torchdq.dq.components import unit

QuaternionOrder = Literal["wxyz", "xyzw"]


def root_to_isaac(X_WB: Tensor, V_WB_B: Tensor, order: QuaternionOrder = "wxyz", com: Tensor | None = None) -> Tensor:
    """Root state [..., 13] of Isaac.

    Args:
        X_WB, V_WB_B: pose [..., 8] and twist [..., 6] of the base.
        order: "wxyz" for Isaac Lab before 3.0 and Isaac Sim, "xyzw" for Isaac Gym and Isaac Lab from 3.0 on.
        com: point of the base [m], shape [..., 3], that the linear velocity is of; None: the origin, as in
            `root_link_state_w`. Isaac Lab's `root_state_w` has that of the centre of mass, `robot.base_com`.

    >>> import torch
    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> root_to_isaac(X_WB, torch.tensor([0.0, 0, 2, 1, 0, 0]))[7:].round(decimals=4)
    tensor([0., 1., 0., 0., 0., 2.])
    """
    require_choice("order", order, ("wxyz", "xyzw"))
    r = dq.rotation(X_WB)
    w, v = parts("V_WB_B", V_WB_B, 3, 3)[:2]
    v = v if com is None else v + cross(w, com)
    return row(dq.translation(X_WB), r if order == "wxyz" else to_xyzw(r), dq.rotate(r, v), dq.rotate(r, w))


def root_from_isaac(state: Tensor, order: QuaternionOrder = "wxyz", com: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Pose X_WB [..., 8] and twist V_WB_B [..., 6] of the base, from a root state [..., 13]; see `root_to_isaac`.

    Raises:
        ArgumentError: a quaternion is not unit; `torchdq.dq.normalize` makes it so.

    >>> import torch
    >>> X_WB, V_WB_B = root_from_isaac(torch.tensor([1.0, 2, 3, 1, 0, 0, 0, 4, 5, 6, 7, 8, 9]))
    >>> V_WB_B
    tensor([7., 8., 9., 4., 5., 6.])
    """
    require_choice("order", order, ("wxyz", "xyzw"))
    position, r, v, w, _ = parts("state", state, 3, 4, 3, 3)
    r = unit("state", r)
    X_WB = dq.from_pose(r if order == "wxyz" else from_xyzw(r), position)
    w, v = to_base(X_WB, w), to_base(X_WB, v)
    return X_WB, row(w, v if com is None else v - cross(w, com))


def acceleration_to_isaac(X_WB: Tensor, V_WB_B: Tensor, A_WB_B: Tensor, com: Tensor | None = None) -> Tensor:
    """Linear and angular acceleration [..., 6] of the base in world axes; `com` as in `root_to_isaac`.

    >>> import torch
    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> turning, still = torch.tensor([0.0, 0, 2, 1, 0, 0]), torch.zeros(6)
    >>> acceleration_to_isaac(X_WB, turning, still).round(decimals=4)  # v turns with the base
    tensor([-2.,  0.,  0.,  0.,  0.,  0.])
    """
    (w, v), (wd, vd) = (parts(*x, 3, 3)[:2] for x in (("V_WB_B", V_WB_B), ("A_WB_B", A_WB_B)))
    r = dq.rotation(X_WB)
    if com is not None:
        v, vd = v + cross(w, com), vd + cross(wd, com)
    return row(dq.rotate(r, vd + cross(w, v)), dq.rotate(r, wd))


def acceleration_from_isaac(X_WB: Tensor, V_WB_B: Tensor, acceleration: Tensor, com: Tensor | None = None) -> Tensor:
    """Rate A_WB_B [..., 6] of the base's twist, from linear and angular acceleration [..., 6] in world axes.

    >>> import torch
    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> turning = torch.tensor([0.0, 0, 2, 1, 0, 0])
    >>> A_WB_B = acceleration_from_isaac(X_WB, turning, torch.tensor([-2.0, 0, 0, 0, 0, 0]))
    >>> A_WB_B.abs().max() < 1e-6
    tensor(True)
    """
    w, v = parts("V_WB_B", V_WB_B, 3, 3)[:2]
    vd, wd = (to_base(X_WB, x) for x in parts("acceleration", acceleration, 3, 3)[:2])
    if com is not None:
        v, vd = v + cross(w, com), vd - cross(wd, com)
    return row(wd, vd - cross(w, v))


def wrench_to_isaac(F_B: Tensor, com: Tensor) -> tuple[Tensor, Tensor]:
    """Force and moment about the centre of mass `com` [..., 3], both in base axes, of a wrench F_B [..., 6].

    >>> import torch
    >>> wrench_to_isaac(torch.tensor([0.0, 0, 10, 0, 0, 0]), com=torch.tensor([0.5, 0, 0]))
    (tensor([ 0.,  0., 10.]), tensor([0., 5., 0.]))
    """
    force, moment = parts("F_B", F_B, 3, 3)[:2]
    return force, moment - cross(com, force)


def wrench_from_isaac(force: Tensor, moment: Tensor, com: Tensor) -> Tensor:
    """Wrench F_B [..., 6] about the origin of the base, from force and moment about its centre of mass.

    >>> import torch
    >>> force, moment = torch.tensor([0.0, 0, 10]), torch.tensor([0.0, 5, 0])
    >>> wrench_from_isaac(force, moment, com=torch.tensor([0.5, 0, 0]))
    tensor([ 0.,  0., 10.,  0.,  0.,  0.])
    """
    return row(force, moment + cross(com, force))
