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
from torchdq.layers.residual import PredictedTorques, ResidualDynamics
from torchdq.learning.evaluation.blocks import MotionRows
from torchdq.learning.identification.identified import Identified, recorded
from torchdq.learning.logs.motions import Motion, require_torques
from torchdq.learning.logs.samples import Samples
from torchdq.robot import Robot

BODIES = ("mass", "com", "inertia")


@dataclass(frozen=True, eq=False)
class IdentifiedWithResidual:
    """Identified robot with a network for the residual torques, in predictions and in scenes.

        tau = identified.predict(motions) + network(q, qd, qdd)

    The network is that of `ResidualDynamics(identified.layer())`. Train it on `samples`: their torques are without what
    `identified.predict` knows and the layer cannot, which is the memory of friction, and what the filter of a log does
    to the steps of dry friction.

    Args:
        identified: from `identify`.
        residual: network around `identified.layer()`, or `identified.layer(learn="offset")`: the offset is all
            that the layer may go on learning.

    Raises:
        ArgumentError: the layer of the residual is another one, or it goes on learning masses or friction.

    >>> import torch, torchdq
    >>> from torchdq import effects
    >>> from torchdq.learning import Model, Samples, fit, identify
    >>> robot, (q, qd, qdd) = torchdq.robots.load("two_link"), torch.randn(3, 300, 2, dtype=torch.float64)
    >>> tau = torchdq.inverse_dynamics(robot, q, qd, qdd) + 0.5 * qd.sin()
    >>> plain = Model(friction=(effects.Viscous(), effects.Coulomb()))
    >>> found = identify(robot, Samples(q, qd, qdd, tau), plain, prior=1.0)
    >>> whole = IdentifiedWithResidual(found, torchdq.ResidualDynamics(found.layer(), hidden=(8,)))
    >>> train = whole.samples(q, qd, qdd, tau)
    >>> whole.residual.standardise(*train)
    >>> history = fit(whole.residual, train, steps=20)
    >>> whole.predict(q, qd, qdd).tau.shape
    torch.Size([300, 2])
    """

    identified: Identified
    residual: ResidualDynamics

    def __post_init__(self) -> None:
        found, network = self.identified, self.residual
        if not isinstance(found, Identified):
            raise ArgumentError(f"identified must be what identify returns, found {type(found).__name__}")
        if not isinstance(network, ResidualDynamics):
            raise ArgumentError(
                f"residual must be a torchdq.ResidualDynamics, found {type(network).__name__}; "
                "ResidualDynamics(identified.layer()) is one"
            )
        learns = [name for name in network.model.learn if name != "offset"]
        if learns:
            raise ArgumentError(
                f"residual must be around identified.layer(), which learns at most the offset, found one that learns "
                f"{learns}: predict would not use what it learned"
            )
        pairs = [(getattr(found.robot, name), getattr(network.robot, name)) for name in BODIES]
        if not all(a.shape == b.shape and torch.equal(a, b.to(a)) for a, b in pairs):
            raise ArgumentError("residual must be around identified.layer(), found one around another robot")

    @property
    def robot(self) -> Robot:
        """Identified robot."""
        return self.identified.robot

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
        return Samples(rows.q, rows.qd, rows.qdd, measured - (known - self._steady(rows)))

    def predict(
        self, motions: Motion | Sequence[Motion] | Tensor, qd: Tensor | None = None, qdd: Tensor | None = None
    ) -> PredictedTorques:
        """Torques [..., n] of the identified robot and the network, standard errors of measured ones, 95 % intervals.

        At joints where the network has no weight, intervals are as wide as those of `Identified.predict`, and errors
        are its errors together with the noise found. At the others both are those of `ResidualDynamics.predict`.

        Args:
            motions, qd, qdd: as in `Identified.predict`.

        Raises:
            ArgumentError: the errors are not known, because `torchdq.learning.fit` has not trained the network.
        """
        found = self.identified
        batch, rows = recorded(self.robot, motions, qd, qdd)
        tau, error, low, high = (x.reshape(rows.q.shape) for x in found.predict(motions, qd, qdd))
        both, steady = self.residual.predict(rows.q, rows.qd, rows.qdd), self._steady(rows)
        added, memory = both.tau - steady, tau - steady  # an offset that was learned is added without a network, too
        alone = PredictedTorques(tau + added, torch.hypot(error, found.noise.to(error)), low + added, high + added)
        both = PredictedTorques(tau + added, both.error, both.low + memory, both.high + memory)
        acts = self.residual.weight > 0
        shown = (torch.where(acts, x, y).reshape(*batch, self.robot.n) for x, y in zip(both, alone, strict=True))
        return PredictedTorques(*shown)

    def effects(self) -> tuple[Effect, ...]:
        """Effects of a scene with `robot`: gravity, rotor inertia, friction with its memory, and the network.

        The offset that was found is among them, as a part of the network's torques.
        """
        return (*self.identified.effects(), Residual(self.residual))

    @torch.no_grad()
    def _steady(self, rows: MotionRows) -> Tensor:
        """Torques [rows, n] of the identified robot as a layer."""
        return self.identified.layer()(rows.q, rows.qd, rows.qdd)
