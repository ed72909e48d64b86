"""Rigid-body dynamics of a robot on tensors.

Every function broadcasts the leading axes of its inputs with each other and with the batch axes of the robot. Results
have the dtype (float32 or float64) and the device of the inputs, and are differentiable to any order in all inputs and
in the tensors of the robot that were replaced (`robot.replace`). A row that is not finite gives a row that is not
finite and does not change another.

`backend` names what runs the program that is recorded for the robot, as in `torchdq.backend`; None: the backend of the
innermost block of that kind, or "auto".

Functions of robots with a floating base are those of `torchdq.floating`, with the same arguments in the same order,
each with that of the base before it.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.base.checks import require_choice, require_finite
from torchdq.control.joints import ComputedTorque
from torchdq.functions.call import Precision, function_of, of_one_frame, of_pairs, on_links, poses, with_options
from torchdq.objects import Object, resolved
from torchdq.program.transforms import outside_of_graphs
from torchdq.robot import Robot

__all__ = [
    "closed_form",
    "computed_torque",
    "distances",
    "dynamics_hessian",
    "dynamics_jacobian",
    "error_growth",
    "external_wrenches",
    "forward_dynamics",
    "forward_kinematics",
    "inverse_dynamics",
    "jacobian",
    "kinetic_energy",
    "mass_matrix",
    "mass_matrix_derivative",
    "potential_energy",
    "regressor",
    "require_finite",
]

# --- dynamics --------------------------------------------------------------------------------------------------------


def inverse_dynamics(
    robot: Robot,
    q: Tensor,
    qd: Tensor | None = None,
    qdd: Tensor | None = None,
    f_tip: Tensor | None = None,
    f_ext: Tensor | None = None,
    backend: BackendName | None = None,
) -> Tensor:
    """Joint torques tau [..., n] that produce a motion, by the recursive dual-quaternion Newton-Euler algorithm.

        tau = M(q) qdd + c(q, qd) + g(q) + J^T f_tip - sum of J_i^T f_ext_i

    The recorded program is Algorithm 1 of the paper in aligned frames (`torchdq.dynamics.aligned.rnea`), which gives
    the same torques with fewer operations; for a robot whose geometry was replaced, it is Algorithm 1 in the link
    frames of the description.

    Args:
        robot: the robot; its batch axes broadcast with the others.
        q: joint positions [rad or m], shape [..., n].
        qd: joint velocities [rad/s or m/s], shape [..., n]; None: zero, and no operation is spent on them.
        qdd: joint accelerations [rad/s^2 or m/s^2], shape [..., n]; None: zero, likewise.
        f_tip: wrench (force, moment) the end effector exerts on the environment [N, N m], shape [..., 6], in the tip
            frame, about its origin; None: none.
        f_ext: wrenches (force, moment) the environment exerts on the links [N, N m], shape [..., n, 6], each in its
            link frame, about its origin; None: none.
    Returns:
        tau: joint torques [N m] or forces [N], shape [..., n].
    Raises:
        ArgumentError: an argument is not a tensor, or has another shape than stated.
        DtypeError: dtypes differ, or are neither float32 nor float64.

    Source: Algorithm 1 of the paper, equations (38)-(48), with errata 25, 30, 38, 40, 46, 47, A1 corrected.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> # holding the arm against gravity
    >>> inverse_dynamics(robot, torch.zeros(2, dtype=torch.float64))
    tensor([19.6200,  4.9050], dtype=torch.float64)
    """
    return function_of(
        "inverse_dynamics", robot, {"q": q, "qd": qd, "qdd": qdd, "f_tip": f_tip, "f_ext": f_ext}, backend
    )[0]


def forward_dynamics(
    robot: Robot,
    q: Tensor,
    qd: Tensor | None,
    tau: Tensor,
    f_tip: Tensor | None = None,
    f_ext: Tensor | None = None,
    backend: BackendName | None = None,
    precision: Precision = "auto",
) -> Tensor:
    """Joint accelerations qdd [..., n] that torques produce: the inverse of `inverse_dynamics` in qdd.

        qdd = M(q)^-1 (tau - c(q, qd) - g(q) - J^T f_tip + sum of J_i^T f_ext_i)

    Rounding errors grow with the condition number of M, whatever the method. Each row is checked (`error_growth`): a
    row that would lose half of its digits in float32 is computed in float64 and rounded, and so are its derivatives; a
    row whose mass matrix is singular in float64, or not positive definite, is NaN. Other rows do not change.

    Args:
        tau: joint torques [N m] or forces [N], shape [..., n].
        robot, q, qd, f_tip, f_ext: as in `inverse_dynamics`.
        precision: "auto": as above; "double": all rows are computed in float64, also those of float32 inputs.
    Raises:
        SingularInertiaError: a joint moves no inertia in any position.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> forward_dynamics(robot, q, None, inverse_dynamics(robot, q)).abs().max() < 1e-13
    tensor(True)
    """
    given = {"q": q, "qd": qd, "tau": tau, "f_tip": f_tip, "f_ext": f_ext}
    return function_of("forward_dynamics", robot, given, backend, precision=precision)[0]


def error_growth(robot: Robot, q: Tensor, backend: BackendName | None = None) -> Tensor:
    """Factor [...], at least 1, by which `forward_dynamics` magnifies rounding errors: the largest M_ii / D_i.

    M_ii is the inertia at joint i if the joints beyond it are locked, and D_i, a pivot of M, the inertia if they are
    free. The relative error of accelerations is typically 10 eps, seldom more than 200 eps, times this factor. Above
    2^10, float32 inputs are computed in float64; above 2^46, accelerations are NaN. If a pivot is not positive, the
    factor is 1e30 or more.

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].

    >>> import torch, torchdq
    >>> error_growth(torchdq.robots.load("two_link"), torch.zeros(2, dtype=torch.float64))
    tensor(4.5714, dtype=torch.float64)
    """
    return function_of("error_growth", robot, {"q": q}, backend)[0]


def mass_matrix(robot: Robot, q: Tensor, backend: BackendName | None = None) -> Tensor:
    """Mass matrix M(q) [..., n, n], symmetric to the last bit, rotor inertia on its diagonal (69).

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].

    >>> import torch, torchdq
    >>> mass_matrix(torchdq.robots.load("two_link"), torch.tensor([0.3, 0.0])).mul(12).round()
    tensor([[32., 10.],
            [10.,  4.]])
    """
    return function_of("mass_matrix", robot, {"q": q}, backend)[0]


def mass_matrix_derivative(robot: Robot, q: Tensor, backend: BackendName | None = None) -> Tensor:
    """Derivatives dM/dq [..., n, n, n] of the mass matrix in the joint positions, which are the last axis.

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> rate = mass_matrix_derivative(robot, q) @ q  # of the mass matrix, at the velocities q
    >>> C = torchdq.coriolis_matrix(robot, q, q)
    >>> torch.allclose(rate, C + C.mT)
    True
    """
    return function_of("mass_matrix_derivative", robot, {"q": q}, backend)[0]


class ClosedForm(NamedTuple):
    """Terms of tau = M qdd + c + g + Jt f_tip (63)."""

    M: Tensor  # [..., n, n]
    c: Tensor  # [..., n]
    g: Tensor  # [..., n]
    Jt: Tensor | None  # [..., n, 6] on (force, moment) in the tip frame; None: the robot has no tip


def closed_form(robot: Robot, q: Tensor, qd: Tensor, backend: BackendName | None = None) -> ClosedForm:
    """Terms M [..., n, n], c, g [..., n], J^T [..., n, 6] of the equations of motion.

        tau = M qdd + c + g + Jt f_tip   (63)

        M, c, g  mass matrix, Coriolis and centrifugal torques, gravity torques
        f_tip    enters with +: the wrench the end effector exerts on the environment
        f_ext    enters with - where there is one: wrenches the environment exerts on the links,
                 as in Pinocchio
        Jt       transposed Jacobian of the tip, columns in the order of a wrench, (force,
                 moment), in the axes of the tip frame; the rows of `jacobian` are in the order
                 of a twist, (angular, linear)
        names    Pinocchio: `computeAllTerms`, with nle = c + g, and Jt the transpose of the
                 LOCAL Jacobian of the tip

    The recorded program computes every term by itself: M by composite bodies, c and g by the recursion without gravity
    and at rest. The matrices of dual quaternions of the paper (`torchdq.paper.closed_form`) give the same.

    Args:
        robot, q, qd: the robot, its joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].

    Source: equations (57)-(72) of the paper, with errata 57, 61, T1.4, 68, 70, 71 corrected.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> closed_form(robot, q, torch.zeros_like(q)).g
    tensor([18.5756,  4.5178], dtype=torch.float64)
    """
    M, c, g, *Jt = with_options("closed_form", robot, {"q": q, "qd": qd}, backend)
    return ClosedForm(M, c, g, Jt[0] if Jt else None)


def regressor(
    robot: Robot,
    q: Tensor,
    qd: Tensor | None = None,
    qdd: Tensor | None = None,
    backend: BackendName | None = None,
) -> Tensor:
    """Regressor Y [..., n, 10 n]: tau = Y pi, with pi = `robot.inertial_parameters`, without rotor inertia.

    Ten columns per link: mass, first moments m c (x y z) and inertia about the link frame's origin
    (xx xy yy xz yz zz), the order of Pinocchio.

    Args:
        robot: the robot; the regressor does not depend on its mass, com and inertia.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
            shape [..., n]; qd and qdd None: zero.

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("puma560"), torch.ones(6, dtype=torch.float64)
    >>> tau = regressor(robot, q, q, 0 * q) @ robot.inertial_parameters
    >>> torch.allclose(tau, inverse_dynamics(robot, q, q), rtol=1e-12)
    True
    """
    return function_of("regressor", robot, {"q": q, "qd": qd, "qdd": qdd}, backend)[0]


def dynamics_jacobian(
    robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor, backend: BackendName | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives (dtau/dq, dtau/dqd, M) of `inverse_dynamics`, not forward dynamics, each [..., n, n]; M is dtau/dqdd.

    Where qdd = forward_dynamics(q, qd, tau), the derivatives of `forward_dynamics` by q, qd and tau are -M^-1 dtau/dq,
    -M^-1 dtau/dqd and M^-1, which `torchdq.compile(robot, "forward_dynamics").jacobian()` computes.

    Args:
        robot: the robot.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
            shape [..., n].

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> torch.equal(dynamics_jacobian(robot, q, q, q)[2], mass_matrix(robot, q))
    True
    """
    dtau_dq, dtau_dqd, M = function_of("dynamics_jacobian", robot, {"q": q, "qd": qd, "qdd": qdd}, backend)
    return dtau_dq, dtau_dqd, M


class DynamicsHessian(NamedTuple):
    """Second and first derivatives of torques or accelerations in z = (q, qd, qdd) or (q, qd, tau)."""

    H: Tensor  # contracted with a weight [..., 3n, 3n], or of each joint [..., n, 3n, 3n]
    J: Tensor  # [..., n, 3n]


def dynamics_hessian(
    robot: Robot,
    q: Tensor,
    qd: Tensor,
    qdd: Tensor,
    weight: Tensor | None = None,
    of: Literal["inverse", "forward"] = "inverse",
    backend: BackendName | None = None,
) -> DynamicsHessian:
    """Second derivatives H [..., 3n, 3n] and first ones J [..., n, 3n] of `inverse_dynamics` or `forward_dynamics`.

        of="inverse"  f = tau,  z = (q, qd, qdd)
        of="forward"  f = qdd,  z = (q, qd, tau): the argument qdd has the torques
        weight        H = sum over i of weight_i d2f_i/dz2, shape [..., 3n, 3n], as in
                      differential dynamic programming, where the weight is the gradient of the
                      value function
        no weight     H_i = d2f_i/dz2, shape [..., n, 3n, 3n], in two to three times the time,
                      and n times the memory
        J             df/dz, shape [..., n, 3n]

    Rows and columns are in the order of z: H[..., :n, n : 2 * n] has the derivatives in q and qd, H[..., :n, 2 * n :]
    those in q and qdd or tau. H is symmetric to the last bit. The blocks of qd with qdd or tau, and of these with
    themselves, are zero. Rows whose accelerations lose too many digits are treated as in `forward_dynamics`.

    Args:
        robot: the robot.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
            shape [..., n]; with of="forward" the third are the torques [N m] or forces [N].
        weight: weights of the torques or accelerations, shape [..., n]; None: see above.
        of: "inverse" or "forward", as above.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> H, J = dynamics_hessian(robot, q, q, q, weight=torch.ones_like(q))
    >>> H.shape, torch.allclose(J[:, 4:], mass_matrix(robot, q))
    (torch.Size([6, 6]), True)
    >>> # d2tau/dq dqdd is dM/dq
    >>> torch.allclose(H[:2, 4:], mass_matrix_derivative(robot, q).sum(0).mT)
    True
    """
    require_choice("of", of, ("inverse", "forward"))
    name, last = ("dynamics_hessian", "qdd") if of == "inverse" else ("forward_dynamics_hessian", "tau")
    return DynamicsHessian(*function_of(name, robot, {"q": q, "qd": qd, last: qdd, "weight": weight}, backend))


def kinetic_energy(robot: Robot, q: Tensor, qd: Tensor, backend: BackendName | None = None) -> Tensor:
    """Kinetic energy qd^T M qd / 2 [J], shape [...], rotors included.

    Args:
        robot, q, qd: the robot, its joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> torch.isclose(kinetic_energy(robot, q, q), q @ mass_matrix(robot, q) @ q / 2)
    tensor(True)
    """
    return function_of("kinetic_energy", robot, {"q": q, "qd": qd}, backend)[0]


def potential_energy(robot: Robot, q: Tensor, backend: BackendName | None = None) -> Tensor:
    """Potential energy -sum of m g . p_com [J], shape [...]; its gradient in q is the gravity torque.

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> torch.allclose(
    ...     torch.func.grad(lambda q: potential_energy(robot, q))(q), inverse_dynamics(robot, q)
    ... )
    True
    """
    return function_of("potential_energy", robot, {"q": q}, backend)[0]


# --- kinematics ------------------------------------------------------------------------------------------------------


def forward_kinematics(
    robot: Robot, q: Tensor, frame: str | Sequence[str] | None = None, backend: BackendName | None = None
) -> Tensor:
    """Pose X_WF [..., 8] of a frame in the base frame, or [..., frames, 8] of several or all frames (39).

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].
        frame: name of the frame; or names of several, which one program computes together, much faster than one by one;
            None: all of them, in the order of `robot.frame_names`.

    >>> import torch, torchdq
    >>> X = forward_kinematics(torchdq.robots.load("two_link"), torch.zeros(2), "tip")
    >>> torchdq.dq.translation(X)
    tensor([2., 0., 0.])
    """
    return poses("forward_kinematics", robot, {"q": q}, frame, backend)


def jacobian(
    robot: Robot,
    q: Tensor,
    frame: str,
    expressed: Literal["body", "world"] = "body",
    backend: BackendName | None = None,
) -> Tensor:
    """Jacobian J [..., 6, n]: the twist (angular, linear) of a frame is J qd.

        rows                 in the order of a twist, (angular, linear); Pinocchio has (linear,
                             angular)
        expressed="body"     V_WF_F, the twist of F's origin in the axes of F; Pinocchio: LOCAL
        expressed="world"    the same twist of F's origin in the axes of the base frame;
                             Pinocchio: LOCAL_WORLD_ALIGNED
        torques of a wrench  J^T swap(f), since a wrench f is (force, moment); with + in the
                             torques where the frame exerts it on the environment (f_tip), with
                             - where the environment exerts it (f_ext)

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].
        frame: name of the frame F.
        expressed: "body" or "world", as above.

    >>> import torch, torchdq
    >>> # the tip's velocity along y
    >>> jacobian(torchdq.robots.load("two_link"), torch.zeros(2), "tip")[4]
    tensor([2., 1.])
    """
    return of_one_frame("jacobian", robot, {"q": q}, (frame, expressed), backend)


def external_wrenches(
    robot: Robot,
    q: Tensor,
    wrenches: Mapping[str, Tensor],
    expressed: Literal["body", "world"] = "world",
    backend: BackendName | None = None,
) -> Tensor:
    """Wrenches f_ext [..., n, 6] on the links, in link frames, of wrenches that the environment exerts at frames.

        sum of J_i^T f_ext_i = sum over the frames of J_F^T F

    with J^T as in `jacobian`, of swapped wrenches.

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].
        wrenches: wrench (force, moment) [N, N m], shape [..., 6], by the name of the frame about whose origin it is;
            those on one link add up, and one on the base, which moves no joint, is not among the results.
        expressed: "world", all in axes of the base frame, or "body", each in those of its frame.

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.zeros(2)
    >>> # 10 N downwards
    >>> f_ext = external_wrenches(robot, q, {"tip": torch.tensor([0.0, -10, 0, 0, 0, 0])})
    >>> (inverse_dynamics(robot, q, f_ext=f_ext) - inverse_dynamics(robot, q)).round()
    tensor([20., 10.])
    """
    return on_links("external_wrenches", robot, {"q": q}, wrenches, expressed, backend)[0]


class Distances(NamedTuple):
    """Signed distances of spheres of a robot, and what each is between."""

    distance: Tensor  # negative where they overlap, [..., pairs] [m]
    pairs: tuple[tuple[str, str], ...]  # frame of the sphere, and object, "ground" or frame of the other sphere


@outside_of_graphs
def distances(
    robot: Robot,
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

    They are exact outside and inside, where that from the nearest face counts, so that their gradients lead out. Where
    two faces or edges are equally near, the gradient jumps. Pairs are in the order of things: every object with all
    spheres, the ground with all spheres, and spheres on different links.

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].
        points: the spheres, as in `effects.Contact`: names or patterns of frames, with the points of
            `robot.contact_points`, or the origin of the frame if the file has none; or `torchdq.robot.ContactPoint`
            objects; None: the origin of the end effector.
        objects: those of `torchdq.objects`; their sizes may be tensors, and have gradients.
        X_WO: poses of the objects in the base frame, unit dual quaternions, shape [..., objects, 8]; None: at the
            origin.
        height: height of the ground along its normal [m], a number or [...]; None: there is no ground.
        normal: unit normal of the ground, shape [..., 3]; None: the z axis.
        own: whether there are distances between spheres on different links, neighbours too.

    `torch.compile` calls it between two graphs, since objects are none of its constants; `torchdq.compile(robot,
    "distances", options=...)` is part of a graph.

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.tensor([0.1, 0.2])
    >>> box = torchdq.objects.Box("box", mass=1.0, size=(1.0, 1.0, 1.0))
    >>> X_WO = torchdq.dq.from_pose(torch.eye(4)[0], torch.tensor([2.0, 0.6, 0.0]))[None]
    >>> distances(robot, q, "tip", (box,), X_WO)
    Distances(distance=tensor([-0.2954]), pairs=(('tip', 'box'),))
    >>> def depth(q):
    ...     at = distances(robot, q, "tip", (box,), X_WO)
    ...     return at.distance.clamp(max=0.01).sub(0.01).square().sum()
    >>> for _ in range(10):
    ...     q = q - 0.1 * torch.func.grad(depth)(q)
    >>> distances(robot, q, "tip", (box,), X_WO).distance > 0
    tensor([True])
    """
    given = {"q": q, "X_WO": X_WO, "height": height, "normal": normal}
    return Distances(*of_pairs("distances", robot, given, (points, resolved(objects, robot), own), backend))


# --- control ---------------------------------------------------------------------------------------------------------


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
        q_des, qd_des, qdd_des: desired positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or
            m/s^2], shape [..., n].
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
    return ComputedTorque(kp, kd)(robot, q, qd, q_des, qd_des, qdd_des, f_tip, backend=backend)
