"""Computed torque control as a layer."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from torchdq.backends.choice import BackendName
from torchdq.dynamics.tracking import commanded
from torchdq.effects.friction import Friction
from torchdq.functions.call import check
from torchdq.layers.control_module import ControlModule
from torchdq.robot import Robot


class ComputedTorque(ControlModule):
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
        super().__init__(robot, {"kp": kp, "kd": kd}, None, learn, backend, sign_width, friction)

    def forward(
        self, q: Tensor, qd: Tensor, q_des: Tensor, qd_des: Tensor, qdd_des: Tensor, f_tip: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.computed_torque`."""
        given = {"q": q, "qd": qd, "q_des": q_des, "qd_des": qd_des, "qdd_des": qdd_des, "f_tip": f_tip}
        if self.model is None or self._recorded:
            return self._evaluated(given)[0]
        check(self.robot, ("f_tip",), **given)
        kp, kd = self.kp.to(q), self.kd.to(q)
        return self.model(q, qd, commanded(q, qd, q_des, qd_des, qdd_des, kp, kd), f_tip)
