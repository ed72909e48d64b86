"""Small perceptrons, several side by side in one product."""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor, nn


class Perceptrons(nn.Module):
    """Several perceptrons of one shape side by side: [..., groups, inputs] to [..., groups, outputs], in one product.

    Hidden layers are hyperbolic tangents. The last layer is zero, and so are the outputs, until it is trained.
    tanh y is computed as 2 s(2 y) - 1 with the logistic function s, which torch computes in a third of the time; its
    factors are those of the products before and after it.

    Args:
        groups: number of perceptrons; each has its own weights and sees its own inputs only.
        inputs, outputs: numbers of inputs and outputs of each.
        hidden: widths of the hidden layers.

    >>> Perceptrons(7, 6, 1)(torch.ones(100, 7, 6)).shape
    torch.Size([100, 7, 1])
    """

    def __init__(self, groups: int, inputs: int, outputs: int, hidden: Sequence[int] = (32, 32)):
        super().__init__()
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for width, following in pairwise([inputs, *hidden, outputs]):
            self.weights.append(nn.Parameter(torch.empty(groups, following, width)))
            self.biases.append(nn.Parameter(torch.empty(groups, following, 1)))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw new weights with the spread of torch's own linear layers; the last layer starts at zero."""
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            bound = 0.0 if k == len(self.weights) - 1 else 1.0 / math.sqrt(weight.shape[-1])
            nn.init.uniform_(weight, -bound, bound)
            nn.init.uniform_(bias, -bound, bound)

    def forward(self, x: Tensor) -> Tensor:
        """Outputs [..., groups, outputs] for inputs x [..., groups, inputs]."""
        y = self._layers(x, len(self.weights))
        return y.permute(2, 0, 1).reshape(*x.shape[:-1], y.shape[1])

    def last_hidden(self, x: Tensor) -> Tensor:
        """Outputs [..., groups, width] of the last hidden layer, of which those of the network are linear."""
        y = self._layers(x, len(self.weights) - 1)
        y = 2 * y.sigmoid() - 1 if len(self.weights) > 1 else y
        return y.permute(2, 0, 1).reshape(*x.shape[:-1], y.shape[1])

    def _layers(self, x: Tensor, layers: int) -> Tensor:
        """Products [groups, width, samples] of so many layers, twice them before a hyperbolic tangent."""
        y = x.reshape(-1, *x.shape[-2:]).permute(1, 2, 0)  # samples last: rows are long
        for k, (weight, bias) in enumerate(zip(list(self.weights)[:layers], list(self.biases)[:layers], strict=True)):
            factor = 1.0 if k == len(self.weights) - 1 else 2.0
            if k:
                bias = bias - weight.sum(-1, keepdim=True)
            y = torch.baddbmm(bias, weight, y.sigmoid_() if k else y, beta=factor, alpha=2 * factor if k else factor)
        return y


class Joined(nn.Sequential):
    """One perceptron that sees the features of all joints: [..., inputs] to [..., outputs]."""

    def __init__(self, inputs: int, outputs: int, hidden: Sequence[int]):
        super().__init__(nn.Unflatten(-1, (1, -1)), Perceptrons(1, inputs, outputs, hidden), nn.Flatten(-2))


def perceptrons(network: Any) -> Perceptrons | None:
    """Perceptrons that a network is made of; None if it is another one."""
    inner = network[1] if type(network) is Joined else network
    return inner if type(inner) is Perceptrons else None
