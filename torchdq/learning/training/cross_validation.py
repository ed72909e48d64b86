"""Cross-validation of a residual network: copies of it are trained without some rows, and predict those.

The rows are held out in blocks (`blocks`), and the blocks in a few groups; for each group a copy of the network, with
new weights, is trained on the other rows for as many steps. The physical model stays as it is. A motion that repeats
itself shows a copy the states of its block in another part, so where there are fewer than three motions, regions of the
states are held out, too (`regions`). The predictions for held-out rows decide how far the network is trusted
(`validation_gain`). With validation samples, on which the network was not trained, no copies are needed.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchdq.base.progress import Progress
from torchdq.layers.residual import ResidualDynamics
from torchdq.layers.residual.domain import Domain
from torchdq.layers.residual.networks import perceptrons
from torchdq.layers.residual.posterior import Posterior
from torchdq.learning.evaluation.blocks import MotionRows, blocks, regions
from torchdq.learning.evaluation.correlation import correlation_times
from torchdq.learning.logs.samples import Samples, torque_variance
from torchdq.learning.training.loop import Optimiser, Training, learned, seeded
from torchdq.learning.training.validation_gain import HeldOut, ValidationGain, validation_gain

GROUPS = 5  # groups of blocks, each held out from one copy of the network
ROWS = 4096  # rows that are computed at a time


def cross_validation(
    model: ResidualDynamics, train: Samples, lengths: Sequence[int], valid: Samples | None, training: Training
) -> ValidationGain:
    """Gain of a trained residual on held-out rows; its domain, bound, weights and errors are set from it.

    It was trained on the rows `train` of motions of these lengths, with an open gate and weights one; `valid` are rows
    that it was not trained on, and None has blocks of `train` held out.
    """
    was_training = model.training
    model.eval()
    try:
        x, residual = _inputs_and_residuals(model, train)
        correlation = correlation_times(residual, lengths).to(residual)
        own = _Copy(model, model.network, model.domain, model.posterior)
        with torch.no_grad():
            model.cover(x, residual)
            own.learn_posterior(x, residual, correlation)
        regional: list[HeldOut] = []
        if valid is None:
            copies = _Copies(model, x, residual, torque_variance(train.tau).to(x), correlation, training)
            with Progress("measuring the residual on held-out rows") as progress:
                held_out, regional = copies.predictions(_motion_rows(train, lengths), progress)
        else:
            x, residual = _inputs_and_residuals(model, valid)
            parts = blocks(_motion_rows(valid, (len(valid.q),)))
            held_out = [own.predictions(x[block.rows], residual[block.rows]) for block in parts]
        with torch.no_grad():
            return validation_gain(model, held_out, regional, torque_variance(train.tau).double())
    finally:
        model.train(was_training)


def with_fixed_physics(model: ResidualDynamics, train: Samples) -> Callable[[Tensor], Tensor]:
    """Torques of rows of `train` as a function of the rows, with those of the physical model computed here."""
    x, residual = _inputs_and_residuals(model, train)
    physical = train.tau - residual.to(train.tau)
    return lambda rows: physical[rows] + model.of_scaled(x[rows]).to(physical)


def _inputs_and_residuals(model: ResidualDynamics, samples: Samples) -> tuple[Tensor, Tensor]:
    """Scaled features [rows, groups, features] of the network, and torques [rows, n] that the model leaves."""
    features, residuals = [], []
    with torch.no_grad():
        for q, qd, qdd, tau in zip(*(x.split(ROWS) for x in samples), strict=True):
            physical = model.model(q, qd, qdd)
            features.append(model.scaled(model.features(q, qd, qdd, physical)))
            residuals.append((tau - physical).double())
    return torch.cat(features), torch.cat(residuals)


def _motion_rows(samples: Samples, lengths: Sequence[int]) -> MotionRows:
    q, qd, qdd, tau = (x.double() for x in samples)
    return MotionRows(q, qd, qdd, tuple(lengths), tau)


def _by_parts(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Values of a function of rows, as float64."""
    return torch.cat([function(part).double() for part in x.split(ROWS)])


@dataclass(frozen=True)
class _Copy:
    """Network, with the domain and the posterior of the rows that it was trained on."""

    model: ResidualDynamics
    network: nn.Module
    domain: Domain
    posterior: Posterior

    def learn_posterior(self, x: Tensor, residual: Tensor, correlation: Tensor) -> None:
        """Set the posterior of the last layer from training rows; nothing if the layer is not known."""
        inner = perceptrons(self.network)
        if inner is None:
            return
        left = _by_parts(lambda x: self.model.ungated(x, self.network), x) - residual
        last, scale = inner.weights[-1].detach().double(), self.model.torque_scale
        spread = last.square().mean(-1).reshape(-1) * scale.to(last).square()  # variance of a weight
        ridge = (left.square().mean(0) * correlation) / spread.clamp_min(1e-12 * float(scale.max()) ** 2)
        hidden = _by_parts(lambda x: inner.last_hidden(self.model.scales.within_range(x)), x)
        self.posterior.learn(hidden, ridge.reshape(len(self.posterior.root), -1).mean(1))

    @torch.no_grad()
    def predictions(self, x: Tensor, residual: Tensor) -> HeldOut:
        """Torques for rows that it was not trained on, and how far these are from those that it was trained on."""
        model, inner = self.model, perceptrons(self.network)
        torque = _by_parts(lambda x: model.ungated(x, self.network), x)
        distance = _by_parts(lambda x: self.domain.squared_distance(model.scales.of_state(x)), x)
        past = _by_parts(lambda x: model.scales.past_torque(model.scales.of_torque(x)), x)
        leverage = torch.zeros_like(distance)
        if inner is not None:
            leverage = _by_parts(lambda x: self.posterior.leverage(inner.last_hidden(model.scales.within_range(x))), x)
        return HeldOut(torque, residual, distance, past, leverage)


@dataclass(frozen=True)
class _Copies:
    """Copies of the network of a model, trained on some of the rows."""

    model: ResidualDynamics
    x: Tensor  # [rows, groups, features]
    residual: Tensor  # [rows, n]
    variance: Tensor  # [n] of the torques
    correlation: Tensor  # [n]
    training: Training

    def predictions(self, motions: MotionRows, progress: Progress) -> tuple[list[HeldOut], list[HeldOut]]:
        """Predictions for blocks, in the order of time, and for regions, by copies trained without those."""
        found = blocks(motions)
        halves = [half.cpu() for pair in regions(motions) for half in pair] if found else []
        groups = min(GROUPS, len(found))

        def say(number: int) -> Callable[[str], None]:
            return progress.within(f"network {number + 1} of {groups + len(halves)}")

        held_out: dict[int, HeldOut] = {}
        for k in range(groups):
            unused = [rows for block in found[k::GROUPS] for rows in (block.rows, *block.margins)]
            trained = self._trained_without(unused, k, say(k))
            for block in found[k::GROUPS]:
                held_out[block.rows.start] = trained.predictions(self.x[block.rows], self.residual[block.rows])
        regional = []
        for k, half in enumerate(halves):
            trained = self._trained_without([half], GROUPS + k, say(groups + k))
            regional.append(trained.predictions(self.x[half], self.residual[half]))
        return [held_out[start] for start in sorted(held_out)], regional

    def _trained_without(self, unused: Sequence[slice | Tensor], number: int, say: Callable[[str], None]) -> _Copy:
        """Copy with new weights, trained on the other rows; its seed follows from its number."""
        used = torch.ones(len(self.x), dtype=torch.bool)
        for rows in unused:
            used[rows] = False
        seen = used.nonzero()[:, 0].to(self.x.device)
        model, training = self.model, self.training._replace(seed=self.training.seed + number)
        network, target = copy.deepcopy(model.network).train(), self.residual.to(self.x)

        def error(rows: Tensor) -> Tensor:
            return ((model.ungated(self.x[rows], network) - target[rows]).square() / self.variance).mean()

        with seeded(self.x.device, training.seed), torch.enable_grad():
            for part in network.modules():
                if callable(reset := getattr(part, "reset_parameters", None)):
                    reset()
            optimiser = Optimiser(learned(network), training)
            while optimiser.step < training.steps:
                optimiser.epoch(seen, error, say)
        trained = _Copy(model, network.eval(), copy.deepcopy(model.domain), copy.deepcopy(model.posterior))
        with torch.no_grad():
            trained.domain.cover(model.scales.of_state(self.x[seen]))
            trained.learn_posterior(self.x[seen], self.residual[seen], self.correlation)
        return trained
