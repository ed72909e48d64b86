"""Rigid-body dynamics with a network that learns the residual torques."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NoReturn, get_args

import torch
from torch import Tensor, nn

from torchdq.base.checks import require_choice, require_count
from torchdq.dynamics.friction import smooth_sign
from torchdq.effects import Effect, Gravity, Residual, RotorInertia
from torchdq.errors import ArgumentError
from torchdq.functional import mass_matrix
from torchdq.layers.dynamics import InverseDynamics
from torchdq.layers.residual.domain import OPEN, Domain
from torchdq.layers.residual.gate import CHANGED, Gate
from torchdq.layers.residual.networks import Joined, Perceptrons, perceptrons
from torchdq.layers.residual.posterior import Posterior, PredictedTorques
from torchdq.layers.residual.recorded import Learned, Prepared
from torchdq.layers.residual.smooth import BEYOND, limited
from torchdq.program.transforms import number
from torchdq.robot import Robot

Grouping = Literal["joint", "all"]
WIDTHS = (1.0, 5.0, 20.0)  # widths of the smooth signs of the velocity, in units of the model's friction width
WITHOUT_LIMIT = 1e30


class ResidualDynamics(nn.Module):
    """Inverse dynamics and a network for the residual: `forward(q, qd, qdd, f_tip, f_ext)` returns tau [..., n].

        tau = model(q, qd, qdd) + weight * gate(x) * limited(network(x))

    The network starts at zero, so that before training the torques are the model's to the last bit. Its features x are,
    of every joint, qd, qd / sqrt(qd^2 + w^2) for w of 1, 5 and 20 of the model's friction widths, qdd, and the model's
    own torque, on which friction depends; through the last no gradient flows. With the positions as well it would learn
    the places it has seen, and be wrong at others.

    Call `standardise` with the training data before training, and train by `torchdq.learning.fit`, so that

    * features beyond the range trained on are as those at its edge;
    * the gate falls from one to exactly zero, where the model is left alone, away from the trained states (`Domain`),
      and where the model's torque is beyond its range. The first does not look at accelerations, the second falls so
      slowly that the whole torque still rises with the model's: otherwise a torque would have several accelerations,
      and a simulation would jump between them;
    * no residual is larger than `bound`, 1.25 times the largest one in the training data, whatever the weights are:
      a controller with a network that went wrong is a controller with a bounded disturbance;
    * the weight of each joint, from 0 to 1, is the one that is best on rows that the network was not trained on;
    * `predict` knows how far measured torques are off.

    Beside an identified robot whose friction remembers, `torchdq.learning.IdentifiedWithResidual` has its memory, too.

    Args:
        model: the dynamics; what it learns is learned along with the network.
        network: a network of your own, taken as it is: from [..., n, 6] to [..., n, 1] if inputs is "joint", from
            [..., 6 n] (joint by joint) to [..., n] if "all". It computes in the dtype of its parameters. None: small
            perceptrons with tanh, in torch's default dtype.
        inputs: "joint": each joint has a network of its own that sees that joint only, which finds friction and gears
            but cannot imitate couplings and generalises the better for it; "all": one network sees all joints.
        hidden: widths of the hidden layers, if network is None.
        position: two more features before the others, sin q and cos q of a joint that turns, q and zero of one that
            slides: for torques that depend on the position, such as those of cables and gears, if the motions are in
            all places that matter.

    Raises:
        ArgumentError: an argument is none of these.

    >>> import torchdq
    >>> layer = ResidualDynamics(InverseDynamics(torchdq.robots.load("panda"), learn=("friction",)))
    >>> layer(*torch.ones(3, 100, 7, dtype=torch.float64)).shape
    torch.Size([100, 7])
    """

    feature_mean: Tensor
    feature_spread: Tensor
    feature_middle: Tensor
    feature_range: Tensor
    torque_scale: Tensor
    largest: Tensor
    weight: Tensor
    turns: Tensor  # [n] bool, of the joints; not learned, so no part of the state

    def __init__(
        self,
        model: InverseDynamics,
        network: nn.Module | None = None,
        inputs: Grouping = "joint",
        hidden: Sequence[int] = (32, 32),
        position: bool = False,
    ):
        super().__init__()
        if not isinstance(model, InverseDynamics):
            raise ArgumentError(
                f"model must be a torchdq.InverseDynamics, found {type(model).__name__}; make one of the robot"
            )
        require_choice("inputs", inputs, get_args(Grouping))
        require_choice("position", position, (True, False))
        for width in hidden:
            require_count("every width in hidden", width)
        n, self.features_of_a_joint = model.robot.n, len(WIDTHS) + (5 if position else 3)
        self.model, self.inputs, self.position = model, inputs, position
        turns = torch.tensor([joint.turns for joint in model.robot.joint_types])
        self.register_buffer("turns", turns, persistent=False)
        groups, features = (n, self.features_of_a_joint) if inputs == "joint" else (1, n * self.features_of_a_joint)
        if network is None:
            network = Perceptrons(n, features, 1, hidden) if inputs == "joint" else Joined(features, n, hidden)
        self.network = network
        inner = perceptrons(network)
        self.domain = Domain(groups, features - CHANGED * (n // groups))
        self.posterior = Posterior(groups, 0 if inner is None else inner.weights[-1].shape[-1], n)
        for name, value in {"mean": 0.0, "spread": 1.0, "middle": 0.0, "range": WITHOUT_LIMIT}.items():
            start = torch.full((n, self.features_of_a_joint), value, dtype=torch.float64)
            self.register_buffer(f"feature_{name}", start)
        for name, value in {"torque_scale": 1.0, "largest": WITHOUT_LIMIT, "weight": 1.0}.items():
            self.register_buffer(name, torch.full((n,), value, dtype=torch.float64))

    @property
    def robot(self) -> Robot:
        """Robot with the model's present parameters."""
        return self.model.robot

    @property
    def bound(self) -> Tensor:
        """Largest size that a residual can have, [n] [N m or N], whatever the weights of the network are."""
        return self.weight * (BEYOND * self.largest)

    def program(self, *wrenches: str, parameters: str = "constants") -> NoReturn:
        """No program, since the network has none; raises `ArgumentError`, which says what has."""
        raise ArgumentError(
            "a ResidualDynamics has no program, because its network is none; export its model by "
            "torchdq.compile(layer.model.program()).export(folder), the network by torch.export or torch.onnx, and add "
            "their torques"
        )

    def prior(self) -> Tensor:
        """Prior of the model, which concerns its physical parameters; see `InverseDynamics.prior`."""
        return self.model.prior()

    def forward(
        self, q: Tensor, qd: Tensor, qdd: Tensor | None = None, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> Tensor:
        """Joint torques [..., n]; see `torchdq.inverse_dynamics`."""
        tau = self.model(q, qd, qdd, f_tip, f_ext)
        return tau + self.correction(self.features(q, qd, qdd, tau))

    def residual(
        self, q: Tensor, qd: Tensor, qdd: Tensor | None = None, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> Tensor:
        """Torques [..., n] that the network adds to those of the model."""
        return self.correction(self.features(q, qd, qdd, self.model(q, qd, qdd, f_tip, f_ext)))

    @torch.no_grad()
    def predict(
        self, q: Tensor, qd: Tensor, qdd: Tensor | None = None, f_tip: Tensor | None = None, f_ext: Tensor | None = None
    ) -> PredictedTorques:
        """Torques [..., n], standard errors of measured ones, and intervals that hold 95 % of those.

        The intervals are as wide as they had to be on rows that the network was not trained on, and widen away from the
        trained states.

        Raises:
            ArgumentError: the errors are not known, because `torchdq.learning.fit` has not trained the network.
        """
        if not self.posterior.measured:
            raise ArgumentError("the errors of this ResidualDynamics are not known; train it by torchdq.learning.fit")
        tau = self.model(q, qd, qdd, f_tip, f_ext)
        scaled = self.scaled(self.features(q, qd, qdd, tau))
        parts = (self.leverage(scaled), self.gate(scaled), self.distance(scaled))
        found = tau + self.of_scaled(scaled).to(tau)
        leverage, gate, distance = (x.double().expand(tau.shape) for x in parts)
        error = self.posterior.errors(leverage, gate, distance, self.weight).to(tau)
        margin = self.posterior.quantile.to(tau) * error
        return PredictedTorques(found, error, found - margin, found + margin)

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
        # the model's torque is linear in qdd, but for friction that depends on the load, whose share is small
        M = mass_matrix(self.robot, q, self.model.backend)
        directions = torch.stack(torch.broadcast_tensors(W, M @ W), -2)
        features, inner = self._columns(q, qd, qdd, tau), perceptrons(self.network)
        x, offset = self.scaled(features), self.model.offset if "offset" in self.model.learn else None
        if inner is None:
            return Learned(self.scales, self.domain, self.network, x, directions, offset)
        return Prepared(self.scales, self.domain, inner, x, directions, offset)

    def effects(self) -> tuple[Effect, ...]:
        """Effects that simulate all that was learned, with `robot`: `Scene(model.robot, model.effects())`.

        Gravity and rotor inertia if the robot has them, the friction of its model, and `torchdq.effects.Residual`.
        Learned masses, friction and so on are as they are now: after an update of the parameters, make the scene again.
        The network itself is always the present one.

        >>> import torchdq
        >>> model = ResidualDynamics(InverseDynamics(torchdq.robots.load("panda"), learn=("friction",)))
        >>> print(*[type(effect).__name__ for effect in model.effects()])
        Gravity Viscous Coulomb Residual
        """
        found: list[Effect] = [] if self.robot.gravity is None else [Gravity()]
        found += [] if self.robot.armature is None else [RotorInertia()]
        return (*found, *self.model.friction, Residual(self))

    def features(self, q: Tensor, qd: Tensor, qdd: Tensor | None, tau: Tensor) -> Tensor:
        """Features of every joint [..., n, 6 or 8], before scaling; tau [..., n] are the torques of the model."""
        return self._columns(q, qd, qdd, tau.detach())

    def _columns(self, q: Tensor, qd: Tensor, qdd: Tensor | None, tau: Tensor) -> Tensor:
        width = self.model.sign_width
        directions = [smooth_sign(qd, number(w * width, qd)) for w in WIDTHS]
        # metres are not angles
        places = (q.sin().where(self.turns, q), q.cos().where(self.turns, 0.0)) if self.position else ()
        columns = (*places, qd, *directions, torch.zeros_like(qd) if qdd is None else qdd, tau)
        return torch.stack(torch.broadcast_tensors(*columns), -1)

    def correction(self, features: Tensor) -> Tensor:
        """Torques [..., n] that are added to those of the model, for features [..., n, 6 or 8]."""
        return self.of_scaled(self.scaled(features)).to(features)

    @property
    def scales(self) -> Gate:
        """Scales of the network, and the bounds within which it acts, as they are now."""
        of_features = self.feature_mean, self.feature_spread, self.feature_middle, self.feature_range
        return Gate(*of_features, self.torque_scale, self.largest, self.weight, joined=self.inputs == "all")

    def scaled(self, features: Tensor) -> Tensor:
        """Features in the units and the dtype of the network, [..., groups, features of a group]."""
        return self.scales.scaled(features, next(self.network.parameters(), features))

    def of_scaled(self, x: Tensor) -> Tensor:
        """`correction` of scaled features, in the dtype of the network."""
        return self.weight.to(x) * self.gate(x) * self.ungated(x, self.network)

    def gate(self, x: Tensor) -> Tensor:
        """Factors [..., n] of the residual for scaled features: one where it was trained, zero far from there."""
        scales = self.scales
        return self.domain(scales.of_state(x)) * scales.factor(scales.of_torque(x))

    def distance(self, x: Tensor) -> Tensor:
        """Distance [..., n] of scaled features from what was trained, in units of the trained size."""
        scales = self.scales
        states = self.domain.squared_distance(scales.of_state(x)).clamp_min(0.0).sqrt() / self.domain.reach.to(x)
        return states + scales.past_torque(scales.of_torque(x)).clamp_min(0.0)

    def ungated(self, x: Tensor, network: nn.Module) -> Tensor:
        """Torques [..., n] of a network for scaled features, limited, as if the gate were open and the weight one."""
        return limited(self.scales.torques(self.scales.within_range(x), network), self.largest.to(x))

    def leverage(self, x: Tensor) -> Tensor:
        """How little the training rows tell the network's last layer, for scaled features; see `Posterior.leverage`."""
        inner = perceptrons(self.network)
        if inner is None:
            return x.new_zeros(x.shape[:-1])
        return self.posterior.leverage(inner.last_hidden(self.scales.within_range(x)))

    @torch.no_grad()
    def standardise(self, q: Tensor, qd: Tensor, qdd: Tensor | None, tau: Tensor) -> None:
        """Scale the network to these motions: features of mean zero and spread one, outputs in units of torque spread.

        The ranges of the features, the bound of the residual and the domain are those of the motions, too. Call it
        once, before training: afterwards it changes what the network computes.

        Args:
            q, qd, qdd: positions, velocities and accelerations, shape [..., n]; qdd may be None.
            tau: measured torques [N m or N], shape [..., n]; their standard deviation becomes the network's unit.

        Raises:
            ArgumentError: there are fewer than two samples.
        """
        described = self.model(q, qd, qdd)
        features = self.features(q, qd, qdd, described)
        features, torques = features.reshape(-1, *features.shape[-2:]), tau.reshape(-1, tau.shape[-1])
        if min(len(features), len(torques)) < 2:
            raise ArgumentError(f"q must have at least two samples, found the shape {tuple(q.shape)}")
        mean = features.mean(0)
        self.feature_mean.copy_(mean)
        self.feature_spread.copy_(_spread(features, mean))
        self.torque_scale.copy_(_spread(torques, torques.mean(0)))
        least, most = ((features - mean) / self.feature_spread.to(features)).aminmax(dim=0)
        self.feature_middle.copy_((least + most) / 2)
        self.feature_range.copy_(((most - least) / 2).clamp_min(1e-3))  # a feature that is constant has some room
        self.cover(self.scaled(features), torques - described.reshape(torques.shape))

    @torch.no_grad()
    def open(self) -> None:
        """Let the network act everywhere with weight one, as while it is trained, until it is measured again."""
        self.domain.reach.fill_(OPEN)
        self.weight.fill_(1.0)

    @torch.no_grad()
    def cover(self, x: Tensor, residuals: Tensor) -> None:
        """Take scaled features [rows, ...] as the trained states, and residuals [rows, n] as those that can be."""
        self.domain.cover(self.scales.of_state(x))
        most = residuals.abs().amax(0)
        self.largest.copy_(torch.where(most > 0, most, WITHOUT_LIMIT))


def _spread(x: Tensor, mean: Tensor) -> Tensor:
    """Standard deviations over samples; one where a column is constant but for rounding, so that dividing is safe."""
    spread = (x - mean).square().mean(0).sqrt()
    return spread.where(spread > 1e-6 * mean.abs(), 1.0)
