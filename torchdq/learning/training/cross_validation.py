"""Copies of a residual network that are trained without some rows, and what they say about those.

The rows are left out in blocks (`blocks`), and the blocks in a few groups; for each group a copy of the network, with
new weights, is trained on the other rows for as many steps. The physical model stays as it is. A motion that repeats
itself shows a copy the states of its block in another part, so where there are fewer than three motions, regions of the
states are left out, too (`regions`). What the copies say about the rows that they have not seen decides what the
network is worth (`worth`). With validation samples, on which the network was not trained, no copies are needed.
"""

from __future__ import annotations

import copy
import functools
import math
import warnings
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torchdq.base.progress import Notice
from torchdq.layers.residual import Domain, Posterior, ResidualDynamics
from torchdq.layers.residual.networks import perceptrons
from torchdq.learning.evaluation.blocks import MotionRows, blocks, regions
from torchdq.learning.evaluation.correlation import correlation_times
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.samples import Samples, torque_variance
from torchdq.learning.training.validation_gain import LEAST, LeftOut, Worth, decide

GROUPS = 5  # groups of blocks, each left out by one copy of the network
ROWS = 4096  # rows that are computed at a time


class Training(NamedTuple):
    """How the network was trained."""

    steps: int
    batch: int
    rate: float
    decay: float
    seed: int


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
            with Notice("measuring the residual on left-out rows") as notice:
                left, apart = _by_copies(model, train, rows, lengths, correlation, how, notice)
        else:
            x, residual = _rows(model, valid)
            parts = [block.rows for block in blocks(_motion_rows(valid, (len(valid.q),)))]
            see = functools.partial(_seen_by, model, model.network, model.domain, model.posterior)
            left, apart = [see(x[rows], residual[rows]) for rows in parts], []
        with torch.no_grad():
            return decide(model, left, apart, torque_variance(train.tau).double())
    finally:
        model.train(was_training)


def beside_fixed_physics(model: ResidualDynamics, train: Samples) -> Callable[[Tensor], Tensor]:
    """Torques of rows of `train` as a function of the rows, with those of the physical model computed here."""
    x, residual = _rows(model, train)
    described = train.tau - residual.to(train.tau)
    return lambda rows: described[rows] + model.of_scaled(x[rows]).to(described)


def tell(worth: Worth) -> None:
    """Warn where the residual does not help, or the rows are too few to say so."""
    if math.isinf(float(worth.standard_errors.amax())):
        warnings.warn(
            "the rows are too few to leave blocks of them out, so that nothing is known about the residual where it "
            "was not trained: it is not kept, its weight is 0; record some tens of seconds",
            LogWarning,
            stacklevel=3,
        )
        return
    named = list(zip(worth.joints, worth.weight.tolist(), worth.independent.tolist(), strict=True))
    few = [f"{name} ({math.floor(count)})" for name, _, count in named if count < LEAST * worth.blocks]
    if few:
        warnings.warn(
            f"the residual has no weight at {', '.join(few)}: its rows say as much as so many independent "
            f"samples there, and {LEAST} for each left-out block are needed, {LEAST * worth.blocks}; record longer",
            LogWarning,
            stacklevel=3,
        )
    poor = [name for name, weight, count in named if weight < 0.5 and count >= LEAST * worth.blocks]
    if poor:
        warnings.warn(
            f"the residual helps little on left-out rows at {', '.join(poor)}, and acts there with weights below 0.5 "
            "or not at all; record more and other motions, or improve the model below it",
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
    """`LeftOut` of a network and rows that it was not trained on."""
    inner = perceptrons(network)
    with torch.no_grad():
        torque = _by_parts(lambda x: model.ungated(x, network), x)
        distance = _by_parts(lambda x: domain.squared_distance(model.of_state(x)), x)
        past = _by_parts(lambda x: model.past_torque(model.of_torque(x)), x)
        leverage = torch.zeros_like(distance)
        if inner is not None:
            leverage = _by_parts(lambda x: posterior.leverage(inner.last_hidden(model.within_range(x))), x)
    return LeftOut(torque, residual, distance, past, leverage)


def _by_parts(function: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Values of a function of rows, as float64."""
    return torch.cat([function(part).double() for part in x.split(ROWS)])


def _motion_rows(samples: Samples, lengths: Sequence[int]) -> MotionRows:
    q, qd, qdd, tau = (x.double() for x in samples)
    return MotionRows(q, qd, qdd, tuple(lengths), tau)


def _by_copies(
    model: ResidualDynamics,
    train: Samples,
    rows: tuple[Tensor, Tensor],
    lengths: Sequence[int],
    correlation: Tensor,
    how: Training,
    notice: Notice,
) -> tuple[list[LeftOut], list[LeftOut]]:
    """Torques that copies find for blocks, in the order of time, and for regions, trained without those."""
    recording = _motion_rows(train, lengths)
    found, (x, residual) = blocks(recording), rows
    scale = torque_variance(train.tau).to(x)
    halves = [half.cpu() for pair in regions(recording) for half in pair] if found else []
    groups = min(GROUPS, len(found))

    def without(unused: Sequence[slice | Tensor], shown: Sequence[slice | Tensor], k: int) -> list[LeftOut]:
        """Torques that a copy finds for some rows, trained without others."""
        used = torch.ones(len(x), dtype=torch.bool)
        for some in unused:
            used[some] = False
        seen = used.nonzero()[:, 0].to(x.device)
        number = k + 1 if k < GROUPS else groups + k - GROUPS + 1
        say = notice.within(f"network {number} of {groups + len(halves)}")
        network = _trained(model, x, residual, scale, seen, how._replace(seed=how.seed + k), say)
        domain, posterior = copy.deepcopy(model.domain), copy.deepcopy(model.posterior)
        with torch.no_grad():
            domain.cover(model.of_state(x[seen]))
            learn_posterior(model, network, posterior, (x[seen], residual[seen]), correlation)
        return [_seen_by(model, network, domain, posterior, x[some], residual[some]) for some in shown]

    left: dict[int, LeftOut] = {}
    for k in range(groups):
        mine = found[k::GROUPS]
        unused = [some for block in mine for some in (block.rows, *block.margins)]
        parts = without(unused, [block.rows for block in mine], k)
        left |= {block.rows.start: part for block, part in zip(mine, parts, strict=True)}
    apart = [part for k, half in enumerate(halves) for part in without([half], [half], GROUPS + k)]
    return [left[start] for start in sorted(left)], apart


def _trained(
    model: ResidualDynamics,
    x: Tensor,
    residual: Tensor,
    variance: Tensor,
    seen: Tensor,
    how: Training,
    say: Callable[[str], None],
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
            say(f"step {step + 1} of {how.steps}")
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
