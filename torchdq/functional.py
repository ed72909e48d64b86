"""Rigid-body dynamics of a robot: tensors in, tensors out.

Every function broadcasts the leading axes of its inputs against each other and against the robot's own batch axes,
follows the dtype (float32 or float64) and the device of its inputs, and is differentiable to any order in all of
them and in the robot's tensors. A row that is not finite gives a row that is not finite and touches no other.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchdq.algebra import dual_quaternion, quaternion, screw
from torchdq.algebra.dual_quaternion import DualQuaternion
from torchdq.algebra.screw import Adjoint, Screw
from torchdq.dynamics import closed_form as closed
from torchdq.dynamics import crba, energy, forward, kinematics, rnea
from torchdq.dynamics import regressor as regression
from torchdq.dynamics.mechanism import BASE, Coordinate, Mechanism
from torchdq.errors import ArgumentError, DtypeError
from torchdq.robot import Frame, Robot
from torchdq.robot.robot import DTYPES, SHAPES

# --- arguments -------------------------------------------------------------------------------------------------------


class State(NamedTuple):
    """A robot in a position: what every algorithm starts from."""

    robot: Robot  # cast to the inputs
    mechanism: Mechanism
    X_PB: tuple[DualQuaternion, ...]
    Ad: tuple[Adjoint, ...]
    like: Tensor  # scalar per sample: the batch shape of q and the robot, the dtype and device of the results


def check(robot: Robot, optional: Sequence[str] = (), **arguments: tuple[Tensor | None, tuple[int | str, ...]]) -> None:
    """Raise, naming the argument, unless all tensors have their trailing shape, one dtype, one device, one batch.

    Args:
        robot: the robot, whose batch axes must broadcast with the others.
        optional: names of the arguments that may be None.
        arguments: tensors with their trailing shapes, "n" being the number of joints.
    """
    if not isinstance(robot, Robot):
        raise ArgumentError(f"robot must be a torchdq.Robot, found {type(robot).__name__}")
    first: tuple[str, Tensor] | None = None
    batches = _robot_batches(robot)
    for name, (x, shape) in arguments.items():
        if x is None and name in optional:
            continue
        trailing = tuple(robot.n if axis == "n" else axis for axis in shape)
        if not isinstance(x, Tensor):
            raise ArgumentError(f"{name} must be a tensor, found {type(x).__name__}; use torch.as_tensor")
        if x.dtype not in DTYPES:
            raise DtypeError(
                f"{name} must be float32 or float64, found {x.dtype}; integers would round angles and half precision "
                f"loses centimetres over an arm, so convert it yourself"
            )
        if tuple(x.shape[x.ndim - len(trailing) :]) != trailing or x.ndim < len(trailing):
            joints = f" for the {robot.n} joints of robot {robot.name!r}"
            raise ArgumentError(
                f"{name} must have the shape [{', '.join(['...', *map(str, trailing)])}]{joints}, "
                f"found {tuple(x.shape)}"
            )
        batches[name] = x.shape[: x.ndim - len(trailing)]
        if first is None:
            first = (name, x)
            continue
        if x.dtype != first[1].dtype:
            raise DtypeError(f"{name} is {x.dtype} but {first[0]} is {first[1].dtype}; convert one of them")
        if x.device != first[1].device:
            raise ArgumentError(f"{name} is on {x.device} but {first[0]} is on {first[1].device}; move one of them")
    try:
        torch.broadcast_shapes(*batches.values())
    except RuntimeError as error:
        found = ", ".join(f"{name} {tuple(batch)}" for name, batch in batches.items())
        raise ArgumentError(f"the batch axes of the arguments must broadcast, found {found}") from error


def _robot_batches(robot: Robot) -> dict[str, torch.Size]:
    """Batch axes of those tensors of the robot that have any."""
    tensors = {field: getattr(robot, field) for field in SHAPES}
    return {
        f"robot.{field}": x.shape[: x.ndim - len(SHAPES[field])]
        for field, x in tensors.items()
        if x is not None and x.ndim > len(SHAPES[field])
    }


def require_finite(**arguments: Tensor | None) -> None:
    """Raise `ArgumentError`, naming the argument and its first bad entry, unless all tensors are finite.

    The dynamics functions do not look at values: not-a-number in, not-a-number out, in that row only. Call this where
    a wrong row must stop the program instead.

    >>> import torch
    >>> require_finite(q=torch.zeros(3), qd=None)
    """
    for name, x in arguments.items():
        if x is None:
            continue
        if not isinstance(x, Tensor):
            raise ArgumentError(f"{name} must be a tensor, found {type(x).__name__}")
        bad = (~x.isfinite()).nonzero()
        if len(bad):
            at = tuple(bad[0].tolist())
            raise ArgumentError(f"{name} must be finite, found {x[at].item()} at {at}, and {len(bad) - 1} more")


def _state(robot: Robot, q: Tensor) -> State:
    robot = robot.to(dtype=q.dtype, device=q.device)
    value = q if robot.home is None else q - robot.home
    half = 0.5 * value
    coordinates = [
        Coordinate(*parts) for parts in zip(value.unbind(-1), half.cos().unbind(-1), half.sin().unbind(-1), strict=True)
    ]
    mechanism = robot.mechanism()
    X_PB = kinematics.joint_poses(mechanism, coordinates)
    sample = _sample(value)
    # a result need not depend on what has the batch axes; it has them all the same
    like = sample.expand(torch.broadcast_shapes(sample.shape, *_robot_batches(robot).values()))
    return State(robot, mechanism, X_PB, kinematics.adjoints(X_PB), like)


def _sample(x: Tensor) -> Tensor:
    """A number per sample, for its batch shape, dtype and device."""
    return x[..., 0] if x.shape[-1] else x.sum(-1)  # no joints, no first joint


def _screw(x: Tensor) -> Screw:
    parts: tuple = x.unbind(-1)
    return (parts[:3], parts[3:])


def _numbers(x: Tensor | None) -> tuple[Tensor, ...] | None:
    return None if x is None else x.unbind(-1)


def _exerted(s: State, f_tip: Tensor | None, f_ext: Tensor | None) -> list[Screw | None]:
    on_links = None if f_ext is None else [_screw(f) for f in f_ext.unbind(-2)]
    if f_tip is None:
        return rnea.exerted_wrenches(s.mechanism, on_links, None, None)
    return rnea.exerted_wrenches(s.mechanism, on_links, _tip(s.robot), _screw(f_tip))


def _tip(robot: Robot) -> tuple[int, Adjoint]:
    if robot.tip is None:
        raise ArgumentError(
            f"f_tip needs an end effector, and robot {robot.name!r} has none chosen; load it with tip=, or use "
            f"robot.with_tip(name) with one of {', '.join(robot.frame_names)}"
        )
    frame = robot.frame(robot.tip)
    if frame.link == BASE:
        raise ArgumentError(f"the tip {frame.name!r} of robot {robot.name!r} is fixed to the base")
    return frame.link, screw.columns(_pose(frame.X_BF))


def _pose(x: Tensor) -> DualQuaternion:
    parts: tuple = x.unbind(-1)
    return (parts[:4], parts[4:])


def _filled(components: Sequence[Tensor | None], like: Sequence[Tensor | None]) -> Tensor:
    """Tensor [..., k] of components of which some are absent, with the batch axes of all of `like`."""
    shape = torch.broadcast_shapes(*[x.shape for x in [*components, *like] if x is not None])
    zero = next(x for x in like if x is not None).new_zeros(())
    if not components:
        return zero.expand(*shape, 0)
    return torch.stack([(zero if x is None else x).expand(shape) for x in components], -1)


def _matrix(rows: Sequence[Sequence[Tensor | None]], width: int, like: Sequence[Tensor | None]) -> Tensor:
    """Tensor [..., rows, width] of rows of components of which some are absent."""
    entries = _filled([entry for row in rows for entry in row], like)
    return entries.reshape(*entries.shape[:-1], len(rows), width)


def _number(x: Tensor | float, like: Sequence[Tensor]) -> Tensor:
    """Tensor [...] of a number per sample; a Python number is the zero of a sum without terms."""
    return _filled([x if isinstance(x, Tensor) else None], like)[..., 0]


def _components(x: Screw | None) -> tuple[Tensor | None, ...]:
    return (None,) * 6 if x is None else (*x[0], *x[1])


# --- dynamics --------------------------------------------------------------------------------------------------------


def inverse_dynamics(
    robot: Robot,
    q: Tensor,
    qd: Tensor | None = None,
    qdd: Tensor | None = None,
    f_tip: Tensor | None = None,
    f_ext: Tensor | None = None,
) -> Tensor:
    """Joint torques tau [..., n] that produce a motion, by the recursive dual-quaternion Newton-Euler algorithm.

        tau = M(q) qdd + c(q, qd) + g(q) + J^T f_tip - sum of J_i^T f_ext_i

    Args:
        robot: the robot; its batch axes broadcast with the others.
        q: joint positions [rad or m], shape [..., n].
        qd: joint velocities [rad/s or m/s], shape [..., n]; None: at rest, and nothing of it is computed.
        qdd: joint accelerations [rad/s^2 or m/s^2], shape [..., n]; None: none.
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
    >>> inverse_dynamics(robot, torch.zeros(2, dtype=torch.float64))  # holding it out against gravity
    tensor([19.6200,  4.9050], dtype=torch.float64)
    """
    check(
        robot,
        optional=("qd", "qdd", "f_tip", "f_ext"),
        q=(q, ("n",)),
        qd=(qd, ("n",)),
        qdd=(qdd, ("n",)),
        f_tip=(f_tip, (6,)),
        f_ext=(f_ext, ("n", 6)),
    )
    s = _state(robot, q)
    tau = rnea.rnea(s.mechanism, s.Ad, _numbers(qd), _numbers(qdd), _exerted(s, f_tip, f_ext))
    return _filled(tau, [s.like, *(_sample(x) for x in (qd, qdd, f_tip) if x is not None)])


def mass_matrix(robot: Robot, q: Tensor) -> Tensor:
    """Mass matrix M(q) [..., n, n], symmetric to the last bit, rotor inertia on its diagonal (69).

    Args:
        robot: the robot.
        q: joint positions [rad or m], shape [..., n].

    >>> import torch, torchdq
    >>> mass_matrix(torchdq.robots.load("two_link"), torch.tensor([0.3, 0.0])).mul(12).round()
    tensor([[32., 10.],
            [10.,  4.]])
    """
    check(robot, q=(q, ("n",)))
    s = _state(robot, q)
    return _matrix(crba.mass_matrix(s.mechanism, s.X_PB, s.Ad), robot.n, [s.like])


def forward_dynamics(
    robot: Robot,
    q: Tensor,
    qd: Tensor | None,
    tau: Tensor,
    f_tip: Tensor | None = None,
    f_ext: Tensor | None = None,
) -> Tensor:
    """Joint accelerations qdd [..., n] that torques produce: the inverse of `inverse_dynamics` in qdd.

        qdd = M(q)^-1 (tau - c(q, qd) - g(q) - J^T f_tip + sum of J_i^T f_ext_i)

    The error grows with the condition number of M, whatever the method; use float64 for long chains. A mass matrix
    that is singular makes that row infinite or NaN.

    Args:
        tau: joint torques [N m] or forces [N], shape [..., n].
        robot, q, qd, f_tip, f_ext: as in `inverse_dynamics`.

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> forward_dynamics(robot, q, None, inverse_dynamics(robot, q)).abs().max() < 1e-13
    tensor(True)
    """
    check(
        robot,
        optional=("qd", "f_tip", "f_ext"),
        q=(q, ("n",)),
        qd=(qd, ("n",)),
        tau=(tau, ("n",)),
        f_tip=(f_tip, (6,)),
        f_ext=(f_ext, ("n", 6)),
    )
    s = _state(robot, q)
    bias = rnea.rnea(s.mechanism, s.Ad, _numbers(qd), None, _exerted(s, f_tip, f_ext))
    M = crba.mass_matrix(s.mechanism, s.X_PB, s.Ad)
    qdd = forward.forward_dynamics(s.mechanism, M, bias, tau.unbind(-1))
    return _filled(qdd, [s.like, *(_sample(x) for x in (qd, tau, f_tip) if x is not None)])


class ClosedForm(NamedTuple):
    """Terms of tau = M qdd + c + g + Jt f_tip (63)."""

    M: Tensor  # [..., n, n]
    c: Tensor  # [..., n]
    g: Tensor  # [..., n]
    Jt: Tensor | None  # [..., n, 6] on (force, moment) in the tip frame; None: the robot has no tip


def closed_form(robot: Robot, q: Tensor, qd: Tensor) -> ClosedForm:
    """Mass matrix M [..., n, n], Coriolis and gravity torques c, g [..., n] and Jacobian Jt [..., n, 6].

        tau = M qdd + c + g + Jt f_tip   (63)

    Args:
        robot: the robot.
        q, qd: joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].

    Source: equations (57)-(72); departures: errata 57, 61, T1.4, 68, 70, 71.

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> closed_form(robot, q, torch.zeros_like(q)).g
    tensor([18.5756,  4.5178], dtype=torch.float64)
    """
    check(robot, q=(q, ("n",)), qd=(qd, ("n",)))
    s = _state(robot, q)
    terms = closed.closed_form(s.mechanism, s.Ad, qd.unbind(-1), None if robot.tip is None else _tip(s.robot))
    like = [s.like, _sample(qd)]
    Jt = None if terms.Jt is None else _matrix([_components(row) for row in terms.Jt], 6, like)
    return ClosedForm(_matrix(terms.M, robot.n, like), _filled(terms.c, like), _filled(terms.g, like), Jt)


def regressor(robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor) -> Tensor:
    """Regressor Y [..., n, 10 n]: tau = Y pi, with pi = `robot.inertial_parameters`, without rotor inertia.

    Ten columns per link: mass, first moments m c (x y z) and inertia about the link frame's origin
    (xx xy yy xz yz zz), the order of Pinocchio.

    Args:
        robot: the robot; its own mass, com and inertia do not enter.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
            shape [..., n].

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("puma560"), torch.ones(6, dtype=torch.float64)
    >>> tau = regressor(robot, q, q, 0 * q) @ robot.inertial_parameters
    >>> torch.allclose(tau, inverse_dynamics(robot, q, q), rtol=1e-12)
    True
    """
    check(robot, q=(q, ("n",)), qd=(qd, ("n",)), qdd=(qdd, ("n",)))
    s = _state(robot, q)
    V, A = rnea.outward(s.mechanism, s.Ad, qd.unbind(-1), qdd.unbind(-1), rnea.base_at_rest(s.mechanism))
    blocks = regression.regressor(s.mechanism, s.Ad, V, A)
    rows = [[entry for block in row for entry in (block or (None,) * 10)] for row in blocks]
    return _matrix(rows, 10 * robot.n, [s.like, _sample(qd), _sample(qdd)])


def kinetic_energy(robot: Robot, q: Tensor, qd: Tensor) -> Tensor:
    """Kinetic energy qd^T M qd / 2 [J], shape [...], rotors included.

    Args:
        robot: the robot.
        q, qd: joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].
    """
    check(robot, q=(q, ("n",)), qd=(qd, ("n",)))
    s = _state(robot, q)
    rates = qd.unbind(-1)
    V, _ = rnea.outward(s.mechanism, s.Ad, rates, [None] * robot.n, rnea.Base(None, None))
    return _number(energy.kinetic_energy(s.mechanism, V, rates), [s.like, _sample(qd)])


def potential_energy(robot: Robot, q: Tensor) -> Tensor:
    """Potential energy -sum of m g . p_com [J], shape [...]; its gradient in q is the gravity torque.

    Args:
        robot: the robot.
        q: joint positions [rad or m], shape [..., n].
    """
    check(robot, q=(q, ("n",)))
    s = _state(robot, q)
    value = energy.potential_energy(s.mechanism, kinematics.link_poses(s.mechanism, s.X_PB))
    return _number(value, [s.like])


# --- kinematics ------------------------------------------------------------------------------------------------------


def forward_kinematics(robot: Robot, q: Tensor, frame: str | None = None) -> Tensor:
    """Pose X_WF [..., 8] of a frame in the base frame, or [..., frames, 8] of all frames in `robot.frame_names` (39).

    Args:
        robot: the robot.
        q: joint positions [rad or m], shape [..., n].
        frame: name of the frame; None: all of them.

    >>> import torch, torchdq
    >>> X = forward_kinematics(torchdq.robots.load("two_link"), torch.zeros(2), "tip")
    >>> torchdq.dq.translation(X)
    tensor([2., 0., 0.])
    """
    check(robot, q=(q, ("n",)))
    s = _state(robot, q)
    X_WB = kinematics.link_poses(s.mechanism, s.X_PB)
    frames = s.robot.frames if frame is None else (s.robot.frame(frame),)
    poses = [_frame_pose(X_WB, f, s.like) for f in frames]
    return poses[0] if frame is not None else torch.stack(torch.broadcast_tensors(*poses), -2)


def _frame_pose(X_WB: Sequence[DualQuaternion], frame: Frame, like: Tensor) -> Tensor:
    X_BF = _pose(frame.X_BF)
    x = X_BF if frame.link == BASE else dual_quaternion.mul(X_WB[frame.link], X_BF)
    return _filled((*x[0], *x[1]), [like])


def jacobian(robot: Robot, q: Tensor, frame: str, expressed: Literal["body", "world"] = "body") -> Tensor:
    """Jacobian J [..., 6, n]: the twist (angular, linear) of a frame is J qd.

    Args:
        robot: the robot.
        q: joint positions [rad or m], shape [..., n].
        frame: name of the frame F.
        expressed: "body": V_WF_F, the twist in F's own axes, of F's origin. "world": the same twist of F's origin in
            the axes of the base frame.

    >>> import torch, torchdq
    >>> jacobian(torchdq.robots.load("two_link"), torch.zeros(2), "tip")[4]  # the tip's velocity along y
    tensor([2., 1.])
    """
    check(robot, q=(q, ("n",)))
    if expressed not in ("body", "world"):
        raise ArgumentError(f"expressed must be 'body' or 'world', found {expressed!r}")
    s = _state(robot, q)
    f = s.robot.frame(frame)
    if f.link == BASE:
        columns: tuple[Screw | None, ...] = (None,) * robot.n
    else:
        columns = kinematics.jacobian(s.mechanism, s.Ad, f.link, _pose(f.X_BF))
    if expressed == "world" and f.link != BASE:
        # component by component: a matrix product would be rounded to half precision under autocast
        r_WF = quaternion.mul(kinematics.link_poses(s.mechanism, s.X_PB)[f.link][0], _pose(f.X_BF)[0])
        columns = tuple(c and (quaternion.rotate(r_WF, c[0]), quaternion.rotate(r_WF, c[1])) for c in columns)
    return _matrix([_components(c) for c in columns], 6, [s.like]).mT


def dynamics_jacobian(robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives (dtau/dq, dtau/dqd, M) of `inverse_dynamics`, each [..., n, n]; M is dtau/dqdd.

    Args:
        robot: the robot.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
            shape [..., n].
    """
    check(robot, q=(q, ("n",)), qd=(qd, ("n",)), qdd=(qdd, ("n",)))
    # forward mode refuses tensors whose elements share memory, which broadcasting makes
    q, qd, qdd = (x.contiguous() for x in torch.broadcast_tensors(q, qd, qdd))
    M = mass_matrix(robot, q)
    if not robot.n:
        return M, M, M  # vmap cannot map over no directions
    unit = torch.eye(robot.n, dtype=q.dtype, device=q.device)

    def along(direction: Tensor, of: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
        return torch.func.jvp(of, (at,), (direction.expand_as(at),))[1]

    def columns(of: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
        return torch.func.vmap(lambda direction: along(direction, of, at), out_dims=-1)(unit)

    return (
        columns(lambda x: inverse_dynamics(robot, x, qd, qdd), q),
        columns(lambda x: inverse_dynamics(robot, q, x, qdd), qd),
        M,
    )
