"""Rigid-body dynamics with a network for the residual torques, which acts only near the states it was trained on."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Literal, NoReturn, get_args

import torch
from torch import Tensor, nn

from torchdq.base.checks import require_choice, require_count
from torchdq.dynamics.friction import smooth_sign
from torchdq.effects import Effect, Gravity, Residual, RotorInertia
from torchdq.errors import ArgumentError
from torchdq.layers.dynamics import InverseDynamics
from torchdq.program.transforms import number
from torchdq.robot import Robot

WIDTHS = (1.0, 5.0, 20.0)  # widths of the smooth signs of the velocity, in units of the model's friction width
STATE = 3  # features of a joint that tell how far it is from its trained states: two of position, one of velocity
FEATURES = STATE + len(WIDTHS)  # of a joint
BEYOND = 1.25  # bound of the residual, in units of the largest one in the training data
CENTRES = 48  # trained states that stand for all of them
NOWHERE = 1e15  # place of a centre that is not needed; its square is a number in float32
LEAST = 0.25  # least reach of a centre, per root of the number of standardised features
Inputs = Literal["joint", "all"]


class ResidualDynamics(nn.Module):
    """Inverse dynamics and a network for the residual: `forward(q, qd, qdd, f_tip, f_ext)` returns tau [..., n].

        tau = model(q, qd, qdd, f_tip, f_ext) + weight * gate(x) * bound * tanh(network(x))

    The network is for torques of the state that no term of the model has, such as those of cables; masses, rotors and
    friction are found better by `torchdq.learning.identify`. Of each joint, the features x are sin q and cos q (q and
    zero where a joint slides), qd, and qd / sqrt(qd^2 + w^2) for w of 1, 5 and 20 of the model's friction widths. It
    starts at zero, so that before training the torques are the model's to the last bit.

    `torchdq.learning.fit` trains the network on top of the model, which stays as it is, and validates it on held-out
    rows, so that

    * the gate falls from one to exactly zero away from the training states, with two continuous derivatives;
    * no residual is larger than `bound`, 1.25 times the largest one in the training data, whatever the weights are:
      for a controller, a network that failed to train is a bounded disturbance;
    * a joint where it does not help has the weight zero.

    Around the layer of an identified robot, train it on what `Identified.predict` leaves, so that friction keeps its
    memory: predictions are the sum of both, with errors times `narrowing`.

    Args:
        model: the dynamics.
        network: a network of your own, from standardised features [..., 6 n], joint by joint, to torques [..., n] in
            units of `bound`. It computes in the dtype of its parameters. None: a small perceptron with tanh, in torch's
            default dtype.
        inputs: "joint": every joint has a network and training states of its own, so that few motions show all that it
            needs; "all": one network sees all joints, for torques that depend on several, and acts only where all
            joints together have been.
        hidden: widths of the hidden layers, if network is None.

    Raises:
        ArgumentError: model is no `InverseDynamics`, inputs is unknown, or a width is not a positive integer.

    >>> import torchdq
    >>> layer = ResidualDynamics(InverseDynamics(torchdq.robots.load("panda")))
    >>> layer(*torch.ones(3, 100, 7, dtype=torch.float64)).shape
    torch.Size([100, 7])
    """

    mean: Tensor  # [n, features]
    spread: Tensor  # [n, features]
    centres: Tensor  # [groups, centres, features] trained states
    reach: Tensor  # [groups] distance from a centre up to which the gate is one
    bound: Tensor  # [n] [N m or N]
    weight: Tensor  # [n], from 0 to 1
    remaining: Tensor  # [n], error with the network over that without on held-out rows, where it was trained
    turns: Tensor  # [n] bool, of the joints; not learned, so no part of the state

    def __init__(
        self,
        model: InverseDynamics,
        network: nn.Module | None = None,
        inputs: Inputs = "joint",
        hidden: Sequence[int] = (32, 32),
    ):
        super().__init__()
        if not isinstance(model, InverseDynamics):
            raise ArgumentError(
                f"model must be a torchdq.InverseDynamics, found {type(model).__name__}; make one from the robot"
            )
        require_choice("inputs", inputs, get_args(Inputs))
        for width in hidden:
            require_count("every width in hidden", width)
        n = model.robot.n
        self.model, self.groups = model, n if inputs == "joint" else 1
        self.network = _perceptron(self.groups, (FEATURES * n, *hidden, n)) if network is None else network
        states = {"mean": (n, FEATURES), "centres": (self.groups, CENTRES, STATE * n // self.groups)}
        ones = {"spread": (n, FEATURES), **dict.fromkeys(("bound", "weight", "remaining"), (n,))}
        for name, shape in states.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))
        for name, shape in ones.items():
            self.register_buffer(name, torch.ones(shape, dtype=torch.float64))
        self.register_buffer("reach", torch.full((self.groups,), 1e30, dtype=torch.float64))
        turns = torch.tensor([joint.turns for joint in model.robot.joint_types])
        self.register_buffer("turns", turns, persistent=False)

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

    def forward(
        self, q: Tensor, qd: Tensor, qdd: Tensor | None = None, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.inverse_dynamics`."""
        return self.model(q, qd, qdd, f_tip, f_ext) + self.residual(q, qd)

    def residual(self, q: Tensor, qd: Tensor) -> Tensor:
        """Torques [..., n] that the network adds to those of the model."""
        x = self.features(q, qd)
        return (self.weight.to(x) * self.gate(x) * self.ungated(x)).to(q)

    def unmodelled(self, q: Tensor, qd: Tensor) -> Tensor:
        """Torques [..., n] that no effect simulates: those of the network, and an offset that the model has."""
        rest = self.residual(q, qd)
        return rest + self.model.offset.to(rest) if "offset" in self.model.learn else rest

    @torch.no_grad()
    def narrowing(self, q: Tensor, qd: Tensor) -> Tensor:
        """Standard errors [..., n] with the network, in units of those without: `remaining` where it was trained."""
        gate = self.gate(self.features(q, qd)).to(self.remaining)
        return (1 + gate * (self.remaining.square() - 1)).sqrt()  # squared errors are mixed

    def effects(self) -> tuple[Effect, ...]:
        """Effects that simulate all of it, with `robot`: `Scene(model.robot, model.effects())`.

        Gravity and rotor inertia if the robot has them, the friction of its model, and `torchdq.effects.Residual`.
        Learned masses and friction are as they are now: after an update of the parameters, make the scene again. The
        network itself is always the present one.

        >>> import torchdq
        >>> model = ResidualDynamics(
        ...     InverseDynamics(torchdq.robots.load("panda"), learn=("friction",))
        ... )
        >>> print(*[type(effect).__name__ for effect in model.effects()])
        Gravity Viscous Coulomb Residual
        """
        found: list[Effect] = [] if self.robot.gravity is None else [Gravity()]
        found += [] if self.robot.armature is None else [RotorInertia()]
        return (*found, *self.model.friction, Residual(self))

    @torch.no_grad()
    def standardise(self, q: Tensor, qd: Tensor, qdd: Tensor | None, tau: Tensor) -> None:
        """Fit the normalisation, the training states and the bound to these motions.

        `torchdq.learning.fit` does so; call it before training with an optimiser of your own. Afterwards it changes
        what the network computes.

        Args:
            q, qd, qdd: positions, velocities and accelerations, shape [..., n]; qdd may be None.
            tau: measured torques [N m or N], shape [..., n].

        Raises:
            ArgumentError: there are fewer than two samples.
        """
        columns = self._columns(*torch.atleast_2d(q, qd)).flatten(0, -3)
        if len(columns) < 2:
            raise ArgumentError(f"q must have at least two samples, found the shape {tuple(q.shape)}")
        spread, mean = torch.std_mean(columns, 0, correction=0)
        self.mean.copy_(mean)
        self.spread.copy_(spread.where(spread > 1e-6 * mean.abs(), 1.0))  # 1 where constant but for rounding
        largest = (tau - self.model(q, qd, qdd)).abs().flatten(0, -2).amax(0)
        self.bound.copy_(BEYOND * largest.where(largest > 0, 1.0))
        self.cover(self.features(q, qd).flatten(0, -2))

    @torch.no_grad()
    def cover(self, x: Tensor) -> None:
        """Choose the centres of the gate among the states of features [rows, 6 n], whose gate is one from then on.

        The first one is the row nearest to the mean, each further one the row farthest from those before it.
        """
        x, group = self._states(x).to(self.centres), torch.arange(self.groups, device=x.device)
        left, chosen = torch.full_like(x[..., 0], torch.inf), (x - x.mean(0)).square().sum(-1).argmin(0)
        least = LEAST * x.shape[-1] ** 0.5
        for k in range(CENTRES):  # a centre more where there are rows beyond the reach of all others
            self.centres[:, k] = x[chosen, group].where((left.amax(0) > least**2)[:, None], NOWHERE)
            left = left.minimum((x - self.centres[:, k]).square().sum(-1))
            chosen = left.argmax(0)
        self.reach.copy_(left.amax(0).sqrt().clamp_min(least) * (1 + 1e-6))  # rounding moves no row out

    def features(self, q: Tensor, qd: Tensor) -> Tensor:
        """Standardised features [..., 6 n] of states, joint by joint, in the dtype of the network."""
        x = self._columns(q, qd)
        x = (x - self.mean.to(x)) / self.spread.to(x)
        return x.flatten(-2).to(next(self.network.parameters(), x).dtype)

    def gate(self, x: Tensor) -> Tensor:
        """Factors [..., n or 1] of the residual for features: one where it was trained, zero far from there.

        That is 1 - prod_k (1 - b(d_k)) of the distances d_k to the centres in units of the reach, where b falls from
        one at d = 1 to zero at d = 2 along a polynomial of d^2.
        """
        away = self._states(x).unsqueeze(-2) - self.centres.to(x)
        squared = away.square().sum(-1) / self.reach.to(x).square()[:, None]
        t = ((squared - 1) / 3).clamp(0.0, 1.0)
        return 1 - (t * t * t * (10 + t * (6 * t - 15))).prod(-1)

    def ungated(self, x: Tensor) -> Tensor:
        """Torques [..., n] of the network for features, bounded, as if the gate were open and the weight one."""
        found, expected = self.network(x), (*x.shape[:-1], len(self.bound))
        if found.shape != expected:
            raise ArgumentError(
                f"network must return the shape {expected} for inputs of the shape {tuple(x.shape)}, found "
                f"{tuple(found.shape)}"
            )
        return self.bound.to(found) * found.tanh()

    def _columns(self, q: Tensor, qd: Tensor) -> Tensor:
        """Features [..., n, 6] before scaling."""
        signs = [smooth_sign(qd, number(w * self.model.sign_width, qd)) for w in WIDTHS]
        places = (q.sin().where(self.turns, q), q.cos().where(self.turns, 0.0))  # metres are not angles
        return torch.stack(torch.broadcast_tensors(*places, qd, *signs), -1)

    def _states(self, x: Tensor) -> Tensor:
        """Features [..., groups, features] that tell how far a state is from those that were trained."""
        return x.unflatten(-1, (self.groups, -1, FEATURES))[..., :STATE].flatten(-2)


class GroupedLinear(nn.Module):
    """Linear layer for each group: [..., groups, inputs] to [..., groups, outputs]."""

    def __init__(self, groups: int, inputs: int, outputs: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(groups, outputs, inputs))
        self.bias = nn.Parameter(torch.empty(groups, outputs))
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Draw weights as `torch.nn.Linear` does."""
        for parameter in (self.weight, self.bias):
            nn.init.uniform_(parameter, -(self.weight.shape[-1] ** -0.5), self.weight.shape[-1] ** -0.5)

    def forward(self, x: Tensor) -> Tensor:
        """Outputs [..., groups, outputs]."""
        return (self.weight @ x.unsqueeze(-1)).squeeze(-1) + self.bias


def _perceptron(groups: int, widths: Sequence[int]) -> nn.Sequential:
    """Layers with tanh between them, from and to numbers that the groups share evenly; the last is zero at first."""
    shared = (widths[0] // groups, *widths[1:-1], widths[-1] // groups)
    layers = [GroupedLinear(groups, width, following) for width, following in pairwise(shared)]
    for parameter in layers[-1].parameters():
        nn.init.zeros_(parameter)
    inner = [part for layer in layers for part in (layer, nn.Tanh())][:-1]
    return nn.Sequential(nn.Unflatten(-1, (groups, shared[0])), *inner, nn.Flatten(-2))
