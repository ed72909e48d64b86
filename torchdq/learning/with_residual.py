"""Identified robot with a residual network, for friction that depends on the motion before.

A layer computes torques from one state, so it takes friction with a memory as that of steady sliding. A network added
to the layer cannot learn the difference, because it does not see the motion before, either. Here the identified robot
predicts with its memory, and the network adds what is left.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchdq.effects import Effect, Residual
from torchdq.errors import ArgumentError
from torchdq.layers.residual import ResidualDynamics
from torchdq.learning.identification.identified import Identified, Prediction, recorded
from torchdq.learning.logs.motions import Motion, require_torques
from torchdq.learning.logs.samples import Samples
from torchdq.robot import Robot


@dataclass(frozen=True, eq=False)
class IdentifiedWithResidual:
    """Identified robot with a network for the residual torques, in predictions and in scenes.

        tau = identified.predict(motions) + network(q, qd)

    Train the network on `samples`: their torques are without what `identified.predict` knows and the layer cannot, the
    memory of friction, and what the filter of a log does to the steps of dry friction.

    Args:
        identified: from `identify`.
        residual: network around `identified.layer()`.

    Raises:
        ArgumentError: the layer of the residual is that of another robot.

    >>> import torch, torchdq
    >>> from torchdq import effects
    >>> from torchdq.learning import Model, Samples, fit, identify
    >>> robot, (q, qd, qdd) = torchdq.robots.load("two_link"), torch.randn(3, 300, 2, dtype=torch.float64)
    >>> tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 0.5 * q[..., :1].sin() * q[..., 1:].cos()
    >>> plain = Model(friction=(effects.Viscous(), effects.Coulomb()))
    >>> found = identify(robot, Samples(q, qd, qdd, tau), plain, prior=1.0)
    >>> whole = IdentifiedWithResidual(found, torchdq.ResidualDynamics(found.layer(), hidden=(8,)))
    >>> history = fit(whole.residual, whole.samples(q, qd, qdd, tau), steps=20)
    >>> whole.predict(q, qd, qdd).tau.shape
    torch.Size([300, 2])
    """

    identified: Identified
    residual: ResidualDynamics

    def __post_init__(self) -> None:
        found, network = self.identified, self.residual
        if not (isinstance(found, Identified) and isinstance(network, ResidualDynamics)):
            raise ArgumentError(
                "identified must be what identify returns, and residual a ResidualDynamics(identified.layer()), found "
                f"{type(found).__name__} and {type(network).__name__}"
            )
        pairs = [(getattr(found.robot, name), getattr(network.robot, name)) for name in ("mass", "com", "inertia")]
        if not all(a.shape == b.shape and torch.equal(a, b.to(a)) for a, b in pairs):
            raise ArgumentError("residual must be around identified.layer(), found one around another robot")

    @property
    def robot(self) -> Robot:
        """Identified robot."""
        return self.identified.robot

    @torch.no_grad()
    def samples(
        self,
        motions: Motion | Sequence[Motion] | Tensor,
        qd: Tensor | None = None,
        qdd: Tensor | None = None,
        tau: Tensor | None = None,
    ) -> Samples:
        """Samples to train the network on: measured torques without what only `identified.predict` knows.

        Args:
            motions: motions from `smooth`, whose rows follow each other; or joint positions [..., n] [rad or m], as in
                `Identified.predict`.
            qd, qdd, tau: joint velocities [rad/s or m/s], accelerations [rad/s^2 or m/s^2] and measured torques [N m or
                N], [..., n], with positions; torques in the unit of the identification, where gains were estimated.

        Raises:
            ArgumentError: there are no torques, or efforts of unknown gains that were not identified.
        """
        gains, several = self.identified.gains, [motions] if isinstance(motions, Motion) else motions
        _, rows = recorded(self.robot, motions, qd, qdd, tau=tau)
        if gains is None and not isinstance(several, Tensor):
            require_torques(several)
        measured = rows.measured if gains is None else rows.measured * gains.value.to(rows.measured)
        known = self.identified.predict(motions, qd, qdd).tau.reshape(rows.q.shape)
        steady = self.residual.model(rows.q, rows.qd, rows.qdd)
        return Samples(rows.q, rows.qd, rows.qdd, measured - (known - steady))

    @torch.no_grad()
    def predict(
        self, motions: Motion | Sequence[Motion] | Tensor, qd: Tensor | None = None, qdd: Tensor | None = None
    ) -> Prediction:
        """Torques [..., n] of the identified robot and the network, standard errors, and 95 % intervals.

        Errors and intervals are those of `Identified.predict`, in the trained states smaller by as much as the network
        lowered the error on held-out rows.

        Args:
            motions, qd, qdd: as in `Identified.predict`.
        """
        _, rows = recorded(self.robot, motions, qd, qdd)
        found = self.identified.predict(motions, qd, qdd)
        added, factor = (
            f(rows.q, rows.qd).reshape(found.tau.shape) for f in (self.residual.residual, self.residual.narrowing)
        )
        tau = found.tau + added
        low, high = (tau + factor * (end - found.tau) for end in (found.low, found.high))
        return Prediction(tau, factor * found.error, low, high)

    def effects(self) -> tuple[Effect, ...]:
        """Effects of a scene with `robot`: gravity, rotor inertia, friction with its memory, and the network.

        The offset that was found is among them, as a part of the network's torques.
        """
        return (*self.identified.effects(), Residual(self.residual))
