"""Laws of joints: feedback of the errors of positions and velocities, with or without a model of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from torchdq.control.law import Law
from torchdq.dynamics.posed import Posed, Row
from torchdq.dynamics.tracking import commanded
from torchdq.functions.parametric import Parameter
from torchdq.functions.recipe import Results
from torchdq.functions.signature import parameter


@dataclass(frozen=True)
class Feedback(Law):
    """Feedback of the errors of positions and velocities.

    Args:
        kp, kd: gains of the errors of positions and velocities, shape [..., n].
    """

    kp: Parameter = field(metadata=parameter("n"))
    kd: Parameter = field(metadata=parameter("n"))


@dataclass(frozen=True)
class ComputedTorque(Feedback):
    """Feedback linearisation: tau = M a + c + g, a = qdd_des + kd (qd_des - qd) + kp (q_des - q), equations (73)-(78).

    With the scene's own model and small steps the error obeys e'' + kd e' + kp e = 0; friction, and everything else
    that is not in the model, are disturbances. Its reference [..., 3 n] is q_des [n], qd_des [n] and qdd_des [n].

    Args:
        kp: position gain [1/s^2], shape [..., n].
        kd: velocity gain [1/s], shape [..., n].
        model: the controller's model of the robot, with its own gravity and rotor inertia; its numbers are copied when
            a scene is made. None: as it is in the scene, payload and gravity included.

    >>> import torch, torchdq
    >>> from torchdq import effects
    >>> from torchdq.scene import Scene, controllers
    >>> robot = torchdq.robots.load("two_link")
    >>> control = controllers.ComputedTorque(kp=100.0, kd=20.0)
    >>> scene = Scene(robot, (effects.Gravity(),), controller=control, dt=0.01)
    >>> end = scene.rollout(scene.start(torch.ones(2)), reference=torch.zeros(200, 6)).q[-1]
    >>> bool((end.abs() < 1e-3).all())
    True
    """

    NAME: ClassVar[str] = "computed_torque"
    WRENCHES: ClassVar[tuple[str, ...]] = ("f_tip",)
    FIXED: ClassVar[str] = "its torques would need the forces of the ground on the base; use PD or effects.Servo"

    def torques(self, at: Posed, goal: Mapping[str, Any], q: Row, qd: Row) -> Results:
        """Torques of the desired acceleration, with the errors fed back."""
        a = list(map(commanded, q, qd, *(goal[name] for name in self.GOAL), self.kp, self.kd))
        return {"tau": at.torques(qd, a, goal.get("exerted"))}  # (73), (74)


@dataclass(frozen=True)
class PD(Feedback):
    """Torques of errors alone: tau = kp (q_des - q) + kd (qd_des - qd), and of gravity if a model is given.

    Its reference is that of `ComputedTorque`, with accelerations that it does not use and that calls may leave out.

    Args:
        kp: position gain [N m/rad or N/m], shape [..., n].
        kd: velocity gain [N m s/rad or N s/m], shape [..., n].
        model: the robot whose gravity torques are added, copied likewise; None: none are.

    >>> import torchdq
    >>> from torchdq import effects
    >>> from torchdq.scene import Scene, controllers
    >>> robot = torchdq.robots.load("two_link")
    >>> control = controllers.PD(kp=50.0, kd=10.0, model=robot)
    >>> scene = Scene(robot, (effects.Gravity(),), controller=control)
    """

    OPTIONAL: ClassVar[frozenset[str]] = frozenset({"qdd_des"})

    def torques(self, at: Posed, goal: Mapping[str, Any], q: Row, qd: Row) -> Results:
        """Torques of the errors, and the model's weight."""
        tau = list(map(commanded, q, qd, goal["q_des"], goal["qd_des"], (0.0,) * len(q), self.kp, self.kd))
        if self.model is None:
            return {"tau": tau}
        weight = at.torques(None, None, None)
        return {"tau": [t if w is None else t + w for t, w in zip(tau, weight, strict=True)]}
