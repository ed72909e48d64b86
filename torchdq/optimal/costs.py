"""Costs of optimal control: squares of residuals, which are numbers that are recorded with a step, as tasks are.

    cost = 1/2 sum over steps and residuals of w r(state at the end of the step, torques of the step)^2

Weights and goals are tensors: arguments of the programs, which depend on formulas and widths alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

from torch import Tensor

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra.quaternion import Number
from torchdq.base.checks import tensor_of
from torchdq.dq import pose_error
from torchdq.dynamics.posed import Row
from torchdq.errors import ArgumentError, TorchdqError
from torchdq.functions import distances
from torchdq.functions.inverse_kinematics import ranges
from torchdq.functions.posed import frame
from torchdq.functions.task_space import pose_of_any_norm
from torchdq.numbers.functions import maximum
from torchdq.objects import Object
from torchdq.robot.contact_points import points_of
from torchdq.scene.free_base import as_pose
from torchdq.scene.spec import Rows, View

Weight = Tensor | float


class Term(NamedTuple):
    """Formula of the residuals of one cost, without its tensors."""

    function: Callable[..., Row]
    settings: tuple[Any, ...]
    widths: tuple[tuple[str, int], ...]  # of its inputs, the weight among them


class Objective(NamedTuple):
    """Sum of costs, as a task of rollouts: hashable, with an input for every tensor."""

    terms: tuple[Term, ...]
    control: str = "torque"  # input of a step that is planned
    squares: bool = False  # whether its rows are all residuals and their weights

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of the inputs."""
        return {named(name, k): width for k, term in enumerate(self.terms) for name, width in term.widths}

    def rows(self, view: View) -> Rows:
        """Cost of a step and the torques that were planned for it, or residuals and weights."""
        view, weights, found = view._replace(torque=view.inputs[self.control]), list[Number](), list[Number]()
        for k, (function, settings, widths) in enumerate(self.terms):
            given = {name: view.inputs[named(name, k)] for name, _ in widths}
            weight, row = given.pop("weight"), _recorded(k, function, view, settings, given)
            if len(weight) not in (1, len(row)):
                raise ArgumentError(
                    f"weight of {function.__name__.strip('_')} must be one number or {len(row)}, found {len(weight)}"
                )
            weights += [*weight] * (len(row) // len(weight))
            found += row
        if self.squares:
            return {"residual": found, "weight": weights}
        return {
            "cost": [0.5 * sum([w * r * r for w, r in zip(weights, found, strict=True)], 0.0)],
            "planned": view.torque,
        }


def _recorded(k: int, function: Callable[..., Row], view: View, settings: Sequence[Any], given: Rows) -> Row:
    """Residuals of a cost; raises with its name where its inputs or results have another form."""
    name = f"cost {k}, {function.__name__.strip('_')},"
    try:
        found = function(view, *settings, **given)
    except TorchdqError:
        raise
    except (ValueError, IndexError, TypeError) as error:
        inputs = ", ".join([f"{name} of {len(x)} numbers" for name, x in given.items()]) or "none"
        raise ArgumentError(f"{name} does not fit its inputs, {inputs}: {error}") from error
    if not isinstance(found, list | tuple):
        raise ArgumentError(f"{name} must return a list of residuals, found {type(found).__name__}")
    return found


def named(name: str, k: int) -> str:
    """Name of an input of a cost, by its number."""
    return f"{name} of cost {k}"


class Residuals:
    """Cost 1/2 sum w r^2 of residuals r, numbers of the state at the end of a step and of the torques of the step.

    The function is called where programs are recorded, with a view of the state: `view.q`, `view.qd`, `view.torque`
    (the torques that are planned), `view.X_WB`, `view.V_WB_B`, `view.frame(name)` with the `position` and the three
    `axes` of a frame, and `view.velocity(name)`, that of its origin; these are in the base frame, or in the world if
    the base is floating. It uses + - * / and `torchdq.numbers.functions`. Programs are known by the function: define it
    once.

    Args:
        function: function `function(view, *settings, **inputs)` that returns a list of residuals.
        weight: w, a number or one for every residual, shape [..., residuals]; with one axis more than the states of the
            problem, [steps, ..., residuals], that of every step.
        settings: constants of the function, hashable.
        inputs: tensors that the function receives as rows of numbers, shape [..., k] or [steps, ..., k]; None: absent.

    >>> import torch, torchdq
    >>> from torchdq import Scene, optimal
    >>> def apart(view, least):
    ...     return [view.q[1] - view.q[0] - least[0]]
    >>> scene = Scene(torchdq.robots.load("two_link"), dt=0.05)
    >>> least = torch.tensor([0.5], dtype=torch.float64)
    >>> problem = optimal.Problem(
    ...     scene, 20, [optimal.Residuals(apart, 10.0, least=least), optimal.Torques(1e-3)]
    ... )
    >>> plan = optimal.solve(problem, scene.start(torch.zeros(2, dtype=torch.float64)))
    >>> plan.states.q[-1].diff()
    tensor([0.5000], dtype=torch.float64)
    """

    def __repr__(self) -> str:
        inputs = ", ".join([f"{name} {tuple(x.shape)}" for name, x in self.inputs.items()])
        return f"{type(self).__name__}({self.term.function.__name__.strip('_')}, {inputs})"

    def __init__(
        self,
        function: Callable[..., Row],
        weight: Weight,
        settings: Sequence[Any] = (),
        **inputs: Tensor | float | None,
    ):
        if not callable(function):
            raise ArgumentError(f"function must be a function function(view, ...) of a cost, found {function!r}")
        tensors = {name: tensor_of(x) for name, x in {"weight": weight, **inputs}.items() if x is not None}
        self.inputs = {name: x if x.ndim else x[None] for name, x in tensors.items()}
        if bool((self.inputs["weight"] < 0).any()):
            raise ArgumentError(f"weight must not be negative, found {weight}")
        self.term = Term(function, tuple(settings), tuple([(name, x.shape[-1]) for name, x in self.inputs.items()]))


# --- costs of motion; the weight of each is that of `Residuals`, one number or as many as its goal has ----------------


class Torques(Residuals):
    """Cost of torques, or targets where these are planned, less a reference [..., n]; None: zero."""

    def __init__(self, weight: Weight, reference: Tensor | None = None):
        super().__init__(_of_row, weight, ("torque",), goal=reference)


class Speeds(Residuals):
    """Cost of velocities of the joints less a goal [rad/s or m/s], shape [..., n]; None: rest."""

    def __init__(self, weight: Weight, goal: Tensor | None = None):
        super().__init__(_of_row, weight, ("qd",), goal=goal)


class Posture(Residuals):
    """Cost of positions of the joints less a goal [rad or m], shape [..., n]."""

    def __init__(self, goal: Tensor, weight: Weight):
        super().__init__(_of_row, weight, ("q",), goal=goal)


class Point(Residuals):
    """Cost of the position of a frame's origin less a goal [m], shape [..., 3], in the base frame.

    Of a floating base it is in the world.
    """

    def __init__(self, frame: str, goal: Tensor, weight: Weight):
        super().__init__(_point, weight, (frame,), goal=goal)


class Pose(Residuals):
    """Cost of the pose X of a frame, r = 2 log(X_D^-1 X) from a goal X_D, shape [..., 8], in the frame of `Point`.

    The six residuals are a rotation vector [rad] and the translation of the screw [m], in the axes of the goal.
    """

    def __init__(self, frame: str, goal: Tensor, weight: Weight):
        super().__init__(_pose, weight, (frame,), goal=goal)


class BasePose(Residuals):
    """Cost of the pose of a floating base, r = 2 log(X_D^-1 X_WB) from a goal X_D, shape [..., 8], as in `Pose`."""

    def __init__(self, goal: Tensor, weight: Weight):
        super().__init__(_pose, weight, (None,), goal=goal)


class BaseVelocity(Residuals):
    """Cost of the twist V_WB_B of a floating base less a goal [rad/s, m/s], shape [..., 6], in its axes; None: rest."""

    def __init__(self, weight: Weight, goal: Tensor | None = None):
        super().__init__(_of_row, weight, ("V_WB_B",), goal=goal)


class JointLimits(Residuals):
    """Cost of joints beyond their limits, or nearer than a margin [rad or m], r = max(0, excess).

    There is a residual for every joint that has limits.
    """

    def __init__(self, weight: Weight, margin: float = 0.05):
        super().__init__(_joint_limits, weight, (float(margin),))


class Spheres(Residuals):
    """Cost of spheres of the robot nearer to things than a margin, r = max(0, margin - distance) of every pair.

    Args:
        weight: as in `Residuals`, one number or one for every pair of `torchdq.distances`.
        points, own: the spheres, and whether those on different links are kept apart, as there.
        objects: those of `torchdq.objects` that are kept away from, with numbers as sizes.
        X_WO: their poses, shape [..., objects, 8]; None: at the origin.
        height: height of the ground [m]; None: there is no ground.
        margin: distance at which the cost begins [m].
    """

    def __init__(
        self,
        weight: Weight,
        points: Any = None,
        objects: Sequence[Object] = (),
        X_WO: Tensor | None = None,
        height: Tensor | float | None = None,
        own: bool = False,
        margin: float = 0.02,
    ):
        points = tuple(points) if isinstance(points, list) else points
        if X_WO is not None and (X_WO.ndim < 2 or X_WO.shape[-2:] != (len(objects), 8)):
            raise ArgumentError(
                f"X_WO must have the shape [..., {len(objects)}, 8], a pose for each object, found {tuple(X_WO.shape)}"
            )
        X_WO = None if X_WO is None else X_WO.flatten(-2)
        settings = (points, tuple([body.shape.template() for body in objects]), bool(own), float(margin))
        super().__init__(_spheres, weight, settings, X_WO=X_WO, height=height)


# --- formulas --------------------------------------------------------------------------------------------------------


def _less(row: Row, goal: Row) -> Row:
    return [a - b for a, b in zip(row, goal, strict=True)] if goal else row


def _floating(view: View) -> View:
    """View of a robot with a floating base; raises if it is fixed."""
    if not view.X_WB:
        name = view.scene.spec.robot.name
        raise ArgumentError(
            f'BasePose and BaseVelocity need a floating base, base="floating"; that of {name!r} is fixed'
        )
    return view


def _of_row(view: View, name: str, goal: Row = ()) -> Row:
    return _less(getattr(_floating(view) if name == "V_WB_B" else view, name), goal)


def _point(view: View, name: str, goal: Row) -> Row:
    return _less(view.frame(name).position, goal)


def _pose(view: View, name: str | None, goal: Row) -> Row:
    if name is None:
        X = as_pose(_floating(view).X_WB)
    else:
        link, X_BF = frame(view.scene.spec.robot, name)
        X = dq.mul(view.posed(view.q).poses()[link], X_BF)
    angular, linear = pose_error.error(dq.mul(dq.conj(pose_of_any_norm(goal)), X))
    return [*angular, *linear]


def _joint_limits(view: View, margin: float) -> Row:
    found = []
    for q, (lower, upper) in zip(view.q, ranges(view.scene.spec.robot), strict=True):
        sides = [(lower + margin) - q] * math.isfinite(lower) + [q - (upper - margin)] * math.isfinite(upper)
        if sides:
            found.append(maximum(0.0, sides[0] if len(sides) == 1 else maximum(*sides)))
    return found


def _spheres(view: View, points: Any, objects: Any, own: bool, margin: float, **given: Row) -> Row:
    robot: Any = view.scene.spec.robot
    x: Any = SimpleNamespace(robot=robot, arguments=given, bodies=lambda: view.posed(view.q))
    points = robot.end_effector().name if points is None else points
    of = points_of(robot, points), objects, distances.GROUND * ("height" in given), "own" * own
    found: Any = distances.distances(x, *of)["distance"]
    return [maximum(0.0, margin - d) for d in found]
