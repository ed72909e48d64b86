"""Poses, twists and quaternions in the conventions of other libraries.

Here a pose X_AB is [..., 8], a quaternion (w, x, y, z), a twist (angular, linear), a wrench (force, moment). Elsewhere:

    scipy      RigidTransform holds the same pose; its Rotation writes quaternions (x, y, z, w) by default
    Pinocchio  pin.SE3 holds the same pose; Motion is (linear, angular); Force is (linear, angular) = (force, moment),
               which is the order here, so that a wrench needs no conversion: `pin.Force(wrench.numpy())`
    MuJoCo     position and quaternion (w, x, y, z)
    Isaac      position and quaternion, (x, y, z, w) or (w, x, y, z): see `root_to_isaac`

Robots with a free base have their converters at the end: their configurations, velocities, accelerations and forces are
rows of the base and then of the joints there. The joints are those of our robots, in our order: take `q[..., order]`
for the order of a model, found by names. These are differentiable.

scipy and Pinocchio are imported when their converters are called. Nothing is differentiated through those two.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor

from torchdq import dq
from torchdq.checks import device_of, require_choice
from torchdq.dq.components import checked
from torchdq.errors import ArgumentError
from torchdq.optional import imported
from torchdq.program.transforms import without_values

if TYPE_CHECKING:
    import pinocchio
    from scipy.spatial.transform import RigidTransform

UNIT = 1e-4  # error of a norm that is taken for 1: finite differences, and logs printed with six digits, stay below


# --- quaternion order ------------------------------------------------------------------------------------------------


def to_xyzw(r: Tensor) -> Tensor:
    """Quaternion [..., 4] in the order (x, y, z, w), from (w, x, y, z).

    Args:
        r: quaternion (w, x, y, z), shape [..., 4].

    >>> to_xyzw(torch.tensor([1.0, 2, 3, 4]))
    tensor([2., 3., 4., 1.])
    """
    return checked("r", r, 4).roll(-1, -1)


def from_xyzw(r: Tensor) -> Tensor:
    """Quaternion [..., 4] in the order (w, x, y, z), from (x, y, z, w).

    Args:
        r: quaternion (x, y, z, w), shape [..., 4].

    >>> from_xyzw(torch.tensor([2.0, 3, 4, 1]))
    tensor([1., 2., 3., 4.])
    """
    return checked("r", r, 4).roll(1, -1)


# --- MuJoCo ----------------------------------------------------------------------------------------------------------


def to_mujoco(x: Tensor) -> tuple[Tensor, Tensor]:
    """Position [..., 3] of B's origin in A [m] and unit quaternion (w, x, y, z) [..., 4] of the pose x = X_AB [..., 8].

    For Isaac, pass the quaternion on to `to_xyzw`.

    Args:
        x: pose, shape [..., 8].

    >>> position, rotation = to_mujoco(torch.tensor([1.0, 0, 0, 0, 0, 0.5, 1, 1.5]))
    >>> position, rotation
    (tensor([1., 2., 3.]), tensor([1., 0., 0., 0.]))
    """
    return dq.translation(x), dq.rotation(x)


def from_mujoco(position: Tensor, rotation: Tensor) -> Tensor:
    """Pose X_AB [..., 8] from MuJoCo's position and quaternion, e.g. `data.xpos` and `data.xquat`, with A the world.

    Args:
        position: position of B's origin in A [m], shape [..., 3], also as a numpy array.
        rotation: unit quaternion (w, x, y, z), shape [..., 4], also as a numpy array.

    >>> from_mujoco(torch.tensor([1.0, 2, 3]), torch.tensor([1.0, 0, 0, 0]))
    tensor([1.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.5000, 1.0000, 1.5000])
    """
    # MuJoCo's arrays are views into its state: a copy keeps the pose from changing with the next step
    position, rotation = (v if isinstance(v, Tensor) else torch.tensor(v) for v in (position, rotation))
    return dq.from_pose(rotation, position)


# --- scipy -----------------------------------------------------------------------------------------------------------


def to_scipy(x: Tensor) -> RigidTransform:
    """RigidTransform of scipy, with the leading axes of x, for the poses x = X_AB [..., 8].

    `to_scipy(x).apply(p)` takes points from B to A, and products compose as `dq.mul` does. Needs scipy >= 1.16, and
    >= 1.17 for more than one leading axis.

    Args:
        x: poses, shape [..., 8].

    >>> x = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3]))
    >>> to_scipy(x).translation
    array([1., 2., 3.])
    """
    transforms = imported("scipy.spatial.transform", "scipy", "to_scipy")
    return transforms.RigidTransform.from_dual_quat(
        checked("x", x, 8).detach().cpu().double().numpy(), scalar_first=True
    )


def from_scipy(
    transform: RigidTransform, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Poses X_AB [..., 8] of a scipy RigidTransform, with its leading axes.

    Args:
        transform: poses of scipy.
        dtype, device: those of the result.

    >>> x = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3]))
    >>> from_scipy(to_scipy(x))
    tensor([1.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.5000, 1.0000, 1.5000],
           dtype=torch.float64)
    """
    device = None if device is None else device_of("device", device)
    return torch.as_tensor(transform.as_dual_quat(scalar_first=True).copy(), dtype=dtype, device=device)


# --- Pinocchio -------------------------------------------------------------------------------------------------------


def to_pinocchio(x: Tensor) -> pinocchio.SE3:
    """Placement aMb of Pinocchio for one pose x = X_AB [8].

    Args:
        x: one pose, shape [8].
    Raises:
        ArgumentError: x is a batch.

    >>> x = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3]))
    >>> to_pinocchio(x).translation
    array([1., 2., 3.])
    """
    pinocchio = imported("pinocchio", "pin", "to_pinocchio")
    if checked("x", x, 8).ndim != 1:
        raise ArgumentError(f"x must be one pose of shape (8,), found {tuple(x.shape)}; convert row by row")
    x = x.detach().cpu().double()
    return pinocchio.SE3(dq.to_rotation_matrix(dq.rotation(x)).numpy(), dq.translation(x).numpy())


def from_pinocchio(
    placement: pinocchio.SE3, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> Tensor:
    """Pose X_AB [8], with w >= 0, of Pinocchio's placement aMb.

    Args:
        placement: pose of Pinocchio, SE3.
        dtype, device: those of the result.

    >>> x = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3]))
    >>> from_pinocchio(to_pinocchio(x))
    tensor([1.0000, 0.0000, 0.0000, 0.0000, 0.0000, 0.5000, 1.0000, 1.5000],
           dtype=torch.float64)
    """
    matrix: Any = placement.homogeneous
    device = None if device is None else device_of("device", device)
    return dq.from_matrix(torch.tensor(matrix, dtype=torch.float64)).to(dtype=dtype, device=device)


def motion_to_pinocchio(twist: Tensor) -> Tensor:
    """Motion [..., 6] in Pinocchio's order (linear [m/s], angular [rad/s]), from a twist or spatial acceleration.

    The frame stays the same. Wrenches are not converted: their order is (force, moment) in both.

    Args:
        twist: (angular [rad/s], linear [m/s]), shape [..., 6].

    >>> motion_to_pinocchio(torch.tensor([1.0, 2, 3, 4, 5, 6]))
    tensor([4., 5., 6., 1., 2., 3.])
    """
    return dq.swap(checked("twist", twist, 6))


def motion_from_pinocchio(motion: Tensor) -> Tensor:
    """Twist, or spatial acceleration, [..., 6] as (angular [rad/s], linear [m/s]), from Pinocchio's (linear, angular).

    Args:
        motion: (linear [m/s], angular [rad/s]), shape [..., 6].

    >>> motion_from_pinocchio(torch.tensor([4.0, 5, 6, 1, 2, 3]))
    tensor([1., 2., 3., 4., 5., 6.])
    """
    return dq.swap(checked("motion", motion, 6))


# --- free bases: Pinocchio's free-flyer ------------------------------------------------------------------------------


def configuration_to_pinocchio(X_WB: Tensor, q: Tensor) -> Tensor:
    """Configuration [..., 7 + n] of Pinocchio: position, quaternion (x, y, z, w), joints of one coordinate.

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        q: joint positions, shape [..., n].

    >>> configuration_to_pinocchio(torch.tensor([1.0, 0, 0, 0, 0, 0.5, 1, 1.5]), torch.tensor([0.7]))
    tensor([1.0000, 2.0000, 3.0000, 0.0000, 0.0000, 0.0000, 1.0000, 0.7000])
    """
    return _row(dq.translation(X_WB), to_xyzw(dq.rotation(X_WB)), q)


def configuration_from_pinocchio(configuration: Tensor) -> tuple[Tensor, Tensor]:
    """Pose X_WB [..., 8] of the base and joint positions q [..., n], from Pinocchio's configuration [..., 7 + n].

    Its quaternion must be unit; `torchdq.dq.normalize` makes it so.

    Args:
        configuration: position [m], quaternion (x, y, z, w), joints [rad or m], shape [..., 7 + n].
    Raises:
        ArgumentError: a quaternion is not unit.

    >>> X_WB, q = configuration_from_pinocchio(torch.tensor([1.0, 2, 3, 0, 0, 0, 1, 0.7]))
    >>> dq.translation(X_WB), q
    (tensor([1., 2., 3.]), tensor([0.7000]))
    """
    position, rotation, q = _parts("configuration", configuration, 3, 4)
    return dq.from_pose(from_xyzw(_unit("configuration", rotation)), position), q


def velocity_to_pinocchio(V_WB_B: Tensor, qd: Tensor) -> Tensor:
    """Velocity [..., 6 + n] of Pinocchio (linear, angular, joints), from the twist of the base and qd.

    Accelerations are converted alike: Pinocchio's, too, are the rates of the twist in the axes of the base.

    Args:
        V_WB_B: twist (angular, linear) of the base in its own axes [rad/s, m/s], shape [..., 6].
        qd: joint velocities [rad/s or m/s], shape [..., n].

    >>> velocity_to_pinocchio(torch.tensor([1.0, 2, 3, 4, 5, 6]), torch.tensor([7.0]))
    tensor([4., 5., 6., 1., 2., 3., 7.])
    """
    return _row(motion_to_pinocchio(V_WB_B), qd)


def velocity_from_pinocchio(velocity: Tensor) -> tuple[Tensor, Tensor]:
    """Twist V_WB_B [..., 6] of the base and qd [..., n], or accelerations, from Pinocchio's [..., 6 + n].

    Args:
        velocity: (linear [m/s], angular [rad/s], joints), shape [..., 6 + n].

    >>> velocity_from_pinocchio(torch.tensor([4.0, 5, 6, 1, 2, 3, 7]))
    (tensor([1., 2., 3., 4., 5., 6.]), tensor([7.]))
    """
    base, qd = _parts("velocity", velocity, 6)
    return motion_from_pinocchio(base), qd


def forces_to_pinocchio(F_B: Tensor, tau: Tensor) -> Tensor:
    """Generalised forces [..., 6 + n] of Pinocchio, from the wrench (force, moment) on the base and torques.

    Args:
        F_B: wrench (force, moment) on the base in its axes, about its origin [N, N m], shape [..., 6].
        tau: joint torques [N m] or forces [N], shape [..., n].

    >>> forces_to_pinocchio(torch.tensor([1.0, 2, 3, 4, 5, 6]), torch.tensor([7.0]))
    tensor([1., 2., 3., 4., 5., 6., 7.])
    """
    return _row(checked("F_B", F_B, 6), tau)


def forces_from_pinocchio(forces: Tensor) -> tuple[Tensor, Tensor]:
    """Wrench F_B [..., 6] on the base and torques tau [..., n], from Pinocchio's generalised forces [..., 6 + n].

    Args:
        forces: (force [N], moment [N m], joints), shape [..., 6 + n].

    >>> forces_from_pinocchio(torch.tensor([1.0, 2, 3, 4, 5, 6, 7]))
    (tensor([1., 2., 3., 4., 5., 6.]), tensor([7.]))
    """
    F_B, tau = _parts("forces", forces, 6)
    return F_B, tau


# --- free bases: MuJoCo's freejoint ----------------------------------------------------------------------------------


def configuration_to_mujoco(X_WB: Tensor, q: Tensor) -> Tensor:
    """`qpos` [..., 7 + n] of MuJoCo: position, quaternion (w, x, y, z), joints; arguments as for Pinocchio.

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        q: joint positions [rad or m], shape [..., n].

    >>> x = dq.from_pose(torch.tensor([1.0, 0, 0, 0]), torch.tensor([1.0, 2, 3]))
    >>> configuration_to_mujoco(x, torch.tensor([0.7]))
    tensor([1.0000, 2.0000, 3.0000, 1.0000, 0.0000, 0.0000, 0.0000, 0.7000])
    """
    return _row(*to_mujoco(X_WB), q)


def configuration_from_mujoco(qpos: Tensor) -> tuple[Tensor, Tensor]:
    """Pose X_WB [..., 8] of the base and joint positions q [..., n], from `qpos` [..., 7 + n].

    Its quaternion must be unit; `torchdq.dq.normalize` makes it so.

    Args:
        qpos: position [m], quaternion (w, x, y, z), joints [rad or m], shape [..., 7 + n], also as a numpy array.
    Raises:
        ArgumentError: a quaternion is not unit.

    >>> X_WB, q = configuration_from_mujoco(torch.tensor([1.0, 2, 3, 1, 0, 0, 0, 0.7]))
    >>> dq.translation(X_WB), q
    (tensor([1., 2., 3.]), tensor([0.7000]))
    """
    position, rotation, q = _parts("qpos", qpos, 3, 4)
    return from_mujoco(position, _unit("qpos", rotation)), q


def velocity_to_mujoco(X_WB: Tensor, V_WB_B: Tensor, qd: Tensor) -> Tensor:
    """`qvel` [..., 6 + n]: velocity of the base's origin in world axes, angular velocity in base axes, joints.

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        V_WB_B: twist (angular, linear) of the base in its own axes [rad/s, m/s], shape [..., 6].
        qd: joint velocities [rad/s or m/s], shape [..., n].

    >>> quarter = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # about z
    >>> velocity_to_mujoco(quarter, torch.tensor([1.0, 0, 0, 1, 0, 0]), torch.tensor([5.0])).round(decimals=4)
    tensor([0., 1., 0., 1., 0., 0., 5.])
    """
    w, v = _parts("V_WB_B", V_WB_B, 3, 3)[:2]
    return _row(dq.rotate(dq.rotation(X_WB), v), w, qd)


def velocity_from_mujoco(X_WB: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
    """Twist V_WB_B [..., 6] of the base and qd [..., n], from `qvel` [..., 6 + n].

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        qvel: velocity of MuJoCo, shape [..., 6 + n], also as a numpy array.

    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> velocity_from_mujoco(X_WB, torch.tensor([0.0, 1, 0, 0, 0, 2, 5]))[0].round(decimals=4)
    tensor([0., 0., 2., 1., 0., 0.])
    """
    v, w, qd = _parts("qvel", qvel, 3, 3)
    return _row(w, _to_base(X_WB, v)), qd


def acceleration_to_mujoco(X_WB: Tensor, V_WB_B: Tensor, A_WB_B: Tensor, qdd: Tensor) -> Tensor:
    """`qacc` [..., 6 + n]: rates of `qvel`; the velocity in world axes also changes as the base turns.

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        V_WB_B: twist (angular, linear) of the base in its own axes [rad/s, m/s], shape [..., 6].
        A_WB_B: rate of that twist [rad/s^2, m/s^2], shape [..., 6].
        qdd: joint accelerations [rad/s^2 or m/s^2], shape [..., n].

    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> turning, still = torch.tensor([0.0, 0, 2, 1, 0, 0]), torch.zeros(6)
    >>> acceleration_to_mujoco(X_WB, turning, still, torch.zeros(1)).round(decimals=4)  # v turns with the base
    tensor([-2.,  0.,  0.,  0.,  0.,  0.,  0.])
    """
    (w, v), (wd, vd) = (_parts(*x, 3, 3)[:2] for x in (("V_WB_B", V_WB_B), ("A_WB_B", A_WB_B)))
    return _row(dq.rotate(dq.rotation(X_WB), vd + _cross(w, v)), wd, qdd)


def acceleration_from_mujoco(X_WB: Tensor, V_WB_B: Tensor, qacc: Tensor) -> tuple[Tensor, Tensor]:
    """Rate A_WB_B [..., 6] of the base's twist and qdd [..., n], from `qacc` [..., 6 + n].

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        V_WB_B: twist (angular, linear) of the base in its own axes [rad/s, m/s], shape [..., 6].
        qacc: acceleration of MuJoCo, shape [..., 6 + n], also as a numpy array.

    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> turning = torch.tensor([0.0, 0, 2, 1, 0, 0])
    >>> acceleration_from_mujoco(X_WB, turning, torch.tensor([-2.0, 0, 0, 0, 0, 0, 0]))[0].abs().max() < 1e-6
    tensor(True)
    """
    w, v = _parts("V_WB_B", V_WB_B, 3, 3)[:2]
    vd, wd, qdd = _parts("qacc", qacc, 3, 3)
    return _row(wd, _to_base(X_WB, vd) - _cross(w, v)), qdd


def forces_to_mujoco(X_WB: Tensor, F_B: Tensor, tau: Tensor) -> Tensor:
    """`qfrc_applied` or `qfrc_inverse` [..., 6 + n]: force in world axes, moment in base axes, torques.

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        F_B: wrench (force, moment) on the base in its axes, about its origin [N, N m], shape [..., 6].
        tau: joint torques [N m] or forces [N], shape [..., n].

    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> forces_to_mujoco(X_WB, torch.tensor([1.0, 0, 0, 4, 5, 6]), torch.tensor([7.0])).round(decimals=4)
    tensor([0., 1., 0., 4., 5., 6., 7.])
    """
    force, moment = _parts("F_B", F_B, 3, 3)[:2]
    return _row(dq.rotate(dq.rotation(X_WB), force), moment, tau)


def forces_from_mujoco(X_WB: Tensor, qfrc: Tensor) -> tuple[Tensor, Tensor]:
    """Wrench F_B [..., 6] on the base and torques tau [..., n], from generalised forces [..., 6 + n] of MuJoCo.

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        qfrc: generalised forces of MuJoCo [N, N m], shape [..., 6 + n], also as a numpy array.

    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> forces_from_mujoco(X_WB, torch.tensor([0.0, 1, 0, 4, 5, 6, 7]))[0].round(decimals=4)
    tensor([1., 0., 0., 4., 5., 6.])
    """
    force, moment, tau = _parts("qfrc", qfrc, 3, 3)
    return _row(_to_base(X_WB, force), moment), tau


# --- free bases: Isaac's root states ---------------------------------------------------------------------------------

QuaternionOrder = Literal["wxyz", "xyzw"]


def root_to_isaac(X_WB: Tensor, V_WB_B: Tensor, order: QuaternionOrder = "wxyz", com: Tensor | None = None) -> Tensor:
    """Root state [..., 13] of Isaac: position, quaternion, linear and angular velocity, all in world axes.

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        V_WB_B: twist (angular, linear) of the base, shape [..., 6].
        order: "wxyz" for Isaac Lab before 3.0 and Isaac Sim, "xyzw" for Isaac Gym and Isaac Lab from 3.0 on.
        com: point of the base [m], shape [..., 3], that the linear velocity is of; None: the origin, as in
            `root_link_state_w`. Isaac Lab's `root_state_w` has that of the centre of mass, `robot.base_com`.

    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> root_to_isaac(X_WB, torch.tensor([0.0, 0, 2, 1, 0, 0]))[7:].round(decimals=4)
    tensor([0., 1., 0., 0., 0., 2.])
    """
    require_choice("order", order, ("wxyz", "xyzw"))
    r = dq.rotation(X_WB)
    w, v = _parts("V_WB_B", V_WB_B, 3, 3)[:2]
    v = v if com is None else v + _cross(w, com)
    return _row(dq.translation(X_WB), r if order == "wxyz" else to_xyzw(r), dq.rotate(r, v), dq.rotate(r, w))


def root_from_isaac(state: Tensor, order: QuaternionOrder = "wxyz", com: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Pose X_WB [..., 8] and twist V_WB_B [..., 6] of the base, from a root state [..., 13]; see `root_to_isaac`.

    Its quaternion must be unit; `torchdq.dq.normalize` makes it so.

    Args:
        state: root state, shape [..., 13].
        order, com: as in `root_to_isaac`.
    Raises:
        ArgumentError: a quaternion is not unit.

    >>> X_WB, V_WB_B = root_from_isaac(torch.tensor([1.0, 2, 3, 1, 0, 0, 0, 4, 5, 6, 7, 8, 9]))
    >>> V_WB_B
    tensor([7., 8., 9., 4., 5., 6.])
    """
    require_choice("order", order, ("wxyz", "xyzw"))
    position, r, v, w, _ = _parts("state", state, 3, 4, 3, 3)
    r = _unit("state", r)
    X_WB = dq.from_pose(r if order == "wxyz" else from_xyzw(r), position)
    w, v = _to_base(X_WB, w), _to_base(X_WB, v)
    return X_WB, _row(w, v if com is None else v - _cross(w, com))


def acceleration_to_isaac(X_WB: Tensor, V_WB_B: Tensor, A_WB_B: Tensor, com: Tensor | None = None) -> Tensor:
    """Linear and angular acceleration [..., 6] of the base in world axes; `com` as in `root_to_isaac`.

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        V_WB_B: twist (angular, linear) of the base in its own axes [rad/s, m/s], shape [..., 6].
        A_WB_B: rate of that twist [rad/s^2, m/s^2], shape [..., 6].
        com: as in `root_to_isaac`.

    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> turning, still = torch.tensor([0.0, 0, 2, 1, 0, 0]), torch.zeros(6)
    >>> acceleration_to_isaac(X_WB, turning, still).round(decimals=4)  # v turns with the base
    tensor([-2.,  0.,  0.,  0.,  0.,  0.])
    """
    (w, v), (wd, vd) = (_parts(*x, 3, 3)[:2] for x in (("V_WB_B", V_WB_B), ("A_WB_B", A_WB_B)))
    r = dq.rotation(X_WB)
    if com is not None:
        v, vd = v + _cross(w, com), vd + _cross(wd, com)
    return _row(dq.rotate(r, vd + _cross(w, v)), dq.rotate(r, wd))


def acceleration_from_isaac(X_WB: Tensor, V_WB_B: Tensor, acceleration: Tensor, com: Tensor | None = None) -> Tensor:
    """Rate A_WB_B [..., 6] of the base's twist, from linear and angular acceleration [..., 6] in world axes.

    Args:
        X_WB: pose of the base in the world, shape [..., 8].
        V_WB_B: twist (angular, linear) of the base in its own axes [rad/s, m/s], shape [..., 6].
        acceleration: (linear [m/s^2], angular [rad/s^2]) in world axes, shape [..., 6].
        com: as in `root_to_isaac`.

    >>> X_WB = torch.tensor([0.5**0.5, 0, 0, 0.5**0.5, 0, 0, 0, 0])  # a quarter turn about z
    >>> turning = torch.tensor([0.0, 0, 2, 1, 0, 0])
    >>> acceleration_from_isaac(X_WB, turning, torch.tensor([-2.0, 0, 0, 0, 0, 0])).abs().max() < 1e-6
    tensor(True)
    """
    w, v = _parts("V_WB_B", V_WB_B, 3, 3)[:2]
    vd, wd = (_to_base(X_WB, x) for x in _parts("acceleration", acceleration, 3, 3)[:2])
    if com is not None:
        v, vd = v + _cross(w, com), vd - _cross(wd, com)
    return _row(wd, vd - _cross(w, v))


def wrench_to_isaac(F_B: Tensor, com: Tensor) -> tuple[Tensor, Tensor]:
    """Force and moment about the centre of mass `com` [..., 3], both in base axes, of a wrench F_B [..., 6].

    Args:
        F_B: wrench (force, moment) about the origin of the base, in its axes [N, N m], shape [..., 6].
        com: centre of mass in the frame of the base [m], shape [..., 3].

    >>> wrench_to_isaac(torch.tensor([0.0, 0, 10, 0, 0, 0]), com=torch.tensor([0.5, 0, 0]))
    (tensor([ 0.,  0., 10.]), tensor([0., 5., 0.]))
    """
    force, moment = _parts("F_B", F_B, 3, 3)[:2]
    return force, moment - _cross(com, force)


def wrench_from_isaac(force: Tensor, moment: Tensor, com: Tensor) -> Tensor:
    """Wrench F_B [..., 6] about the origin of the base, from force and moment about its centre of mass.

    Args:
        force: force in base axes [N], shape [..., 3].
        moment: moment about the centre of mass in base axes [N m], shape [..., 3].
        com: centre of mass in the frame of the base [m], shape [..., 3].

    >>> force, moment = torch.tensor([0.0, 0, 10]), torch.tensor([0.0, 5, 0])
    >>> wrench_from_isaac(force, moment, com=torch.tensor([0.5, 0, 0]))
    tensor([ 0.,  0., 10.,  0.,  0.,  0.])
    """
    return _row(force, moment + _cross(com, force))


def _to_base(X_WB: Tensor, v: Tensor) -> Tensor:
    return dq.rotate(dq.conj(X_WB)[..., :4], v)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return torch.linalg.cross(*torch.broadcast_tensors(a, b))


def _parts(name: str, x: Tensor, *sizes: int) -> Sequence[Tensor]:
    """First parts of a row, of these sizes, and the rest of it."""
    x = x if isinstance(x, Tensor) else torch.tensor(x)  # a copy, see `from_mujoco`
    if x.ndim == 0 or x.shape[-1] < sum(sizes):
        raise ArgumentError(f"{name} must end with an axis of {sum(sizes)} components or more, found {tuple(x.shape)}")
    return x.split([*sizes, x.shape[-1] - sum(sizes)], -1)


def _unit(name: str, r: Tensor) -> Tensor:
    """Quaternions [..., 4] of a row; raises unless they are unit ones, those with NaN apart."""
    if r.numel() and not without_values((r,)):
        wrong = (r.detach().norm(dim=-1) - 1).abs() > UNIT
        if bool(wrong.any()):
            found = r[tuple(wrong.nonzero()[0].tolist())].tolist()
            raise ArgumentError(
                f"{name} must hold unit quaternions, found {found}; normalize that part by torchdq.dq.normalize"
            )
    return r


def _row(*parts: Tensor) -> Tensor:
    """Row of parts whose batch axes broadcast."""
    batch = torch.broadcast_shapes(*[x.shape[:-1] for x in parts])
    return torch.cat([x.expand(*batch, x.shape[-1]) for x in parts], -1)
