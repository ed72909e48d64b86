"""Worth of a residual network, decided on rows that it was not trained on.

Each part of those rows is judged by what the others chose, so that no part has a say in its own choice:

* how far from the trained states the network may act (`torchdq.layers.residual.domain.Domain`): as far as it helps;
* the weight of each joint, from 0 to 1: that of the least squared error;
* whether it may act at a joint: only if the squared error there falls by more than one standard error, over the blocks
  and, where regions of the states were left out, over these by themselves: blocks of a motion that repeats itself say
  nothing about other motions; and if its rows say as much as two independent ones for each block: shorter blocks
  resemble those beside them, and a network that has seen these says nothing about its worth at other times;
* the errors of predicted torques (`torchdq.layers.residual.posterior.Posterior`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.tables import table
from torchdq.layers.residual import ResidualDynamics
from torchdq.layers.residual.smooth import smooth_step
from torchdq.learning.evaluation.correlation import correlation_times
from torchdq.learning.evaluation.coverage import interval_factors

REACHES = (0.5, 0.75, 0.9, 0.99)  # shares of the left-out rows that a domain may reach
LEAST = 2  # fewest independent rows of a block, on average


class Worth(NamedTuple):
    """Worth of a residual on left-out rows; errors are root mean squares in units of the torque's spread, [n]."""

    joints: tuple[str, ...]
    without: Tensor  # [n] error of the model alone
    error: Tensor  # [n] error with the residual, at its weight
    weight: Tensor  # [n] from 0 to 1
    covered: Tensor  # [n] share of torques in the 95 % intervals
    independent: Tensor  # [n] rows that say as much as all do, being correlated
    blocks: int  # parts of the motions that were left out in turn
    gains: Tensor  # [n] how much the squared error falls, over blocks or regions, where less; in units of the variance
    standard_errors: Tensor  # [n] standard errors of these gains; infinite if there are fewer than two blocks

    @property
    def kept(self) -> bool:
        """Whether the residual acts."""
        return bool((self.weight > 0).any())

    def __str__(self) -> str:
        shown = (self.without, self.error, self.weight, self.covered, self.gains, self.standard_errors)
        rows = [
            (name, f"{a:.3f}", f"{b:.3f}", f"{g:.2g} +- {e:.1g}", f"{w:.2f}", f"{c:.0%}")
            for name, a, b, w, c, g, e in zip(self.joints, *(x.tolist() for x in shown), strict=True)
        ]
        heads = ("joint", "without", "with", "squares fall by", "weight", "in 95 %")
        return f"residual on left-out rows: {'kept' if self.kept else 'not kept'}\n\n{table(heads, rows)}"


class LeftOut(NamedTuple):
    """Torques of a network for rows that it was not trained on."""

    torque: Tensor  # [rows, n] of the network, with an open gate and weight one [N m or N]
    residual: Tensor  # [rows, n] measured torque less the model's [N m or N]
    squared_distance: Tensor  # [rows, groups] from the trained states
    past: Tensor  # [rows, n] how far the model's torque is past its range, see `torchdq.layers.residual.gate.Gate`
    leverage: Tensor  # [rows, groups]


def decide(model: ResidualDynamics, blocks: Sequence[LeftOut], apart: Sequence[LeftOut], variance: Tensor) -> Worth:
    """Worth of the residual, set in the model: its domain's reach, its weights and its errors.

    Args:
        model: the model, trained on all rows, its domain reaching just as far as those.
        blocks: blocks of the motions, in the order of time.
        apart: regions of the states, which share rows with the blocks and each other.
        variance: of the torques [n].
    """
    joints = tuple(model.robot.joint_names)
    if len(blocks) < 2:
        zero, unknown = torch.zeros_like(variance), torch.full_like(variance, math.nan)
        model.weight.zero_()
        return Worth(joints, unknown, unknown, zero, unknown, zero, len(blocks), zero, zero + math.inf)
    left = LeftOut(*(torch.cat(x) for x in zip(*blocks, strict=True)))
    lengths = [len(block.residual) for block in blocks]

    least = model.domain.reach.clone()
    quantiles = [left.squared_distance.quantile(share, 0) for share in REACHES]
    reaches = torch.stack([x.clamp_min(0).sqrt().maximum(least) for x in quantiles])  # [reaches, groups]
    moments = []  # products of the gated torques with themselves and the residuals, [2, parts, n] for every reach
    for reach in reaches:
        model.domain.reach.copy_(reach)
        pairs = [(_gate(model, part) * part.torque, part) for part in (*blocks, *apart)]
        squares = torch.stack([y.square().mean(0) for y, _ in pairs])
        moments.append(torch.stack([squares, torch.stack([(y * part.residual).mean(0) for y, part in pairs])]))
    choose = _chooser(torch.stack(moments), variance, shared=reaches.shape[1] < len(variance))
    every = range(len(blocks) + len(apart))
    falls = torch.stack([_falls(*choose([b for b in every if b != part]), part) for part in every]) / variance
    kinds = [kind for kind in falls.tensor_split([len(blocks)]) if len(kind)]
    means, errors = (
        torch.stack(x) for x in zip(*((x.mean(0), x.std(0) / math.sqrt(len(x))) for x in kinds), strict=True)
    )
    at, weight, _ = choose(every)
    model.domain.reach.copy_(reaches[at, torch.arange(len(at))] if reaches.shape[1] == len(at) else reaches[at[0]])

    gate = _gate(model, left)
    gated, r = gate * left.torque, left.residual
    independent = len(r) / correlation_times(r - weight * gated, lengths).to(r)
    weight = weight * ((means > errors).all(0) & (independent >= LEAST * len(blocks)))
    model.weight.copy_(weight)
    wrong = r - weight * gated
    covered = _set_errors(model, left, wrong, gate, lengths)
    without, error = (x.square().mean(0).sqrt() / variance.sqrt() for x in (r, wrong))
    poorest = (means - errors).argmin(0, keepdim=True)  # kind of part, [1, n]
    gains, errors = (x.gather(0, poorest)[0] for x in (means, errors))
    return Worth(joints, without, error, weight, covered, independent, len(blocks), gains, errors)


Choice = tuple[
    Tensor, Tensor, Tensor
]  # indices of the reaches [n], weights [n], moments at these reaches [2, parts, n]


def _chooser(moments: Tensor, variance: Tensor, shared: bool) -> Callable[[Sequence[int]], Choice]:
    """Function that chooses by some parts, given moments [reaches, 2, parts, n]; all joints may share a reach."""

    def choose(parts: Sequence[int]) -> Choice:
        squares, products = moments[:, :, list(parts)].mean(2).unbind(1)  # [reaches, n]
        weights = (products / squares.clamp_min(1e-300)).clamp(0.0, 1.0)
        gains = (2 * weights * products - weights.square() * squares) / variance
        at = (gains.mean(1, keepdim=True).expand_as(gains) if shared else gains).argmax(0)
        joints = torch.arange(len(at))
        return at, weights[at, joints], moments.movedim(-1, 1)[at, joints].movedim(0, -1)

    return choose


def _falls(_: Tensor, weight: Tensor, moments: Tensor, part: int) -> Tensor:
    """How much the squared error [n] of a part falls."""
    squares, products = moments[:, part]
    return 2 * weight * products - weight.square() * squares


def _gate(model: ResidualDynamics, part: LeftOut) -> Tensor:
    """Factors [rows, n] of the network, with the reach that the model's domain has."""
    return model.domain.factor(part.squared_distance) * (1 - smooth_step(part.past))


def _set_errors(model: ResidualDynamics, left: LeftOut, wrong: Tensor, gate: Tensor, lengths: Sequence[int]) -> Tensor:
    """Share of the torques in the intervals [n], after the model's posterior was set from left-out rows."""
    posterior = model.posterior
    inside = (gate >= 1).double()
    rows = inside.sum(0)
    noise = ((wrong.square() * inside).sum(0) / rows.clamp_min(1)).sqrt()
    posterior.noise.copy_(torch.where(rows > 0, noise, wrong.square().mean(0).sqrt()))
    posterior.unexplained.copy_(left.residual.square().mean(0).sqrt())
    posterior.correlation.copy_(correlation_times(wrong, lengths).to(wrong))
    distance = left.squared_distance.clamp_min(0).sqrt() / model.domain.reach + left.past.clamp_min(0)
    leverage, distance = (x.expand_as(wrong) for x in (left.leverage, distance))
    ratio = wrong.abs() / posterior.errors(leverage, gate, distance, model.weight).clamp_min(1e-300)
    posterior.quantile.copy_(interval_factors(ratio.split(list(lengths))))
    return (ratio <= posterior.quantile).double().mean(0)
