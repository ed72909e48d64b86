"""Control of a frame as layers: in operational space, and by a spring and a damper."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchdq.backends.call import common_batch
from torchdq.base.checks import require_choice, require_number
from torchdq.functional import forward_dynamics
from torchdq.functions.call import function_of
from torchdq.functions.catalogue import Function
from torchdq.functions.options import axes_of, options_of
from torchdq.functions.task_space_formulas import rows_of
from torchdq.layers.control_module import ControlModule
from torchdq.robot import Robot
from torchdq.robot.robot import constants
from torchdq.task_space import Expressed


class _TaskControl(ControlModule):
    """Law of `torchdq.task_space`, with the torques of a robot or of a module."""

    def __init__(
        self, robot: Any, gains: dict[str, Any], options: tuple[Any, ...], fixed: dict[str, Any], **layer: Any
    ):
        frame, expressed, axes, *marks = options
        chosen = axes_of(axes)
        if fixed["k_null"] is not None:
            require_number("k_null", fixed["k_null"], least=0.0)
        super().__init__(robot, gains, len(rows_of(chosen)), **layer)
        self._chosen = options_of(self.robot, self._function, (frame or "", expressed, chosen, *marks))
        if fixed["q_null"] is not None:
            what = Function(constants(self.robot), self._function, self._chosen)
            common_batch([("q_null", fixed["q_null"], what.axes("q_null"), False)], what.subject())
        for name, x in fixed.items():
            if x is not None:
                self.register_buffer(name, torch.as_tensor(x, dtype=torch.float64))

    def _options(self) -> tuple[str, ...]:
        """The frame, its axes, and marks."""
        return (*self._chosen, *super()._options())

    def _torques(self, given: dict[str, Tensor | None], q: Tensor, qd: Tensor) -> Tensor:
        """Torques of the program, or those of the module at the acceleration that the law gives its rigid bodies."""
        if self._recorded:
            return self._evaluated({"q": q, "qd": qd, **given})[0]
        law = {"q": q, "qd": qd, **given, **{name: x.to(q) for name, x in self._held().items()}}
        tau = function_of(self._function, self.robot, law, self.backend, self._options())[0]
        return self.model(q, qd, forward_dynamics(self.robot, q, qd, tau, backend=self.backend))  # type: ignore[misc]


class OperationalSpaceControl(_TaskControl):
    """Control in operational space as a layer: `forward(q, qd, X_des, V_des, A_des)` returns tau [..., n].

    The torques of `torchdq.operational_space_control`, and friction and offset as in `ComputedTorque`. Those of a
    `ResidualDynamics`, or of another module, are taken at the acceleration that the law gives the rigid bodies.

    Args:
        robot: the robot, or a trained module, as in `ComputedTorque`.
        kp, kd: gains of the error [1/s^2] and of its rate [1/s], numbers or one for each of the axes, shape [m].
        frame, expressed, axes, q_null, k_null, damping, limits: as in the function; limits are those of rigid bodies.
        layer: `learn`, `backend`, `sign_width` and `friction`, as in `ComputedTorque`.

    >>> import torch, torchdq
    >>> controller = torchdq.nn.OperationalSpaceControl(torchdq.robots.load("panda"), kp=100.0, kd=20.0, learn="kp")
    >>> controller(torch.zeros(3, 7), torch.zeros(3, 7), torch.eye(8)[0].expand(3, 8)).shape
    torch.Size([3, 7])
    """

    _function = "operational_space_control"

    def __init__(
        self,
        robot: Robot | nn.Module,
        kp: Tensor | float,
        kd: Tensor | float,
        frame: str | None = None,
        expressed: Expressed = "body",
        axes: str | Sequence[str] = "pose",
        q_null: Tensor | None = None,
        k_null: float = 10.0,
        damping: float | None = 2.0**-8,
        limits: bool = False,
        **layer: Any,
    ):
        if damping is not None:
            require_number("damping", damping, positive=True)
        require_choice("limits", limits, (False, True))
        fixed = {"q_null": q_null, "k_null": None if q_null is None else k_null, "damping": damping}
        options = (frame, expressed, axes, *["limits"] * limits)
        super().__init__(robot, {"kp": kp, "kd": kd}, options, fixed, **layer)

    def forward(
        self, q: Tensor, qd: Tensor, X_des: Tensor, V_des: Tensor | None = None, A_des: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.operational_space_control`."""
        return self._torques({"X_des": X_des, "V_des": V_des, "A_des": A_des}, q, qd)


class CartesianImpedance(_TaskControl):
    """Spring and damper at a frame as a layer: `forward(q, qd, X_des, V_des)` returns tau [..., n].

    The torques of `torchdq.cartesian_impedance`, and friction and offset as in `OperationalSpaceControl`.

    Args:
        robot, layer: as in `OperationalSpaceControl`.
        stiffness, damping: K and D, numbers or one for each of the axes, shape [m].
        frame, expressed, axes, q_null, k_null, coriolis: as in the function; `coriolis=False` makes it passive.
    """

    _function = "cartesian_impedance"

    def __init__(
        self,
        robot: Robot | nn.Module,
        stiffness: Tensor | float,
        damping: Tensor | float,
        frame: str | None = None,
        expressed: Expressed = "world",
        axes: str | Sequence[str] = "pose",
        q_null: Tensor | None = None,
        k_null: float = 10.0,
        coriolis: bool = True,
        **layer: Any,
    ):
        require_choice("coriolis", coriolis, (False, True))
        fixed = {"q_null": q_null, "k_null": None if q_null is None else k_null}
        options = (frame, expressed, axes, *["gravity"] * (not coriolis))
        super().__init__(robot, {"stiffness": stiffness, "damping": damping}, options, fixed, **layer)

    def forward(self, q: Tensor, qd: Tensor, X_des: Tensor, V_des: Tensor | None = None) -> Tensor:
        """Joint torques [..., n]; see `torchdq.cartesian_impedance`."""
        return self._torques({"X_des": X_des, "V_des": V_des}, q, qd)
