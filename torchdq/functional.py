"""Rigid-body dynamics of a robot: tensors in, tensors out.

Every function broadcasts the leading axes of its inputs against each other and against the robot's own batch axes,
follows the dtype (float32 or float64) and the device of its inputs, and is differentiable to any order in all of
them and in those of the robot's tensors that were replaced (`robot.replace`). A row that is not finite gives a row that
is not finite and touches no other.

`backend` says what runs the program that is recorded for the robot: "c", compiled for the processor; "eager", torch
operations, on any device; "auto", the first that can.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import torch
from torch import Tensor

from torchdq.backends import choice as backends
from torchdq.backends import run
from torchdq.backends.choice import Backend
from torchdq.errors import ArgumentError, DtypeError
from torchdq.functions.catalogue import RECIPES, Signature, program
from torchdq.program.program import Program
from torchdq.robot import Robot
from torchdq.robot.robot import DTYPES, SHAPES

# --- arguments -------------------------------------------------------------------------------------------------------


Shape = tuple[int, ...]
Precision = Literal["auto", "double"]


def check(robot: Robot, **arguments: tuple[Tensor | None, Sequence[int | str], bool]) -> Shape:
    """Batch axes of the arguments and the robot together.

    Raises, naming the argument, unless all tensors have their trailing axes, one dtype, one device, and batch axes that
    broadcast with each other and with the robot's.

    Args:
        robot: the robot.
        arguments: tensors with their trailing axes, "n" being the number of joints, and whether they may be None.
    """
    _robot(robot)
    first: tuple[str, Tensor] | None = None
    batches: dict[str, Sequence[int]] = {}
    for name, (x, axes, optional) in arguments.items():
        if x is None and optional:
            continue
        if not isinstance(x, Tensor):
            raise ArgumentError(f"{name} must be a tensor, found {type(x).__name__}; use torch.as_tensor")
        if x.dtype not in DTYPES:
            raise DtypeError(
                f"{name} must be float32 or float64, found {x.dtype}; integers would round angles and half precision "
                f"loses centimetres over an arm, so convert it yourself"
            )
        trailing = _numbers(axes, robot.n)
        if x.ndim < len(trailing) or tuple(x.shape[x.ndim - len(trailing) :]) != trailing:
            raise ArgumentError(
                f"{name} must have the shape [{', '.join(['...', *map(str, trailing)])}] for the {robot.n} joints of "
                f"robot {robot.name!r}, found {tuple(x.shape)}"
            )
        batches[name] = x.shape[: x.ndim - len(trailing)]
        first = first or (name, x)
        if x.dtype != first[1].dtype:
            raise DtypeError(f"{name} is {x.dtype} but {first[0]} is {first[1].dtype}; convert one of them")
        if x.device != first[1].device:
            raise ArgumentError(f"{name} is on {x.device} but {first[0]} is on {first[1].device}; move one of them")
    for name in robot.varying:
        x = getattr(robot, name)
        if x.ndim > len(SHAPES[name]):
            batches[f"robot.{name}"] = x.shape[: x.ndim - len(SHAPES[name])]
    try:
        return tuple(torch.broadcast_shapes(*batches.values()))
    except RuntimeError as error:
        found = ", ".join(f"{name} {tuple(batch)}" for name, batch in batches.items())
        raise ArgumentError(f"the batch axes of the arguments must broadcast, found {found}") from error


def _robot(robot: Robot) -> Robot:
    if not isinstance(robot, Robot):
        raise ArgumentError(f"robot must be a torchdq.Robot, found {type(robot).__name__}")
    return robot


def _numbers(axes: Sequence[int | str], n: int) -> Shape:
    return tuple([n if axis == "n" else int(axis) for axis in axes])


def check_precision(precision: Precision) -> Precision:
    """The precision, if there is one of that name."""
    if precision not in get_args(Precision):
        raise ArgumentError(f"precision must be 'auto' or 'double', found {precision!r}")
    return precision


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


# --- evaluation ------------------------------------------------------------------------------------------------------


class _Layout(NamedTuple):
    """How inputs of certain shapes become rows of a program, and its results tensors."""

    signature: tuple
    rows: tuple[tuple[Shape, Shape], ...]  # of every input: what it is expanded to, and then reshaped to
    results: tuple[Shape, ...]


class _Plan(NamedTuple):
    """A layout with the program and the backend that run it."""

    layout: _Layout
    program: Program
    eager: bool


_plans: dict[tuple, _Plan] = {}  # found once for all inputs that look the same
_MOST_PLANS = 4096


def _evaluate(
    name: str,
    robot: Robot,
    arguments: tuple[Tensor | None, ...],
    backend: Backend | None,
    options: tuple[str, ...] = (),
) -> list[Tensor]:
    """Results of a recipe, with the batch axes of everything that went in."""
    if torch.compiler.is_compiling():
        return _traced(name, robot, arguments, backend, options)
    try:
        inputs = [x for x in (*arguments, *[getattr(robot, field) for field in robot.varying]) if x is not None]
        like = inputs[0]
        look = [None if x is None else (x.shape, x.dtype, x.device) for x in arguments]
        key = (name, robot.identity, robot.varying, options, backend, backends.present(), *look)
        if robot.varying:
            key += tuple([getattr(robot, field).shape for field in robot.varying])
    except (AttributeError, IndexError):
        _check(name, robot, arguments)  # something is no tensor, or no robot, and the check says what
        raise
    plan = _plans.get(key)
    if plan is None:
        layout = _layout(name, robot, arguments, options)
        eager = backends.choose(backend, like.device.type) == "eager"
        plan = _Plan(layout, program(robot.origin or robot, Signature(*layout.signature)), eager)
        if len(_plans) >= _MOST_PLANS:
            _plans.clear()
        _plans[key] = plan
    rows = [run.row(x, like, shapes) for x, shapes in zip(inputs, plan.layout.rows, strict=True)]
    outputs = run.eager(plan.program, rows) if plan.eager else run.compiled(plan.program, rows)
    return [y if y.shape == shape else y.view(shape) for y, shape in zip(outputs, plan.layout.results, strict=True)]


def _check(name: str, robot: Robot, arguments: tuple[Tensor | None, ...]) -> Shape:
    expected = RECIPES[name].arguments
    return check(
        robot,
        **{argument: (x, axes, optional) for (argument, axes, optional), x in zip(expected, arguments, strict=True)},
    )


def _layout(name: str, robot: Robot, arguments: tuple[Tensor | None, ...], options: tuple[str, ...]) -> _Layout:
    """Layout of checked inputs."""
    batch = _check(name, robot, arguments)
    samples, n, recipe = math.prod(batch), robot.n, RECIPES[name]
    present = [
        (argument, _numbers(axes, n))
        for (argument, axes, _), x in zip(recipe.arguments, arguments, strict=True)
        if x is not None
    ]
    rows: list[tuple[Shape, Shape]] = [(batch + axes, (samples, math.prod(axes))) for _, axes in present]
    fields = []
    for field in robot.varying:
        x = getattr(robot, field)
        axes = _numbers(SHAPES[field], n)
        uniform = x.ndim == len(axes)
        fields.append((field, math.prod(axes), uniform))
        rows.append((axes, (math.prod(axes),)) if uniform else (batch + axes, (samples, math.prod(axes))))
    signature = (
        robot.identity,
        name,
        tuple([(argument, math.prod(axes)) for argument, axes in present]),
        tuple(fields),
        options,
    )
    return _Layout(signature, tuple(rows), tuple([batch + axes for axes in recipe.results(n, *options)]))


def _traced(
    name: str,
    robot: Robot,
    arguments: tuple[Tensor | None, ...],
    backend: Backend | None,
    options: tuple[str, ...],
) -> list[Tensor]:
    """The same in a graph that is being traced: sizes may be symbols, and the program goes by its name."""
    layout = _layout(name, robot, arguments, options)
    inputs = [x for x in (*arguments, *[getattr(robot, field) for field in robot.varying]) if x is not None]
    rows = [run.row(x, inputs[0], shapes) for x, shapes in zip(inputs, layout.rows, strict=True)]
    origin = robot.origin or robot
    if backends.choose(backend, inputs[0].device.type) == "eager":
        outputs = run.eager(_constant_program(origin, layout.signature), rows)
    else:
        outputs = run.operator(_constant_key(origin, layout.signature), rows)
    return [y.reshape(shape) for y, shape in zip(outputs, layout.results, strict=True)]


@torch.compiler.assume_constant_result
def _constant_program(robot: Robot, signature: tuple) -> Program:
    # a tracer hands over plain tuples, not named ones
    return program(robot, Signature(*signature))


@torch.compiler.assume_constant_result
def _constant_key(robot: Robot, signature: tuple) -> str:
    return run.key(program(robot, Signature(*signature)))


# --- dynamics --------------------------------------------------------------------------------------------------------


def inverse_dynamics(
    robot: Robot,
    q: Tensor,
    qd: Tensor | None = None,
    qdd: Tensor | None = None,
    f_tip: Tensor | None = None,
    f_ext: Tensor | None = None,
    backend: Backend | None = None,
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
    return _evaluate("inverse_dynamics", robot, (q, qd, qdd, f_tip, f_ext), backend)[0]


def mass_matrix(robot: Robot, q: Tensor, backend: Backend | None = None) -> Tensor:
    """Mass matrix M(q) [..., n, n], symmetric to the last bit, rotor inertia on its diagonal (69).

    Args:
        robot: the robot.
        q: joint positions [rad or m], shape [..., n].

    >>> import torch, torchdq
    >>> mass_matrix(torchdq.robots.load("two_link"), torch.tensor([0.3, 0.0])).mul(12).round()
    tensor([[32., 10.],
            [10.,  4.]])
    """
    return _evaluate("mass_matrix", robot, (q,), backend)[0]


def forward_dynamics(
    robot: Robot,
    q: Tensor,
    qd: Tensor | None,
    tau: Tensor,
    f_tip: Tensor | None = None,
    f_ext: Tensor | None = None,
    backend: Backend | None = None,
    precision: Precision = "auto",
) -> Tensor:
    """Joint accelerations qdd [..., n] that torques produce: the inverse of `inverse_dynamics` in qdd.

        qdd = M(q)^-1 (tau - c(q, qd) - g(q) - J^T f_tip + sum of J_i^T f_ext_i)

    Rounding errors grow with the condition of M, whatever the method. Every row is watched (`error_growth`): one that
    float32 would leave without half of its digits is computed in float64 and rounded, so are its derivatives; one whose
    mass matrix is singular to float64, or not positive definite, is NaN. Neither touches another row.

    Args:
        tau: joint torques [N m] or forces [N], shape [..., n].
        robot, q, qd, f_tip, f_ext: as in `inverse_dynamics`.
        precision: "auto": as above; "double": all rows are computed in float64, float32 in and out.
    Raises:
        SingularInertiaError: a joint moves nothing in any position.

    >>> import torch, torchdq
    >>> robot, q = torchdq.robots.load("two_link"), torch.tensor([0.3, -0.7], dtype=torch.float64)
    >>> forward_dynamics(robot, q, None, inverse_dynamics(robot, q)).abs().max() < 1e-13
    tensor(True)
    """
    arguments = (q, qd, tau, f_tip, f_ext)
    if check_precision(precision) == "double":
        if len({getattr(x, "dtype", None) for x in arguments if x is not None}) > 1:
            _check("forward_dynamics", robot, arguments)  # what is wide already would no longer be noticed
        wide = tuple([x.double() if isinstance(x, Tensor) and x.dtype == torch.float32 else x for x in arguments])
        return _evaluate("forward_dynamics", robot, wide, backend)[0].to(tau.dtype)
    return _evaluate("forward_dynamics", robot, arguments, backend)[0]


def error_growth(robot: Robot, q: Tensor, backend: Backend | None = None) -> Tensor:
    """Factor [...] by which `forward_dynamics` magnifies rounding errors, from 1: the largest M_ii / D_i.

    D_i is what joint i feels of the inertia M_ii when the joints beyond it are free, a pivot of M. The relative error
    of accelerations is typically 10 eps, seldom more than 200 eps, times this factor. Above 2^10, float32 inputs are
    computed in float64; above 2^46, accelerations are NaN. Where a pivot is not positive it is huge, 1e30 or more.

    Args:
        robot: the robot.
        q: joint positions [rad or m], shape [..., n].

    >>> import torch, torchdq
    >>> error_growth(torchdq.robots.load("two_link"), torch.zeros(2, dtype=torch.float64))
    tensor(4.5714, dtype=torch.float64)
    """
    return _evaluate("error_growth", robot, (q,), backend)[0]


class ClosedForm(NamedTuple):
    """Terms of tau = M qdd + c + g + Jt f_tip (63)."""

    M: Tensor  # [..., n, n]
    c: Tensor  # [..., n]
    g: Tensor  # [..., n]
    Jt: Tensor | None  # [..., n, 6] on (force, moment) in the tip frame; None: the robot has no tip


def closed_form(robot: Robot, q: Tensor, qd: Tensor, backend: Backend | None = None) -> ClosedForm:
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
    M, c, g, *Jt = _evaluate("closed_form", robot, (q, qd), backend, (_robot(robot).tip or "",))
    return ClosedForm(M, c, g, Jt[0] if Jt else None)


def regressor(robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor, backend: Backend | None = None) -> Tensor:
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
    return _evaluate("regressor", robot, (q, qd, qdd), backend)[0]


def kinetic_energy(robot: Robot, q: Tensor, qd: Tensor, backend: Backend | None = None) -> Tensor:
    """Kinetic energy qd^T M qd / 2 [J], shape [...], rotors included.

    Args:
        robot: the robot.
        q, qd: joint positions [rad or m] and velocities [rad/s or m/s], shape [..., n].
    """
    return _evaluate("kinetic_energy", robot, (q, qd), backend)[0]


def potential_energy(robot: Robot, q: Tensor, backend: Backend | None = None) -> Tensor:
    """Potential energy -sum of m g . p_com [J], shape [...]; its gradient in q is the gravity torque.

    Args:
        robot: the robot.
        q: joint positions [rad or m], shape [..., n].
    """
    return _evaluate("potential_energy", robot, (q,), backend)[0]


# --- kinematics ------------------------------------------------------------------------------------------------------


def forward_kinematics(robot: Robot, q: Tensor, frame: str | None = None, backend: Backend | None = None) -> Tensor:
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
    names = _robot(robot).frame_names if frame is None else (_robot(robot).frame(frame).name,)
    X = _evaluate("forward_kinematics", robot, (q,), backend, names)[0]
    return X if frame is None else X.squeeze(-2)


def jacobian(
    robot: Robot, q: Tensor, frame: str, expressed: Literal["body", "world"] = "body", backend: Backend | None = None
) -> Tensor:
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
    if expressed not in ("body", "world"):
        raise ArgumentError(f"expressed must be 'body' or 'world', found {expressed!r}")
    return _evaluate("jacobian", robot, (q,), backend, (_robot(robot).frame(frame).name, expressed))[0]


def dynamics_jacobian(
    robot: Robot, q: Tensor, qd: Tensor, qdd: Tensor, backend: Backend | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives (dtau/dq, dtau/dqd, M) of `inverse_dynamics`, each [..., n, n]; M is dtau/dqdd.

    Args:
        robot: the robot.
        q, qd, qdd: joint positions [rad or m], velocities [rad/s or m/s] and accelerations [rad/s^2 or m/s^2],
            shape [..., n].
    """
    dtau_dq, dtau_dqd = _evaluate("inverse_dynamics_jacobian", robot, (q, qd, qdd), backend)
    return dtau_dq, dtau_dqd, mass_matrix(robot, q, backend).expand_as(dtau_dq)
