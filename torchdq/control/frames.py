"""Laws of a frame: in operational space, and by a spring and a damper."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal, Self

import torch
from torch import Tensor

from torchdq.algebra import quaternion as quat
from torchdq.algebra import screw
from torchdq.algebra.quaternion import Number
from torchdq.algebra.screw import Screw
from torchdq.backends.call import Tensors
from torchdq.base.checks import POSITIVE, REAL, Interval, OneOf, is_number, require_tensor
from torchdq.control.deviation import Deviation, Goal, deviation
from torchdq.control.law import Law
from torchdq.dynamics import task_space
from torchdq.dynamics.error_growth import HUGE
from torchdq.dynamics.posed import Posed, Row, dot
from torchdq.dynamics.task_space import AXES, Task
from torchdq.errors import ArgumentError
from torchdq.functions.call import function_of
from torchdq.functions.options import task_of
from torchdq.functions.parametric import Parameter, Shapes
from torchdq.functions.posed import as_screw
from torchdq.functions.recipe import EXPRESSED, Results
from torchdq.functions.signature import option, parameter
from torchdq.functions.task_space import numbers, pose_of, pose_of_any_norm, six
from torchdq.numbers.functions import at_least, below, maximum, minimum, select, sqrt
from torchdq.program.program import GROWTH
from torchdq.robot import Robot

COMPLETE = (set(range(6)), set(range(3)), set(range(3, 6)))  # components that turn into each other
DAMPING = 2.0**-8  # share of a diagonal of J J^T below which a pivot counts as singular


@dataclass(frozen=True, kw_only=True)
class FrameLaw(Law):
    """Control of a frame. The desired pose is scaled to a unit dual quaternion; twists of zero hold it still.

    Args:
        frame: name of the frame; None: the tip.
        expressed: axes of the error, "body" or "world".
        axes: "pose", "position", "orientation" or names among rx ry rz x y z.
        q_null: posture of the joints where the task leaves them free [rad or m], shape [..., n]; None: none.
        k_null: gain of the posture [1/s^2], shape [...]; it is critically damped.
    """

    OPTIONAL: ClassVar[frozenset[str]] = frozenset({"V_des", "A_des"})
    WHERE: ClassVar[tuple[str, ...]] = ("frame", "expressed", "axes")
    FIXED: ClassVar[str] = "no motor moves its base, so its joints alone cannot give a frame every acceleration"
    GAINS: ClassVar[tuple[str, str]]  # of the error and of its rate, a number for each of the axes
    frame: str | None = None
    expressed: Literal["body", "world"] = field(default="body", metadata=option(EXPRESSED.check))
    axes: str | tuple[str, ...] = "pose"
    q_null: Parameter | None = field(default=None, metadata=parameter("n", check=REAL, optional=True))
    k_null: Parameter = field(default=10.0, metadata=parameter())  # absent without a posture
    task: Task | None = field(default=None, repr=False)  # the frame and its axes, found for a robot

    @property
    def SHAPES(self) -> Shapes:  # type: ignore[override]  # gains have as many numbers as there are axes
        """Trailing axes of the parameters that are not absent."""
        named = AXES.get(self.axes, self.axes.split()) if isinstance(self.axes, str) else self.axes
        own = {name: (len(named),) if axes == ("axes",) else axes for name, axes in self.present().items()}
        return own if "q_null" in own else {name: axes for name, axes in own.items() if name != "k_null"}

    @classmethod
    def require_gain(cls, name: str, x: Tensor, given: Tensors) -> None:
        """Raise where a gain is a matrix: q and X_des have one row."""
        require_tensor("X_des", given["X_des"])
        if name in cls.GAINS and x.ndim > max(given[row].ndim for row in ("q", "X_des")):  # type: ignore[union-attr]
            raise ArgumentError(
                f"{name} must be a number or one for each of the axes, without batch axes that q and X_des lack, found "
                f"shape {tuple(x.shape)}; of a diagonal matrix give the diagonal, and for more gains expand q"
            )

    def subject(self) -> str:
        """The frame and its axes."""
        return f"{len(self.task.rows)} axes of frame {self.frame!r} and " if self.task else ""

    def holding(self, robot: Robot, q: Tensor) -> Tensor:
        """Reference that asks a robot to hold the pose of the frame at q [..., n]."""
        X = function_of("forward_kinematics", robot, {"q": q}, None, (self.frame or robot.end_effector().name,))[0]
        return torch.nn.functional.pad(X.squeeze(-2), (0, self.reference(robot.n) - X.shape[-1]))

    def described(self, robot: Robot) -> Self:
        """Copy with the numbers of the frame and a gain for every axis, and a constant copy of its model."""
        found = super().described(robot)
        name, axes, task = task_of(robot, self.frame, self.expressed, self.axes)
        gains = {gain: _of_axes(getattr(self, gain), len(task.rows)) for gain in self.GAINS}
        return replace(found, frame=name, axes=axes, task=task, **gains)

    def deviation(self, at: Posed, goal: Mapping[str, Any], qd: Row) -> tuple[Task, Deviation]:
        """The task, and the deviation of the frame from its desired motion."""
        task: Any = self.task
        zero = (0.0,) * 6
        X, V, A = (goal.get(name, zero) for name in ("X_des", "V_des", "A_des"))
        wanted = Goal(pose_of_any_norm(X), as_screw(V), as_screw(A))
        return task, deviation(task, pose_of(at, task), task.twist(at, qd), wanted)

    def feedback(self, task: Task, error: Screw, rate: Screw) -> Row:
        """kd e' + kp e, by components."""
        rows = zip(*(getattr(self, name) for name in self.GAINS), task.of(error), task.of(rate), strict=True)
        return [kd * e_rate + kp * e for kp, kd, e, e_rate in rows]

    def posture(self, q: Row, qd: Row) -> Row | None:
        """Acceleration of the joints towards the posture, critically damped; None: there is none."""
        if self.q_null is None:
            return None
        damping = 2.0 * sqrt(self.k_null)
        return [self.k_null * (a - x) - damping * v for a, x, v in zip(self.q_null, q, qd, strict=True)]


@dataclass(frozen=True)
class OperationalSpaceControl(FrameLaw):
    """Torques under which the error of a frame's pose obeys e'' + kd e' + kp e = 0, as far as the model is right.

    See `torchdq.operational_space_control`. What is not in the model, such as friction, is a disturbance. Its reference
    [..., 20] is X_des [8], V_des [6] and A_des [6].

    Args:
        kp, kd, damping, frame, expressed, axes, q_null, k_null: as in the function.
        limits: largest torques, within which those of the task are scaled as a whole [N m or N], shape [..., n]; True:
            those of the robot; False: none.
        model: the controller's model of the robot, copied when a scene is made; None: as it is in the scene.

    >>> import torch, torchdq
    >>> from torchdq.scene import Scene, controllers
    >>> robot = torchdq.robots.load("panda")
    >>> control = controllers.OperationalSpaceControl(kp=100.0, kd=20.0)
    >>> q = torch.tensor([0.1, 0.4, 0.0, -1.5, 0.2, 1.7, 0.3], dtype=torch.float64)
    >>> scene = Scene(robot, controller=control, dt=0.01)
    >>> goal = control.holding(robot, q + 0.05)
    >>> end = scene.rollout(scene.start(q), reference=goal.expand(200, 20)).q[-1]
    >>> torch.allclose(control.holding(robot, end), goal, atol=1e-3)
    True
    """

    NAME: ClassVar[str] = "operational_space_control"
    GOAL: ClassVar[Shapes] = {"X_des": (8,), "V_des": (6,), "A_des": (6,)}
    SWITCHES: ClassVar[frozenset[str]] = frozenset({"limits"})
    GAINS: ClassVar[tuple[str, str]] = ("kp", "kd")
    kp: Parameter = field(metadata=parameter("axes"))
    kd: Parameter = field(metadata=parameter("axes"))
    damping: Parameter | None = field(default=DAMPING, metadata=parameter(check=POSITIVE, optional=True))
    limits: Parameter | bool = field(
        default=False, metadata=parameter("n", check=Interval(0.0, infinite=True), optional=True)
    )

    def described(self, robot: Robot) -> Self:
        """Copy with the robot's limits, too."""
        found, effort = super().described(robot), robot.limits.effort.tolist()
        if self.limits is not True:
            return found
        if not any(0 < most < math.inf for most in effort):
            raise ArgumentError(
                f"limits must be False for robot {robot.name!r}, which has no torque limits, found True"
            )
        return replace(found, limits=tuple([x if x > 0 else math.inf for x in effort]))

    def torques(self, at: Posed, goal: Mapping[str, Any], q: Row, qd: Row) -> Results:
        """Torques J^T Lambda (a - a_0) + tau_0, and the growth of Lambda."""
        task, found = self.deviation(at, goal, qd)
        wanted = found.twist_rate(six(task, [-x for x in self.feedback(task, found.e, found.rate)]))
        u = self.posture(q, qd)
        more, own_axes = screw.sub(wanted, task.twist_rate(at, qd, u)), task
        if task.world and set(task.rows) in COMPLETE:  # fewer digits are lost in the axes of the frame
            back = quat.rotation_columns(quat.conj(pose_of(at, task)[0]))
            more = (screw.columns_times(back, more[0]), screw.columns_times(back, more[1]))
            own_axes = task._replace(world=False)
        inertia = task_space.inertia(at, own_axes, self.damping)
        F = inertia.force(own_axes.of(more))
        own, others = task_space.torques(inertia.J, F), numbers(at.torques(qd, u, None))
        # a joint that does not move the frame has no part in a force that is NaN, but its row has no torques
        growth = maximum(inertia.growth, select(at_least(dot(F, F), 0.0), 1.0, HUGE))
        share = 1.0 if self.limits is False else _share(own, others, self.limits)  # type: ignore[arg-type]
        return {"tau": [b + share * t for b, t in zip(others, own, strict=True)], GROWTH: [growth]}


@dataclass(frozen=True)
class CartesianImpedance(FrameLaw):
    """Torques of a spring and a damper between a frame and its desired pose, and those that hold the robot.

    See `torchdq.cartesian_impedance`. Its reference [..., 14] is X_des [8] and V_des [6].

    Args:
        stiffness, damping, frame, expressed, axes, q_null, k_null, coriolis: as in the function; without `coriolis` the
            spring is passive, up to the torque being held over a step.
        model: as in `OperationalSpaceControl`.

    >>> import torchdq
    >>> from torchdq.scene import controllers
    >>> control = controllers.CartesianImpedance(stiffness=300.0, damping=30.0, axes="position")
    >>> [a.name for a in control.program(torchdq.robots.load("ur10e")).arguments]
    ['q', 'qd', 'X_des', 'V_des']
    """

    NAME: ClassVar[str] = "cartesian_impedance"
    GOAL: ClassVar[Shapes] = {"X_des": (8,), "V_des": (6,)}
    GAINS: ClassVar[tuple[str, str]] = ("stiffness", "damping")
    stiffness: Parameter = field(metadata=parameter("axes"))
    damping: Parameter = field(metadata=parameter("axes"))
    expressed: Literal["body", "world"] = field(default="world", kw_only=True, metadata=option(EXPRESSED.check))
    coriolis: bool = field(default=True, kw_only=True, metadata=option(OneOf((False, True))))

    def torques(self, at: Posed, goal: Mapping[str, Any], q: Row, qd: Row) -> Results:
        """Torques J^T (K e + D e') + c + g, and the growth of the inertia that the posture is projected with."""
        task, found = self.deviation(at, goal, qd)
        u, F, growth, J = self.posture(q, qd), self.feedback(task, found.e, found.rate), 1.0, task.jacobian(at)
        if u is not None:
            inertia = task_space.inertia(at, task, DAMPING)
            growth = inertia.growth
            F = [f - h for f, h in zip(F, inertia.force([dot(row, u) for row in J]), strict=True)]
        held = numbers(at.torques(qd if self.coriolis else None, u, None))
        return {"tau": [b + t for b, t in zip(held, task_space.torques(J, F), strict=True)], GROWTH: [growth]}


def _share(own: Row, others: Row, effort: Sequence[float]) -> Number:
    """Largest share in [0, 1] of the torques `own` that keeps their sum with the others within the efforts."""
    share: Number = 1.0
    for t, b, most in zip(own, others, effort, strict=True):
        room = select(below(t, 0.0), most + b, most - b)
        size = select(below(t, 0.0), -t, t)
        fits = below(size, room)
        share = minimum(share, select(fits, 1.0, maximum(room, 0.0) / select(fits, 1.0, size)))
    return share


def _of_axes(x: Any, m: int) -> Any:
    """Gain of m axes, of one number for all."""
    if isinstance(x, Tensor):
        return x if x.ndim else x.expand(m)
    return (x,) * m if is_number(x) else x
