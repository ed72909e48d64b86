"""Scales of a network for residual torques, and the bounds within which it acts."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor, nn

from torchdq.errors import ArgumentError
from torchdq.layers.residual.smooth import BEYOND, limited, smooth_step

CHANGED = 2  # features of a joint that depend on its acceleration: the last ones, qdd and the model's torque
SLOWLY = 4.0  # least width of the gate's fall with the model's torque, in units of the bound: its slope is below a half


class Gate(NamedTuple):
    """Scales and bounds of a network's features [..., n, features] and torques [..., n], in float64.

    Scaled features are [..., groups, features of a group]: a group is a joint, or all joints joint by joint.
    """

    mean: Tensor  # [n, features]
    spread: Tensor  # [n, features]
    middle: Tensor  # [n, features], centre of the trained range, scaled
    range: Tensor  # [n, features], half the width of that range
    torque_scale: Tensor  # [n], unit of the network's outputs [N m or N]
    largest: Tensor  # [n], largest residual while training [N m or N]
    weight: Tensor  # [n], from 0 to 1
    joined: bool  # whether one network sees all joints

    @property
    def room(self) -> Tensor:
        """Scaled torque [n] past its range over which the gate falls to zero."""
        return self.range[:, -1].maximum(SLOWLY * BEYOND * self.largest / self.spread[:, -1])

    def scaled(self, features: Tensor, like: Tensor) -> Tensor:
        """Features in the units of the network, and in the dtype of `like`, [..., groups, features of a group]."""
        x = ((features - self.mean.to(features)) / self.spread.to(features)).to(like.dtype)
        return x.flatten(-2).unsqueeze(-2) if self.joined else x

    def of_state(self, x: Tensor) -> Tensor:
        """Scaled features [..., groups, features] that the acceleration does not change."""
        return self._by_joint(x)[..., :-CHANGED].flatten(-2)

    def of_torque(self, x: Tensor) -> Tensor:
        """Torques [..., n] of the model among the scaled features."""
        return self._by_joint(x)[..., -1].flatten(-2)

    def within_range(self, x: Tensor) -> Tensor:
        """Scaled features as those at the edge of the range trained on, where they are beyond it."""
        middle, width = (y.to(x).reshape(x.shape[-2:]) for y in (self.middle, self.range))
        return middle + limited(x - middle, width)

    def past_torque(self, z: Tensor) -> Tensor:
        """How far scaled torques [..., n] of the model are past their range: zero there, one where the gate is zero."""
        return ((z - self.middle[:, -1].to(z)).abs() - self.range[:, -1].to(z)) / self.room.to(z)

    def factor(self, z: Tensor) -> Tensor:
        """Factors [..., n] of the residual at scaled torques of the model: one in their range, zero far beyond it."""
        return 1 - smooth_step(self.past_torque(z))

    def torques(self, x: Tensor, network: nn.Module) -> Tensor:
        """Torques [..., n] of a network without any limit, for scaled features within their range."""
        x = x.squeeze(-2) if self.joined else x
        found = network(x)
        expected = (*x.shape[:-1], len(self.weight) if self.joined else 1)
        if found.shape != expected:
            raise ArgumentError(
                f"network must return the shape {tuple(expected)} for inputs of the shape {tuple(x.shape)}, found "
                f"{tuple(found.shape)}"
            )
        found = found if self.joined else found.squeeze(-1)
        return found * self.torque_scale.to(found)

    def _by_joint(self, x: Tensor) -> Tensor:
        """Scaled features [..., groups, joints of a group, features of a joint]."""
        return x.unflatten(-1, (-1, self.mean.shape[-1]))
