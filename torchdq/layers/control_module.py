"""Base of controllers as layers: the robot or module whose torques they take, and their gains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from torchdq.backends.choice import BackendName
from torchdq.effects.friction import Friction
from torchdq.errors import ArgumentError
from torchdq.layers.dynamics import InverseDynamics
from torchdq.layers.layer_friction import described
from torchdq.layers.layer_program import CONTROL
from torchdq.layers.robot_module import RobotModule
from torchdq.robot import Robot
from torchdq.robot.argument import require_robot


class ControlModule(RobotModule):
    """Controller of a robot, or of a trained module; see `ComputedTorque` for the arguments.

    `gains` are numbers, or rows of as many numbers as `number` says; None: one for every joint.
    """

    def __init__(
        self,
        robot: Robot | nn.Module,
        gains: Mapping[str, Tensor | float],
        number: int | None = None,
        learn: Sequence[str] = (),
        backend: BackendName | None = None,
        sign_width: float = 1e-2,
        friction: bool | Sequence[Friction] = True,
    ):
        model = robot if isinstance(robot, nn.Module) and isinstance(getattr(robot, "robot", None), Robot) else None
        names = (learn,) if isinstance(learn, str) else learn
        others = [name for name in names if name not in tuple(gains)] if isinstance(names, Sequence) else learn
        effects = () if isinstance(friction, bool) else friction
        known = require_robot(robot if model is None else model.robot)
        if model is not None:
            _require_torques(model, tuple(gains), learn if others else (), effects)
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
        self._gains = tuple(gains)
        for name, value in gains.items():
            x = gain_of(name, value, known.n if number is None else number).clone()
            if name in names:
                self.register_parameter(name, nn.Parameter(x))
            else:
                self.register_buffer(name, x)

    @property
    def robot(self) -> Robot:
        """Robot with the present parameters of the module or of its model."""
        return self._present() if self.model is None else self.model.robot  # type: ignore[return-value]

    def _own_quantities(self) -> tuple[dict[str, Tensor], list[str]]:
        """Parameters of its program that are not the robot's, its model's or its own, and names of the learned."""
        if not (self.model is None or isinstance(self.model, InverseDynamics)):
            raise ArgumentError(
                f"model of {type(self).__name__} must be a robot or an InverseDynamics for a program, found a "
                f"{type(self.model).__name__}, whose network has no program; export the controller of its `robot`, and "
                "the network by torch.export or torch.onnx"
            )
        own, learned = super()._own_quantities() if self.model is None else self.model._own_quantities()
        return {**own, **self._held()}, [*learned, *[name for name in self._gains if name in self._parameters]]

    def _held(self) -> dict[str, Tensor]:
        """Gains, and what else the law has."""
        return {name: getattr(self, name) for name in CONTROL if name in self._parameters or name in self._buffers}

    def _coefficients(self) -> dict[str, Tensor]:
        """Friction that is learned by itself or by its model, by quantity."""
        owner = self if self.model is None else self.model
        return {name: getattr(owner, name) for name in self._friction.learned}

    @property
    def _recorded(self) -> bool:
        """Whether its torques are one program; a layer of one's own that derives from `InverseDynamics` may differ."""
        return self.model is None or getattr(type(self.model), "forward", None) is InverseDynamics.forward

    def _options(self) -> tuple[str, ...]:
        """Gains that are one number."""
        return tuple([name for name in self._gains if not getattr(self, name).ndim])


def _require_torques(model: nn.Module, gains: tuple[str, ...], learn: Any, effects: Any) -> None:
    """Raise unless a module returns torques of motions, and neither names to learn nor effects are given beside it."""
    if isinstance(model, RobotModule) and not isinstance(model, InverseDynamics):
        raise ArgumentError(
            f"robot must be a torchdq.Robot or a module that returns torques of motions, an InverseDynamics or a "
            f"ResidualDynamics, found a {type(model).__name__}; its attribute `robot` is a robot"
        )
    if learn:
        known = " and ".join(map(repr, gains))
        raise ArgumentError(f"learn must be among {known} for a module, which learns by itself, found {learn!r}")
    if effects:
        raise ArgumentError("friction must be True or False for a module, which has its own; give it to the module")


def gain_of(name: str, gain: Any, n: int) -> Tensor:
    """Gain as float64 numbers, one or n; raises unless they are real, finite and not negative."""
    with suppress(TypeError, ValueError):  # words, and rows of different lengths
        x = gain if isinstance(gain, Tensor) else torch.from_numpy(np.array(gain))
        real = x.dtype != torch.bool and not x.is_complex()
        if real and x.shape in ((), (n,)) and bool((x.isfinite() & (x >= 0)).all()):
            return x.double()
    raise ArgumentError(f"{name} must be a finite non-negative number or {n} of them, found {gain!r}")
