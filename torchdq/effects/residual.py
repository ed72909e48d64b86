"""Learned residual torques as a joint effect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

from torch import Tensor, nn

from torchdq.base.checks import require_tensor
from torchdq.dynamics.posed import Row
from torchdq.effects.effect import Inputs
from torchdq.effects.joint import Impedance, JointEffect
from torchdq.errors import ArgumentError
from torchdq.functions.parametric import TENSOR
from torchdq.robot import Robot

NAME = "residual"  # row of the torques in the programs of a scene


@dataclass(frozen=True)
class Residual(JointEffect):
    """Learned residual torques: the opposite of the torque that a model predicts beyond rigid bodies.

        tau = -r(q, qd)

    torch evaluates the model once per step, in the state at its start. Its torque is held over the step and all
    substeps, for every integrator, like a commanded torque. So the simulation is of first order in `dt`, and a torque
    that changes fast, such as stiff friction, needs short steps: use `Viscous` and `Coulomb` for friction, which are
    integrated implicitly. Gradients flow to the model's parameters and to the state.

    Args:
        model: a `torchdq.ResidualDynamics`, of which network and learned offset act; its `effects()` are this one and
            those of its physics. Or a function or module of (q, qd) that returns torques [..., n]; a module computes in
            the dtype of its parameters.

    >>> import torch, torchdq
    >>> from torchdq import Scene, effects
    >>> scene = Scene(
    ...     torchdq.robots.load("two_link"), (effects.Residual(lambda q, qd: 0.1 * qd),)
    ... )
    >>> scene.step(scene.start(torch.zeros(3, 2), torch.ones(3, 2))).qd.shape
    torch.Size([3, 2])
    """

    ONCE: ClassVar[str] = "their torques are one row; give a function that adds them"
    model: Any

    def described(self, robot: Robot) -> Self:
        """The effect; raises if its model does not return torques of the robot's joints."""
        has_robot = isinstance(getattr(self.model, "robot", None), Robot)
        if isinstance(self.model, type) or not callable(self.model) or (has_robot and not self._has_physics):
            raise ArgumentError(
                f"model of Residual must be a torchdq.ResidualDynamics, or a function or module of (q, qd) that "
                f"returns torques [..., n], found {_named(self.model)}"
                + ("; it is a class; call it to make an object" if isinstance(self.model, type) else "")
                + ("; its torques are those of all bodies, make a ResidualDynamics of it" if has_robot else "")
            )
        if has_robot and self.model.robot.n != robot.n:
            raise ArgumentError(
                f"model of Residual must have the {robot.n} joints of robot {robot.name!r}, found {self.model.robot.n}"
            )
        return self

    @property
    def _has_physics(self) -> bool:
        """True for a `ResidualDynamics`, whose physics are other effects."""
        return callable(getattr(self.model, "unmodelled", None))

    def template(self) -> Self:
        """Copy without the model, because programs do not depend on it."""
        return replace(self, model=TENSOR)

    def computed(self, n: int) -> dict[str, int]:
        """The torques [n]."""
        return {NAME: n}

    def outside(self) -> str:
        """Description of the model, with the size of its network."""
        kind, model = "function", self.model
        if isinstance(model, nn.Module):
            network: Any = model.network if self._has_physics else model
            kind = f"network of {sum(x.numel() for x in network.parameters())} numbers in a {type(model).__name__}"
        return f"a {kind}, run by torch once per step, adds to the joint torques of the rigid bodies and other effects"

    def impedances(self, q: Row, qd: Row, inputs: Inputs) -> Sequence[Impedance]:
        """Impedances of a constant force."""
        return [Impedance(force=x) for x in inputs.get(NAME, (0.0,) * len(q))]

    def torques(self, q: Tensor, qd: Tensor) -> Tensor:
        """Torques [..., n] of the model in a state; raises unless they have the shape of the joints."""
        if self._has_physics:
            found = self.model.unmodelled(q, qd)
        elif isinstance(self.model, nn.Module):
            dtype = next(self.model.parameters(), q).dtype
            found = self.model(q.to(dtype), qd.to(dtype))
            found = found.to(q.dtype) if isinstance(found, Tensor) else found
        else:
            found = self.model(q, qd)
        require_tensor("what model of Residual returns", found)
        if found.shape[-1:] != q.shape[-1:] or found.ndim < q.ndim:
            raise ArgumentError(
                f"model of Residual must return torques of the shape {tuple(q.shape)} for positions of that shape, "
                f"found {tuple(found.shape)}"
            )
        return found


def _named(model: Any) -> str:
    """Name of a model in an error."""
    return repr(model) if isinstance(model, type | Tensor) or not isinstance(model, nn.Module) else type(model).__name__
