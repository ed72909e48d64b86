"""Forward dynamics as a layer."""

from collections.abc import Sequence

from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.effects.friction import Friction
from torchdq.functions.call import Precision, check_precision
from torchdq.layers.robot_module import RobotModule
from torchdq.robot import Robot


class ForwardDynamics(RobotModule):
    """Forward dynamics as a differentiable layer: `forward(q, qd, tau, f_tip, f_ext)` returns qdd [..., n].

    The inverse of `InverseDynamics` in qdd: friction and learned offset are subtracted from the torques, which are
    those of the motors. See `torchdq.forward_dynamics` for the arguments of a call.

    Args:
        robot: the robot.
        learn: names of quantities, such as ("mass", "friction"), as in `InverseDynamics`: "mass", "com", "inertia",
            "gravity", "armature", "home", "X_PB_home", "screw", "friction" and "offset". `prior` is the distance of
            the learned ones from their initial values.
        backend: as in `torchdq.functional`; None: as `torchdq.backend` says at the time of the call.
        sign_width: velocity below which learned Coulomb friction is viscous [rad/s or m/s].
        precision: "auto" or "double", as in `torchdq.forward_dynamics`.
        friction: friction effects of `torchdq.effects` without a memory, the same as in a scene.

    Raises:
        ArgumentError: `learn` names something else, or a quantity that the robot does not have.

    >>> import torch, torchdq
    >>> fall = torchdq.ForwardDynamics(torchdq.robots.load("two_link"))
    >>> q = torch.tensor([-1.5708, 0.0], dtype=torch.float64)  # hanging down
    >>> bool((fall(q, 0 * q, 0 * q).abs() < 1e-3).all())
    True
    """

    _function = "forward_dynamics"

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
        self, q: Tensor, qd: Tensor | None, tau: Tensor, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> Tensor:
        """Joint accelerations [..., n]; see `torchdq.forward_dynamics`."""
        return self._evaluated({"q": q, "qd": qd, "tau": tau, "f_tip": f_tip, "f_ext": f_ext})
