"""Rigid-body dynamics of a robot with a floating base: a humanoid, a quadruped, an arm on a satellite.

Load the robot with `base="floating"`. The pose of the base stays beside the joint positions q, never in one vector
with them: X_WB [..., 8] is the pose of the base B in the world W, a unit dual quaternion (`torchdq.dq`). Velocities
are the twist V_WB_B [..., 6] of the base, (angular, linear) in its own axes and of its own origin, and qd.
Accelerations are the rate A_WB_B of that twist, and qdd. No orientation is special:

    (moment, force, tau) = M(q) (A_WB_B, qdd) + c(q, V_WB_B, qd) + g(X_WB, q)

Functions are those of `torchdq` with the same arguments in the same order, each with that of the base before it: X_WB
before q, V_WB_B before qd, A_WB_B before qdd. They broadcast, run and differentiate as those do. A gradient in X_WB is
one in its eight numbers; the derivative in a displacement X_WB exp(xi/2) is its product with d X_WB / d xi =
X_WB xi / 2. `torchdq.convert` has converters from and to the configurations of Pinocchio, MuJoCo and Isaac.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.functional import Distances
from torchdq.functions.call import Precision, function_of, of_one_frame, of_pairs, on_links, poses
from torchdq.objects import Object, resolved
from torchdq.program.transforms import outside_of_graphs
from torchdq.robot import Robot

__all__ = [
    "centre_of_mass",
    "closed_form",
    "coriolis_matrix",
    "distances",
    "error_growth",
    "external_wrenches",
    "forward_dynamics",
    "forward_kinematics",
    "inverse_dynamics",
    "jacobian",
    "kinetic_energy",
    "mass_matrix",
    "momentum",
    "momentum_rate",
    "potential_energy",
    "regressor",
]


class Forces(NamedTuple):
    """Wrench on the base, and torques of the joints."""

    F_B: Tensor  # [..., 6] (force, moment) that must act on the base, in its axes and about its origin [N, N m]
    tau: Tensor  # [..., n] joint torques [N m] or forces [N]


class Accelerations(NamedTuple):
    """Acceleration of the base, and of the joints."""

    A_WB_B: Tensor  # [..., 6] rate of the twist of the base [rad/s^2, m/s^2]
    qdd: Tensor  # [..., n] joint accelerations [rad/s^2 or m/s^2]


class MassMatrix(NamedTuple):
    """Mass matrix and its blocks, which are views of it; base rows and columns are (angular, linear)."""

    M: Tensor  # [..., 6 + n, 6 + n]
    base: Tensor  # [..., 6, 6] inertia of the whole robot about the base
    coupling: Tensor  # [..., 6, n] wrench (moment, force) on the base per joint acceleration
    joints: Tensor  # [..., n, n] mass matrix of the robot on a fixed base


class FreeClosedForm(NamedTuple):
    """Terms of (moment, force, tau) = M (A_WB_B, qdd) + c + g."""

    M: Tensor  # [..., 6 + n, 6 + n]
    c: Tensor  # [..., 6 + n]
    g: Tensor  # [..., 6 + n]


class Momentum(NamedTuple):
    """Momentum about the centre of mass, or its rate, in axes of the world."""

    linear: Tensor  # [..., 3] [N s], or [N] for the rate
    angular: Tensor  # [..., 3] [N m s], or [N m] for the rate


class ExternalWrenches(NamedTuple):
    """Wrenches (force, moment) that the environment exerts on links and base, each in its frame."""

    f_ext: Tensor  # [..., links, 6] on the links [N, N m]
    f_base: Tensor  # [..., 6] on the base [N, N m]


def inverse_dynamics(
    robot: Robot,
    X_WB: Tensor,
    q: Tensor,
    V_WB_B: Tensor | None = None,
    qd: Tensor | None = None,
    A_WB_B: Tensor | None = None,
    qdd: Tensor | None = None,
    f_tip: Tensor | None = None,
    f_ext: Tensor | None = None,
    f_base: Tensor | None = None,
    backend: BackendName | None = None,
) -> Forces:
    """Wrench on the base [..., 6] and joint torques [..., n] that produce a motion.

    Args:
        robot: the robot, with a floating base.
        X_WB: pose of the base in the world, a unit dual quaternion, shape [..., 8] (see `torchdq.dq.normalize`).
            This is not checked: with a pose that is not unit, gravity has a wrong size.
        q: joint positions [rad or m], shape [..., n].
        V_WB_B: twist (angular, linear) of the base in its own axes [rad/s, m/s], shape [..., 6]; None: at rest.
        qd: joint velocities [rad/s or m/s], shape [..., n]; None: zero.
        A_WB_B: rate of V_WB_B [rad/s^2, m/s^2], shape [..., 6]; None: zero.
        qdd: joint accelerations [rad/s^2 or m/s^2], shape [..., n]; None: zero.
        f_tip: wrench (force, moment) the end effector exerts on the environment [N, N m], shape [..., 6], in the tip
            frame; it enters with +.
        f_ext: wrenches (force, moment) the environment exerts on the links [N, N m], shape [..., links, 6], in the link
            frames; they enter with -.
        f_base: wrench (force, moment) the environment exerts on the base besides F_B [N, N m], shape [..., 6], in its
            frame.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> inverse_dynamics(robot, torch.eye(8)[0], torch.zeros(12)).F_B[2] / 9.81  # its mass [kg]
    tensor(16.0870)
    """
    given = {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd, "A_WB_B": A_WB_B, "qdd": qdd}
    wrenches = {"f_tip": f_tip, "f_ext": f_ext, "f_base": f_base}
    return Forces(*function_of("floating.inverse_dynamics", robot, given | wrenches, backend))


def forward_dynamics(
    robot: Robot,
    X_WB: Tensor,
    q: Tensor,
    V_WB_B: Tensor | None,
    qd: Tensor | None,
    tau: Tensor,
    f_tip: Tensor | None = None,
    f_ext: Tensor | None = None,
    f_base: Tensor | None = None,
    backend: BackendName | None = None,
    precision: Precision = "auto",
) -> Accelerations:
    """Rate of the twist of the base [..., 6] and joint accelerations [..., n] that torques produce.

    Args:
        tau: joint torques [N m] or forces [N], shape [..., n].
        robot, X_WB, q, V_WB_B, qd, f_tip, f_ext: as in `inverse_dynamics`.
        f_base: wrench (force, moment) the environment exerts on the base, shape [..., 6]; None: the base is free.
        precision: as in `torchdq.forward_dynamics`.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> X_WB, q, tau = torch.eye(8)[0], torch.zeros(12), torch.zeros(12)
    >>> forward_dynamics(robot, X_WB, q, None, None, tau).A_WB_B[5]  # it falls
    tensor(-9.8100)
    """
    given = {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd, "tau": tau}
    wrenches = {"f_tip": f_tip, "f_ext": f_ext, "f_base": f_base}
    return Accelerations(
        *function_of("floating.forward_dynamics", robot, given | wrenches, backend, precision=precision)
    )


def mass_matrix(robot: Robot, X_WB: Tensor, q: Tensor, backend: BackendName | None = None) -> MassMatrix:
    """Mass matrix [..., 6 + n, 6 + n] with its blocks; it maps (A_WB_B, qdd) to (moment, force, tau).

    Args:
        robot, X_WB, q: as in `inverse_dynamics`; the matrix depends on X_WB only through its batch axes.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> # its mass [kg]
    >>> mass_matrix(robot, torch.eye(8)[0], torch.zeros(12)).base[3:, 3:].diagonal()
    tensor([16.0870, 16.0870, 16.0870])
    """
    (M,) = function_of("floating.mass_matrix", robot, {"X_WB": X_WB, "q": q}, backend)
    return MassMatrix(M, M[..., :6, :6], M[..., :6, 6:], M[..., 6:, 6:])


def closed_form(
    robot: Robot, X_WB: Tensor, q: Tensor, V_WB_B: Tensor, qd: Tensor, backend: BackendName | None = None
) -> FreeClosedForm:
    """Mass matrix M, Coriolis forces c and gravity forces g [..., 6 + n]; c + g is the bias.

    Args:
        robot, X_WB, q, V_WB_B, qd: as in `inverse_dynamics`.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> X_WB, q = torch.eye(8)[0], torch.zeros(12)
    >>> # its mass [kg]
    >>> closed_form(robot, X_WB, q, torch.zeros(6), torch.zeros(12)).g[5] / 9.81
    tensor(16.0870)
    """
    return FreeClosedForm(
        *function_of("floating.closed_form", robot, {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd}, backend)
    )


def coriolis_matrix(
    robot: Robot, X_WB: Tensor, q: Tensor, V_WB_B: Tensor, qd: Tensor, backend: BackendName | None = None
) -> Tensor:
    """Coriolis matrix C [..., 6 + n, 6 + n]: C v = c for v = (V_WB_B, qd), and dM/dt = C + C^T.

        C = 1/2 (dc/dv + M [v, .])
        [V, W] = (w_V x w_W, w_V x v_W + v_V x w_W), the bracket of twists of the base

    so that C(v) w - C(w) v = M [v, w]. Pinocchio's `computeCoriolisMatrix` has other entries, and the same C v and
    dM/dt.

    Args:
        robot, X_WB, q, V_WB_B, qd: as in `inverse_dynamics`; the matrix depends on X_WB only through its batch axes.

    >>> import torch, torchdq
    >>> robot, X_WB = torchdq.robots.load("go2"), torch.eye(8, dtype=torch.float64)[0]
    >>> q, V, qd = (torch.linspace(-1.0, 1.0, k, dtype=torch.float64) for k in (12, 6, 12))
    >>> C = coriolis_matrix(robot, X_WB, q, V, qd)
    >>> torch.allclose(C @ torch.cat([V, qd]), closed_form(robot, X_WB, q, V, qd).c)
    True
    """
    given = {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd}
    return function_of("floating.coriolis_matrix", robot, given, backend)[0]


def error_growth(robot: Robot, X_WB: Tensor, q: Tensor, backend: BackendName | None = None) -> Tensor:
    """Factor [...], at least 1, by which `forward_dynamics` magnifies rounding errors; see `torchdq.error_growth`.

    Args:
        robot, X_WB, q: as in `inverse_dynamics`.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> error_growth(robot, torch.eye(8)[0], torch.zeros(12)) > 1
    tensor(True)
    """
    return function_of("floating.error_growth", robot, {"X_WB": X_WB, "q": q}, backend)[0]


def regressor(
    robot: Robot,
    X_WB: Tensor,
    q: Tensor,
    V_WB_B: Tensor | None = None,
    qd: Tensor | None = None,
    A_WB_B: Tensor | None = None,
    qdd: Tensor | None = None,
    backend: BackendName | None = None,
) -> Tensor:
    """Regressor Y [..., 6 + n, 10 (1 + links)]: (moment, force, tau) = Y pi, with pi = `robot.inertial_parameters`.

    Args:
        robot, X_WB, q, V_WB_B, qd, A_WB_B, qdd: as in `inverse_dynamics`.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> # 18 rows of forces, 13 bodies of ten parameters
    >>> regressor(robot, torch.eye(8)[0], torch.zeros(12)).shape
    torch.Size([18, 130])
    """
    given = {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd, "A_WB_B": A_WB_B, "qdd": qdd}
    return function_of("floating.regressor", robot, given, backend)[0]


# --- energy and momentum ---------------------------------------------------------------------------------------------


def kinetic_energy(
    robot: Robot, X_WB: Tensor, q: Tensor, V_WB_B: Tensor, qd: Tensor, backend: BackendName | None = None
) -> Tensor:
    """Kinetic energy [J], shape [...], rotors included.

    Args:
        robot, X_WB, q, V_WB_B, qd: as in `inverse_dynamics`.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> X_WB, q = torch.eye(8)[0], torch.zeros(12)
    >>> # 16 kg at 1 m/s
    >>> kinetic_energy(robot, X_WB, q, torch.tensor([0.0, 0, 0, 1, 0, 0]), torch.zeros(12))
    tensor(8.0435)
    """
    return function_of("floating.kinetic_energy", robot, {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd}, backend)[0]


def potential_energy(robot: Robot, X_WB: Tensor, q: Tensor, backend: BackendName | None = None) -> Tensor:
    """Potential energy of gravity [J], shape [...]; zero if the centre of mass is at the origin of the world.

    Args:
        robot, X_WB, q: as in `inverse_dynamics`.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> low, high = torchdq.dq.from_pose(
    ...     torch.eye(4)[0], torch.tensor([[0.0, 0, 0], [0, 0, 1]])
    ... )
    >>> E = [potential_energy(robot, X_WB, torch.zeros(12)) for X_WB in (low, high)]
    >>> (E[1] - E[0]) / 9.81
    tensor(16.0870)
    """
    return function_of("floating.potential_energy", robot, {"X_WB": X_WB, "q": q}, backend)[0]


def centre_of_mass(robot: Robot, X_WB: Tensor, q: Tensor, backend: BackendName | None = None) -> Tensor:
    """Centre of mass of the robot in the world [m], shape [..., 3].

    Args:
        robot, X_WB, q: as in `inverse_dynamics`.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> centre_of_mass(robot, torch.eye(8)[0], torch.zeros(12))
    tensor([ 0.0083,  0.0000, -0.0285])
    """
    return function_of("floating.centre_of_mass", robot, {"X_WB": X_WB, "q": q}, backend)[0]


def momentum(
    robot: Robot, X_WB: Tensor, q: Tensor, V_WB_B: Tensor, qd: Tensor, backend: BackendName | None = None
) -> Momentum:
    """Linear and angular momentum [..., 3] of the robot about its centre of mass, in axes of the world.

    Args:
        robot, X_WB, q, V_WB_B, qd: as in `inverse_dynamics`.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> X_WB, q = torch.eye(8)[0], torch.zeros(12)
    >>> # 16 kg at 1 m/s
    >>> momentum(robot, X_WB, q, torch.tensor([0.0, 0, 0, 1, 0, 0]), torch.zeros(12)).linear
    tensor([16.0870,  0.0000,  0.0000])
    """
    return Momentum(
        *function_of("floating.momentum", robot, {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd}, backend)
    )


def momentum_rate(
    robot: Robot,
    X_WB: Tensor,
    q: Tensor,
    V_WB_B: Tensor | None = None,
    qd: Tensor | None = None,
    A_WB_B: Tensor | None = None,
    qdd: Tensor | None = None,
    backend: BackendName | None = None,
) -> Momentum:
    """Rate of `momentum` in a motion: the sum of all forces [N], and of their moments about the centre of mass [N m].

    Args:
        robot, X_WB, q, V_WB_B, qd, A_WB_B, qdd: as in `inverse_dynamics`.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> X_WB, q = torch.eye(8)[0], torch.zeros(12)
    >>> momentum_rate(robot, X_WB, q, A_WB_B=torch.tensor([0.0, 0, 0, 1, 0, 0])).linear
    tensor([16.0870,  0.0000,  0.0000])
    """
    given = {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd, "A_WB_B": A_WB_B, "qdd": qdd}
    return Momentum(*function_of("floating.momentum_rate", robot, given, backend))


# --- kinematics ------------------------------------------------------------------------------------------------------


def forward_kinematics(
    robot: Robot,
    X_WB: Tensor,
    q: Tensor,
    frame: str | Sequence[str] | None = None,
    backend: BackendName | None = None,
) -> Tensor:
    """Pose X_WF [..., 8] of a frame in the world, or [..., frames, 8] of several or all frames.

    Args:
        robot, X_WB, q: as in `inverse_dynamics`.
        frame: name of the frame, or names of several; None: all of them, in the order of `robot.frame_names`.
    Raises:
        UnknownNameError: the robot has no such frame.
        ArgumentError: an argument is not a tensor, or has another shape than stated.
        DtypeError: dtypes differ, or are neither float32 nor float64.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> torchdq.dq.translation(
    ...     forward_kinematics(robot, torch.eye(8)[0], torch.zeros(12), "FL_foot")
    ... )
    tensor([ 0.1934,  0.1420, -0.4260])
    """
    return poses("floating.forward_kinematics", robot, {"X_WB": X_WB, "q": q}, frame, backend)


def jacobian(
    robot: Robot,
    X_WB: Tensor,
    q: Tensor,
    frame: str,
    expressed: Literal["body", "world"] = "body",
    backend: BackendName | None = None,
) -> Tensor:
    """Jacobian J [..., 6, 6 + n]: the twist (angular, linear) of a frame is J (V_WB_B, qd).

    Args:
        robot, X_WB, q: as in `inverse_dynamics`.
        frame, expressed: as in `torchdq.jacobian`; "world" are the axes of the world.
    Raises:
        UnknownNameError: the robot has no such frame.
        ArgumentError: an argument is not a tensor, or has another shape than stated.
        DtypeError: dtypes differ, or are neither float32 nor float64.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("go2")
    >>> jacobian(robot, torch.eye(8)[0], torch.zeros(12), "FL_foot").shape
    torch.Size([6, 18])
    """
    return of_one_frame("floating.jacobian", robot, {"X_WB": X_WB, "q": q}, (frame, expressed), backend)


def external_wrenches(
    robot: Robot,
    X_WB: Tensor,
    q: Tensor,
    wrenches: Mapping[str, Tensor],
    expressed: Literal["body", "world"] = "world",
    backend: BackendName | None = None,
) -> ExternalWrenches:
    """Wrenches f_ext [..., links, 6] and f_base [..., 6] of wrenches that the environment exerts at frames.

    Args:
        robot, X_WB, q: as in `inverse_dynamics`.
        wrenches, expressed: as in `torchdq.external_wrenches`; "world" are the axes of the world.

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("go2"), torch.zeros(12)
    >>> feet = {
    ...     f"{leg}_foot": torch.tensor([0.0, 0, 40, 0, 0, 0])
    ...     for leg in ("FL", "FR", "RL", "RR")
    ... }
    >>> held = external_wrenches(robot, torch.eye(8)[0], q, feet)  # 40 N upwards at every foot
    >>> fall = forward_dynamics(robot, torch.eye(8)[0], q, None, None, q, **held._asdict())
    >>> fall.A_WB_B[5] > -9.81
    tensor(True)
    """
    given = {"X_WB": X_WB, "q": q}
    return ExternalWrenches(*on_links("floating.external_wrenches", robot, given, wrenches, expressed, backend))


@outside_of_graphs
def distances(
    robot: Robot,
    X_WB: Tensor,
    q: Tensor,
    points: Any = None,
    objects: Sequence[Object] = (),
    X_WO: Tensor | None = None,
    height: Tensor | float | None = None,
    normal: Tensor | None = None,
    own: bool = False,
    backend: BackendName | None = None,
) -> Distances:
    """Signed distances [..., pairs] of spheres of a robot from objects, from the ground, and from each other.

    Args:
        robot, X_WB, q: as in `inverse_dynamics`; X_WB is checked here.
        points, objects, X_WO, height, normal, own: as in `torchdq.distances`; poses and the ground are in the world.

    >>> import torch, torchdq
    >>> at = distances(
    ...     torchdq.robots.load("go2"), torch.eye(8)[0], torch.zeros(12), "F?_foot", height=-0.5
    ... )
    >>> at.pairs
    (('FL_foot', 'ground'), ('FR_foot', 'ground'))
    """
    given = {"X_WB": X_WB, "q": q, "X_WO": X_WO, "height": height, "normal": normal}
    of = (points, resolved(objects, robot), own)
    return Distances(*of_pairs("floating.distances", robot, given, of, backend))
