"""Joint positions at which a frame has a desired pose, and joint velocities at which it has a desired twist.

Frames, axes and everything else are as in `torchdq.task_space`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchdq.backends.call import common_batch
from torchdq.backends.choice import BackendName
from torchdq.base.checks import POSITIVE, require_choice, require_count, require_number, require_tensor, tensor_in
from torchdq.errors import ArgumentError
from torchdq.functions import inverse_kinematics as formulas
from torchdq.functions.call import function_of, gain, with_options, with_tensors
from torchdq.functions.catalogue import Function
from torchdq.functions.options import options_of
from torchdq.program.autograd import in_a_graph
from torchdq.program.transforms import mapped, outside_of_graphs, transforming, without_values
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.robot import constants

__all__ = ["differential_inverse_kinematics", "inverse_kinematics"]

TOLERANCES = {torch.float32: 1e-5, torch.float64: 1e-8}


class InverseKinematics(NamedTuple):
    """Solutions of inverse kinematics."""

    q: Tensor  # joint positions within the limits, [..., n]; the best that were found where it has not converged
    converged: Tensor  # whether the error is within the tolerance, [...]
    error: Tensor  # angle [rad] and distance [m] that are left of the components that count, [..., 2]
    starts: Tensor  # number of starts that were taken, [...]


@outside_of_graphs
def inverse_kinematics(
    robot: Robot,
    X: Tensor,
    frame: str | None = None,
    start: Tensor | None = None,
    expressed: Literal["body", "world"] = "body",
    axes: str | Sequence[str] = "pose",
    tolerance: float | tuple[float, float] | None = None,
    starts: int = 128,
    backend: BackendName | None = None,
) -> InverseKinematics:
    """Joint positions q [..., n] within the limits at which a frame has the pose X, from several starts.

    Levenberg-Marquardt steps on the error (rotation vector to X, displacement to X), with joints held at limits. Where
    they stall, the next start is taken: a point of a low-discrepancy sequence within the limits, the same for all
    rows, so that a row has the same result in every batch. A row that cannot be reached has `converged` False, and the
    q whose error has the smallest norm: damped steps lead to it from the best of all starts and from eight of them. Of
    an X farther than a kilometre the direction counts, and the error is to scale. Of an X that is not finite q is NaN.

    Gradients in X and in tensors of the robot are those of the solution that was found, by its implicit function: of
    the smallest change of q where it is not unique, which may lead a joint that stands at a limit beyond it. They are
    zero where it has not converged, and of first order only.

    Args:
        robot: the robot, with a fixed base.
        X: desired pose of the frame in the base frame, a dual quaternion [-, m], shape [..., 8].
        frame: name of the frame; None: the tip.
        start: positions to begin with [rad or m], shape [..., n]; None: the middle of the limits.
        expressed: axes of the error, "body", those of the frame, or "world", those of the base.
        axes: the components that count, "pose", "position", "orientation" or names among rx ry rz x y z; in axes of the
            frame without "rz" it may turn about its z axis. At most as many as the joints move independently.
        tolerance: largest error [rad] and [m], a number for both or one each; None: 1e-8, in float32 1e-5.
        starts: largest number of starts.
    Raises:
        ArgumentError: the joints cannot move these axes independently; X has no values, as in torch.compile.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("panda")
    >>> X = torchdq.forward_kinematics(
    ...     robot, torch.linspace(-1.0, 1.0, 7, dtype=torch.float64) - 0.2, robot.tip
    ... )
    >>> found = inverse_kinematics(robot, X)
    >>> X_WT = torchdq.forward_kinematics(robot, found.q, robot.tip)
    >>> bool(found.converged), bool((X_WT - X).abs().max() < 1e-8)
    (True, True)
    """
    names = options_of(require_robot(robot), "inverse_kinematics_step", (frame, expressed, axes))
    X = tensor_in(X)
    given = {"X": (X, 8), **({} if start is None else {"start": (start, robot.n)})}
    common_batch([(name, x, (width,), False) for name, (x, width) in given.items()], f" for robot {robot.name!r}")
    require_count("starts", starts)
    tolerance = TOLERANCES[X.dtype] if tolerance is None else tolerance
    angle, distance = tolerance if isinstance(tolerance, Sequence) and len(tolerance) == 2 else (tolerance, tolerance)
    for value in (angle, distance):
        require_number("tolerance", value, positive=True)
    tensors = [x for x in with_tensors(robot, {"X": X, "start": start}).values() if x is not None]
    if any(map(mapped, tensors)) if transforming() else without_values((X,)):
        raise ArgumentError(
            "X must have values, since rows take different numbers of steps; call it outside of traces, and instead of "
            "in torch.func.vmap with batch axes"
        )
    settings = (angle, distance, starts, starts + min(formulas.LAST, starts - 1))
    what = Function(constants(robot), "inverse_kinematics_step", names)
    with torch.no_grad():
        q, converged, error, taken = formulas.solve(what, robot, X.detach(), start, settings, backend)
    if in_a_graph(tensors):
        e, P = function_of("inverse_kinematics_newton", robot, {"q": q, "X": X}, backend, names)
        e = torch.where(converged[..., None], e - e.detach(), 0.0)
        q = q + (P.detach() @ e[..., None])[..., 0]
    return InverseKinematics(q, converged, error, taken)


def differential_inverse_kinematics(
    robot: Robot,
    q: Tensor,
    V_des: Tensor,
    frame: str | None = None,
    expressed: Literal["body", "world"] = "body",
    axes: str | Sequence[str] = "pose",
    dt: Tensor | float | None = None,
    limits: bool = True,
    backend: BackendName | None = None,
) -> tuple[Tensor, Tensor]:
    """Joint velocities qd [..., n] of the smallest norm with J qd = scale V_des, and the largest scale [...] up to 1.

    The direction of the twist is kept. Joints that stand at a limit are held, and the others take over. The scale is
    zero where the joints cannot give the twist, as in a singular configuration.

    Args:
        robot, q: the robot and its joint positions [rad or m], shape [..., n].
        V_des: desired components of the twist (angular, linear) [rad/s, m/s], shape [..., m].
        frame, expressed, axes: as in `torchdq.operational_space`.
        dt: time [s] within which no joint may leave its limits, a number or shape [...]; None: they do not count.
        limits: whether joints keep their limits of velocity.
    Raises:
        ArgumentError: the joints cannot move these axes independently; dt is a number that is not positive.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link")
    >>> q = torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> qd, scale = differential_inverse_kinematics(
    ...     robot, q, torch.tensor([0.1, 0.2]).to(q), axes=("x", "y")
    ... )
    >>> (torchdq.jacobian(robot, q, "tip") @ qd)[3:5], scale
    (tensor([0.1000, 0.2000], dtype=torch.float64), tensor(1., dtype=torch.float64))
    """
    require_tensor("q", q)
    require_choice("limits", limits, (False, True))
    given = {"q": q, "V_des": V_des, "dt": None if dt is None else gain("dt", dt, q, POSITIVE)}
    bounded = "bounded" if limits else ""
    qd, scale = with_options("differential_inverse_kinematics", robot, given, backend, frame, expressed, axes, bounded)
    return qd, scale
