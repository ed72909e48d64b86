"""Dynamics as torch modules; the algorithms are `torchdq.functional` and `torchdq.control`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NoReturn, get_args

import torch
from torch import Tensor, nn
from torch.nn.utils import parametrize

from torchdq.backends.choice import BackendName
from torchdq.checks import require_choice, require_number
from torchdq.control import computed_torque, constant_gain
from torchdq.dynamics.friction import friction_torque
from torchdq.dynamics.tracking import commanded
from torchdq.errors import ArgumentError
from torchdq.functional import Precision, check_precision, forward_dynamics, inverse_dynamics
from torchdq.functional import check as require_alike
from torchdq.learnable import initial_values, learnable
from torchdq.motors import GAINS, MOTORS, Parameters, program
from torchdq.parametrizations import PhysicalInertia, Positive, restored
from torchdq.program.program import Program
from torchdq.program.transforms import number
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.robot import SHAPES

# parametrisation of each constrained quantity
CONSTRAINED: dict[str, type[Positive | PhysicalInertia]] = {
    **dict.fromkeys(("mass", "armature", "viscous", "coulomb"), Positive),
    "inertia": PhysicalInertia,
}
SMALLEST_SIZE = 1e-2  # least size of a body, against which `prior` measures the shift of its centre of mass [m]


class RobotModule(nn.Module):
    """Module that holds a robot and learns the quantities that `learn` names.

    Learned quantities stay physical, whatever an optimiser does: masses, rotor inertias and friction stay positive, and
    inertias are those of bodies that can exist. `module.mass` and so on are the present quantities, and assigning to
    them sets them; the parameters are the unconstrained numbers behind them (`torchdq.parametrizations`, by
    `torch.nn.utils.parametrize`), `module.parametrizations.mass.original`. Weight decay would pull those towards
    1 kg; `prior` pulls towards the description. Other quantities are constants of the compiled programs, and not part
    of the state dict.

    Args:
        robot: the robot.
        learn: names of quantities. Tensors of the robot: "mass", "com", "inertia", "gravity", "armature", "home",
            "X_PB_home", "screw" (the last three and gravity are unconstrained); "armature" starts at 1e-3 kg m^2 (or
            kg) if the robot has none. "friction": the friction torque viscous qd + coulomb qd / sqrt(qd^2 + width^2) of
            every joint, as `torchdq.effects.Viscous` and `Coulomb` have it, from the damping and the friction of the
            robot's description, or 1e-2 (in SI units) where it has none. "offset": a constant torque of every joint,
            from zero.
        backend: as in `torchdq.functional`; None: as `torchdq.backend` says at the time of the call.
        friction_width: velocity below which friction is viscous [rad/s or m/s].

    Raises:
        ArgumentError: `learn` names something else, or a quantity that the robot does not have.
    """

    viscous: Tensor  # [n], if friction is learned
    coulomb: Tensor  # [n], if friction is learned
    offset: Tensor  # [n], if it is learned
    _function: str  # name of the function without friction and offset

    def __init__(
        self, robot: Robot, learn: Sequence[str] = (), backend: BackendName | None = None, friction_width: float = 1e-2
    ):
        super().__init__()
        require_number("friction_width", friction_width, positive=True)
        require_choice("backend", backend, (None, *get_args(BackendName)))
        if require_robot(robot).floating:
            raise ArgumentError(
                f"robot of {type(self).__name__} must have a fixed base, found {robot.name!r} with a free one; "
                "torchdq.floating has functions for it"
            )
        self._robot = robot
        self.learn = learnable(robot, learn)
        self.backend = backend
        self.friction_width = float(friction_width)
        self._initial: dict[str, Tensor] = {}  # unconstrained numbers by quantity, from which `prior` measures
        for name in self.learn:
            for quantity, value in initial_values(robot, name).items():
                self.register_parameter(quantity, nn.Parameter(value))
                if quantity in CONSTRAINED:
                    parametrize.register_parametrization(self, quantity, CONSTRAINED[quantity](quantity))
                if quantity in CONSTRAINED or quantity == "com":
                    self._initial[quantity] = self._unconstrained(quantity).detach().clone()

    def __setattr__(self, name: str, value: Any) -> None:
        """Assign; raises if the robot's quantity is not learned or of another shape. A parameter takes the numbers."""
        if name in (*SHAPES, "viscous", "coulomb", "offset") and "learn" in self.__dict__:
            source = "friction" if name in ("viscous", "coulomb") else name
            if source not in self.learn:
                raise ArgumentError(
                    f"{name} is not learned by this layer, so assigning to it would change nothing; make the layer "
                    f"with learn={(*self.learn, source)}, or with robot.replace(...)"
                )
        if isinstance(value, Tensor) and "_initial" in self.__dict__ and name in self._learned_quantities():
            present = getattr(self, name)
            joints = value.shape[-present.ndim :][:1]
            if joints != present.shape[:1] and value.ndim:
                expected = ", ".join(["...", *map(str, present.shape)])
                raise ArgumentError(f"{name} must have the shape [{expected}], found {tuple(value.shape)}")
            if not isinstance(value, nn.Parameter):
                value = value.to(present)
                if name in self._parameters and value.shape == present.shape:
                    with torch.no_grad():
                        present.copy_(value)  # an optimiser goes on with it
                    return
        super().__setattr__(name, value)

    def _learned_quantities(self) -> set[str]:
        """Names of the tensors that are learned."""
        constrained = self._modules.get("parametrizations", nn.ModuleDict())
        return {*self._parameters, *constrained}  # type: ignore[misc]

    @property
    def robot(self) -> Robot:
        """Robot with the module's present parameters."""
        changes = {name: getattr(self, name) for name in self.learn if name in SHAPES}
        return self._robot._with(**changes) if changes else self._robot

    def friction_torque(self, qd: Tensor) -> Tensor:
        """Torque [..., n] that overcomes the friction at velocities qd [..., n], in its dtype and on its device.

        Zero unless "friction" is learned. A scene with the same effects exerts the opposite on its joints.

        >>> import torchdq
        >>> layer = DQRNEA(torchdq.robots.load("two_link"), learn="friction")
        >>> layer.viscous = torch.tensor([2.0, 3.0], dtype=torch.float64)
        >>> layer.friction_torque(torch.tensor([10.0, -10.0])).detach()
        tensor([ 20.0100, -30.0100])
        """
        if "friction" not in self.learn:
            return torch.zeros_like(qd)
        return friction_torque(qd, self.viscous.to(qd), self.coulomb.to(qd), number(self.friction_width, qd))

    def _learned_torque(self, q: Tensor, qd: Tensor | None) -> Tensor | None:
        """Learned friction and offset, the torque of the motors beyond that of the rigid bodies; None: neither."""
        friction = None if qd is None or "friction" not in self.learn else self.friction_torque(qd)
        if "offset" not in self.learn:
            return friction
        offset = self.offset.to(dtype=q.dtype, device=q.device)
        return offset if friction is None else friction + offset

    def program(self, *wrenches: str, parameters: Parameters = "constants") -> Program:
        """Program of the layer, with learned friction and offset, for `torchdq.compile` and its `export`.

        Its arguments are those of `forward`; "f_tip" and "f_ext" are there if they are named.

        Args:
            wrenches: their names.
            parameters: "constants": all quantities have their present values. "arguments": those that are learned, and
                those that were replaced in the robot, are arguments, in SI units.

        >>> import torchdq
        >>> layer = DQRNEA(torchdq.robots.load("two_link"), learn=("mass", "friction"))
        >>> [a.name for a in layer.program(parameters="arguments").arguments]
        ['q', 'qd', 'qdd', 'mass', 'viscous', 'coulomb']
        """
        fixed, learned = self._beside()
        return program(self.robot, self._function, wrenches, parameters, fixed, learned, self.friction_width)

    def _beside(self) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Quantities of its program that are no tensors of the robot: those that are fixed, and those it learns."""
        return {}, {name: getattr(self, name) for name in MOTORS if name in self._learned_quantities()}

    def prior(self) -> Tensor:
        """Distance of the learned quantities from their initial values: a number >= 0 without units.

        The sum of the mean squares, over links or joints and over robots, of the logarithms of the factors of masses,
        rotor inertias and frictions; of the shifts of centres of mass, relative to the size of the body, the root of
        its second moments over its mass, at least 1 cm; and of the changes of the six unconstrained numbers of
        `torchdq.parametrizations.PhysicalInertia`. Gravity, geometry, home and offset are not part of it.

        >>> import torchdq
        >>> layer = DQRNEA(torchdq.robots.load("panda"), learn=("mass", "com", "inertia"))
        >>> layer.mass = 1.1 * layer.mass.detach()
        >>> f"{layer.prior().item():.6f}", f"{torch.tensor(1.1).log().square():.6f}"
        ('0.009084', '0.009084')
        """
        terms = []
        for quantity, initial in self._initial.items():
            present = self._unconstrained(quantity)
            square = (present - initial.to(present)).square()
            if quantity == "com":
                square = square / self._sizes_squared(square).unsqueeze(-1)
            terms.append(square.sum(-1).mean() if quantity in ("com", "inertia") else square.mean())
        return torch.stack(terms).sum() if terms else torch.zeros((), dtype=torch.float64)

    def _unconstrained(self, quantity: str) -> Tensor:
        """Unconstrained numbers behind a quantity."""
        if parametrize.is_parametrized(self, quantity):
            return self.parametrizations[quantity].original  # type: ignore[union-attr,index]
        return getattr(self, quantity)

    def _sizes_squared(self, like: Tensor) -> Tensor:
        """Second moments of every described body over its mass [..., n] [m^2]."""
        inertia, mass = (x.detach().to(like) for x in (self._robot.inertia, self._robot.mass))
        spread = inertia[..., (0, 2, 5)].sum(-1) / 2
        # without a mass the ratio is undefined, and the least size is as good as any
        return (spread / mass.where(mass > 0, torch.inf)).clamp(min=SMALLEST_SIZE**2)

    def __prepare_scriptable__(self) -> NoReturn:
        kind = parametrize.type_before_parametrizations(self).__name__
        raise ArgumentError(
            f"torch.jit.script cannot compile a {kind}, which runs a program that is compiled for its robot already; "
            f"use torch.compile, torch.export.export, or torch.jit.trace with example inputs"
        )

    def extra_repr(self) -> str:
        """Robot, for `print(module)`."""
        return repr(self._robot)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Parts for pickle, since torch cannot pickle a module whose class it made for its parametrizations."""
        if not parametrize.is_parametrized(self):
            return super().__reduce_ex__(protocol)
        modules = dict(self._modules)
        lists = dict(modules.pop("parametrizations").items())  # type: ignore[union-attr,operator]
        state = {**self.__dict__, "_modules": modules}
        return restored, (parametrize.type_before_parametrizations(self), state, lists)


class DQRNEA(RobotModule):
    """Inverse dynamics as a differentiable layer: `forward(q, qd, qdd, f_tip, f_ext)` returns tau [..., n].

    See `torchdq.inverse_dynamics` for the arguments. dtype and device follow the inputs. Learned friction and offset
    are added: the torques are those of the motors.

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
        tau = inverse_dynamics(self.robot, q, qd, qdd, f_tip, f_ext, self.backend)
        learned = self._learned_torque(q, qd)
        return tau if learned is None else tau + learned


class ForwardDynamics(RobotModule):
    """Forward dynamics as a differentiable layer: `forward(q, qd, tau, f_tip, f_ext)` returns qdd [..., n].

    Learned friction and offset are subtracted from the torques, which are those of the motors. Example: `DQRNEA`,
    which is made and called alike.

    Args:
        precision: as in `torchdq.forward_dynamics`.
        robot, learn, backend, friction_width: as in `RobotModule`.
    """

    _function = "forward_dynamics"

    def __init__(
        self,
        robot: Robot,
        learn: Sequence[str] = (),
        backend: BackendName | None = None,
        friction_width: float = 1e-2,
        precision: Precision = "auto",
    ):
        super().__init__(robot, learn, backend, friction_width)
        self.precision = check_precision(precision)

    def forward(
        self, q: Tensor, qd: Tensor | None, tau: Tensor, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> Tensor:
        """Joint accelerations [..., n]; see `torchdq.forward_dynamics`."""
        robot = self.robot
        require_alike(robot, ("qd",), q=q, qd=qd, tau=tau)
        learned = self._learned_torque(q, qd)
        tau = tau if learned is None else tau - learned
        return forward_dynamics(robot, q, qd, tau, f_tip, f_ext, self.backend, self.precision)


class ComputedTorque(RobotModule):
    """Computed torque controller: `forward(q, qd, q_des, qd_des, qdd_des, f_tip)` returns tau [..., n].

    Friction is added at the measured velocity, once: the learned one, or else that of the robot's description. A
    `ResidualDynamics` adds what its network found, which was trained on torques that include all friction that its
    model does not learn; so that of the description is never added to its torques, nor to those of other modules.

    Args:
        robot: the model of the robot that is controlled; or a trained module, a `DQRNEA` with what it learned or a
            `ResidualDynamics`, whose torques are taken at the desired acceleration with the errors fed back.
        kp, kd: position gain [1/s^2] and velocity gain [1/s], numbers or shape [n].
        learn: as in `RobotModule`, and "kp", "kd", which are unconstrained. For a module only "kp" and "kd": what it
            learned itself goes on being learned with it.
        backend, friction_width: as in `RobotModule`; a module has its own.
        friction: whether the damping and the friction of the robot's description are compensated, as
            `torchdq.effects.Viscous` and `Coulomb` have them, where no friction is learned: of a robot or a `DQRNEA`.

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
        friction: bool = True,
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
        super().__init__(robot, others, backend, getattr(model, "friction_width", friction_width))
        self.model = model
        # the network of a residual learns all friction that its model leaves; other modules are taken as they are
        rigid = self if model is None else model if isinstance(model, DQRNEA) else None
        described = friction and rigid is not None and "friction" not in rigid.learn
        self.friction = described and bool((robot.damping != 0).any() or (robot.friction != 0).any())
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
        kp, kd = self.kp.to(q), self.kd.to(q)
        if self.model is not None:
            require_alike(self.robot, ("f_tip",), q=q, qd=qd, q_des=q_des, qd_des=qd_des, qdd_des=qdd_des, f_tip=f_tip)
            tau = self.model(q, qd, commanded(q, qd, q_des, qd_des, qdd_des, kp, kd), f_tip)
        else:
            tau = computed_torque(self.robot, q, qd, q_des, qd_des, qdd_des, kp, kd, f_tip, self.backend)
        if self.friction:
            viscous, coulomb = self._robot.damping.to(qd), self._robot.friction.to(qd)
            tau = tau + friction_torque(qd, viscous, coulomb, number(self.friction_width, qd))
        learned = self._learned_torque(q, qd)
        return tau if learned is None else tau + learned

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
        if self.friction:
            fixed |= {"viscous": self._robot.damping, "coulomb": self._robot.friction}
        for name in GAINS:
            (learned if name in self._parameters else fixed)[name] = getattr(self, name)
        return fixed, learned


# plain name beside that of the paper's algorithm
InverseDynamics = DQRNEA
