"""Motion of a frame of a robot, its dynamics, and its control.

The twist of a frame F is (angular, linear), of its origin: in the axes of F for `expressed="body"`, in those of the
base for "world". `axes` are its components: "pose", all six; "orientation", the first three; "position", the last
three; or names among rx ry rz x y z, in the order in which rows are wanted. A force on them is in the same order:
(moment, force), where a wrench is (force, moment): `f.roll(3, -1)` turns one into the other.

Everything else is as in `torchdq.backend`. The base is fixed.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.control.frames import CartesianImpedance, OperationalSpaceControl
from torchdq.functions.call import function_of, with_options
from torchdq.functions.options import axes_of
from torchdq.robot import Robot

__all__ = [
    "cartesian_impedance",
    "coriolis_matrix",
    "frame_motion",
    "manipulability",
    "operational_space",
    "operational_space_control",
]

Expressed = Literal["body", "world"]


class FrameMotion(NamedTuple):
    """Motion of a frame."""

    X: Tensor  # pose X_WF, [..., 8]
    V: Tensor  # twist (angular, linear), [..., 6]
    A: Tensor  # rate of the components of V, [..., 6]


def frame_motion(
    robot: Robot,
    q: Tensor,
    qd: Tensor,
    qdd: Tensor | None = None,
    frame: str | None = None,
    expressed: Expressed = "body",
    backend: BackendName | None = None,
) -> FrameMotion:
    """Pose X [..., 8], twist V [..., 6] of a frame, and the rate A [..., 6] of its components.

        V = J qd,   A = J qdd + Jdot qd

    In world axes, the linear part of A is the acceleration of the origin: `getFrameClassicalAcceleration` of Pinocchio
    with LOCAL_WORLD_ALIGNED. In body axes it is that less w x v: `getFrameAcceleration` with LOCAL.

    Args:
        robot: the robot.
        q, qd: joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].
        qdd: joint accelerations [rad/s^2 or m/s^2], shape [..., n]; None: zero, so that A = Jdot qd.
        frame: name of the frame; None: the tip.
        expressed: "body", axes of the frame, or "world", those of the base.

    >>> import torch, torchdq
    >>> q = torch.zeros(2)
    >>> # towards both joints
    >>> frame_motion(torchdq.robots.load("two_link"), q, q + 1, expressed="world").A
    tensor([ 0.,  0.,  0., -5.,  0.,  0.])
    """
    return FrameMotion(*with_options("frame_motion", robot, {"q": q, "qd": qd, "qdd": qdd}, backend, frame, expressed))


class OperationalSpaceTerms(NamedTuple):
    """Terms of F = Lambda a + mu + p for m components of the twist of a frame."""

    Lambda: Tensor  # inertia (J M^-1 J^T)^-1, [..., m, m]
    mu: Tensor  # Coriolis and centrifugal force, [..., m]
    p: Tensor  # gravity force, [..., m]
    J: Tensor  # Jacobian, [..., m, n]
    Jdot_qd: Tensor  # acceleration of the velocities, [..., m]
    Jbar: Tensor  # dynamically consistent inverse M^-1 J^T Lambda of J, [..., n, m]
    growth: Tensor  # factor by which rounding errors grow, large near singular configurations, [...]

    @property
    def N(self) -> Tensor:
        """Projector I - Jbar J on velocities [..., n, n] that do not move the frame; N^T is that on torques."""
        return torch.eye(self.J.shape[-1], dtype=self.J.dtype, device=self.J.device) - self.Jbar @ self.J


def operational_space(
    robot: Robot,
    q: Tensor,
    qd: Tensor,
    frame: str | None = None,
    expressed: Expressed = "body",
    axes: str | Sequence[str] = "pose",
    backend: BackendName | None = None,
) -> OperationalSpaceTerms:
    """Dynamics of a frame: the force (moment, force) at its origin that accelerates it.

        F = Lambda a + mu + p,   Lambda = (J M^-1 J^T)^-1
        a = rate of the components of the twist

    Rows that are singular, whose `growth` would be above 2^46, are NaN; see `forward_dynamics`.

    Args:
        robot: the robot.
        q, qd: joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].
        frame, expressed: as in `frame_motion`.
        axes: the components, "pose", "position", "orientation" or names among rx ry rz x y z.
    Raises:
        ArgumentError: the joints cannot move these axes independently; it says how many they can.

    Source: Khatib, A unified approach for motion and force control of robot manipulators, 1987.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> at = operational_space(robot, q, q, axes=("x", "y"))
    >>> # by a unit of force
    >>> moved = at.J @ torch.linalg.solve(torchdq.mass_matrix(robot, q), at.J.mT)
    >>> torch.allclose(at.Lambda, torch.linalg.inv(moved))
    True
    """
    given = {"q": q, "qd": qd}
    return OperationalSpaceTerms(*with_options("operational_space", robot, given, backend, frame, expressed, axes))


def manipulability(
    robot: Robot,
    q: Tensor,
    frame: str | None = None,
    expressed: Expressed = "body",
    axes: str | Sequence[str] = "pose",
    backend: BackendName | None = None,
) -> Tensor:
    """Manipulability sqrt(det J J^T) [...] of a frame, zero where it is singular; so is the gradient there.

    Its unit is m^k for k displacements, so only values for the same axes compare. (Yoshikawa, Manipulability of robotic
    mechanisms, 1985.)

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].
        frame, expressed, axes: as in `operational_space`.

    >>> import torch, torchdq
    >>> manipulability(
    ...     torchdq.robots.load("two_link"), torch.tensor([0.3, 0.0]), axes=("x", "y")
    ... )
    tensor(0.)
    """
    return with_options("manipulability", robot, {"q": q}, backend, frame, expressed, axes)[0]


def coriolis_matrix(robot: Robot, q: Tensor, qd: Tensor, backend: BackendName | None = None) -> Tensor:
    """Coriolis matrix C [..., n, n] of Christoffel symbols: C qd = c, and dM/dt = C + C^T.

        C = 1/2 dc/dqd

    because c is quadratic in qd with symmetric coefficients. Pinocchio's `computeCoriolisMatrix` has the same two
    properties, and other entries where joints slide.

    Args:
        robot, q, qd: the robot, its joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> torch.allclose(coriolis_matrix(robot, q, q) @ q, torchdq.closed_form(robot, q, q).c)
    True
    """
    return function_of("coriolis_matrix", robot, {"q": q, "qd": qd}, backend)[0]


def operational_space_control(
    robot: Robot,
    q: Tensor,
    qd: Tensor,
    X_des: Tensor,
    V_des: Tensor | None = None,
    A_des: Tensor | None = None,
    *,
    kp: Tensor | float,
    kd: Tensor | float,
    frame: str | None = None,
    expressed: Expressed = "body",
    axes: str | Sequence[str] = "pose",
    q_null: Tensor | None = None,
    k_null: Tensor | float = 10.0,
    damping: Tensor | float | None = 2**-8,
    limits: bool = False,
    backend: BackendName | None = None,
) -> Tensor:
    """Torques tau [..., n] under which the error e of a frame's pose obeys e'' + kd e' + kp e = 0.

        tau = J^T Lambda (a - a_0) + tau_0

    a is the rate of the twist that the error asks for, tau_0 are the torques (of inverse dynamics, gravity included)
    that accelerate the joints towards the posture, or not at all, and a_0 is the rate of the twist that these give.
    Coriolis terms, Jdot qd and the derivatives of the logarithm are included, so the equation holds up to half a turn:

        body axes, all components   e = 2 log(X* X_des), the screw to the goal in axes of the
                                    frame
        otherwise                   e = (rotation vector to the goal, difference of the
                                    positions), whose rates are those in the base frame, seen in
                                    those axes; of some rotations without the others it holds
                                    for small errors

    X_des is scaled to a unit dual quaternion, and -X_des is the same goal. Beyond half a turn the rotation in
    the other direction is shorter, and e jumps.

    Args:
        robot: the model of the robot that is controlled.
        q, qd: measured positions [rad or m] and velocities [rad/s or m/s], shape [..., n].
        X_des: desired pose of the frame, a dual quaternion [-, m], shape [..., 8].
        V_des: its twist (angular, linear) [rad/s, m/s], in its own axes or those of the base, as `expressed` says,
            shape [..., 6]; None: zero.
        A_des: rate of the components of V_des [rad/s^2, m/s^2], shape [..., 6]; None: zero.
        kp: gain of the error [1/s^2], a number or one for each of the axes, [..., m]; matrices are not taken.
        kd: gain of its rate [1/s], likewise; 2 sqrt(kp) is critical damping.
        frame, expressed, axes: as in `operational_space`.
        q_null: posture [rad or m] that joints move to if the task leaves them free, shape [..., n]; q itself: they come
            to rest; None: they move on.
        k_null: gain of the posture [1/s^2], a number or shape [...]; it is critically damped.
        damping: share of the mean of a diagonal of J J^T below which a pivot counts as singular [1]: there Lambda is
            limited, so that torques are bounded; elsewhere nothing is changed. None: nowhere, and rows that are
            singular are NaN.
        limits: whether the torques of the task are scaled by one factor, so that all torques stay within the limits of
            the robot, if tau_0 does. The direction of a - a_0 is kept.
    Raises:
        ArgumentError: the joints cannot move these axes independently; the robot has no torque limits.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("panda")
    >>> q = torch.tensor([0.1, 0.4, 0.0, -1.5, 0.2, 1.7, 0.3], dtype=torch.float64)
    >>> X_des = torchdq.forward_kinematics(robot, q + 0.01, robot.tip)
    >>> tau = operational_space_control(robot, q, 0 * q, X_des, kp=100.0, kd=20.0)
    >>> X = torchdq.dq.Pose(frame_motion(robot, q, 0 * q).X)
    >>> e = (X.inverse() @ torchdq.dq.Pose(X_des)).log()
    >>> torch.allclose(
    ...     frame_motion(robot, q, 0 * q, torchdq.forward_dynamics(robot, q, 0 * q, tau)).A,
    ...     100 * e,
    ... )
    True
    """
    where: Any = {"frame": frame, "expressed": expressed, "axes": axes_of(axes)}
    law = OperationalSpaceControl(kp, kd, damping, limits, q_null=q_null, k_null=k_null, **where)
    return law(robot, q, qd, X_des, V_des, A_des, backend=backend)


def cartesian_impedance(
    robot: Robot,
    q: Tensor,
    qd: Tensor,
    X_des: Tensor,
    V_des: Tensor | None = None,
    *,
    stiffness: Tensor | float,
    damping: Tensor | float,
    frame: str | None = None,
    expressed: Expressed = "world",
    axes: str | Sequence[str] = "pose",
    q_null: Tensor | None = None,
    k_null: Tensor | float = 10.0,
    coriolis: bool = True,
    backend: BackendName | None = None,
) -> Tensor:
    """Torques tau [..., n] of a spring and a damper between a frame and its desired pose, without inertia shaping.

        tau = J^T (K e + D e') + c + g

    e is the error as in `operational_space_control`, so that a force on the frame moves it by force / stiffness. The
    posture acts where it does not accelerate the frame. To cancel c takes work: the spring is not passive, and without
    a damper the energy may grow. With `coriolis=False` c is left to the arm, and its kinetic energy with that of the
    spring never grows: in world axes, to a goal at rest, without a posture, and with one stiffness and damping for all
    rotations.

    Args:
        robot, q, qd, X_des, V_des, frame, expressed, axes, q_null, k_null: as in `operational_space_control`.
        stiffness: K, a number or one for each of the axes [N m/rad, N/m], shape [..., m]; matrices are not taken.
        damping: D, likewise [N m s/rad, N s/m].
        coriolis: whether the torques contain c; False: tau = J^T (K e + D e') + g.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("ur10e")
    >>> q = torch.tensor([0.1, -1.0, 1.2, 0.3, 0.8, 0.0], dtype=torch.float64)
    >>> X = torchdq.forward_kinematics(robot, q, robot.tip)
    >>> tau = cartesian_impedance(robot, q, 0 * q, X, stiffness=400.0, damping=40.0)
    >>> torch.allclose(tau, torchdq.inverse_dynamics(robot, q))  # at rest at the goal
    True
    """
    where: Any = {"frame": frame, "expressed": expressed, "axes": axes_of(axes), "coriolis": coriolis}
    law = CartesianImpedance(stiffness, damping, q_null=q_null, k_null=k_null, **where)
    return law(robot, q, qd, X_des, V_des, backend=backend)
