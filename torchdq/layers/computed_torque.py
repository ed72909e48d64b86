"""Computed torque control as a layer."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchdq.backends.choice import BackendName
from torchdq.dynamics.tracking import commanded
from torchdq.effects.friction import Friction
from torchdq.errors import ArgumentError
from torchdq.functions.call import check
from torchdq.layers.dynamics import InverseDynamics
from torchdq.layers.layer_friction import described
from torchdq.layers.layer_program import GAINS
from torchdq.layers.robot_module import RobotModule
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot


class ComputedTorque(RobotModule):
    """Computed torque controller: `forward(q, qd, q_des, qd_des, qdd_des, f_tip)` returns tau [..., n].

        tau = M a + c + g + J^T f_tip + friction(q, qd) + offset,   a = qdd_des + kd (qd_des - qd) + kp (q_des - q)

    Friction is added at the measured velocity, once: the given or learned one, or else that of the description. A
    `ResidualDynamics` adds what its network found, which was trained on torques that include all friction that its
    model does not learn; so that of the description is never added to its torques, nor to those of other modules.

    Args:
        robot: the model of the robot that is controlled; or a trained module, an `InverseDynamics` with what it learned
            or a `ResidualDynamics`, whose torques are taken at the desired acceleration with the errors fed back.
        kp, kd: position gain [1/s^2] and velocity gain [1/s], numbers or shape [n].
        learn: names of quantities, such as ("kp", "friction"): "kp" and "kd", which are unconstrained, and those of
            `InverseDynamics`, whose `prior` there is here, too. For a module only "kp" and "kd": what it learned itself
            goes on being learned with it.
        backend: as in `torchdq.functional`; None: as `torchdq.backend` says at the time of the call. A module has its
            own.
        sign_width: velocity below which learned or described Coulomb friction is viscous [rad/s or m/s]. A module
            has its own.
        friction: effects that are compensated, of `torchdq.effects` without a memory; True: the damping and the
            friction of the robot's description, as `torchdq.effects.Viscous` and `Coulomb` have them, where no friction
            is learned, of a robot or an `InverseDynamics`; False: none. A module has its own.

    Raises:
        ArgumentError: a gain is not real, finite and not negative, `learn` names something else or a quantity that the
            robot does not have, or the module returns no torques of motions.

    >>> import torch, torchdq
    >>> controller = torchdq.ComputedTorque(torchdq.robots.load("two_link"), kp=25.0, kd=10.0)
    >>> controller(*torch.zeros(5, 3, 2)).shape
    torch.Size([3, 2])
    """

    kp: Tensor
    kd: Tensor
    _function = "computed_torque"

    def __init__(
        self,
        robot: Robot | nn.Module,
        kp: Tensor | float,
        kd: Tensor | float,
        learn: Sequence[str] = (),
        backend: BackendName | None = None,
        sign_width: float = 1e-2,
        friction: bool | Sequence[Friction] = True,
    ):
        model = robot if isinstance(robot, nn.Module) and isinstance(getattr(robot, "robot", None), Robot) else None
        names = (learn,) if isinstance(learn, str) else learn
        others = [name for name in names if name not in GAINS] if isinstance(names, Sequence) else learn
        effects = () if isinstance(friction, bool) else friction
        known = require_robot(robot if model is None else model.robot)
        if model is not None:
            _require_torques(model, learn if others else (), effects)
            backend = getattr(model, "backend", backend)
            sign_width = getattr(model, "sign_width", sign_width)
        super().__init__(known, others, backend, sign_width, effects)
        self.model, self._rigid = model, False
        if isinstance(model, InverseDynamics):
            self._friction = model._friction
        # the network of a residual learns all friction that its model leaves; other modules are taken as they are
        alone = model is None or isinstance(model, InverseDynamics)
        if friction is True and alone and not self._friction.effects:
            self._friction = described(known, self.sign_width)
        for name, value in (("kp", kp), ("kd", kd)):
            x = gain_of(name, value, known.n).clone()
            if name in names:
                self.register_parameter(name, nn.Parameter(x))
            else:
                self.register_buffer(name, x)

    def forward(
        self, q: Tensor, qd: Tensor, q_des: Tensor, qd_des: Tensor, qdd_des: Tensor, f_tip: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.computed_torque`."""
        given = {"q": q, "qd": qd, "q_des": q_des, "qd_des": qd_des, "qdd_des": qdd_des, "f_tip": f_tip}
        # a layer of one's own that derives from `InverseDynamics` may compute something else
        if self.model is None or getattr(type(self.model), "forward", None) is InverseDynamics.forward:
            return self._evaluated(given)[0]
        check(self.robot, ("f_tip",), **given)
        kp, kd = self.kp.to(q), self.kd.to(q)
        return self.model(q, qd, commanded(q, qd, q_des, qd_des, qdd_des, kp, kd), f_tip)

    @property
    def robot(self) -> Robot:
        """Robot with the present parameters of the module or of its model."""
        return super().robot if self.model is None else self.model.robot  # type: ignore[return-value]

    def _own_quantities(self) -> tuple[dict[str, Tensor], list[str]]:
        """Parameters of its program that are not the robot's, its model's or its own, and names of the learned."""
        if not (self.model is None or isinstance(self.model, InverseDynamics)):
            raise ArgumentError(
                f"model of a ComputedTorque must be a robot or an InverseDynamics for a program, found a "
                f"{type(self.model).__name__}, whose network has no program; export the controller of its `robot`, and "
                "the network by torch.export or torch.onnx"
            )
        own, learned = super()._own_quantities() if self.model is None else self.model._own_quantities()
        gains = [name for name in GAINS if name in self._parameters]
        return {**own, **{name: getattr(self, name) for name in GAINS}}, [*learned, *gains]

    def _coefficients(self) -> dict[str, Tensor]:
        """Friction that is learned by itself or by its model, by quantity."""
        owner = self if self.model is None else self.model
        return {name: getattr(owner, name) for name in self._friction.learned}


def _require_torques(model: nn.Module, learn: Any, effects: Any) -> None:
    """Raise unless a module returns torques of motions, and neither names to learn nor effects are given beside it."""
    if isinstance(model, RobotModule) and not isinstance(model, InverseDynamics):
        raise ArgumentError(
            f"robot must be a torchdq.Robot or a module that returns torques of motions, an InverseDynamics or a "
            f"ResidualDynamics, found a {type(model).__name__}; its attribute `robot` is a robot"
        )
    if learn:
        raise ArgumentError(f"learn must be among 'kp' and 'kd' for a module, which learns by itself, found {learn!r}")
    if effects:
        raise ArgumentError("friction must be True or False for a module, which has its own; give it to the module")


def gain_of(name: str, gain: Any, n: int) -> Tensor:
    """Gain as float64 numbers, one or n; raises unless they are real, finite and not negative."""
    with suppress(TypeError, ValueError):  # words, and rows of different lengths
        x = gain if isinstance(gain, Tensor) else torch.from_numpy(np.array(gain))
        real = x.dtype != torch.bool and not x.is_complex()
        if real and x.shape in ((), (n,)) and bool((x.isfinite() & (x >= 0)).all()):
            return x.double()
    raise ArgumentError(f"{name} must be a number or {n} numbers, real, finite and not negative, found {gain!r}")
