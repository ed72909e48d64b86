"""Controllers: torques from a reference. They see the readings once per step and hold the torque over it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from torchdq.algebra.quaternion import Number
from torchdq.base.checks import is_number, require_choice
from torchdq.dynamics.posed import Posed, Row
from torchdq.dynamics.task_space import Task
from torchdq.dynamics.tracking import commanded
from torchdq.effects.effect import Parameter, Parametric, Shapes, undefined
from torchdq.errors import ArgumentError
from torchdq.export.meaning import heading, part
from torchdq.functions.call import function_of
from torchdq.functions.options import axes_of, options_of
from torchdq.functions.posed import as_screw, frame, posed
from torchdq.functions.task_space import Gains, Goal, impedance_torques, operational_space_torques, pose_of_any_norm
from torchdq.functions.task_space_formulas import DAMPING, rows_of
from torchdq.program.program import Argument, Program, record
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.fields import SHAPES, trailing
from torchdq.robot.robot import arguments, constants, recorded

__all__ = ["PD", "CartesianImpedance", "ComputedTorqueController", "Controller", "OperationalSpace"]


@dataclass(frozen=True)
class Controller(Parametric):
    """Torques from the input `reference` [..., 3 n]: desired positions, velocities and accelerations.

    A controller that follows something else overrides `reference` and `holding`.
    """

    FIXED: ClassVar[str] = ""  # reason why a robot with a floating base is refused; "": it is not
    LEARNED: ClassVar[str] = "torchdq.computed_torque"  # function in which a model may be learned

    def reference(self, n: int) -> int:
        """Width of the reference, for n joints."""
        return 3 * n

    def holding(self, robot: Robot, q: Tensor) -> Tensor:
        """Reference that asks a robot to stand still at positions q [..., n]."""
        return torch.cat([q, torch.zeros_like(q), torch.zeros_like(q)], -1)

    def torques(self, at: Posed, reference: Row, q: Row, qd: Row) -> Sequence[Number]:
        """Torques at the measured positions and velocities; `at` is the scene's robot at these positions."""
        raise undefined(self, "torques")

    def program(self, robot: Robot) -> Program:
        """Program of the controller by itself, which takes reference, q and qd, for `torchdq.compile` and its `export`.

        Gains that are tensors are arguments after these; the robot's numbers are constants.

        Args:
            robot: the robot as it is in the scene.

        >>> import torchdq
        >>> program = PD(kp=30.0, kd=9.0).program(torchdq.robots.load("two_link"))
        >>> torchdq.compile(program).count().multiplications
        4
        """
        n, whole, constant = require_robot(robot).n, self.resolved(robot), robot.bake()
        tensors = whole.tensors()
        taken = [Argument("reference", self.reference(n)), Argument("q", n), Argument("qd", n)]
        for name, x in tensors.items():
            axes = trailing(whole.SHAPES[name], robot.sizes)
            taken.append(Argument(name, math.prod(axes), x.ndim == len(axes)))

        def algorithm(reference: Row, q: Row, qd: Row, *gains: Row) -> dict[str, Sequence[Number]]:
            bound = whole.bound(dict(zip(tensors, gains, strict=True)))
            return {"tau": bound.torques(posed(constant, q, {}, ()), reference, q, qd)}

        kind = type(self).__name__
        about = (*heading(f"controller {kind}", robot.name, robot.joint_names), part(whole.template()))
        return replace(record(f"{kind}_{robot.name}", taken, algorithm), about=about)


def _believed(controller: Controller, model: Robot | None, robot: Robot) -> Robot | None:
    """Constant copy of a controller's model; raises unless it is one robot with these joints, without gradients."""
    what = f"model of {type(controller).__name__}"
    if model is None:
        return None
    if robot.floating or model.floating:
        raise ArgumentError(
            f"{what} must be None for a robot with a floating base: what its joints carry depends on the forces on "
            "the base"
        )
    if model.n != robot.n:
        raise ArgumentError(f"{what} must have the {robot.n} joints of robot {robot.name!r}, found {model.n}")
    for name in arguments(model):
        if getattr(model, name).ndim > len(SHAPES[name]):
            raise ArgumentError(f"{what} must be one robot, found batch axes of its {name}; its tensors are constants")
        if getattr(model, name).requires_grad:
            raise ArgumentError(
                f"{what} must have constants, which get no gradient, found a {name} that requires grad; use "
                f"model.bake(), or learn with torques from {controller.LEARNED}"
            )
    return recorded(constants(model.bake()))


@dataclass(frozen=True)
class Feedback(Controller):
    """Feedback of the errors of positions and velocities, with or without a model of the robot.

    Args:
        kp, kd: gains of the errors of positions and velocities, shape [..., n].
        model: one robot, whose numbers a scene copies as constants when it is made; None: no model.
    """

    SHAPES: ClassVar[Shapes] = {"kp": ("n",), "kd": ("n",)}
    kp: Parameter
    kd: Parameter
    model: Robot | None = None

    def described(self, robot: Robot) -> Self:
        """Copy whose model is a constant copy; raises unless it is one robot with these joints, without gradients."""
        return replace(self, model=_believed(self, self.model, robot))

    def corrected(self, reference: Row, q: Row, qd: Row) -> list[Number]:
        """Desired acceleration, or feed-forward, with the errors fed back."""
        n = len(q)
        desired = (reference[:n], reference[n : 2 * n], reference[2 * n :])
        return list(map(commanded, q, qd, *desired, self.kp, self.kd))


@dataclass(frozen=True)
class ComputedTorqueController(Feedback):
    """Feedback linearisation: tau = M a + c + g, a = qdd_des + kd (qd_des - qd) + kp (q_des - q), equations (73)-(78).

    With the scene's own model and small steps the error obeys e'' + kd e' + kp e = 0; friction, and everything else
    that is not in the model, are disturbances.

    Args:
        kp: position gain [1/s^2], shape [..., n].
        kd: velocity gain [1/s], shape [..., n].
        model: the robot as the controller believes it to be, with its own gravity and rotor inertia; its numbers
            are copied when a scene is made. None: as it is in the scene, payload and gravity included.

    >>> import torch, torchdq
    >>> from torchdq import effects
    >>> from torchdq.scene import Scene, controllers
    >>> robot, control = torchdq.robots.load("two_link"), controllers.ComputedTorqueController(kp=100.0, kd=20.0)
    >>> scene = Scene(robot, (effects.Gravity(),), controller=control, dt=0.01)
    >>> end = scene.rollout(scene.start(torch.ones(2)), reference=torch.zeros(200, 6)).q[-1]
    >>> bool((end.abs() < 1e-3).all())
    True
    """

    FIXED: ClassVar[str] = "its torques would need the forces of the ground on the base; use PD or effects.Servo"

    def torques(self, at: Posed, reference: Row, q: Row, qd: Row) -> Sequence[Number]:
        """Torques of the corrected acceleration."""
        a = self.corrected(reference, q, qd)
        believed = at if self.model is None else posed(self.model, q, {}, ())
        return believed.torques(qd, a, None)  # (73), (74)


@dataclass(frozen=True)
class PD(Feedback):
    """Torques of errors alone: tau = kp (q_des - q) + kd (qd_des - qd), and of gravity if a model is given.

    Args:
        kp: position gain [N m/rad or N/m], shape [..., n].
        kd: velocity gain [N m s/rad or N s/m], shape [..., n].
        model: the robot whose gravity torques are added, copied likewise; None: none are.

    >>> import torchdq
    >>> from torchdq import effects
    >>> from torchdq.scene import Scene, controllers
    >>> robot = torchdq.robots.load("two_link")
    >>> scene = Scene(robot, (effects.Gravity(),), controller=controllers.PD(kp=50.0, kd=10.0, model=robot))
    """

    def torques(self, at: Posed, reference: Row, q: Row, qd: Row) -> Sequence[Number]:
        """Torques of the errors, and the model's weight."""
        n = len(q)
        tau = self.corrected((*reference[: 2 * n], *[0.0] * n), q, qd)
        if self.model is None:
            return tau
        weight = posed(self.model, q, {}, ()).torques(None, None, None)
        return [t if w is None else t + w for t, w in zip(tau, weight, strict=True)]


@dataclass(frozen=True, kw_only=True)
class TaskController(Controller):
    """Control of a frame. Its reference [..., 20] is a pose X_des [8], twist V_des [6] and the rate A_des [6] of that.

    X_des is scaled to a unit dual quaternion; twists of zero hold it still.

    Args:
        frame, expressed, axes, q_null, k_null: as in `torchdq.operational_space_control`, shapes [], [n] and [].
        model: the robot as the controller believes it to be, copied when a scene is made; None: as it is in the scene.
    """

    FIXED: ClassVar[str] = "no motor moves its base, so its joints alone cannot give a frame every acceleration"
    LEARNED: ClassVar[str] = "torchdq.operational_space_control"
    GAINS: ClassVar[tuple[str, str]]
    SIGNED: ClassVar[frozenset[str]] = frozenset({"q_null"})
    frame: str | None = None
    expressed: Literal["body", "world"] = "body"
    axes: str | tuple[str, ...] = "pose"
    q_null: Parameter | None = None
    k_null: Parameter = 10.0
    model: Robot | None = None
    task: Task | None = field(default=None, repr=False)  # the frame and its axes, found when a scene is made

    @property
    def SHAPES(self) -> Shapes:  # type: ignore[override]  # gains have as many numbers as there are axes
        """Trailing axes of the gains, and of the posture if there is one."""
        gains = dict.fromkeys(self.GAINS, (len(rows_of(axes_of(self.axes))),))
        return gains if self.q_null is None else {**gains, "q_null": ("n",), "k_null": ()}

    def reference(self, n: int) -> int:
        """Width of the reference, 20."""
        return 20

    def holding(self, robot: Robot, q: Tensor) -> Tensor:
        """Reference that asks a robot to hold the pose of the frame at q [..., n]."""
        X = function_of("forward_kinematics", robot, {"q": q}, None, (self.frame or robot.end_effector().name,))[0]
        return torch.nn.functional.pad(X.squeeze(-2), (0, 12))

    def described(self, robot: Robot) -> Self:
        """Copy with the numbers of the frame and a gain for every axis, whose model is a constant copy."""
        marks = ["limits"] if getattr(self, "limits", False) is True else []
        chosen = (self.frame or "", self.expressed, axes_of(self.axes), *marks)
        name, expressed, axes, *_ = options_of(robot, "operational_space_control", chosen)
        rows = rows_of(axes)
        gains = {gain: _of_axes(getattr(self, gain), len(rows)) for gain in self.GAINS}
        task = Task(*frame(robot, name), expressed == "world", rows)
        model = _believed(self, self.model, robot)
        return replace(self, frame=name, axes=axes, model=model, task=task, **gains)

    def _case(self, at: Posed, reference: Row, q: Row, qd: Row) -> tuple[Posed, Task, Row, Row, Goal, Gains]:
        """Believed robot, task, state, goal and gains."""
        goal = Goal(pose_of_any_norm(reference[:8]), as_screw(reference[8:14]), as_screw(reference[14:]))
        kp, kd = (getattr(self, name) for name in self.GAINS)
        gains: Any = Gains(kp, kd, self.q_null, self.k_null)
        return at if self.model is None else posed(self.model, q, {}, ()), self.task, q, qd, goal, gains  # type: ignore[return-value]


def _of_axes(x: Any, m: int) -> Any:
    """Gain of m axes, of one number for all."""
    if isinstance(x, Tensor):
        return x if x.ndim else x.expand(m)
    return (x,) * m if is_number(x) else x


@dataclass(frozen=True)
class OperationalSpace(TaskController):
    """Torques under which the error of a frame's pose obeys e'' + kd e' + kp e = 0, as far as the model is right.

    See `torchdq.operational_space_control`. What is not in the model, such as friction, is a disturbance.

    Args:
        kp, kd: gains of the error [1/s^2] and of its rate [1/s], a number or one for each of the axes, [..., m].
        damping: share of a diagonal of J J^T below which a pivot counts as singular [1], shape [].
        limits: largest torques, within which those of the task are scaled as a whole [N m or N], shape [..., n]; True:
            those of the robot; False: none.
        frame, expressed, axes, q_null, k_null, model: as in `CartesianImpedance`.

    >>> import torch, torchdq
    >>> from torchdq.scene import Scene, controllers
    >>> robot, control = torchdq.robots.load("panda"), controllers.OperationalSpace(kp=100.0, kd=20.0)
    >>> q = torch.tensor([0.1, 0.4, 0.0, -1.5, 0.2, 1.7, 0.3], dtype=torch.float64)
    >>> scene, goal = Scene(robot, controller=control, dt=0.01), control.holding(robot, q + 0.05)
    >>> end = scene.rollout(scene.start(q), reference=goal.expand(200, 20)).q[-1]
    >>> torch.allclose(control.holding(robot, end), goal, atol=1e-3)
    True
    """

    GAINS: ClassVar[tuple[str, str]] = ("kp", "kd")
    UNBOUNDED: ClassVar[frozenset[str]] = frozenset({"limits"})
    DIVIDING: ClassVar[frozenset[str]] = frozenset({"damping"})
    kp: Parameter
    kd: Parameter
    damping: Parameter = 2.0**-8
    limits: Parameter | bool = False

    @property
    def SHAPES(self) -> Shapes:  # type: ignore[override]
        """Trailing axes of the parameters."""
        return {**super().SHAPES, "damping": (), **({} if self.limits is False else {"limits": ("n",)})}

    def described(self, robot: Robot) -> Self:
        """Copy with the robot's limits."""
        found, effort = super().described(robot), [x if x > 0 else math.inf for x in robot.limits.effort.tolist()]
        return replace(found, limits=tuple(effort)) if self.limits is True else found

    def torques(self, at: Posed, reference: Row, q: Row, qd: Row) -> Sequence[Number]:
        """Torques of the law."""
        case, effort = self._case(at, reference, q, qd), None if self.limits is False else self.limits
        return operational_space_torques(*case, self.damping, effort)[0]  # type: ignore[arg-type]


@dataclass(frozen=True)
class CartesianImpedance(TaskController):
    """Torques of a spring and a damper between a frame and its desired pose, and those that hold the robot.

    See `torchdq.cartesian_impedance`. A_des is not used: the inertia that is felt is the robot's own.

    Args:
        stiffness, damping: K and D [N m/rad or N/m, N m s/rad or N s/m], a number or one for each axis, [..., m].
        frame: name of the frame; None: the tip.
        expressed: axes of the error, "body" or "world".
        axes: "pose", "position", "orientation" or names among rx ry rz x y z.
        q_null: posture of the joints where the task leaves them free [rad or m], shape [..., n]; None: none.
        k_null: gain of the posture [1/s^2], shape [...].
        coriolis: whether c is compensated; False: the spring is passive, up to the torque being held over a step.
        model: the robot as the controller believes it to be, copied when a scene is made; None: as it is in the scene.

    >>> import torchdq
    >>> from torchdq.scene import controllers
    >>> control = controllers.CartesianImpedance(stiffness=300.0, damping=30.0, axes="position")
    >>> control.program(torchdq.robots.load("ur10e")).arguments[0].width
    20
    """

    GAINS: ClassVar[tuple[str, str]] = ("stiffness", "damping")
    stiffness: Parameter
    damping: Parameter
    expressed: Literal["body", "world"] = field(default="world", kw_only=True)
    coriolis: bool = field(default=True, kw_only=True)

    def described(self, robot: Robot) -> Self:
        """Copy with the numbers of the frame; raises unless `coriolis` is True or False."""
        require_choice("coriolis", self.coriolis, (False, True))
        return super().described(robot)

    def torques(self, at: Posed, reference: Row, q: Row, qd: Row) -> Sequence[Number]:
        """Torques of the law."""
        return impedance_torques(*self._case(at, reference, q, qd), DAMPING, self.coriolis)[0]
