"""Controllers: torques from a reference. They see the readings once per step and hold the torque over it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from torchdq.algebra.quaternion import Number
from torchdq.dynamics.posed import Posed, Row
from torchdq.dynamics.tracking import commanded
from torchdq.effects.effect import Parameter, Parametric, Shapes, undefined
from torchdq.errors import ArgumentError
from torchdq.export.meaning import heading, part
from torchdq.functions.posed import posed
from torchdq.program.program import Argument, Program, record
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.fields import SHAPES
from torchdq.robot.robot import arguments, constants, recorded

__all__ = ["PD", "ComputedTorqueController", "Controller"]


@dataclass(frozen=True)
class Controller(Parametric):
    """Torques from the input `reference` [..., 3 n]: desired positions, velocities and accelerations."""

    FIXED: ClassVar[str] = ""  # reason why a robot with a floating base is refused; "": it is not

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
        taken = [Argument("reference", 3 * n), Argument("q", n), Argument("qd", n)]
        taken += [Argument(name, x.shape[-1], x.ndim == 1) for name, x in tensors.items()]

        def algorithm(reference: Row, q: Row, qd: Row, *gains: Row) -> dict[str, Sequence[Number]]:
            bound = whole.bound(dict(zip(tensors, gains, strict=True)))
            return {"tau": bound.torques(posed(constant, q, {}, ()), reference, q, qd)}

        kind = type(self).__name__
        about = (*heading(f"controller {kind}", robot.name, robot.joint_names), part(whole.template()))
        return replace(record(f"{kind}_{robot.name}", taken, algorithm), about=about)


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
        believed, what = self.model, f"model of {type(self).__name__}"
        if believed is None:
            return self
        if robot.floating or believed.floating:
            raise ArgumentError(
                f"{what} must be None for a robot with a floating base: what its joints carry depends on the forces on "
                "the base"
            )
        if believed.n != robot.n:
            raise ArgumentError(f"{what} must have the {robot.n} joints of robot {robot.name!r}, found {believed.n}")
        for name in arguments(believed):
            if getattr(believed, name).ndim > len(SHAPES[name]):
                raise ArgumentError(
                    f"{what} must be one robot, found batch axes of its {name}; its tensors are constants"
                )
            if getattr(believed, name).requires_grad:
                raise ArgumentError(
                    f"{what} must have constants, which get no gradient, found a {name} that requires grad; use "
                    "model.bake(), or learn with torques from torchdq.computed_torque"
                )
        return replace(self, model=recorded(constants(believed.bake())))

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
