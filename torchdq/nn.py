"""The dynamics as torch modules; the algorithms are `torchdq.functional` and `torchdq.control`."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchdq.control import computed_torque
from torchdq.errors import ArgumentError
from torchdq.functional import forward_dynamics, inverse_dynamics
from torchdq.program.backends import Backend
from torchdq.robot import Robot
from torchdq.robot.robot import SHAPES


class RobotModule(nn.Module):
    """A module that holds a robot; the robot's tensors named in `learn` are its parameters.

    The others are constants of the compiled programs and are not part of the state dict.

    Args:
        robot: the robot.
        learn: names of robot tensors to make parameters: "mass", "com", "inertia", "gravity", "armature", "home",
            "X_PB_home", "screw". They are free real numbers; nothing keeps a mass positive.
        backend: as in `torchdq.functional`; None: what `torchdq.backend` says at the time of the call.
    """

    def __init__(self, robot: Robot, learn: Sequence[str] = (), backend: Backend | None = None):
        super().__init__()
        self.learn = (learn,) if isinstance(learn, str) else tuple(learn)
        present = [name for name in SHAPES if getattr(robot, name) is not None]
        for name in self.learn:
            if name not in present:
                raise ArgumentError(f"learn must name tensors of the robot among {present}, found {name!r}")
            self.register_parameter(name, nn.Parameter(getattr(robot, name).detach().clone()))
        self._robot = robot
        self.backend = backend

    @property
    def robot(self) -> Robot:
        """The robot with the module's present parameters."""
        if not self.learn:
            return self._robot
        return self._robot.replace(**{name: getattr(self, name) for name in self.learn})

    def extra_repr(self) -> str:
        """The robot, for `print(module)`."""
        return repr(self._robot)


class DQRNEA(RobotModule):
    """Inverse dynamics as a differentiable layer: `forward(q, qd, qdd, f_tip, f_ext)` returns tau [..., n].

    See `torchdq.inverse_dynamics` for the arguments. dtype and device follow the inputs.

    >>> import torchdq
    >>> layer = DQRNEA(torchdq.robots.load("two_link"), learn=("mass",))
    >>> layer(torch.zeros(5, 2), torch.zeros(5, 2), torch.zeros(5, 2)).shape
    torch.Size([5, 2])
    """

    def forward(
        self,
        q: Tensor,
        qd: Tensor | None = None,
        qdd: Tensor | None = None,
        f_tip: Tensor | None = None,
        f_ext: Tensor | None = None,
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.inverse_dynamics`."""
        return inverse_dynamics(self.robot, q, qd, qdd, f_tip, f_ext, self.backend)


class ForwardDynamics(RobotModule):
    """Forward dynamics as a differentiable layer: `forward(q, qd, tau, f_tip, f_ext)` returns qdd [..., n].

    >>> import torchdq
    >>> layer = ForwardDynamics(torchdq.robots.load("two_link"))
    >>> layer(torch.zeros(5, 2), torch.zeros(5, 2), torch.zeros(5, 2)).shape
    torch.Size([5, 2])
    """

    def forward(
        self,
        q: Tensor,
        qd: Tensor | None,
        tau: Tensor,
        f_tip: Tensor | None = None,
        f_ext: Tensor | None = None,
    ) -> Tensor:
        """Joint accelerations [..., n]; see `torchdq.forward_dynamics`."""
        return forward_dynamics(self.robot, q, qd, tau, f_tip, f_ext, self.backend)


class ComputedTorque(RobotModule):
    """Computed torque controller: `forward(q, qd, q_des, qd_des, qdd_des, f_tip)` returns tau [..., n].

    Args:
        robot: the model of the robot that is controlled.
        kp, kd: position gain [1/s^2] and velocity gain [1/s], numbers or shape [n].
        learn: as in `RobotModule`, and "kp", "kd".

    >>> import torchdq
    >>> controller = ComputedTorque(torchdq.robots.load("two_link"), kp=25.0, kd=10.0)
    >>> controller(*torch.zeros(5, 3, 2)).shape
    torch.Size([3, 2])
    """

    kp: Tensor
    kd: Tensor

    def __init__(
        self,
        robot: Robot,
        kp: Tensor | float,
        kd: Tensor | float,
        learn: Sequence[str] = (),
        backend: Backend | None = None,
    ):
        learn = (learn,) if isinstance(learn, str) else tuple(learn)
        super().__init__(robot, tuple(name for name in learn if name not in ("kp", "kd")), backend)
        for name, gain in (("kp", kp), ("kd", kd)):
            value = torch.as_tensor(gain, dtype=torch.float64)
            if value.shape not in ((), (robot.n,)) or not bool((value >= 0).all()):
                raise ArgumentError(f"{name} must be a number or [{robot.n}] numbers, not negative, found {gain}")
            if name in learn:
                self.register_parameter(name, nn.Parameter(value.clone()))
            else:
                self.register_buffer(name, value.clone())

    def forward(
        self,
        q: Tensor,
        qd: Tensor,
        q_des: Tensor,
        qd_des: Tensor,
        qdd_des: Tensor,
        f_tip: Tensor | None = None,
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.computed_torque`."""
        kp, kd = (gain.to(dtype=q.dtype, device=q.device) for gain in (self.kp, self.kd))
        return computed_torque(self.robot, q, qd, q_des, qd_des, qdd_des, kp, kd, f_tip, self.backend)
