"""Robots with closed loops: positions at which their closures are closed, and how far they are from it.

A robot's links are a tree; `Robot.closures` are pairs of frames that are held together besides. They do not depend on
the pose of a floating base, so that the functions here are for robots on any base.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.base.checks import matching, require_tensor
from torchdq.dynamics.closures import ROWS
from torchdq.errors import ArgumentError
from torchdq.functions.call import function_of
from torchdq.program.transforms import outside_of_graphs
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot

__all__ = ["closed", "closure_errors", "constrained_inverse_dynamics"]

MOST = 50  # Newton steps
TOLERANCES = {torch.float32: 4e-6, torch.float64: 4e-12}  # [m] and [rad], of a machine of a metre
ROUNDED = 1e-6  # gap of rows that contradict others by the rounding of a file, which no positions close [m] and [rad]
# singular values, relative to the norm of the Jacobian, that are left out: of rows that others imply
SINGULAR = {torch.float32: 1e-5, torch.float64: 1e-6}
UNBALANCED = 1e-6  # torque that is left at joints without motors, relative to the largest


class ClosureErrors(NamedTuple):
    """Errors of every closure of a robot."""

    distance: Tensor  # between the origins of its frames [m], shape [..., closures]
    angle: Tensor  # between the axes that it holds [rad], zero for points, shape [..., closures]


def closure_errors(robot: Robot, q: Tensor, backend: BackendName | None = None) -> ClosureErrors:
    """Distances between the frames that closures hold together, and angles between their axes.

    Args:
        robot: the robot, on any base.
        q: joint positions [rad or m], shape [..., n].

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link").with_closures(torchdq.Closure("base", "tip"))
    >>> closure_errors(robot, torch.tensor([0.0, 0.0])).distance
    tensor([2.])
    """
    g, _, cosine = function_of("closure_gaps", _looped(robot), {"q": q}, backend)
    parts = g.split([ROWS[x.kind] for x in robot.closures], -1)
    distance, sine = (torch.stack([x[..., of].norm(dim=-1) for x in parts], -1) for of in (slice(3), slice(3, None)))
    return ClosureErrors(distance, torch.atan2(sine, cosine))


@outside_of_graphs
def closed(robot: Robot, q: Tensor, hold: Sequence[str] | str = (), backend: BackendName | None = None) -> Tensor:
    """Joint positions [..., n] near q at which all closures are closed, by Newton's method.

    Each step is the smallest change that closes the gaps to first order, q - J^+ g. Gradients in q are those of the
    solution: of the projection on positions that are closed; second derivatives, too, where `hold` leaves one solution.
    A row that is not finite remains so. Closures that contradict one another by the rounding of a file, up to 1e-6 m,
    are closed as far as they go.

    Args:
        robot: the robot, on any base.
        q: joint positions to begin with [rad or m], shape [..., n].
        hold: names or patterns of joints that keep their positions.
    Raises:
        ArgumentError: the closures of a row cannot be closed from there, or only with axes half a turn apart.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link").with_closures(torchdq.Closure("base", "tip"))
    >>> closed(robot, torch.tensor([0.3, 3.0]), hold="joint1")
    tensor([0.3000, 3.1416])
    """
    held = matching("hold", hold, _looped(robot).joint_names, f"joint of robot {robot.name!r}")
    require_tensor("q", q)
    free = torch.tensor([name not in held for name in robot.joint_names], device=q.device)
    with torch.no_grad():
        at, gaping, turned, k = towards_closed(robot, q.detach(), free, backend=backend)
    done = not bool(gaping.any())
    if not done or bool(turned.any()):
        errors = closure_errors(robot, at)
        found = (errors.angle if done else errors.distance).nan_to_num().reshape(-1, len(robot.closures)).amax(0)
        a, b, _ = robot.closures[int(found.argmax())]
        apart = f"an angle of {float(found.max()):.3g} rad" if done else f"{float(found.max()):.3g} m"
        raise ArgumentError(
            f"q must be near positions at which {a!r} and {b!r} of robot {robot.name!r} come together, found {apart} "
            f"between them after {k} steps; start nearer, or hold others"
        )
    moved = q + (at - q.detach())
    g, J, _ = function_of("closure_gaps", robot, {"q": moved}, backend)
    inverse = _inverse(J.detach() * free, J)
    contradicting = g.detach().abs().amax(-1, keepdim=True) > 10 * TOLERANCES[q.dtype]  # which steps would not close
    for order in range(2):  # each step of a constant inverse gives derivatives of an order more
        g = g if order == 0 else function_of("closure_gaps", robot, {"q": moved}, backend)[0]
        last = (inverse @ g[..., None])[..., 0]
        moved = moved - (last - last.detach().where(contradicting, 0.0))
    return moved


def towards_closed(
    robot: Robot, q: Tensor, free: Tensor, most: int = MOST, backend: BackendName | None = None
) -> tuple[Tensor, Tensor, Tensor, int]:
    """Positions [..., n] after Newton steps of the free joints, each row until it is closed.

    Then which rows are not closed, which have axes more than a quarter turn apart, and the number of steps. Rows do not
    depend on each other, and a row that is not finite remains as it is.
    """
    last: Tensor | float = torch.inf
    for k in range(most + 1):
        step, gap, cosine = function_of("loop_step", robot, {"q": q, "free": free.to(q.dtype)}, backend)
        least = TOLERANCES[q.dtype]
        apart, last = (gap > least) & ~((gap <= ROUNDED) & (gap > 0.5 * last)), gap
        if k == most or (q.is_cpu and not bool(apart.any())):  # other devices are not waited for
            break
        q = torch.where(apart[..., None], q + step, q)
    return q, apart, cosine < 0, k


def held_velocities(robot: Robot, q: Tensor, qd: Tensor, backend: BackendName | None = None) -> Tensor:
    """Velocities [..., n] nearest to qd that keep the loops closed, at closed positions q."""
    for _ in range(2):  # as least squares are damped
        qd = qd - function_of("loop_step", robot, {"q": q, "qd": qd, "free": q.new_ones(robot.n)}, backend)[0]
    return qd


def _inverse(A: Tensor, J: Tensor) -> Tensor:
    """Pseudo-inverse of a matrix, without singular values that are small beside J; of one that is not finite NaN."""
    finite = J.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
    whole = torch.where(finite, J, 0.0).detach()
    least = SINGULAR[J.dtype] * torch.linalg.matrix_norm(whole)
    found = torch.linalg.pinv(torch.where(finite, A, 0.0), atol=least, rtol=torch.zeros_like(least))
    return torch.where(finite, found, torch.nan)


class ConstrainedInverseDynamics(NamedTuple):
    """Torques of a robot with loops."""

    tau: Tensor  # of all joints, zero for those without a motor [N m or N], shape [..., n]
    forces: Tensor  # of the closures on their second frames, row by row [N or N m], shape [..., rows]


def constrained_inverse_dynamics(
    robot: Robot,
    q: Tensor,
    qd: Tensor | None = None,
    qdd: Tensor | None = None,
    actuated: Sequence[str] | str = "*",
    f_tip: Tensor | None = None,
    f_ext: Tensor | None = None,
    backend: BackendName | None = None,
) -> ConstrainedInverseDynamics:
    """Torques of the actuated joints that produce a motion of a robot with loops, and the forces in its closures.

        tau + J^T forces = M qdd + c + g,    tau = 0 at the other joints

    Of the torques that do, where there are more motors than degrees of freedom, those of least norm. They are computed
    in float64 whatever the inputs are.

    Args:
        robot: the robot, with a fixed base.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2] that keep
            the loops closed, shape [..., n]. This is not checked, as feedback asks for motions that nearly do; of
            others, the torques do the work of the motion on the velocities that the loops allow.
        actuated: names or patterns of the joints that have motors.
        f_tip, f_ext: wrenches, as in `inverse_dynamics`.
    Raises:
        ArgumentError: another joint would need a torque of its own in a row.

    >>> import torch, torchdq
    >>> robot = torchdq.robots.load("two_link").with_closures(torchdq.Closure("base", "tip"))
    >>> constrained_inverse_dynamics(
    ...     robot, torch.tensor([0.3, torch.pi]), actuated="joint1"
    ... ).tau.shape
    torch.Size([2])
    """
    if _looped(robot).floating:
        raise ArgumentError(
            f"robot {robot.name!r} must have a fixed base, found a floating one, to which no motor gives every "
            "acceleration; load it with base='fixed'"
        )
    names = matching("actuated", actuated, robot.joint_names, f"joint of robot {robot.name!r}")
    given = {"q": q, "qd": qd, "qdd": qdd, "f_tip": f_tip, "f_ext": f_ext}
    for name, x in given.items():
        require_tensor(name, q if x is None else x)
    double = {name: None if x is None else x.double() for name, x in given.items()}
    tree, J = function_of("loop_torques", robot, double, backend)
    has = torch.tensor([name in names for name in robot.joint_names], device=q.device).to(J)
    J_T, passive, motors = J.mT, (1 - has)[:, None], has[:, None]
    bound = _inverse(passive * J_T, J_T)  # forces are those that torques of zero need, and what they leave free
    first, free = bound @ (passive * tree[..., None]), torch.eye(J.shape[-2]).to(J) - bound @ (passive * J_T)
    forces = first + free @ (_inverse(motors * (J_T @ free), J_T) @ (motors * (tree[..., None] - J_T @ first)))
    tau = tree - (J_T @ forces)[..., 0]
    left, size = (passive[:, 0] * tau).detach().abs(), tree.detach().abs()
    if bool((left > UNBALANCED * size.amax(-1, keepdim=True)).any()):
        joint = robot.joint_names[int(left.nan_to_num().reshape(-1, robot.n).amax(0).argmax())]
        raise ArgumentError(
            f"actuated must be joints that move robot {robot.name!r} as asked, found {', '.join(names) or 'none'}, "
            f"which leave a torque of {float(left.nan_to_num().amax()):.3g} at {joint!r}; name it, too, or others of "
            "its loop"
        )
    return ConstrainedInverseDynamics((tau * has).to(q.dtype), forces[..., 0].to(q.dtype))


def _looped(robot: Robot) -> Robot:
    """Robot, if it has closures."""
    if not require_robot(robot).closures:
        raise ArgumentError(f"robot {robot.name!r} must have closures, found none; see Robot.with_closures")
    return robot
