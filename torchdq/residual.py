"""Rigid-body dynamics with a network that learns the residual torques."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal, NoReturn, get_args

import torch
from torch import Tensor, nn

from torchdq.checks import require_count
from torchdq.dynamics.friction import smooth_sign
from torchdq.effects import Effect, Gravity, Residual, RotorInertia
from torchdq.errors import ArgumentError
from torchdq.functional import mass_matrix
from torchdq.nn import DQRNEA
from torchdq.program.transforms import load_forward_mode, number
from torchdq.robot import Robot

Grouping = Literal["joint", "all"]
FEATURES = 6  # features per joint: sin q, cos q, qd, qdd, a smooth sign of qd, the model's torque


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
        widths = [inputs, *hidden, outputs]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for k, (width, following) in enumerate(pairwise(widths)):
            # the spread of torch's own linear layers; the last layer starts at zero
            bound = 0.0 if k == len(hidden) else 1.0 / math.sqrt(width)
            self.weights.append(nn.Parameter(torch.empty(groups, following, width).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(groups, following, 1).uniform_(-bound, bound)))

    def forward(self, x: Tensor) -> Tensor:
        """Outputs [..., groups, outputs] for inputs x [..., groups, inputs]."""
        y = x.reshape(-1, *x.shape[-2:]).permute(1, 2, 0)  # samples last: rows are long
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            factor = 1.0 if k == len(self.weights) - 1 else 2.0
            if k:
                bias = bias - weight.sum(-1, keepdim=True)
            y = torch.baddbmm(bias, weight, y.sigmoid_() if k else y, beta=factor, alpha=2 * factor if k else factor)
        return y.permute(2, 0, 1).reshape(*x.shape[:-1], y.shape[1])


class Joined(nn.Sequential):
    """One perceptron that sees the features of all joints: [..., inputs] to [..., outputs]."""

    def __init__(self, inputs: int, outputs: int, hidden: Sequence[int]):
        super().__init__(nn.Unflatten(-1, (1, -1)), Perceptrons(1, inputs, outputs, hidden), nn.Flatten(-2))


class ResidualDynamics(nn.Module):
    """Inverse dynamics and a network for the residual: `forward(q, qd, qdd, f_tip, f_ext)` returns tau [..., n].

    The sum of the model's torques and the network's. The network starts at zero, so that before training the torques
    are the model's to the last bit. It sees, of every joint, sin q, cos q, qd, qdd, qd / sqrt(qd^2 + width^2) with the
    model's friction width, and the model's own torque, on which friction depends; through the last no gradient flows.
    Call `standardise` with the training data before training.

    Args:
        model: the dynamics; what it learns is learned along with the network.
        network: a network of your own, taken as it is: from [..., n, 6] to [..., n, 1] if inputs is "joint", from
            [..., 6 n] (joint by joint) to [..., n] if "all". It computes in the dtype of its parameters. None: small
            perceptrons with tanh, in torch's default dtype.
        inputs: "joint": each joint has a network of its own that sees that joint only, which finds friction and gears
            but cannot imitate couplings and generalises the better for it; "all": one network sees all joints.
        hidden: widths of the hidden layers, if network is None.

    Raises:
        ArgumentError: an argument is none of these.

    >>> import torchdq
    >>> layer = ResidualDynamics(DQRNEA(torchdq.robots.load("panda"), learn="friction"))
    >>> layer(*torch.ones(3, 100, 7, dtype=torch.float64)).shape
    torch.Size([100, 7])
    """

    feature_mean: Tensor
    feature_spread: Tensor
    torque_scale: Tensor

    def __init__(
        self,
        model: DQRNEA,
        network: nn.Module | None = None,
        inputs: Grouping = "joint",
        hidden: Sequence[int] = (32, 32),
    ):
        super().__init__()
        if not isinstance(model, DQRNEA):
            raise ArgumentError(f"model must be a torchdq.DQRNEA, found {type(model).__name__}; make one of the robot")
        if inputs not in get_args(Grouping):
            raise ArgumentError(f"inputs must be one of {get_args(Grouping)}, found {inputs!r}")
        for width in hidden:
            require_count("every width in hidden", width)
        n = model.robot.n
        self.model = model
        self.inputs = inputs
        if network is None and inputs == "joint":
            network = Perceptrons(n, FEATURES, 1, hidden)
        elif network is None:
            network = Joined(FEATURES * n, n, hidden)
        self.network = network
        self.register_buffer("feature_mean", torch.zeros(n, FEATURES, dtype=torch.float64))
        self.register_buffer("feature_spread", torch.ones(n, FEATURES, dtype=torch.float64))
        self.register_buffer("torque_scale", torch.ones(n, dtype=torch.float64))

    @property
    def robot(self) -> Robot:
        """Robot with the model's present parameters."""
        return self.model.robot

    def program(self, *wrenches: str, parameters: str = "constants") -> NoReturn:
        """No program, since the network has none; raises `ArgumentError`, which says what has."""
        raise ArgumentError(
            "a ResidualDynamics has no program, because its network is none; export its model by "
            "torchdq.compile(layer.model.program()).export(folder), the network by torch.export or torch.onnx, and add "
            "their torques"
        )

    def prior(self) -> Tensor:
        """Prior of the model, which concerns its physical parameters; see `torchdq.nn.RobotModule.prior`."""
        return self.model.prior()

    def forward(
        self, q: Tensor, qd: Tensor, qdd: Tensor | None = None, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.inverse_dynamics`."""
        tau, rest = self._parts(q, qd, qdd, f_tip, f_ext)
        return tau + rest

    def residual(
        self, q: Tensor, qd: Tensor, qdd: Tensor | None = None, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> Tensor:
        """Torques [..., n] that the network adds to those of the model."""
        return self._parts(q, qd, qdd, f_tip, f_ext)[1]

    def unmodelled(self, q: Tensor, qd: Tensor, qdd: Tensor | None = None) -> Tensor:
        """Torques [..., n] of the network and of the offset that the model learned: all that is not physics."""
        tau = self.model(q, qd, qdd)
        # where the torque is simulated, its gradient flows through the model as well
        rest = self.correction(self._columns(q, qd, qdd, tau))
        return rest + self.model.offset.to(rest) if "offset" in self.model.learn else rest

    @torch.no_grad()
    def line(self, q: Tensor, qd: Tensor, qdd: Tensor, W: Tensor) -> Learned:
        """Torques as a function of torques r [..., n] that change the acceleration: unmodelled(q, qd, qdd - W r).

        Without gradients, and for little: the model itself is computed once. See `torchdq.effects.Residual`.
        """
        tau = self.model(q, qd, qdd)
        M = mass_matrix(self.robot, q, self.model.backend)  # the model's torque is linear in qdd
        directions = torch.stack(torch.broadcast_tensors(W, M @ W), -2)
        known = type(self.network) in (Perceptrons, Joined)
        return (Prepared if known else Learned)(self, self._columns(q, qd, qdd, tau), directions)

    def effects(self) -> tuple[Effect, ...]:
        """Effects that simulate all that was learned, with `robot`: `Scene(model.robot, model.effects())`.

        Gravity and rotor inertia if the robot has them, the friction of its model, and `torchdq.effects.Residual`.
        Learned masses, friction and so on are as they are now: after an update of the parameters, make the scene anew.
        The network itself is always the present one.

        >>> import torchdq
        >>> model = ResidualDynamics(DQRNEA(torchdq.robots.load("panda"), learn="friction"))
        >>> print(*[type(effect).__name__ for effect in model.effects()])
        Gravity Viscous Coulomb Residual
        """
        robot, inner = self.robot, self.model
        found: list[Effect] = [] if robot.gravity is None else [Gravity()]
        found += [] if robot.armature is None else [RotorInertia()]
        return (*found, *inner.friction, Residual(self))

    def _parts(self, q: Tensor, qd: Tensor, qdd: Tensor | None, *wrenches: Tensor | None) -> tuple[Tensor, Tensor]:
        """Torques of the model, and those of the network."""
        tau = self.model(q, qd, qdd, *wrenches)
        return tau, self.correction(self.features(q, qd, qdd, tau))

    def features(self, q: Tensor, qd: Tensor, qdd: Tensor | None, tau: Tensor) -> Tensor:
        """Features of every joint [..., n, 6], before scaling; tau [..., n] are the torques of the model."""
        return self._columns(q, qd, qdd, tau.detach())

    def _columns(self, q: Tensor, qd: Tensor, qdd: Tensor | None, tau: Tensor) -> Tensor:
        direction = smooth_sign(qd, number(self.model.friction_width, qd))
        columns = (q.sin(), q.cos(), qd, torch.zeros_like(qd) if qdd is None else qdd, direction, tau)
        return torch.stack(torch.broadcast_tensors(*columns), -1)

    def correction(self, features: Tensor) -> Tensor:
        """Torques [..., n] of the network for features [..., n, 6]."""
        x = self._scaled(features)
        found = self.network(x)
        expected = (*features.shape[:-1], 1) if self.inputs == "joint" else features.shape[:-1]
        if found.shape != expected:
            raise ArgumentError(
                f"network must return the shape {tuple(expected)} for inputs of the shape {tuple(x.shape)}, found "
                f"{tuple(found.shape)}"
            )
        found = found.squeeze(-1) if self.inputs == "joint" else found
        return found.to(features.dtype) * self.torque_scale.to(features)

    def _scaled(self, features: Tensor) -> Tensor:
        """Inputs of the network."""
        x = (features - self.feature_mean.to(features)) / self.feature_spread.to(features)
        x = x.to(next(self.network.parameters(), x).dtype)
        return x if self.inputs == "joint" else x.flatten(-2)

    @torch.no_grad()
    def standardise(self, q: Tensor, qd: Tensor, qdd: Tensor | None, tau: Tensor) -> None:
        """Scale the network to these motions: features of mean zero and spread one, outputs in units of torque spread.

        Call it once, before training: afterwards it changes what the network computes.

        Args:
            q, qd, qdd: positions, velocities and accelerations, shape [..., n]; qdd may be None.
            tau: measured torques [N m or N], shape [..., n]; their standard deviation becomes the network's unit.

        Raises:
            ArgumentError: there are fewer than two samples.
        """
        features = self.features(q, qd, qdd, self.model(q, qd, qdd))
        features, torques = features.reshape(-1, *features.shape[-2:]), tau.reshape(-1, tau.shape[-1])
        if min(len(features), len(torques)) < 2:
            raise ArgumentError(f"q must have at least two samples, found the shape {tuple(q.shape)}")
        mean = features.mean(0)
        self.feature_mean.copy_(mean)
        self.feature_spread.copy_(_spread(features, mean))
        self.torque_scale.copy_(_spread(torques, torques.mean(0)))


class Learned:
    """Torques of a `ResidualDynamics` as a function of torques r [..., n], of which its accelerations are linear.

    Args:
        dynamics: the model and the network.
        features: features [..., n, 6] without r.
        directions: what r subtracts from the accelerations and from the model's torques, [..., n, 2, n].
    """

    def __init__(self, dynamics: ResidualDynamics, features: Tensor, directions: Tensor):
        self.dynamics, self.features, self.directions = dynamics, features, directions
        n = features.shape[-2]
        self.one = torch.eye(n, dtype=features.dtype, device=features.device)
        self.offset = dynamics.model.offset.to(features) if "offset" in dynamics.model.learn else None

    def torques(self, r: Tensor) -> Tensor:
        """Torques [..., n]."""
        return self._with_offset(self.dynamics.correction(self._features(r)))

    def linearised(self, r: Tensor) -> tuple[Tensor, Tensor]:
        """Torques [..., n], and J = 1 - their derivatives by r, [..., n, n]."""
        features = self._features(r)
        none = torch.zeros_like(self.directions[..., 0, :])
        columns = (none, none, none, self.directions[..., 0, :], none, self.directions[..., 1, :])
        along = torch.stack(columns, -1).movedim(-2, 0)  # [n, ..., n, 6]

        def changed(direction: Tensor) -> Tensor:
            return torch.func.jvp(self.dynamics.correction, (features,), (direction,))[1]

        if not torch.compiler.is_compiling():
            load_forward_mode()
        # forward mode, because torch refuses reverse mode inside of a checkpoint
        J = self.one + torch.func.vmap(changed)(along).movedim(0, -1)
        return self._with_offset(self.dynamics.correction(features)), J

    def _features(self, r: Tensor) -> Tensor:
        """Features [..., n, 6]."""
        change = (self.directions @ r[..., None, :, None]).squeeze(-1)
        none = torch.zeros_like(change[..., 0])
        return self.features - torch.stack((none, none, none, change[..., 0], none, change[..., 1]), -1)

    def _with_offset(self, torques: Tensor) -> Tensor:
        return torques if self.offset is None else torques + self.offset


class Prepared(Learned):
    """`Learned` of `Perceptrons`: all that r does not change is computed before, derivatives are products backwards."""

    def __init__(self, dynamics: ResidualDynamics, features: Tensor, directions: Tensor):
        super().__init__(dynamics, features, directions)
        network: Any = dynamics.network[1] if isinstance(dynamics.network, Joined) else dynamics.network
        weights, biases = list(network.weights), list(network.biases)
        self.groups, self.dtype = weights[0].shape[0], weights[0].dtype
        self.columns = directions.flatten(-3, -2)  # [..., 2 n, n], joint by joint
        spread = dynamics.feature_spread.to(weights[0]).reshape(self.groups, 1, -1)
        scale = dynamics.torque_scale.to(weights[0]).reshape(self.groups, -1, 1)
        for k, weight in enumerate(weights):
            # tanh y = 2 s(2 y) - 1, as in `Perceptrons`; the torques in N m
            factor = scale if k == len(weights) - 1 else 2.0
            biases[k] = factor * (biases[k] - weight.sum(-1, keepdim=True) if k else biases[k])
            weights[k] = factor * (2 * weight if k else weight)
        x = dynamics._scaled(features).reshape(-1, self.groups, weights[0].shape[-1]).permute(1, 2, 0)
        self.start = torch.baddbmm(biases[0], weights[0], x)  # [groups, width, samples], without r
        self.first = -(weights[0] / spread).unflatten(-1, (-1, FEATURES))[..., 3::2].flatten(-2)
        self.weights, self.biases = weights[1:], biases[1:]

    def torques(self, r: Tensor) -> Tensor:
        """Torques [..., n]."""
        return self._layers(r)[0]

    def linearised(self, r: Tensor) -> tuple[Tensor, Tensor]:
        """Torques [..., n], and J = 1 - their derivatives by r, [..., n, n]."""
        found, hidden = self._layers(r)
        # [groups, width, outputs, samples], from the outputs backwards; the derivative of s is s (1 - s)
        weights = [self.first, *self.weights]
        J = weights.pop().mT.unsqueeze(-1)
        for s in reversed(hidden):
            along = torch.ops.aten.sigmoid_backward(J, s.unsqueeze(2))
            J = (weights.pop().mT @ along.flatten(2)).unflatten(2, along.shape[2:])
        J = J.permute(3, 0, 2, 1).to(r.dtype)  # [samples, groups, outputs, changes]
        if self.groups > 1 or r.shape[-1] == 1:  # a joint's torque depends on the features of this joint only
            J = J.squeeze(2).expand(r.shape[:-1].numel(), -1, -1).reshape(*r.shape, 2, 1)
            by = torch.addcmul(self.one, J[..., 0, :], self.directions[..., 0, :], value=-1)
            return found, by.addcmul(J[..., 1, :], self.directions[..., 1, :], value=-1)
        J = J.squeeze(1).expand(r.shape[:-1].numel(), -1, -1).reshape(*r.shape, -1)
        return found, self.one - J @ self.columns

    def _layers(self, r: Tensor) -> tuple[Tensor, list[Tensor]]:
        """Torques [..., n], and the logistic functions of the hidden layers [groups, width, samples]."""
        change = (self.columns @ r.unsqueeze(-1)).reshape(-1, self.groups, self.first.shape[-1]).permute(1, 2, 0)
        y, hidden = torch.baddbmm(self.start, self.first, change.to(self.dtype)), []
        for weight, bias in zip(self.weights, self.biases, strict=True):
            hidden.append(y.sigmoid_())
            y = torch.baddbmm(bias, weight, y)
        return self._with_offset(y.flatten(0, 1).mT.reshape(r.shape).to(r.dtype)), hidden


def _spread(x: Tensor, mean: Tensor) -> Tensor:
    """Standard deviations over samples; one where a column is constant but for rounding, so that dividing is safe."""
    spread = (x - mean).square().mean(0).sqrt()
    return spread.where(spread > 1e-6 * mean.abs(), 1.0)
