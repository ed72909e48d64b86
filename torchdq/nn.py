"""Dynamics as torch modules; the algorithms are `torchdq.functional` and `torchdq.control`."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchdq.backends.choice import BackendName
from torchdq.base.checks import require_tensor
from torchdq.control import computed_torque, constant_gain
from torchdq.dynamics.tracking import commanded
from torchdq.effects.friction import Friction
from torchdq.effects.resistance import load_under
from torchdq.errors import ArgumentError
from torchdq.functional import Precision, check_precision, forward_dynamics, inverse_dynamics
from torchdq.functional import check as require_alike
from torchdq.layers.layer_friction import LayerFriction, described
from torchdq.layers.layer_program import GAINS
from torchdq.layers.robot_module import RobotModule
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot


class DQRNEA(RobotModule):
    """Inverse dynamics as a differentiable layer: `forward(q, qd, qdd, f_tip, f_ext)` returns tau [..., n].

    See `torchdq.inverse_dynamics` for the arguments of a call. dtype and device follow the inputs. Friction and learned
    offset are added: the torques are those of the motors. A layer without `friction` that learns none is the rigid
    bodies alone, whatever damping and friction the description has.

    Learned quantities stay physical, whatever an optimiser does: masses, rotor inertias and friction stay positive, and
    inertias are those of bodies that can exist. `module.mass` and so on are the present quantities, and assigning to
    them sets them; the parameters are the unconstrained numbers behind them (`torchdq.layers.parametrizations`, by
    `torch.nn.utils.parametrize`), `module.parametrizations.mass.original`. Weight decay would pull those towards
    1 kg; `prior` pulls towards the description. Other quantities are constants of the compiled programs, and not part
    of the state dict.

    Args:
        robot: the robot.
        learn: names of quantities. Tensors of the robot: "mass", "com", "inertia", "gravity", "armature", "home",
            "X_PB_home", "screw" (the last three and gravity are unconstrained); "armature" starts at 1e-3 kg m^2 (or
            kg) if the robot has none. "friction": the coefficients in which the effects of `friction` are linear, from
            their values, or 1e-2 (in SI units) where these are zero or absent; without effects those of viscous and
            Coulomb friction, `viscous` and `coulomb`, from the damping and the friction of the robot's description.
            "offset": a constant torque of every joint, from zero.
        backend: as in `torchdq.functional`; None: as `torchdq.backend` says at the time of the call.
        friction_width: velocity below which that Coulomb friction is viscous [rad/s or m/s].
        friction: friction effects of `torchdq.effects` without a memory, the same as in a scene; learned coefficients
            are named after effect and parameter, such as `quadratic_coefficient`.

    Raises:
        ArgumentError: `learn` names something else, or a quantity that the robot does not have.

    >>> import torchdq
    >>> layer = DQRNEA(torchdq.robots.load("two_link"), learn=("mass",))
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
        return self._with_motors(inverse_dynamics(self.robot, q, qd, qdd, f_tip, f_ext, self.backend), q, qd)


class ForwardDynamics(RobotModule):
    """Forward dynamics as a differentiable layer: `forward(q, qd, tau, f_tip, f_ext)` returns qdd [..., n].

    Friction and learned offset are subtracted from the torques, which are those of the motors.

    Args:
        precision: as in `torchdq.forward_dynamics`.
        robot, learn, backend, friction_width, friction: as in `DQRNEA`.

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
        friction_width: float = 1e-2,
        precision: Precision = "auto",
        friction: Sequence[Friction] = (),
    ):
        super().__init__(robot, learn, backend, friction_width, friction)
        self.precision = check_precision(precision)

    def forward(
        self, q: Tensor, qd: Tensor | None, tau: Tensor, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> Tensor:
        """Joint accelerations [..., n]; see `torchdq.forward_dynamics`."""
        robot = self.robot
        require_alike(robot, ("qd",), q=q, qd=qd, tau=tau)
        tau = tau - self.offset.to(tau) if "offset" in self.learn else tau
        if self._friction.effects:
            velocities = torch.zeros_like(q) if qd is None else qd
            tau = load_under(self._friction.parts(self._coefficients()), q, velocities, tau, self.backend)
        return forward_dynamics(robot, q, qd, tau, f_tip, f_ext, self.backend, self.precision)


class ComputedTorque(RobotModule):
    """Computed torque controller: `forward(q, qd, q_des, qd_des, qdd_des, f_tip)` returns tau [..., n].

    Friction is added at the measured velocity, once: the given or learned one, or else that of the description. A
    `ResidualDynamics` adds what its network found, which was trained on torques that include all friction that its
    model does not learn; so that of the description is never added to its torques, nor to those of other modules.

    Args:
        robot: the model of the robot that is controlled; or a trained module, a `DQRNEA` with what it learned or a
            `ResidualDynamics`, whose torques are taken at the desired acceleration with the errors fed back.
        kp, kd: position gain [1/s^2] and velocity gain [1/s], numbers or shape [n].
        learn: as in `DQRNEA`, and "kp", "kd", which are unconstrained. For a module only "kp" and "kd": what it
            learned itself goes on being learned with it.
        backend, friction_width: as in `DQRNEA`; a module has its own.
        friction: effects that are compensated, as in `DQRNEA`; True: the damping and the friction of the robot's
            description, as `torchdq.effects.Viscous` and `Coulomb` have them, where no friction is learned, of a robot
            or a `DQRNEA`; False: none. A module has its own.

    >>> import torchdq
    >>> controller = ComputedTorque(torchdq.robots.load("two_link"), kp=25.0, kd=10.0)
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
        friction_width: float = 1e-2,
        friction: bool | Sequence[Friction] = True,
    ):
        model = robot if isinstance(robot, nn.Module) and isinstance(getattr(robot, "robot", None), Robot) else None
        robot = require_robot(robot if model is None else model.robot)
        names = (learn,) if isinstance(learn, str) else learn
        others = [name for name in names if name not in ("kp", "kd")] if isinstance(names, Sequence) else learn
        if isinstance(model, RobotModule) and not isinstance(model, DQRNEA):
            raise ArgumentError(
                f"robot must be a torchdq.Robot or a module that returns torques of motions, a DQRNEA or a "
                f"ResidualDynamics, found a {type(model).__name__}; its attribute `robot` is a robot"
            )
        if model is not None and others:
            raise ArgumentError(
                f"learn must be among 'kp' and 'kd' for a module, which learns by itself, found {learn!r}"
            )
        given = () if isinstance(friction, bool) else friction
        if model is not None and given:
            raise ArgumentError("friction must be True or False for a module, which has its own; give it to the module")
        super().__init__(robot, others, backend, getattr(model, "friction_width", friction_width), given)
        self.model = model
        # the network of a residual learns all friction that its model leaves; other modules are taken as they are
        rigid = self if model is None else model if isinstance(model, DQRNEA) else None
        if friction is True and rigid is not None and not rigid._friction.effects:
            self._friction = described(robot, self.friction_width)
        for name, gain in (("kp", kp), ("kd", kd)):
            value = constant_gain(name, gain, robot.n)
            if name in learn:
                self.register_parameter(name, nn.Parameter(value.clone()))
            else:
                self.register_buffer(name, value.clone())

    def forward(
        self, q: Tensor, qd: Tensor, q_des: Tensor, qd_des: Tensor, qdd_des: Tensor, f_tip: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.computed_torque`."""
        require_tensor("q", q)
        kp, kd = self.kp.to(q), self.kd.to(q)
        if self.model is not None:
            require_alike(self.robot, ("f_tip",), q=q, qd=qd, q_des=q_des, qd_des=qd_des, qdd_des=qdd_des, f_tip=f_tip)
            tau = self.model(q, qd, commanded(q, qd, q_des, qd_des, qdd_des, kp, kd), f_tip)
        else:
            tau = computed_torque(self.robot, q, qd, q_des, qd_des, qdd_des, kp, kd, f_tip, self.backend)
        return self._with_motors(tau, q, qd)

    @property
    def robot(self) -> Robot:
        """Robot with the present parameters of the module or of its model."""
        return super().robot if self.model is None else self.model.robot  # type: ignore[return-value]

    def _beside(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Quantities of its program that are no tensors of the robot, fixed and learned, by its model or itself."""
        if not (self.model is None or isinstance(self.model, DQRNEA)):
            raise ArgumentError(
                f"model of a ComputedTorque must be a robot or a DQRNEA for a program, found a "
                f"{type(self.model).__name__}, whose network is no program; export the controller of its `robot`, and "
                "the network by torch.export or torch.onnx"
            )
        fixed, learned = super()._beside() if self.model is None else self.model._beside()
        for name in GAINS:
            (learned if name in self._parameters else fixed)[name] = getattr(self, name)
        return fixed, learned

    def _rubbing(self) -> LayerFriction:
        """Friction in its program, its own or that of its model."""
        if isinstance(self.model, RobotModule) and not self._friction.effects:
            return self.model._rubbing()
        return self._friction


# plain name beside that of the paper's algorithm
InverseDynamics = DQRNEA
