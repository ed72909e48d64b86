"""Rigid-body dynamics of a robot on tensors.

Every function broadcasts the leading axes of its inputs with each other and with the batch axes of the robot. Results
have the dtype (float32 or float64) and the device of the inputs, and are differentiable to any order in all inputs and
in the tensors of the robot that were replaced (`robot.replace`). A row that is not finite gives a row that is not
finite and does not change another.

`backend` names what runs the program that is recorded for the robot: "c", compiled for the CPU; "cuda", compiled for
NVIDIA GPUs; "eager", torch operations, on any device; "auto", the first of these that can run on the device; None, that
of the innermost `torchdq.backend` block, or "auto".
"""

import time
from collections.abc import Mapping, Sequence
from typing import Literal, NamedTuple, get_args

from torch import Tensor
from torch.compiler import is_compiling

from torchdq.backends.call import batch_of, evaluate
from torchdq.backends.choice import BackendName
from torchdq.base.caches import PROGRAMS, Bounded
from torchdq.base.checks import names_of, require_tensor
from torchdq.base.progress import FIRST, warn_once
from torchdq.errors import ArgumentError
from torchdq.functions.catalogue import Function, recordings
from torchdq.functions.options import options_of
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.constants import Constants
from torchdq.robot.fields import SHAPES, trailing
from torchdq.robot.robot import arguments, constants

# --- arguments -------------------------------------------------------------------------------------------------------

Precision = Literal["auto", "double"]


def require_finite(**arguments: Tensor | None) -> None:
    """Raise `ArgumentError`, naming the argument and its first bad entry, unless all `arguments` are finite.

    The dynamics functions do not check values: a row with NaN gives a row with NaN. Call this function where such a row
    must be an error.

    >>> import torch
    >>> require_finite(q=torch.zeros(3), qd=None)
    """
    for name, x in arguments.items():
        if x is None:
            continue
        require_tensor(name, x)
        bad = (~x.isfinite()).nonzero()
        if len(bad):
            at = tuple(bad[0].tolist())
            raise ArgumentError(f"{name} must be finite, found {x[at].item()} at {at}, and {len(bad) - 1} more")


def check_precision(precision: Precision) -> Precision:
    """Precision, after a check of its name."""
    if precision not in get_args(Precision):
        raise ArgumentError(f"precision must be 'auto' or 'double', found {precision!r}")
    return precision


class _Quantities(Function):
    """Quantities of a robot's joints and the wrench at its tip, to be checked; it has no program."""

    def axes(self, name: str) -> tuple[int, ...]:
        """Trailing axes of a quantity, or of a tensor of the robot."""
        return trailing({"f_tip": (6,), **SHAPES}.get(name, ("n",)), self.sizes)

    def check(self, tensors: Mapping[str, Tensor]) -> None:
        """Raise unless the base is fixed; any of them may be absent."""
        if self.constants.fields["base_mass"] is not None:
            raise ArgumentError(
                f"robot {self.constants.fields['name']!r} must have a fixed base here, found a free one"
            )


def check(robot: Robot, optional: Sequence[str] = (), **quantities: Tensor | None) -> tuple[int, ...]:
    """Broadcast batch axes of quantities and a robot.

    Raises, naming the argument, unless all have their trailing axes, one dtype, one device, and batch axes that
    broadcast with each other and with the robot's.

    Args:
        robot: the robot.
        optional: names of the quantities that may be None.
        quantities: [..., n] of the joints, and `f_tip` [..., 6].
    """
    for name, x in quantities.items():
        if name not in optional:
            require_tensor(name, x)
    return batch_of(_Quantities(constants(require_robot(robot)), "check"), _with_tensors(robot, quantities))


def _with_tensors(robot: Robot, given: dict[str, Tensor | None]) -> dict[str, Tensor | None]:
    """Arguments of a function, together with the tensors of the robot that are arguments of its programs."""
    names = arguments(robot)
    return {**given, **{name: getattr(robot, name) for name in names}} if names else given


def function_of(
    name: str,
    robot: Robot,
    given: dict[str, Tensor | None],
    backend: BackendName | None,
    options: tuple[str, ...] = (),
    double: bool = False,
) -> list[Tensor]:
    """Results of a function of the catalogue, with the broadcast batch axes of all tensors."""
    what = Function(constants(require_robot(robot)), name, options)
    return list(evaluate(what, _with_tensors(robot, given), backend, double).values())


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
        ArgumentError, DtypeError: naming the argument that does not fit.

    Source: Algorithm 1, equations (38)-(48); departures: errata 25, 30, 38, 40, 46, 47, A1.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> inverse_dynamics(robot, torch.zeros(2, dtype=torch.float64))  # holding the arm against gravity
    tensor([19.6200,  4.9050], dtype=torch.float64)
    """
    return function_of(
        "inverse_dynamics", robot, {"q": q, "qd": qd, "qdd": qdd, "f_tip": f_tip, "f_ext": f_ext}, backend
    )[0]


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
    >>> robot, q = torchdq.robots.load("two_link"), torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> forward_dynamics(robot, q, None, inverse_dynamics(robot, q)).abs().max() < 1e-13
    tensor(True)
    """
    given = {"q": q, "qd": qd, "tau": tau, "f_tip": f_tip, "f_ext": f_ext}
    return function_of("forward_dynamics", robot, given, backend, double=check_precision(precision) == "double")[0]


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


class ClosedForm(NamedTuple):
    """Terms of tau = M qdd + c + g + Jt f_tip (63)."""

    M: Tensor  # [..., n, n]
    c: Tensor  # [..., n]
    g: Tensor  # [..., n]
    Jt: Tensor | None  # [..., n, 6] on (force, moment) in the tip frame; None: the robot has no tip


def closed_form(robot: Robot, q: Tensor, qd: Tensor, backend: BackendName | None = None) -> ClosedForm:
    """Mass matrix M [..., n, n], Coriolis and gravity torques c, g [..., n] and Jacobian Jt [..., n, 6].

        tau = M qdd + c + g + Jt f_tip   (63)

    The recorded program computes every term by itself: M by composite bodies, c and g by the recursion without gravity
    and at rest. The matrices of dual quaternions of the paper (`torchdq.paper.closed_form`) give the same.

    Args:
        robot, q, qd: the robot, its joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].

    Source: equations (57)-(72); departures: errata 57, 61, T1.4, 68, 70, 71.

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> closed_form(robot, q, torch.zeros_like(q)).g
    tensor([18.5756,  4.5178], dtype=torch.float64)
    """
    M, c, g, *Jt = function_of(
        "closed_form", robot, {"q": q, "qd": qd}, backend, options_of(require_robot(robot), "closed_form", ())
    )
    return ClosedForm(M, c, g, Jt[0] if Jt else None)


def regressor(robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor, backend: BackendName | None = None) -> Tensor:
    """Regressor Y [..., n, 10 n]: tau = Y pi, with pi = `robot.inertial_parameters`, without rotor inertia.

    Ten columns per link: mass, first moments m c (x y z) and inertia about the link frame's origin
    (xx xy yy xz yz zz), the order of Pinocchio.

    Args:
        robot: the robot; the regressor does not depend on its mass, com and inertia.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
            shape [..., n].

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("puma560"), torch.ones(6, dtype=torch.float64)
    >>> tau = regressor(robot, q, q, 0 * q) @ robot.inertial_parameters
    >>> torch.allclose(tau, inverse_dynamics(robot, q, q), rtol=1e-12)
    True
    """
    return function_of("regressor", robot, {"q": q, "qd": qd, "qdd": qdd}, backend)[0]


def kinetic_energy(robot: Robot, q: Tensor, qd: Tensor, backend: BackendName | None = None) -> Tensor:
    """Kinetic energy qd^T M qd / 2 [J], shape [...], rotors included.

    Args:
        robot, q, qd: the robot, its joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> torch.isclose(kinetic_energy(robot, q, q), q @ mass_matrix(robot, q) @ q / 2)
    tensor(True)
    """
    return function_of("kinetic_energy", robot, {"q": q, "qd": qd}, backend)[0]


def potential_energy(robot: Robot, q: Tensor, backend: BackendName | None = None) -> Tensor:
    """Potential energy -sum of m g . p_com [J], shape [...]; its gradient in q is the gravity torque.

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> torch.allclose(torch.func.grad(lambda q: potential_energy(robot, q))(q), inverse_dynamics(robot, q))
    True
    """
    return function_of("potential_energy", robot, {"q": q}, backend)[0]


# --- kinematics ------------------------------------------------------------------------------------------------------

FEW = 2  # single frames of a robot, each with its own program, that need no warning
_built: Bounded[tuple[str, Constants], tuple[int, float]] = Bounded(PROGRAMS)  # programs of single frames, and seconds


def _of_one_frame(
    name: str, robot: Robot, q: Tensor, options: tuple[str, ...], backend: BackendName | None, otherwise: str
) -> Tensor:
    """Result for one frame; warns once if the programs of single frames of a robot took more than 2 s in all."""
    if is_compiling():
        return function_of(name, robot, {"q": q}, backend, options)[0]
    before, start = recordings(), time.perf_counter()
    found = function_of(name, robot, {"q": q}, backend, options)[0]
    if recordings() != before:
        key = (name, constants(robot))
        number, seconds = _built.get(key, (0, 0.0))
        _built[key] = number, seconds = number + 1, seconds + time.perf_counter() - start
        if number > FEW and seconds > FIRST:
            text = f"{name} built {number} programs in {seconds:.1f} s, one for each frame of robot {robot.name!r}"
            warn_once(f"{name} of {key[1].digest}", f"{text}; {otherwise}", stacklevel=4)
    return found


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
    if not isinstance(frame, str):
        names = robot_frames = require_robot(robot).frame_names
        if frame is not None:
            names = names_of("frame", frame, robot_frames, f"frame of robot {robot.name!r}")
            if not names:
                raise ArgumentError(f"frame must name one frame at least, found none; known: {', '.join(robot_frames)}")
        return function_of("forward_kinematics", robot, {"q": q}, backend, names)[0]
    names = options_of(require_robot(robot), "forward_kinematics", (frame,))
    otherwise = "frame=[...] takes the names of all of them in one program"
    return _of_one_frame("forward_kinematics", robot, q, names, backend, otherwise).squeeze(-2)


def jacobian(
    robot: Robot,
    q: Tensor,
    frame: str,
    expressed: Literal["body", "world"] = "body",
    backend: BackendName | None = None,
) -> Tensor:
    """Jacobian J [..., 6, n]: the twist (angular, linear) of a frame is J qd.

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].
        frame: name of the frame F.
        expressed: "body": V_WF_F, the twist in F's own axes, of F's origin. "world": the same twist of F's origin in
            the axes of the base frame.

    >>> import torch, torchdq
    >>> jacobian(torchdq.robots.load("two_link"), torch.zeros(2), "tip")[4]  # the tip's velocity along y
    tensor([2., 1.])
    """
    names = options_of(require_robot(robot), "jacobian", (frame, expressed))
    otherwise = "they are kept on disk, and the next process finds them there"
    return _of_one_frame("jacobian", robot, q, names, backend, otherwise)


def dynamics_jacobian(
    robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor, backend: BackendName | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives (dtau/dq, dtau/dqd, M) of `inverse_dynamics`, each [..., n, n]; M is dtau/dqdd.

    Args:
        robot: the robot.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
            shape [..., n].

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> torch.equal(dynamics_jacobian(robot, q, q, q)[2], mass_matrix(robot, q))
    True
    """
    dtau_dq, dtau_dqd = function_of("inverse_dynamics_jacobian", robot, {"q": q, "qd": qd, "qdd": qdd}, backend)
    return dtau_dq, dtau_dqd, mass_matrix(robot, q, backend).expand_as(dtau_dq)
