"""Worth of a residual network on rows that it was not trained on, and where it may act.

The rows are left out in blocks (`blocks`), and the blocks in a few groups; for each group a copy of the network, with
new weights, is trained on the other rows for as many steps. The physical model stays as it is. What the copies say
about the rows that they have not seen decides

* how far from the trained states the network may act (`torchdq.residual.Domain`): as far as it helps;
* the weight of each joint, from 0 to 1: that of the least squared error;
* whether it may act at all: only if the error without it is more than one standard error larger, over the blocks;
* the errors of predicted torques (`torchdq.residual.Posterior`).

With validation samples, on which the network was not trained, no copies are needed.
"""

from __future__ import annotations

import copy
import math
import warnings
from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchdq.learning.logs.blocks import Block, MotionRows, blocks
from torchdq.learning.logs.correlation import correlation_times
from torchdq.learning.logs.plausibility import LogWarning
from torchdq.learning.logs.samples import Samples, torque_variance
from torchdq.residual import Domain, Posterior, ResidualDynamics
from torchdq.residual.networks import perceptrons
from torchdq.residual.smooth import smooth_step
from torchdq.tables import table

GROUPS = 5  # groups of blocks, each left out by one copy of the network
REACHES = (0.5, 0.75, 0.9, 0.99)  # shares of the left-out rows that a domain may reach
COVERED = 0.95  # share of measured torques in an interval
ROWS = 4096  # rows that are computed at a time


class Training(NamedTuple):
    """How the network was trained."""

    steps: int
    batch: int
    rate: float
    decay: float
    seed: int


class Worth(NamedTuple):
    """Worth of a residual on left-out rows; errors are root mean squares in units of the torque's spread, [n]."""

    joints: tuple[str, ...]
    without: Tensor  # [n] error of the model alone
    error: Tensor  # [n] error with the residual, at its weight
    weight: Tensor  # [n] from 0 to 1
    covered: Tensor  # [n] share of torques in the 95 % intervals
    independent: Tensor  # [n] rows that say as much as all do, being correlated
    gain: float  # how much the mean squared error of all joints falls
    standard_error: float  # standard error of the gain over the blocks; infinite if there are fewer than two

    @property
    def kept(self) -> bool:
        """Whether the residual acts."""
        return bool((self.weight > 0).any())

    def __str__(self) -> str:
        numbers = zip(self.joints, self.without, self.error, self.weight, self.covered, strict=True)
        rows = [(name, *(f"{float(x):.3f}" for x in (a, b)), f"{w:.2f}", f"{c:.0%}") for name, a, b, w, c in numbers]
        found = "kept" if self.kept else "not kept"
        title = (
            f"residual on left-out rows: {found}; the squared error falls by {self.gain:.3g} +- "
            f"{self.standard_error:.2g} of the torque's variance"
        )
        return f"{title}\n\n{table(('joint', 'without', 'with', 'weight', 'in 95 %'), rows)}"


class LeftOut(NamedTuple):
    """Torques of networks for rows that they were not trained on."""

    torque: Tensor  # [rows, n] of the networks, with an open gate and weight one [N m or N]
    residual: Tensor  # [rows, n] measured torque less the model's [N m or N]
    squared_distance: Tensor  # [rows, groups] from the trained states
    past: Tensor  # [rows, n] how far the model's torque is past its range, see `ResidualDynamics.past_torque`
    leverage: Tensor  # [rows, groups]
    blocks: list[slice]


def measure(
    model: ResidualDynamics, train: Samples, lengths: Sequence[int], valid: Samples | None, how: Training
) -> Worth:
    """Worth of a trained residual; its domain, bound, weights and errors are set from it.

    Args:
        model: trained on `train`, with an open gate and weights one.
        train: rows in the order of time, motion after motion.
        lengths: rows of each motion.
        valid: rows that it was not trained on; None: blocks of `train` are left out.
        how: the training that the copies repeat.
    """
    was_training = model.training
    model.eval()
    try:
        rows = _rows(model, train)
        correlation = correlation_times(rows[1], lengths).to(rows[1])
        with torch.no_grad():
            model.cover(*rows)
            learn_posterior(model, model.network, model.posterior, rows, correlation)
        if valid is None:
            left = _by_copies(model, train, rows, lengths, correlation, how)
        else:
            other = _rows(model, valid)
            left = _seen_by(model, model.network, model.domain, model.posterior, *other)._replace(
                blocks=[block.rows for block in _blocks(valid, (len(valid.q),))]
            )
        with torch.no_grad():
            return _set(model, left, train, lengths)
    finally:
        model.train(was_training)


def beside_fixed_physics(model: ResidualDynamics, train: Samples) -> Callable[[Tensor], Tensor]:
    """Torques of rows of `train` as a function of the rows, with those of the physical model computed here."""
    x, residual = _rows(model, train)
    described = train.tau - residual.to(train.tau)
    return lambda rows: described[rows] + model.of_scaled(x[rows]).to(described)


def tell(worth: Worth) -> None:
    """Warn where the residual does not help, or the rows are too few to say so."""
    if math.isinf(worth.standard_error):
        warnings.warn(
            "the rows are too few to leave blocks of them out, so that nothing is known about the residual where it "
            "was not trained: it is not kept, its weight is 0; record some tens of seconds",
            LogWarning,
            stacklevel=3,
        )
        return
    poor = [name for name, w in zip(worth.joints, worth.weight.tolist(), strict=True) if w < 0.5]
    if poor:
        few = int(worth.independent.min())
        warnings.warn(
            f"the residual helps little on left-out rows at {', '.join(poor)}, and acts there with weights below 0.5 "
            f"or not at all: its samples say as much as {few} independent ones; record more and other motions, or "
            "improve the model below it",
            LogWarning,
            stacklevel=3,
        )


def _rows(model: ResidualDynamics, samples: Samples) -> tuple[Tensor, Tensor]:
    """Scaled features [rows, groups, features], and torques [rows, n] that the model leaves."""
    features, residuals = [], []
    with torch.no_grad():
        for part in zip(*(x.split(ROWS) for x in samples), strict=True):
            q, qd, qdd, tau = part
            described = model.model(q, qd, qdd)
            features.append(model.scaled(model.features(q, qd, qdd, described)))
            residuals.append((tau - described).double())
    return torch.cat(features), torch.cat(residuals)


def learn_posterior(
    model: ResidualDynamics, network: nn.Module, posterior: Posterior, rows: tuple[Tensor, Tensor], correlation: Tensor
) -> None:
    """Posterior of a network's last layer, given its rows; nothing if the layer is not known."""
    inner = perceptrons(network)
    if inner is None:
        return
    x, residual = rows
    left = _by_parts(lambda x: model.ungated(x, network), x) - residual
    last = inner.weights[-1].detach().double()
    spread = last.square().mean(-1).reshape(-1) * model.torque_scale.to(last).square()  # variance of a weight
    ridge = (left.square().mean(0) * correlation) / spread.clamp_min(1e-12 * float(model.torque_scale.max()) ** 2)
    groups = posterior.root.shape[0]
    posterior.learn(_by_parts(lambda x: inner.last_hidden(model.within_range(x)), x), ridge.reshape(groups, -1).mean(1))


def _seen_by(
    model: ResidualDynamics, network: nn.Module, domain: Domain, posterior: Posterior, x: Tensor, residual: Tensor
) -> LeftOut:
    """`LeftOut` of a network and rows that it was not trained on, in one block."""
    inner = perceptrons(network)
    with torch.no_grad():
        torque = _by_parts(lambda x: model.ungated(x, network), x)
        distance = _by_parts(lambda x: domain.squared_distance(model.of_state(x)), x)
        past = _by_parts(lambda x: model.past_torque(model.of_torque(x)), x)
        leverage = torch.zeros_like(distance)
        if inner is not None:
            leverage = _by_parts(lambda x: posterior.leverage(inner.last_hidden(model.within_range(x))), x)
    return LeftOut(torque, residual, distance, past, leverage, [])


def _by_parts(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Values of a function of rows, as float64."""
    return torch.cat([function(part).double() for part in x.split(ROWS)])


def _blocks(samples: Samples, lengths: Sequence[int]) -> list[Block]:
    q, qd, qdd, tau = (x.double() for x in samples)
    return blocks(MotionRows(q, qd, qdd, tuple(lengths), tau))


def _by_copies(
    model: ResidualDynamics,
    train: Samples,
    rows: tuple[Tensor, Tensor],
    lengths: Sequence[int],
    correlation: Tensor,
    how: Training,
) -> LeftOut:
    """`LeftOut` of copies of the network, each trained without some blocks, and those blocks."""
    found, parts = _blocks(train, lengths), list[LeftOut]()
    x, residual = rows
    scale = torque_variance(train.tau).to(x)
    for k in range(min(GROUPS, len(found))):
        mine = found[k::GROUPS]
        used = torch.ones(len(x), dtype=torch.bool)  # rows that the copy is trained on
        for block in mine:
            for some in (block.rows, *block.beside):
                used[some] = False
        seen = used.nonzero()[:, 0].to(x.device)
        network = _trained(model, x, residual, scale, seen, how._replace(seed=how.seed + k))
        domain, posterior = copy.deepcopy(model.domain), copy.deepcopy(model.posterior)
        with torch.no_grad():
            domain.cover(model.of_state(x[seen]))
            learn_posterior(model, network, posterior, (x[seen], residual[seen]), correlation)
        for block in mine:
            parts.append(
                _seen_by(model, network, domain, posterior, x[block.rows], residual[block.rows])._replace(
                    blocks=[block.rows]
                )
            )
    if not parts:
        none = residual[:0]
        return LeftOut(none, none, none, none, none, [])
    parts.sort(key=lambda part: part.blocks[0].start)

    def together(name: str) -> Tensor:
        return torch.cat([getattr(part, name) for part in parts])

    return LeftOut(
        together("torque"),
        together("residual"),
        together("squared_distance"),
        together("past"),
        together("leverage"),
        [part.blocks[0] for part in parts],
    )


def _trained(
    model: ResidualDynamics, x: Tensor, residual: Tensor, variance: Tensor, seen: Tensor, how: Training
) -> nn.Module:
    """Copy of the network with new weights, trained on rows of scaled features and what the model leaves there."""
    network = copy.deepcopy(model.network).train()
    target = residual.to(x)
    with torch.random.fork_rng([x.device] if x.device.type == "cuda" else []), torch.enable_grad():
        torch.manual_seed(how.seed)
        for part in network.modules():
            if callable(reset := getattr(part, "reset_parameters", None)):
                reset()
        learned = [p for p in network.parameters() if p.requires_grad]
        optimiser = torch.optim.AdamW(learned, lr=how.rate, weight_decay=how.decay)
        for step in range(how.steps):
            at = step * how.batch % len(seen)
            if at < how.batch:
                order = seen[torch.randperm(len(seen)).to(seen.device)]
            rows = order[at : at + how.batch]
            for group in optimiser.param_groups:
                group["lr"] = how.rate / 2 * (1 + math.cos(math.pi * step / how.steps))
            optimiser.zero_grad()
            ((model.ungated(x[rows], network) - target[rows]).square() / variance).mean().backward()
            optimiser.step()
    return network.eval()


def _set(model: ResidualDynamics, left: LeftOut, train: Samples, lengths: Sequence[int]) -> Worth:
    """Worth of the residual, set in the model: its domain's reach, its weights and its errors."""
    y, r, n = left.torque, left.residual, model.robot.n
    variance = torque_variance(train.tau).double()
    joints = tuple(model.robot.joint_names)
    if len(left.blocks) < 2:
        zero, unknown = torch.zeros_like(variance), torch.full_like(variance, math.nan)
        model.weight.zero_()
        return Worth(joints, unknown, unknown, zero, unknown, zero, 0.0, math.inf)
    ends = list(accumulate(block.stop - block.start for block in left.blocks))
    parts = [slice(a, b) for a, b in pairwise([0, *ends])]

    def gate_of() -> Tensor:
        return model.domain.factor(left.squared_distance) * (1 - smooth_step(left.past))

    def at_best(gate: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Gated torques, weights [n], and how much the squared error of every block falls [blocks, n]."""
        gated = gate * y
        squares = torch.stack([gated[some].square().mean(0) for some in parts])
        products = torch.stack([(gated[some] * r[some]).mean(0) for some in parts])
        weight = (products.mean(0) / squares.mean(0).clamp_min(1e-300)).clamp(0.0, 1.0)
        return gated, weight, 2 * weight * products - weight.square() * squares

    least = model.domain.reach.clone()
    best, reach = torch.full_like(least, -math.inf), least
    for share in REACHES:
        tried = left.squared_distance.quantile(share, 0).clamp_min(0).sqrt().maximum(least)
        model.domain.reach.copy_(tried)
        gains = (at_best(gate_of())[2] / variance).mean(0)
        gains = gains if len(best) == n else gains.mean(0, keepdim=True)
        best, reach = best.maximum(gains), torch.where(gains > best, tried, reach)
    model.domain.reach.copy_(reach)
    gate = gate_of()
    gated, weight, falls = at_best(gate)
    by_block = (falls / variance).mean(-1)
    gain, error = float(by_block.mean()), float(by_block.std() / math.sqrt(len(parts)))
    weight = weight if gain > error else torch.zeros_like(weight)
    model.weight.copy_(weight)

    wrong, posterior = r - weight * gated, model.posterior
    inside = (gate >= 1).double()
    rows = inside.sum(0)
    noise = ((wrong.square() * inside).sum(0) / rows.clamp_min(1)).sqrt()
    posterior.noise.copy_(torch.where(rows > 0, noise, wrong.square().mean(0).sqrt()))
    posterior.unexplained.copy_(r.square().mean(0).sqrt())
    correlation = correlation_times(wrong, [b.stop - b.start for b in parts]).to(wrong)
    posterior.correlation.copy_(correlation)
    distance = left.squared_distance.clamp_min(0).sqrt() / model.domain.reach + left.past.clamp_min(0)
    errors = posterior.errors(left.leverage.expand_as(r), gate, distance.expand_as(r), weight)
    ratio = wrong.abs() / errors.clamp_min(1e-300)
    posterior.quantile.copy_(ratio.quantile(COVERED, 0))
    spread = variance.sqrt()
    return Worth(
        joints,
        r.square().mean(0).sqrt() / spread,
        wrong.square().mean(0).sqrt() / spread,
        weight,
        (ratio <= posterior.quantile).double().mean(0),
        len(r) / correlation,
        gain,
        error,
    )
