"""Costs of optimal control: squares of residuals, which are numbers that are recorded with a step, as tasks are.

    cost = 1/2 sum over steps and residuals of w r(state at the end of the step, torques of the step)^2

Weights and goals are tensors: arguments of the programs, which depend on formulas and widths alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

from torch import Tensor

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra.quaternion import Number
from torchdq.base.checks import require_tensor, tensor_of
from torchdq.dq import pose_error
from torchdq.dynamics.posed import Row
from torchdq.errors import ArgumentError
from torchdq.functions import distances
from torchdq.functions.inverse_kinematics import ranges
from torchdq.functions.posed import frame
from torchdq.functions.task_space import pose_of_any_norm
from torchdq.numbers.functions import maximum
from torchdq.objects import Object
from torchdq.robot.contact_points import points_of
from torchdq.scene.free_base import as_pose
from torchdq.scene.spec import Rows, View

Weight = Tensor | float | Sequence[float]


class Term(NamedTuple):
    """Formula of the residuals of one cost, without its tensors."""

    function: Callable[..., Row]
    settings: tuple[Any, ...]
    widths: tuple[tuple[str, int], ...]  # of its inputs, the weight among them


class Objective(NamedTuple):
    """Sum of costs, as a task of rollouts: hashable, with an input for every tensor."""

    terms: tuple[Term, ...]
    control: str = "torque"  # input of a step that is planned

    def inputs(self, n: int) -> dict[str, int]:
        """Names and widths of the inputs."""
        return {named(name, k): width for k, term in enumerate(self.terms) for name, width in term.widths}

    def residuals(self, view: View) -> list[tuple[Number, Number]]:
        """Weight and residual of every square."""
        view, found = view._replace(torque=view.inputs[self.control]), list[tuple[Number, Number]]()
        for k, (function, settings, widths) in enumerate(self.terms):
            given = {name: view.inputs[named(name, k)] for name, _ in widths}
            weight, row = given.pop("weight"), function(view, *settings, **given)
            if len(weight) not in (1, len(row)):
                raise ArgumentError(
                    f"weight of cost {k} must be a number, or have one for each of {len(row)} residuals, found "
                    f"{len(weight)}"
                )
            found += zip(weight if len(weight) == len(row) else [*weight] * len(row), row, strict=True)
        return found

    def rows(self, view: View) -> Rows:
        """Cost of a step, and the torques that were planned for it."""
        cost = sum([w * r * r for w, r in self.residuals(view)], 0.0)
        return {"cost": [0.5 * cost], "planned": view.inputs[self.control]}


def named(name: str, k: int) -> str:
    """Name of an input of a cost, by its number."""
    return f"{name} of cost {k}"


class Residuals:
    """Cost 1/2 sum w r^2 of residuals r, numbers of the state at the end of a step and of the torques of the step.

    The function is called once, when programs are recorded, with a view of the state: `view.q`, `view.qd`,
    `view.torque` (the torques that are planned), `view.X_WB`, `view.V_WB_B`, and `view.posed(view.q)`, the robot, as
    in tasks of environments. Its numbers are recorded, so it uses + - * / and `torchdq.numbers.functions`. Programs are
    known by the function: define it once, not at every call.

    Args:
        function: function `function(view, *settings, **inputs)` that returns a list of residuals.
        weight: w, a number or one for every residual, shape [..., residuals]; with one axis more than the states of the
            problem, [steps, ..., residuals], that of every step.
        settings: constants of the function, hashable.
        inputs: tensors that the function receives as rows of numbers, shape [..., k] or [steps, ..., k].

    >>> import torch, torchdq
    >>> from torchdq import optimal
    >>> def near(view, goal):
    ...     return [q - g for q, g in zip(view.q, goal)]
    >>> optimal.Residuals(near, 10.0, goal=torch.tensor([0.3, 0.2]))
    Residuals(near, weight=10.0, goal=[2])
    """

    def __init__(
        self,
        function: Callable[..., Row],
        weight: Weight = 1.0,
        settings: Sequence[Any] = (),
        **inputs: Tensor | Sequence[float] | None,
    ):
        if not callable(function):
            raise ArgumentError(f"function must be a function function(view, ...) of a cost, found {function!r}")
        self.function, self.settings = function, tuple(settings)
        self.inputs = {name: tensor_of(x) for name, x in {"weight": weight, **inputs}.items() if x is not None}
        for name, x in self.inputs.items():
            require_tensor(name, x)
        self.inputs = {name: x if x.ndim else x[None] for name, x in self.inputs.items()}

    @property
    def term(self) -> Term:
        """Formula."""
        return Term(self.function, self.settings, tuple([(name, x.shape[-1]) for name, x in self.inputs.items()]))

    def __repr__(self) -> str:
        shown = {name: f"{x.item():g}" if x.numel() == 1 else [*x.shape] for name, x in self.inputs.items()}
        about = [*map(str, self.settings), *(f"{name}={x}" for name, x in shown.items())]
        kind, name = type(self).__name__, self.function.__name__
        return f"{kind}({', '.join([name] * (kind == 'Residuals') + about)})".replace("=10)", "=10.0)")


# --- costs of motion -------------------------------------------------------------------------------------------------


class Torques(Residuals):
    """Cost of torques, r = tau - reference.

    Args:
        weight: as in `Residuals`, one number or n.
        reference: torques that cost nothing [N m or N], shape [..., n]; None: zero.
    """

    def __init__(self, weight: Weight, reference: Tensor | None = None):
        super().__init__(_torques, weight, reference=reference)


class Speeds(Residuals):
    """Cost of the velocities of the joints, r = qd - goal.

    Args:
        weight: as in `Residuals`, one number or n.
        goal: desired velocities [rad/s or m/s], shape [..., n]; None: rest.
    """

    def __init__(self, weight: Weight, goal: Tensor | None = None):
        super().__init__(_speeds, weight, goal=goal)


class Posture(Residuals):
    """Cost of positions of the joints, r = q - goal.

    Args:
        goal: desired positions [rad or m], shape [..., n].
        weight: as in `Residuals`, one number or n.
    """

    def __init__(self, goal: Tensor, weight: Weight):
        super().__init__(_posture, weight, goal=goal)


class Point(Residuals):
    """Cost of the position of a frame's origin, r = p - goal [m].

    Args:
        frame: name of the frame.
        goal: desired position in the base frame, in the world if the base is floating [m], shape [..., 3].
        weight: as in `Residuals`, one number or 3.
    """

    def __init__(self, frame: str, goal: Tensor, weight: Weight):
        super().__init__(_point, weight, (frame,), goal=goal)


class Pose(Residuals):
    """Cost of the pose of a frame, r = 2 log(X_D^-1 X): rotation vector [rad], and translation along the screw [m].

    Args:
        frame: name of the frame.
        goal: desired pose X_D in the base frame, in the world if the base is floating, shape [..., 8].
        weight: as in `Residuals`, one number or 6, (angular, linear) in the axes of X_D.
    """

    def __init__(self, frame: str, goal: Tensor, weight: Weight):
        super().__init__(_pose, weight, (frame,), goal=goal)


class BasePose(Residuals):
    """Cost of the pose of a floating base, r = 2 log(X_D^-1 X_WB), as in `Pose`.

    Args:
        goal: desired pose X_D in the world, shape [..., 8].
        weight: as in `Residuals`, one number or 6.
    """

    def __init__(self, goal: Tensor, weight: Weight):
        super().__init__(_base_pose, weight, goal=goal)


class BaseVelocity(Residuals):
    """Cost of the twist of a floating base, r = V_WB_B - goal.

    Args:
        weight: as in `Residuals`, one number or 6.
        goal: desired twist (angular, linear) in the axes of the base [rad/s, m/s], shape [..., 6]; None: rest.
    """

    def __init__(self, weight: Weight, goal: Tensor | None = None):
        super().__init__(_base_velocity, weight, goal=goal)


# --- limits as costs -------------------------------------------------------------------------------------------------


class JointLimits(Residuals):
    """Cost of positions beyond the limits of the joints, or nearer to them than a margin: r = max(0, excess).

    Args:
        weight: as in `Residuals`, one number or one for every joint that has limits.
        margin: distance from the limits at which the cost begins [rad or m].
    """

    def __init__(self, weight: Weight, margin: float = 0.05):
        super().__init__(_joint_limits, weight, (float(margin),))


class Spheres(Residuals):
    """Cost of spheres of the robot nearer to things than a margin: r = max(0, margin - distance) of every pair.

    Args:
        weight: as in `Residuals`, one number or one for every pair, which are those of `torchdq.distances`.
        points: the spheres, as there.
        objects: those of `torchdq.objects` that are kept away from, with numbers as sizes.
        X_WO: their poses, shape [..., 8 objects], one after the other; None: at the origin.
        height: height of the ground [m]; None: there is no ground.
        own: whether spheres on different links are kept away from each other.
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
        settings = (points, tuple([body.shape.template() for body in objects]), bool(own), float(margin))
        super().__init__(_spheres, weight, settings, X_WO=X_WO, height=height)


# --- formulas --------------------------------------------------------------------------------------------------------


def _less(row: Row, goal: Row) -> Row:
    return [a - b for a, b in zip(row, goal, strict=True)] if goal else row


def _torques(view: View, reference: Row = ()) -> Row:
    return _less(view.torque, reference)


def _speeds(view: View, goal: Row = ()) -> Row:
    return _less(view.qd, goal)


def _posture(view: View, goal: Row) -> Row:
    return _less(view.q, goal)


def _point(view: View, name: str, goal: Row) -> Row:
    at, (link, X_BF) = view.posed(view.q), frame(view.scene.spec.robot, name)
    return _less(at.position(link, at.point(link, X_BF).position), goal)


def _error(X: Any, goal: Row) -> Row:
    angular, linear = pose_error.error(dq.mul(dq.conj(pose_of_any_norm(goal)), X))
    return [*angular, *linear]


def _pose(view: View, name: str, goal: Row) -> Row:
    link, X_BF = frame(view.scene.spec.robot, name)
    return _error(dq.mul(view.posed(view.q).poses()[link], X_BF), goal)


def _base_pose(view: View, goal: Row) -> Row:
    _require_floating(view, "BasePose")
    return _error(as_pose(view.X_WB), goal)


def _base_velocity(view: View, goal: Row = ()) -> Row:
    _require_floating(view, "BaseVelocity")
    return _less(view.V_WB_B, goal)


def _require_floating(view: View, cost: str) -> None:
    if not view.X_WB:
        name = view.scene.spec.robot.name
        raise ArgumentError(f'{cost} needs a floating base, found robot {name!r} on a fixed one; load it with base="floating"')


def _joint_limits(view: View, margin: float) -> Row:
    found = []
    for q, (lower, upper) in zip(view.q, ranges(view.scene.spec.robot), strict=True):
        sides = [(lower + margin) - q] * math.isfinite(lower) + [q - (upper - margin)] * math.isfinite(upper)
        if sides:
            found.append(maximum(0.0, sides[0] if len(sides) == 1 else maximum(*sides)))
    return found


def _spheres(view: View, points: Any, objects: Any, own: bool, margin: float, **given: Row) -> Row:
    robot: Any = view.scene.spec.robot
    ground = distances.GROUND * ("height" in given)
    x: Any = SimpleNamespace(robot=robot, arguments=given, bodies=lambda: view.posed(view.q))
    found = distances.distances(x, points_of(robot, points), objects, ground, "own" * own)["distance"]
    return [maximum(0.0, margin - d) for d in found]


def merged(costs: Mapping[str, Sequence[Residuals]]) -> list[tuple[Residuals, dict[str, Tensor]]]:
    """Costs of equal formulas and goals as one, each with its weights by where it was found."""
    found: list[tuple[Residuals, dict[str, Tensor]]] = []
    for place, group in costs.items():
        for cost in group:
            same = next((weights for one, weights in found if place not in weights and _same(one, cost)), None)
            if same is None:
                found.append((cost, same := {}))
            same[place] = cost.inputs["weight"]
    return found


def _same(a: Residuals, b: Residuals) -> bool:
    """Whether two costs differ by their weights alone."""
    if (a.function, a.settings, a.inputs.keys()) != (b.function, b.settings, b.inputs.keys()):
        return False
    pairs = [(x, b.inputs[name]) for name, x in a.inputs.items() if name != "weight"]
    return all([x is y or (x.shape == y.shape and bool((x == y).all())) for x, y in pairs])
