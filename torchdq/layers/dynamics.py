"""Inverse and forward dynamics as layers, of robots on a fixed and on a floating base."""

from collections.abc import Sequence

from torch import Tensor

from torchdq.backends.choice import BackendName
from torchdq.base.checks import require
from torchdq.effects.friction import Friction
from torchdq.floating import Accelerations, Forces
from torchdq.functions.call import PRECISION, Precision
from torchdq.functions.signature import Field
from torchdq.layers.robot_module import RobotModule
from torchdq.robot import Robot


class InverseDynamics(RobotModule):
    """Inverse dynamics as a differentiable layer: `forward(q, qd, qdd, f_tip, f_ext)` returns tau [..., n].

        tau = M qdd + c + g + J^T f_tip - sum of J_i^T f_ext_i + friction(q, qd) + offset

    See `torchdq.inverse_dynamics` for the arguments of a call. dtype and device follow the inputs. Friction and learned
    offset make the torques those of the motors. A layer without `friction` that learns none is the rigid bodies alone,
    whatever damping and friction the description has. All of it is one program, that of `program()`.

    Learned quantities stay physical, whatever an optimiser does: masses, rotor inertias and friction stay positive, and
    inertias stay physically consistent. `module.mass` and so on are the present quantities, and assigning to
    them sets them; the parameters are the unconstrained numbers behind them (`torchdq.layers.parametrizations`, by
    `torch.nn.utils.parametrize`), `module.parametrizations.mass.original`. Weight decay would pull those towards
    1 kg; `prior` pulls towards the nominal values. Other quantities are constants of the compiled programs, and not
    part of the state dict.

    Args:
        robot: the robot.
        learn: names of quantities, such as ("mass", "friction"), or one name. Tensors of the robot: "mass", "com",
            "inertia", "gravity", "armature", "home", "X_PB_home", "screw" (the last three and gravity are
            unconstrained); "armature" starts at 1e-3 kg m^2 (or kg) if the robot has none. "friction": the coefficients
            in which the effects of `friction` are linear, from their values, or 1e-2 (in SI units) where these are zero
            or absent; without effects those of viscous and Coulomb friction, `viscous` and `coulomb`, from the damping
            and the friction of the robot's description. "offset": a constant torque of every joint, from zero.
        backend: as in `torchdq.backend`; None: as `torchdq.backend` says at the time of the call.
        sign_width: velocity below which that Coulomb friction is viscous [rad/s or m/s].
        friction: friction effects of `torchdq.effects` without a memory, the same as in a scene; learned coefficients
            are named after effect and parameter, such as `quadratic_coefficient`.

    Raises:
        ArgumentError: `learn` names something else, or a quantity that the robot does not have.

    >>> import torch, torchdq
    >>> layer = torchdq.InverseDynamics(torchdq.robots.load("two_link"), learn=("mass",))
    >>> layer(torch.zeros(5, 2), torch.zeros(5, 2), torch.zeros(5, 2)).shape
    torch.Size([5, 2])
    """

    _function = "inverse_dynamics"

    def forward(
        self,
        q: Tensor,
        qd: Tensor | None = None,
        qdd: Tensor | None = None,
        f_tip: Tensor | None = None,
        f_ext: Tensor | None = None,
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.inverse_dynamics`."""
        return self._evaluated({"q": q, "qd": qd, "qdd": qdd, "f_tip": f_tip, "f_ext": f_ext})[0]


class DQRNEA(InverseDynamics):
    """Inverse dynamics as a layer, with the arguments of `InverseDynamics`, named after the paper's algorithm.

        # learn=(): no parameters
        layer = torchdq.DQRNEA(robot, learn=("mass", "com", "inertia", "friction"))
        # joint torques [..., n], differentiable in all inputs and parameters
        tau = layer(q, qd, qdd)
        # what has been learned: quantities that stay physical, and the robot with them
        layer.mass, layer.robot

    >>> import torch, torchdq
    >>> layer = DQRNEA(torchdq.robots.load("two_link"), learn="mass")
    >>> layer(torch.zeros(5, 2), torch.zeros(5, 2), torch.zeros(5, 2)).sum().backward()
    >>> layer.parametrizations.mass.original.grad.shape
    torch.Size([2])
    """


class _Solved(RobotModule):
    """Layer that solves for accelerations, in a precision."""

    OPTIONS = {**RobotModule.OPTIONS, "precision": Field("precision", kind="option", check=PRECISION)}  # noqa: RUF012

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
        require("precision", precision, PRECISION)
        self.precision = precision


class ForwardDynamics(_Solved):
    """Forward dynamics as a differentiable layer: `forward(q, qd, tau, f_tip, f_ext)` returns qdd [..., n].

    The inverse of `InverseDynamics` in qdd: friction and learned offset are subtracted from the torques, which are
    those of the motors. See `torchdq.forward_dynamics` for the arguments of a call.

    Args:
        robot, learn, backend, sign_width, friction: as in `InverseDynamics`, and so is `prior`.
        precision: "auto" or "double", as in `torchdq.forward_dynamics`.

    Raises:
        ArgumentError: `learn` names something else, or a quantity that the robot does not have.

    >>> import torch, torchdq
    >>> fall = torchdq.ForwardDynamics(torchdq.robots.load("two_link"))
    >>> q = torch.tensor([-1.5708, 0.0], dtype=torch.float64)  # hanging down
    >>> bool((fall(q, 0 * q, 0 * q).abs() < 1e-3).all())
    True
    """

    _function = "forward_dynamics"

    def forward(
        self, q: Tensor, qd: Tensor | None, tau: Tensor, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> Tensor:
        """Joint accelerations [..., n]; see `torchdq.forward_dynamics`."""
        return self._evaluated({"q": q, "qd": qd, "tau": tau, "f_tip": f_tip, "f_ext": f_ext})[0]


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
    >>> layer = torchdq.nn.FloatingInverseDynamics(
    ...     torchdq.robots.load("go2"), learn="base_mass"
    ... )
    >>> layer(torch.eye(8)[0], torch.zeros(12)).F_B[:3].detach() / 9.81  # its mass [kg]
    tensor([ 0.0000,  0.0000, 16.0870])
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


class FloatingForwardDynamics(_Solved):
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
