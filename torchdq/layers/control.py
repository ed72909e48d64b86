"""Control laws as layers, of a robot or of a trained module."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from torchdq.backends.call import evaluate
from torchdq.backends.choice import BackendName
from torchdq.base.checks import is_number, require_object
from torchdq.control import frames, joints
from torchdq.control.law import Law
from torchdq.dynamics.tracking import commanded
from torchdq.effects.friction import Friction
from torchdq.errors import ArgumentError
from torchdq.functional import forward_dynamics
from torchdq.functions.call import check, with_tensors
from torchdq.functions.catalogue import Function
from torchdq.functions.parametric import TENSOR
from torchdq.layers.dynamics import InverseDynamics
from torchdq.layers.layer_friction import described
from torchdq.layers.robot_module import RobotModule
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot
from torchdq.robot.robot import constants


class Control(RobotModule):
    """Control law as a layer: `forward(q, qd, *goal)` returns tau [..., n], with friction and offset of the motors.

    Friction is added at the measured velocity, once: the given or learned one, or else that of the description. Torques
    of a `ResidualDynamics`, or of another module, are taken at the acceleration that the law gives the rigid bodies.
    What a `ResidualDynamics` learned includes all friction that its model does not learn, so that of the description is
    never added to its torques, nor to those of other modules.

    Args:
        robot: the model of the robot that is controlled; or a trained module, an `InverseDynamics` with what it learned
            or a `ResidualDynamics`.
        law: one of `torchdq.scene.controllers`, or of one's own.
        learn: names of quantities, such as ("kp", "friction"): parameters of the law, which are unconstrained, and
            those of `InverseDynamics`, whose `prior` there is here, too. For a module only those of the law: what it
            learned itself goes on being learned with it.
        backend: as in `torchdq.backend`; None: as `torchdq.backend` says at the time of the call. A module has its
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
    >>> from torchdq.scene import controllers
    >>> layer = torchdq.nn.Control(
    ...     torchdq.robots.load("two_link"), controllers.PD(kp=25.0, kd=10.0), learn="kd"
    ... )
    >>> layer(*torch.zeros(5, 3, 2)).shape
    torch.Size([3, 2])
    """

    def __init__(
        self,
        robot: Robot | nn.Module,
        law: Law,
        learn: Sequence[str] = (),
        backend: BackendName | None = None,
        sign_width: float = 1e-2,
        friction: bool | Sequence[Friction] = True,
    ):
        model = robot if isinstance(robot, nn.Module) and isinstance(getattr(robot, "robot", None), Robot) else None
        known = require_robot(robot if model is None else model.robot)
        require_object("law", law, Law, "torchdq.scene.controllers", "PD(kp=9.0, kd=1.0)")
        whole = law.resolved(known)
        own = law.arguments(whole.SHAPES)
        names = (learn,) if isinstance(learn, str) else learn
        others = [name for name in names if name not in own] if isinstance(names, Sequence) else learn
        effects = () if isinstance(friction, bool) else friction
        if model is not None:
            _require_torques(model, own, learn if others else (), effects)
            backend = getattr(model, "backend", backend)
            sign_width = getattr(model, "sign_width", sign_width)
        self._function, self._own = law.named(), own
        super().__init__(known, others, backend, sign_width, effects)
        self.model, self._rigid = model, False
        if isinstance(model, InverseDynamics):
            self._friction = model._friction
        # the network of a residual learns all friction that its model leaves; other modules are taken as they are
        alone = model is None or isinstance(model, InverseDynamics)
        if friction is True and alone and not self._friction.effects:
            self._friction = described(known, self.sign_width)
        held: dict[str, Any] = dict.fromkeys(own, TENSOR)
        self.law = replace(whole, **held)
        self._axes, self._form = self.law.SHAPES, self.law.form(own)
        for name in own:
            given = getattr(law, name)
            single = given.ndim == 0 if isinstance(given, Tensor) else is_number(given)
            x = torch.as_tensor(given if single else getattr(whole, name), dtype=torch.float64).detach().clone()
            if name in names:
                self.register_parameter(name, nn.Parameter(x))
            else:
                self.register_buffer(name, x)

    @property
    def robot(self) -> Robot:
        """Robot with the present parameters of the module or of its model."""
        return self._present() if self.model is None else self.model.robot  # type: ignore[return-value]

    def forward(self, q: Tensor, qd: Tensor, *goal: Tensor | None) -> Tensor:
        """Joint torques [..., n].

        Args:
            q, qd: measured positions [rad or m] and velocities [rad/s or m/s], shape [..., n].
            goal: rows of the law's goal, and then wrenches, in their order; None, or left out at the end: absent.
        """
        rows = self.law.rows(goal)
        if self.model is None or self._recorded:
            return self._evaluated({"q": q, "qd": qd, **rows})[0]
        return self._of_module(q, qd, rows)

    def _of_module(self, q: Tensor, qd: Tensor, rows: dict[str, Tensor | None]) -> Tensor:
        """Torques of the module, at the acceleration that the law gives its rigid bodies."""
        given = {"q": q, "qd": qd, **rows, **{name: getattr(self, name).to(q) for name in self._own}}
        tau = evaluate(self._computation(self._function), with_tensors(self.robot, given), self.backend)["tau"]
        return self.model(q, qd, forward_dynamics(self.robot, q, qd, tau, backend=self.backend))  # type: ignore[misc]

    def _computation(self, function: str) -> Function:
        """Function of the law, or another one."""
        if function != self._function:
            return super()._computation(function)
        single = tuple([name for name in self._own if self._axes[name] and not getattr(self, name).ndim])
        return Function(constants(self.robot), function, single, self._form)

    def _own_quantities(self) -> tuple[dict[str, Tensor], list[str]]:
        """Parameters of its program that are not the robot's, its model's or its own, and names of the learned."""
        if not (self.model is None or isinstance(self.model, InverseDynamics)):
            raise ArgumentError(
                f"model of {type(self).__name__} must be a robot or an InverseDynamics for a program, found a "
                f"{type(self.model).__name__}, whose network has no program; export the controller of its `robot`, and "
                "the network by torch.export or torch.onnx"
            )
        own, learned = super()._own_quantities() if self.model is None else self.model._own_quantities()
        held = {name: getattr(self, name) for name in self._own}
        return {**own, **held}, [*learned, *[name for name in self._own if name in self._parameters]]

    def _coefficients(self) -> dict[str, Tensor]:
        """Friction that is learned by itself or by its model, by quantity."""
        owner = self if self.model is None else self.model
        return {name: getattr(owner, name) for name in self._friction.learned}

    @property
    def _recorded(self) -> bool:
        """Whether its torques are one program; a layer of one's own that derives from `InverseDynamics` may differ."""
        return self.model is None or getattr(type(self.model), "forward", None) is InverseDynamics.forward


class _Named(Control):
    """Layer of a law of this package."""

    LAW: ClassVar[type[Law]]

    def __init__(
        self,
        robot: Robot | nn.Module,
        *gains: Tensor | float,
        learn: Sequence[str] = (),
        backend: BackendName | None = None,
        sign_width: float = 1e-2,
        friction: bool | Sequence[Friction] = True,
        **law: Any,
    ):
        super().__init__(robot, self.LAW(*gains, **law), learn, backend, sign_width, friction)


class ComputedTorque(_Named):
    """Computed torque controller: `forward(q, qd, q_des, qd_des, qdd_des, f_tip)` returns tau [..., n].

        tau = M a + c + g + J^T f_tip + friction(q, qd) + offset
        a = qdd_des + kd (qd_des - qd) + kp (q_des - q)

    Those of a `ResidualDynamics`, or of another module, are taken at a.

    Args:
        robot: the robot, or a trained module, as in `torchdq.nn.Control`.
        kp, kd: position gain [1/s^2] and velocity gain [1/s], numbers or shape [n].
        learn, backend, sign_width, friction: as in `torchdq.nn.Control`.

    >>> import torch, torchdq
    >>> controller = torchdq.ComputedTorque(torchdq.robots.load("two_link"), kp=25.0, kd=10.0)
    >>> controller(*torch.zeros(5, 3, 2)).shape
    torch.Size([3, 2])
    """

    LAW = joints.ComputedTorque
    kp: Tensor
    kd: Tensor

    def forward(  # type: ignore[override]
        self, q: Tensor, qd: Tensor, q_des: Tensor, qd_des: Tensor, qdd_des: Tensor, f_tip: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.computed_torque`."""
        return super().forward(q, qd, q_des, qd_des, qdd_des, f_tip)

    def _of_module(self, q: Tensor, qd: Tensor, rows: dict[str, Any]) -> Tensor:
        """Torques of the module at the desired acceleration, with the errors fed back."""
        check(self.robot, ("f_tip",), q=q, qd=qd, **rows)
        desired: list[Any] = [rows[name] for name in self.law.GOAL]
        a: Any = commanded(q, qd, *desired, self.kp.to(q), self.kd.to(q))  # type: ignore[call-arg]
        return self.model(q, qd, a, rows["f_tip"])  # type: ignore[misc]


class OperationalSpaceControl(_Named):
    """Control in operational space as a layer: `forward(q, qd, X_des, V_des, A_des)` returns tau [..., n].

    The torques of `torchdq.operational_space_control`, and friction and offset as in `torchdq.nn.Control`.

    Args:
        robot: the robot, or a trained module, as in `torchdq.nn.Control`.
        kp, kd: gains of the error [1/s^2] and of its rate [1/s], numbers or one for each of the axes, shape [m].
        frame, expressed, axes, q_null, k_null, damping, limits: as in the function; limits are those of rigid bodies.
        learn, backend, sign_width, friction: as in `torchdq.nn.Control`.

    >>> import torch, torchdq
    >>> controller = torchdq.nn.OperationalSpaceControl(
    ...     torchdq.robots.load("panda"), kp=100.0, kd=20.0, learn="kp"
    ... )
    >>> controller(torch.zeros(3, 7), torch.zeros(3, 7), torch.eye(8)[0].expand(3, 8)).shape
    torch.Size([3, 7])
    """

    LAW = frames.OperationalSpaceControl

    def forward(  # type: ignore[override]
        self, q: Tensor, qd: Tensor, X_des: Tensor, V_des: Tensor | None = None, A_des: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.operational_space_control`."""
        return super().forward(q, qd, X_des, V_des, A_des)


class CartesianImpedance(_Named):
    """Spring and damper at a frame as a layer: `forward(q, qd, X_des, V_des)` returns tau [..., n].

    The torques of `torchdq.cartesian_impedance`, and friction and offset as in `torchdq.nn.Control`.

    Args:
        robot: the robot, or a trained module, as in `torchdq.nn.Control`.
        stiffness, damping: K and D, numbers or one for each of the axes, shape [m].
        frame, expressed, axes, q_null, k_null, coriolis: as in the function; `coriolis=False` makes it passive.
        learn, backend, sign_width, friction: as in `torchdq.nn.Control`.
    """

    LAW = frames.CartesianImpedance

    def forward(  # type: ignore[override]
        self, q: Tensor, qd: Tensor, X_des: Tensor, V_des: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.cartesian_impedance`."""
        return super().forward(q, qd, X_des, V_des)


def _require_torques(model: nn.Module, own: tuple[str, ...], learn: Any, effects: Any) -> None:
    """Raise unless a module returns torques of motions, and neither names to learn nor effects are given beside it."""
    if isinstance(model, RobotModule) and not isinstance(model, InverseDynamics):
        raise ArgumentError(
            f"robot must be a torchdq.Robot or a module that returns torques of motions, an InverseDynamics or a "
            f"ResidualDynamics, found a {type(model).__name__}; its attribute `robot` is a robot"
        )
    if learn:
        known = " and ".join(map(repr, own))
        raise ArgumentError(f"learn must be among {known} for a module, which learns by itself, found {learn!r}")
    if effects:
        raise ArgumentError("friction must be True or False for a module, which has its own; give it to the module")
