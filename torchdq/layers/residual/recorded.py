"""Learned torques as a function of torques that change the acceleration, for `torchdq.effects.Residual`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from torchdq.layers.residual.domain import Domain
from torchdq.layers.residual.gate import Gate
from torchdq.layers.residual.networks import Perceptrons
from torchdq.layers.residual.smooth import limit_slope, limited, step_slope
from torchdq.program.transforms import load_forward_mode


class Learned:
    """Torques of a `ResidualDynamics` as a function of torques r [..., n], of which its accelerations are linear.

    Of every joint's features, r changes the last two: its acceleration and the model's torque.

    Args:
        scales, domain, network: of the `ResidualDynamics`.
        x: scaled features [..., groups, features] without r.
        directions: what r subtracts from the accelerations and from the model's torques, [..., n, 2, n].
        offset: learned offset [n] of the model; None: none.
    """

    def __init__(
        self, scales: Gate, domain: Domain, network: Any, x: Tensor, directions: Tensor, offset: Tensor | None
    ):
        self.scales, self.network, (n, self.size) = scales, network, scales.mean.shape
        self.one = torch.eye(n, dtype=directions.dtype, device=directions.device)
        self.offset = None if offset is None else offset.to(directions)
        self.largest = scales.largest.to(x)
        self.factor = scales.weight.to(x) * domain(scales.of_state(x))  # [..., n], which r does not change
        of_features = (scales.spread, scales.middle, scales.range)
        spread, self.middle, self.range = (self._last(y.to(x).reshape(x.shape[-2:])) for y in of_features)
        # features that r does not change, as the network sees them, and those that it does
        self.still, self.moving = self._first(scales.within_range(x)), self._last(x)
        # what r subtracts from those, [..., groups, changes, n]
        self.columns = directions.to(x).reshape(*directions.shape[:-3], *spread.shape, n) / spread.unsqueeze(-1)

    def torques(self, r: Tensor) -> Tensor:
        """Torques [..., n]."""
        moved = self._moved(r)
        gate = self.scales.factor(self._torque(moved))
        return self._with_offset((self.factor * gate * limited(self._network(moved), self.largest)).to(r))

    def linearised(self, r: Tensor) -> tuple[Tensor, Tensor]:
        """Torques [..., n], and J = 1 - their derivatives by r, [..., n, n]."""
        moved = self._moved(r)
        bent = limit_slope(moved - self.middle, self.range)
        y, change = self._linearised(moved, bent.unsqueeze(-1) * self.columns)
        found, z = limited(y, self.largest), self._torque(moved)
        gate, past = self.scales.factor(z), self.scales.past_torque(z)
        slope = -step_slope(past) / self.scales.room.to(z) * (z - self._torque(self.middle)).sign()
        fading = slope.unsqueeze(-1) * self.columns[..., 1::2, :].flatten(-3, -2)  # [..., n, n]
        change = (gate * limit_slope(y, self.largest)).unsqueeze(-1) * change + found.unsqueeze(-1) * fading
        J = self.one + (self.factor.unsqueeze(-1) * change).to(r)
        return self._with_offset((self.factor * gate * found).to(r)), J

    def _network(self, moved: Tensor) -> Tensor:
        """Torques [..., n] of the network without limit."""
        return self._outputs(self._within_range(moved))

    def _linearised(self, moved: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
        """`_network`, and how it changes along directions [..., groups, changes, n] of the features, [..., n, n]."""
        inside = self._within_range(moved)

        def changed(direction: Tensor) -> Tensor:
            return torch.func.jvp(self._outputs, (inside,), (direction,))[1]

        if not torch.compiler.is_compiling():
            load_forward_mode()
        # forward mode, because torch refuses reverse mode inside of a checkpoint
        return self._outputs(inside), torch.func.vmap(changed)(along.movedim(-1, 0)).movedim(0, -1)

    def _outputs(self, inside: Tensor) -> Tensor:
        """Torques [..., n] of the network for features that r changes, within their range."""
        joints = (inside.shape[-1] // 2, -1)
        x = torch.cat([part.unflatten(-1, joints) for part in (self.still, inside)], -1)
        return self.scales.torques(x.flatten(-2), self.network)

    def _moved(self, r: Tensor) -> Tensor:
        """Features [..., groups, changes] that r changes, scaled."""
        return self.moving - (self.columns @ r.to(self.columns)[..., None, :, None]).squeeze(-1)

    def _within_range(self, moved: Tensor) -> Tensor:
        """Features that r changes, as the network sees them."""
        return self.middle + limited(moved - self.middle, self.range)

    def _first(self, x: Tensor) -> Tensor:
        """Of the features in the last axis those of every joint that r does not change."""
        return x.unflatten(-1, (-1, self.size))[..., :-2].flatten(-2)

    def _last(self, x: Tensor) -> Tensor:
        """Of the features in the last axis those of every joint that r changes."""
        return x.unflatten(-1, (-1, self.size))[..., -2:].flatten(-2)

    def _torque(self, moved: Tensor) -> Tensor:
        """Torques [..., n] of the model among the features that r changes."""
        return moved[..., 1::2].flatten(-2)

    def _with_offset(self, torques: Tensor) -> Tensor:
        return torques if self.offset is None else torques + self.offset


class Prepared(Learned):
    """`Learned` of `Perceptrons`: all that r does not change is computed before, derivatives are products backwards."""

    def __init__(
        self, scales: Gate, domain: Domain, network: Perceptrons, x: Tensor, directions: Tensor, offset: Tensor | None
    ):
        super().__init__(scales, domain, network, x, directions, offset)
        weights, biases = list(network.weights), list(network.biases)
        self.groups, self.n = weights[0].shape[0], len(scales.weight)
        scale = scales.torque_scale.to(weights[0]).reshape(self.groups, -1, 1)
        for k, weight in enumerate(weights):
            # tanh y = 2 s(2 y) - 1, as in `Perceptrons`; the torques in N m
            factor = scale if k == len(weights) - 1 else 2.0
            biases[k] = factor * (biases[k] - weight.sum(-1, keepdim=True) if k else biases[k])
            weights[k] = factor * (2 * weight if k else weight)
        self.start = torch.baddbmm(biases[0], self._first(weights[0]), _samples_last(self.still))
        self.first, self.weights, self.biases = self._last(weights[0]), weights[1:], biases[1:]

    def _network(self, moved: Tensor) -> Tensor:
        """Torques [..., n] of the network without limit."""
        return self._layers(moved)[0]

    def _linearised(self, moved: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
        """`_network`, and how it changes along directions [..., groups, changes, n] of the features, [..., n, n]."""
        found, hidden = self._layers(moved)
        # [groups, width, outputs, samples], from the outputs backwards; the derivative of s is s (1 - s)
        weights = [self.first, *self.weights]
        J = weights.pop().mT.unsqueeze(-1)
        for s in reversed(hidden):
            backwards = torch.ops.aten.sigmoid_backward(J, s.unsqueeze(2))
            J = (weights.pop().mT @ backwards.flatten(2)).unflatten(2, backwards.shape[2:])
        J = J.permute(3, 0, 2, 1)  # [samples, groups, outputs, changes]
        J = J.expand(found.shape[:-1].numel(), -1, -1, -1).reshape(*found.shape[:-1], *J.shape[1:])
        return found, (J @ along).flatten(-3, -2)

    def _layers(self, moved: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Torques [..., n] without limit, and the logistic functions of the hidden layers [groups, width, samples]."""
        y, hidden = torch.baddbmm(self.start, self.first, _samples_last(self._within_range(moved))), []
        for weight, bias in zip(self.weights, self.biases, strict=True):
            hidden.append(y.sigmoid_())
            y = torch.baddbmm(bias, weight, y)
        return y.flatten(0, 1).mT.reshape(*moved.shape[:-2], self.n), hidden


def _samples_last(x: Tensor) -> Tensor:
    """Rows [groups, features, samples] of features [..., groups, features]."""
    return x.reshape(-1, *x.shape[-2:]).permute(1, 2, 0)
