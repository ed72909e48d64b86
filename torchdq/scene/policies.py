"""Policies that are recorded with the steps of a rollout: torques as formulas of rows, whose tensors are arguments."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from torchdq.algebra import dual_quaternion as dq
from torchdq.algebra.quaternion import Number
from torchdq.base.checks import require_tensor
from torchdq.dq import Pose, pose_error
from torchdq.dynamics.posed import Row, dot
from torchdq.errors import ArgumentError
from torchdq.numbers.functions import below, clip, exp, maximum, minimum, select, sqrt, tanh
from torchdq.scene.free_base import POSE, TWIST, as_pose
from torchdq.scene.spec import ORDER, POSES
from torchdq.scene.state import State

__all__ = ["Linear", "Network"]

TOGETHER = 8  # outputs of a layer whose sums stay in registers while the inputs are read once
STEPPED = ("gain of the policy", "torque of the policy", "state of the policy")
LIMITS = ("lower", "upper")


@dataclass(frozen=True, eq=False)
class Linear:
    """Policy of gains that differ from step to step: tau_k = torque_k + gain_k (s_k - state_k), within limits.

    The numbers of s are (q, qd), then memory and reading where a scene has them. Of a floating base they are (X_WB, q,
    V_WB_B, qd), and the difference of poses is a displacement xi of six numbers, as in a `Linearization`. Called as
    `policy(state, k)` it returns the torques of step k, those in a rollout but for rounding.

    Args:
        gain: gains K, shape [steps, ..., n, s], s the size of a displacement.
        torque: torques where the state is the expected one [N m or N], shape [steps, ..., n].
        state: expected states, shape [steps, ..., s], of a floating base with 8 numbers for the pose.
        limits: smallest and largest torques [N m or N], each of shape [..., n]; None: there are none.
        control: input that all of these are: "torque", or "target" of a `Servo` [rad or m].

    >>> import torch, torchdq
    >>> from torchdq.scene import policies
    >>> scene = torchdq.Scene(torchdq.robots.load("two_link"))
    >>> hold = policies.Linear(-torch.ones(50, 2, 4), torch.zeros(50, 2), torch.zeros(50, 4))
    >>> scene.rollout(scene.start(torch.ones(3, 2)), policy=hold).q.shape
    torch.Size([50, 3, 2])
    """

    gain: Tensor
    torque: Tensor
    state: Tensor
    limits: tuple[Tensor, Tensor] | None = None
    control: str = "torque"

    def __post_init__(self) -> None:
        for name, axes in {"gain": 3, "torque": 2, "state": 2}.items():
            require_tensor(name, x := getattr(self, name))
            if x.ndim < axes:
                shape = "[steps, ..., n, s]" if axes == 3 else "[steps, ...]"
                raise ArgumentError(f"{name} of Linear must have the shape {shape}, found {tuple(x.shape)}")

    def __call__(self, state: State, k: int) -> Tensor:
        """Torques of step k, shape [..., n]."""
        return self.at(state.rows(), k)

    def at(self, rows: Mapping[str, Tensor], k: int) -> Tensor:
        """Torques of step k, of rows of the state and inputs by name."""
        names = [name for name in ORDER if name in rows]
        expected = self.state[k].split([rows[name].shape[-1] for name in names], -1)
        error = torch.cat([apart(name, rows[name], x) for name, x in zip(names, expected, strict=True)], -1)
        found = self.torque[k] + (self.gain[k] @ error[..., None])[..., 0]
        return found if self.limits is None else found.clamp(*self.limits)

    @property
    def form(self) -> LinearForm:
        """Formula, without the tensors."""
        return LinearForm(self.limits is not None, self.control)

    def stepped(self) -> dict[str, Tensor]:
        """Tensors of every step, by the names of their arguments."""
        return dict(zip(STEPPED, (self.gain, self.torque, self.state), strict=True))

    def weights(self) -> dict[str, Tensor]:
        """Tensors that are the same at all steps: the limits."""
        return {} if self.limits is None else dict(zip(LIMITS, self.limits, strict=True))


def displacement(name: str, row: Row, of: Row) -> Row:
    """Displacement of a row of a state from another, of poses the twists xi of X = X_of exp(xi/2)."""
    if name not in POSES:
        return [a - b for a, b in zip(row, of, strict=True)]
    found: list[Number] = []
    for k in range(0, len(row), POSE):
        angular, linear = pose_error.error(dq.mul(dq.conj(as_pose(of[k : k + POSE])), as_pose(row[k : k + POSE])))
        found += [*angular, *linear]
    return found


def apart(name: str, x: Tensor, of: Tensor) -> Tensor:
    """Displacement of a row of a state from another, as tensors."""
    if name not in POSES:
        return x - of
    X, expected = (Pose(y.unflatten(-1, (-1, POSE))) for y in (x, of))
    return (expected.inverse() @ X).log().flatten(-2)


@dataclass(frozen=True)
class LinearForm:
    """Formula of `Linear`."""

    limits: bool = False
    control: str = "torque"

    def axes(self, n: int, widths: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Trailing axes of the tensors, by name, of states with these widths."""
        names = [name for name in ORDER if name in widths]
        s = sum([widths[name] for name in names])
        moved = sum([widths[name] * TWIST // POSE if name in POSES else widths[name] for name in names])
        found = dict(zip(STEPPED, ((n, moved), (n,), (s,)), strict=True))
        return found | (dict.fromkeys(LIMITS, (n,)) if self.limits else {})

    def torques(self, rows: Mapping[str, Row], weights: Mapping[str, Row]) -> Row:
        """Torques of rows of the state."""
        gain, torque, state = (rows[name] for name in STEPPED)
        error, at = list[Number](), 0
        for name in ORDER:
            row = rows.get(name, ())
            error += displacement(name, row, state[at : at + len(row)])
            at += len(row)
        s = len(error)
        found = [t + dot(gain[i * s : (i + 1) * s], error) for i, t in enumerate(torque)]
        return (
            [clip(*of) for of in zip(found, *map(weights.__getitem__, LIMITS), strict=True)] if self.limits else found
        )


@dataclass(frozen=True, eq=False)
class Network:
    """Policy that is a network of rows of the state and the inputs; its weights get gradients.

    They are cast to the dtype of the state, as all parameters are.

    Called as `policy(state, k)` it returns the torques of a state, without the inputs of a step; those in a rollout are
    the same but for rounding.

    Args:
        network: `torch.nn.Sequential` of Linear, Tanh, ReLU, ELU and LayerNorm; it takes the rows, joined, and returns
            torques [..., n].
        inputs: names of rows of the state, as in `State`, and of inputs of a step.

    >>> import torch, torchdq
    >>> from torchdq.scene import policies
    >>> scene = torchdq.Scene(torchdq.robots.load("two_link"))
    >>> layers = torch.nn.Linear(4, 16), torch.nn.Tanh(), torch.nn.Linear(16, 2)
    >>> policy = policies.Network(torch.nn.Sequential(*layers))
    >>> states = scene.rollout(scene.start(torch.ones(3, 2)), steps=50, policy=policy)
    >>> states.q.square().mean().backward()
    >>> layers[0].weight.grad.shape
    torch.Size([16, 4])
    """

    network: nn.Sequential
    inputs: Sequence[str] = ("q", "qd")
    control: ClassVar[str] = "torque"

    def __post_init__(self) -> None:
        if not isinstance(self.network, nn.Sequential):
            raise ArgumentError(f"network must be a torch.nn.Sequential, found {type(self.network).__name__}")
        if isinstance(self.inputs, str) or not all(isinstance(name, str) for name in self.inputs):
            raise ArgumentError(f"inputs must be names of rows, such as ('q', 'qd'), found {self.inputs!r}")
        _ = self.form  # raises

    def __call__(self, state: State, k: int) -> Tensor:
        """Torques of a state, shape [..., n]."""
        return self.at(state.rows(), k)

    def at(self, rows: Mapping[str, Tensor], k: int) -> Tensor:
        """Torques of rows of the state and inputs by name."""
        for name in self.inputs:
            if name not in rows:
                raise ArgumentError(f"inputs of Network must be among {', '.join(rows)}, found {name!r}")
        x = torch.cat([rows[name] for name in self.inputs], -1)
        own = {name: w.to(x.dtype) for name, w in self.weights().items()}
        return torch.func.functional_call(self.network, own, (x,), tie_weights=False)

    @property
    def form(self) -> NetworkForm:
        """Formula, without the tensors."""
        layers = []
        for name, layer in self.network.named_modules(remove_duplicate=False):
            hooked = layer._forward_hooks or layer._forward_pre_hooks or "forward" in vars(layer)
            if type(layer) in FORMULAS and not hooked:
                axes = {key: tuple(x.shape) for key, x in layer.named_parameters()}
                number = getattr(layer, NUMBERS.get(type(layer), ""), 0.0)
                layers.append(Layer(type(layer), name, tuple(axes.items()), number))
            elif type(layer) is not nn.Sequential or hooked:
                known = ", ".join(kind.__name__ for kind in FORMULAS)
                raise ArgumentError(
                    f"layers of Network must be {known}, found {type(layer).__name__}"
                    f"{' with hooks' if hooked else ''}; a function of the state and the "
                    f"number of the step may be anything, policy=lambda state, k: ..., and is called at every step"
                )
        return NetworkForm(tuple(self.inputs), tuple(layers))

    def recorded(self, row: Row, weights: Mapping[str, Row]) -> Row:
        """Outputs for a row of numbers of any kind, with the rows of the weights by name."""
        return self.form.recorded(row, weights)

    def stepped(self) -> dict[str, Tensor]:
        """Tensors of every step: none."""
        return {}

    def weights(self) -> dict[str, Tensor]:
        """Weights by name, as `named_parameters` has them."""
        return dict(self.network.named_parameters(remove_duplicate=False))


@dataclass(frozen=True)
class NetworkForm:
    """Formula of `Network`."""

    inputs: tuple[str, ...]
    layers: tuple[Layer, ...]
    control: ClassVar[str] = "torque"

    def axes(self, n: int, widths: Mapping[str, int]) -> dict[str, tuple[int, ...]]:
        """Trailing axes of the weights, by name."""
        return {f"{layer.name}.{name}": axes for layer in self.layers for name, axes in layer.axes}

    def torques(self, rows: Mapping[str, Row], weights: Mapping[str, Row]) -> Row:
        """Torques of rows of the state and inputs."""
        return self.recorded([x for name in self.inputs for x in rows[name]], weights)

    def recorded(self, row: Row, weights: Mapping[str, Row]) -> Row:
        """Outputs for a row of numbers."""
        for layer in self.layers:
            own = {name: weights[f"{layer.name}.{name}"] for name, _ in layer.axes}
            if layer.takes not in (None, len(row)):
                raise ArgumentError(
                    f"layer {layer.name!r} of Network takes {layer.takes} numbers, found {len(row)}, of {self.inputs}"
                )
            row = FORMULAS[layer.kind](row, layer.number, **own)
        return row


class Layer(NamedTuple):
    """Layer of a network."""

    kind: type[nn.Module]
    name: str
    axes: tuple[tuple[str, tuple[int, ...]], ...]  # of its weights
    number: float  # alpha of ELU, eps of LayerNorm

    @property
    def takes(self) -> int | None:
        """Number of its inputs; None: any."""
        return self.axes[0][1][-1] if self.axes else None


def _affine(x: Row, _: float, weight: Row, bias: Row = ()) -> Row:
    rows, found = [weight[k : k + len(x)] for k in range(0, len(weight), len(x))], list[Number]()
    for k in range(0, len(rows), TOGETHER):
        sums: Row = [0.0] * len(rows[k : k + TOGETHER])
        for v, *weights in zip(x, *rows[k : k + TOGETHER], strict=True):
            sums = [s + v * w for s, w in zip(sums, weights, strict=True)]
        found += sums
    return [y + b for y, b in zip(found, bias, strict=True)] if bias else found


def _normalised(x: Row, eps: float, weight: Row = (), bias: Row = ()) -> Row:
    mean = sum(x, 0.0) / len(x)
    centred = [v - mean for v in x]
    scale = 1.0 / sqrt(dot(centred, centred) / len(x) + eps)
    found = [v * scale for v in centred]
    found = [y * w for y, w in zip(found, weight, strict=True)] if weight else found
    return [y + b for y, b in zip(found, bias, strict=True)] if bias else found


FORMULAS: dict[type[nn.Module], Callable[..., Row]] = {
    nn.Linear: _affine,
    nn.Tanh: lambda x, _: [tanh(v) for v in x],
    nn.ReLU: lambda x, _: [maximum(0.0, v) for v in x],
    nn.ELU: lambda x, alpha: [select(below(v, 0.0), alpha * (exp(minimum(v, 0.0)) - 1.0), v) for v in x],
    nn.LayerNorm: _normalised,
}
NUMBERS: dict[type[nn.Module], str] = {nn.ELU: "alpha", nn.LayerNorm: "eps"}
