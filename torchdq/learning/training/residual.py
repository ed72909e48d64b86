"""Training of a residual network on top of physics that stay as they are, and its cross-validation.

Rows are held out in blocks (`blocks`), and the blocks in a few groups; for each group a copy of the network, with new
weights, is trained on the other rows for as many steps. A motion that repeats itself shows a copy the states of its
block in another part, so where there are fewer than three motions, regions of the states are held out, too (`regions`).
The torques for held-out rows decide how far the network is trusted (`validation_gain`).
"""

import copy
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from torchdq.base.progress import Progress
from torchdq.layers.residual import ResidualDynamics
from torchdq.learning.evaluation.blocks import MotionRows, blocks, regions
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.samples import Samples, torque_variance
from torchdq.learning.training.loop import History, Training, by_parts, descend, seeded
from torchdq.learning.training.validation_gain import HeldOut, validation_gain

GROUPS = 5  # groups of blocks, each held out from one copy of the network


def fit_residual(
    model: ResidualDynamics,
    train: Samples,
    lengths: Sequence[int],
    valid: Samples | None,
    training: Training,
    progress: Progress,
) -> History:
    """History of the network of a model, trained on the rows `train` of motions of these lengths, and measured."""
    model.standardise(*train)
    variance = torque_variance(train.tau).double()
    trainer = _Trainer(model, _residuals(model, train), variance, training)
    if valid is None:
        history = trainer.train(model.network, progress.at)
        held_out, regional = trainer.cross_validated(_motions(train, lengths), progress)
    else:
        rows = _residuals(model, valid)
        history = trainer.train(model.network, progress.at, valid=rows)
        found = blocks(_motions(valid, (len(valid.q),)))
        held_out, regional = _predicted(model, model.network, model.domain, rows, [block.rows for block in found]), []
    gain = validation_gain(model, held_out, regional, variance)
    if poor := [name for name, weight in zip(gain.joints, gain.weight.tolist(), strict=True) if not weight]:
        warnings.warn(
            f"the residual network has no weight at {', '.join(poor)}: on held-out rows the squared error does not "
            "fall by more than two standard errors, or the rows are too few to know; record more and other motions, or "
            "go without a network there",
            LogWarning,
            stacklevel=3,
        )
    return replace(history, residual=gain)


@dataclass(frozen=True)
class _Trainer:
    """Training of networks on the residuals of a model."""

    model: ResidualDynamics
    rows: tuple[Tensor, Tensor]  # features and residuals
    variance: Tensor  # [n] of the torques
    training: Training

    def train(
        self,
        network: nn.Module,
        say: Callable[[str], None],
        used: Tensor | slice = slice(None),
        valid: tuple[Tensor, Tensor] | None = None,
    ) -> History:
        """History of a network that is trained on the rows `used`."""
        x, residual = (y[used] for y in self.rows)
        torques = partial(self.model.ungated, network=network)
        return descend(network, torques, (x, residual), valid, self.variance.to(x), self.training, say)

    def cross_validated(self, motions: MotionRows, progress: Progress) -> tuple[list[HeldOut], list[HeldOut]]:
        """Torques for blocks and for regions, of copies that were trained without those."""
        found = blocks(motions)
        groups = [found[k::GROUPS] for k in range(min(GROUPS, len(found)))]
        # rows that a copy predicts, and further ones that it is not trained on, either
        parts: list[tuple[list[Any], list[Any]]] = [
            ([block.rows for block in group], [rows for block in group for rows in block.margins]) for group in groups
        ]
        if found and len(motions.lengths) < 3:
            parts += [([half], []) for pair in regions(motions) for half in pair]
        held_out = list[HeldOut]()
        for k, (some, margins) in enumerate(parts):
            used = torch.ones(len(self.rows[1]), dtype=torch.bool, device=self.rows[1].device)
            for rows in (*some, *margins):
                used[rows] = False
            say = progress.within(f"copy {k + 1} of {len(parts)} for held-out rows")
            held_out += self._predicted(some, used, k, say)
        return held_out[: len(found)], held_out[len(found) :]

    def _predicted(
        self, some: Sequence[slice | Tensor], used: Tensor, number: int, say: Callable[[str], None]
    ) -> list[HeldOut]:
        """Torques for sets of rows of a copy with new weights, trained on others; its seed follows from its number."""
        model, network, domain = self.model, copy.deepcopy(self.model.network), copy.deepcopy(self.model.domain)
        with seeded(used.device, self.training.seed + number):
            for part in network.modules():
                if callable(reset := getattr(part, "reset_parameters", None)):
                    reset()
            self.train(network, say, used)
        domain.cover(model.state_of(self.rows[0][used]))
        return _predicted(model, network, domain, self.rows, some)


@torch.no_grad()
def _predicted(
    model: ResidualDynamics,
    network: nn.Module,
    domain: nn.Module,
    rows: tuple[Tensor, Tensor],
    some: Sequence[slice | Tensor],
) -> list[HeldOut]:
    """Torques of a network, trained in a domain, for sets of rows."""
    network.eval()
    torque = by_parts(partial(model.ungated, network=network), rows[0]).double()
    gate = domain(model.state_of(rows[0])).double()
    return [HeldOut(gate[k] * torque[k], gate[k].expand_as(torque[k]), rows[1][k].double()) for k in some]


def _motions(samples: Samples, lengths: Sequence[int]) -> MotionRows:
    q, qd, qdd, tau = (x.double().cpu() for x in samples)
    return MotionRows(q, qd, qdd, tuple(lengths), tau)


@torch.no_grad()
def _residuals(model: ResidualDynamics, samples: Samples) -> tuple[Tensor, Tensor]:
    """Features of the network, and torques [rows, n] that the model leaves, in its dtype."""
    q, qd, qdd, tau = samples
    x = model.features(q, qd)
    return x, (tau - by_parts(model.model, q, qd, qdd)).to(x)
