"""Inverse and forward dynamics of robots with a floating base as layers."""

from collections.abc import Sequence

from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.effects.friction import Friction
from torchdq.floating import Accelerations, Forces
from torchdq.functions.call import Precision, check_precision
from torchdq.layers.robot_module import RobotModule
from torchdq.robot import Robot


class FloatingInverseDynamics(RobotModule):
    """Inverse dynamics of a robot with a floating base as a layer: the wrench F_B on the base, and tau [..., n].

    `forward(X_WB, q, V_WB_B, qd, A_WB_B, qdd, f_tip, f_ext, f_base)` is `torchdq.floating.inverse_dynamics`, with
    friction and offset of the motors as in `InverseDynamics`. Where nothing but its feet touches a robot, F_B is zero
    under the right `f_ext`.

    Args:
        robot: the robot, with a floating base.
        learn: as in `InverseDynamics`; and "base_mass", "base_com", "base_inertia", the body of the base.
        backend, sign_width, friction: as in `InverseDynamics`.

    Raises:
        ArgumentError: the base is fixed, or `learn` names something else, or a quantity that the robot does not have.

    >>> import torch, torchdq
    >>> base = '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    >>> body = torchdq.Robot.from_urdf(f'<robot name="b"><link name="l">{base}</link></robot>', base="floating")
    >>> layer = torchdq.nn.FloatingInverseDynamics(body, learn="base_mass")
    >>> layer(torch.eye(8)[0], torch.zeros(0)).F_B.detach()  # its weight
    tensor([ 0.0000,  0.0000, 19.6200,  0.0000,  0.0000,  0.0000])
    """

    _function = "floating.inverse_dynamics"

    def forward(
        self,
        X_WB: Tensor,
        q: Tensor,
        V_WB_B: Tensor | None = None,
        qd: Tensor | None = None,
        A_WB_B: Tensor | None = None,
        qdd: Tensor | None = None,
        f_tip: Tensor | None = None,
        f_ext: Tensor | None = None,
        f_base: Tensor | None = None,
    ) -> Forces:
        """Wrench on the base [..., 6] and joint torques [..., n]; see `torchdq.floating.inverse_dynamics`."""
        motion = {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd, "A_WB_B": A_WB_B, "qdd": qdd}
        return Forces(*self._evaluated({**motion, "f_tip": f_tip, "f_ext": f_ext, "f_base": f_base}))


class FloatingForwardDynamics(RobotModule):
    """Forward dynamics of a robot with a floating base as a layer: A_WB_B [..., 6] of the base, and qdd [..., n].

    `forward(X_WB, q, V_WB_B, qd, tau, f_tip, f_ext, f_base)` is `torchdq.floating.forward_dynamics`, the inverse of
    `FloatingInverseDynamics` in the accelerations.

    Args:
        robot, learn, backend, sign_width, friction: as in `FloatingInverseDynamics`.
        precision: "auto" or "double", as in `torchdq.forward_dynamics`.

    Raises:
        ArgumentError: as in `FloatingInverseDynamics`.
    """

    _function = "floating.forward_dynamics"

    def __init__(
        self,
        robot: Robot,
        learn: Sequence[str] = (),
        backend: BackendName | None = None,
        sign_width: float = 1e-2,
        precision: Precision = "auto",
        friction: Sequence[Friction] = (),
    ):
        super().__init__(robot, learn, backend, sign_width, friction)
        self.precision = check_precision(precision)

    def forward(
        self,
        X_WB: Tensor,
        q: Tensor,
        V_WB_B: Tensor | None,
        qd: Tensor | None,
        tau: Tensor,
        f_tip: Tensor | None = None,
        f_ext: Tensor | None = None,
        f_base: Tensor | None = None,
    ) -> Accelerations:
        """Accelerations of base and joints; see `torchdq.floating.forward_dynamics`."""
        given = {"X_WB": X_WB, "q": q, "V_WB_B": V_WB_B, "qd": qd, "tau": tau}
        return Accelerations(*self._evaluated({**given, "f_tip": f_tip, "f_ext": f_ext, "f_base": f_base}))
