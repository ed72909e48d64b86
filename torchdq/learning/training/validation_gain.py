"""Validation gain of a residual network: how much its torques lower the error on rows that it was not trained on.

Each part of those rows is judged by what the others chose, so that no part decides about itself:

* how far from the trained states the network may act (`torchdq.layers.residual.domain.Domain`): as far as it helps;
* the weight of each joint, from 0 to 1: that of the least squared error;
* whether it may act at a joint: only if the squared error there falls by more than one standard error, over the blocks
  and, where regions of the states were held out, over these by themselves: blocks of a motion that repeats itself say
  nothing about other motions; and if its rows are as informative as two independent ones for each block: shorter
  blocks resemble their neighbours, and a network that has seen these shows nothing about its gain at other times;
* the errors of predicted torques (`torchdq.layers.residual.posterior.Posterior`).
"""

import math
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.tables import table
from torchdq.layers.residual import ResidualDynamics
from torchdq.layers.residual.smooth import smooth_step
from torchdq.learning.evaluation.correlation import correlation_times
from torchdq.learning.evaluation.coverage import interval_factors
from torchdq.learning.logs.errors import LogWarning

REACHES = (0.5, 0.75, 0.9, 0.99)  # shares of the held-out rows that a domain may reach
LEAST = 2  # fewest independent rows of a block, on average


class ValidationGain(NamedTuple):
    """Gain of a residual on held-out rows; errors are root mean squares in units of the torque's spread, [n]."""

    joints: tuple[str, ...]
    without: Tensor  # [n] error of the model alone
    error: Tensor  # [n] error with the residual, at its weight
    weight: Tensor  # [n] from 0 to 1
    covered: Tensor  # [n] share of torques in the 95 % intervals
    independent: Tensor  # [n] effective number of independent rows
    blocks: int  # parts of the motions that were held out in turn
    gains: Tensor  # [n] how much the squared error falls, over blocks or regions, where less; in units of the variance
    standard_errors: Tensor  # [n] standard errors of these gains; infinite if there are fewer than two blocks

    @property
    def active(self) -> bool:
        """Whether the residual acts."""
        return bool((self.weight > 0).any())

    def __str__(self) -> str:
        shown = (self.without, self.error, self.weight, self.covered, self.gains, self.standard_errors)
        rows = [
            (name, f"{a:.3f}", f"{b:.3f}", f"{g:.2g} +- {e:.1g}", f"{w:.2f}", f"{c:.0%}")
            for name, a, b, w, c, g, e in zip(self.joints, *(x.tolist() for x in shown), strict=True)
        ]
        heads = ("joint", "without", "with", "squares fall by", "weight", "in 95 %")
        return f"residual on held-out rows: {'active' if self.active else 'inactive'}\n\n{table(heads, rows)}"


class HeldOut(NamedTuple):
    """Torques of a network for rows that it was not trained on."""

    torque: Tensor  # [rows, n] of the network, with an open gate and weight one [N m or N]
    residual: Tensor  # [rows, n] measured torque less the model's [N m or N]
    squared_distance: Tensor  # [rows, groups] from the trained states
    past: Tensor  # [rows, n] how far the model's torque is past its range, see `torchdq.layers.residual.gate.Gate`
    leverage: Tensor  # [rows, groups]


@torch.no_grad()
def validation_gain(
    model: ResidualDynamics, blocks: Sequence[HeldOut], regions: Sequence[HeldOut], variance: Tensor
) -> ValidationGain:
    """Gain of the residual on blocks of the motions, in the order of time, and regions of the states, which share rows.

    The model was trained on all rows, and its domain reaches just as far as those; its reach, weights and errors are
    set from the gain. `variance` is that of the torques [n].
    """
    joints = tuple(model.robot.joint_names)
    if len(blocks) < 2:
        zero, unknown = torch.zeros_like(variance), torch.full_like(variance, math.nan)
        model.weight.zero_()
        return ValidationGain(joints, unknown, unknown, zero, unknown, zero, len(blocks), zero, zero + math.inf)
    rows = HeldOut(*(torch.cat(x) for x in zip(*blocks, strict=True)))
    lengths = [len(block.residual) for block in blocks]

    parts = (*blocks, *regions)
    quantiles = [rows.squared_distance.quantile(share, 0) for share in REACHES]
    reaches = torch.stack([x.clamp_min(0).sqrt().maximum(model.domain.reach) for x in quantiles])  # [reaches, groups]
    shared = reaches.shape[1] < len(variance)
    moments = _moments(model, parts, reaches)
    falls = torch.stack([_fall_of(moments, k, variance, shared) for k in range(len(parts))]) / variance
    kinds = [kind for kind in falls.tensor_split([len(blocks)]) if len(kind)]  # blocks, and regions
    means = torch.stack([kind.mean(0) for kind in kinds])
    errors = torch.stack([kind.std(0) / math.sqrt(len(kind)) for kind in kinds])
    at, weight = _choice(moments, variance, shared)
    model.domain.reach.copy_(reaches[at[0]] if shared else reaches[at, torch.arange(len(at))])

    gate = _gate(model, rows)
    gated, r = gate * rows.torque, rows.residual
    independent = len(r) / correlation_times(r - weight * gated, lengths).to(r)
    weight = weight * ((means > errors).all(0) & (independent >= LEAST * len(blocks)))
    model.weight.copy_(weight)
    left = r - weight * gated
    covered = _set_errors(model, rows, left, gate, lengths)
    without, error = (x.square().mean(0).sqrt() / variance.sqrt() for x in (r, left))
    poorest = (means - errors).argmin(0, keepdim=True)  # kind of part, [1, n]
    gains, errors = (x.gather(0, poorest)[0] for x in (means, errors))
    return ValidationGain(joints, without, error, weight, covered, independent, len(blocks), gains, errors)


def warn_of_little_gain(gain: ValidationGain) -> None:
    """Warn where the residual does not help, or the rows are too few to know."""
    needed, messages = LEAST * gain.blocks, list[str]()
    if math.isinf(float(gain.standard_errors.amax())):
        messages.append(
            "the rows are too few to hold blocks of them out, so the residual is unknown where it was not trained: its "
            "weight is 0; record some tens of seconds"
        )
    else:
        named = list(zip(gain.joints, gain.weight.tolist(), gain.independent.tolist(), strict=True))
        if few := [f"{name} ({math.floor(count)})" for name, _, count in named if count < needed]:
            messages.append(
                f"the residual has no weight at {', '.join(few)}: its rows are as informative as so many independent "
                f"samples there, and {LEAST} for each held-out block are needed, {needed}; record longer"
            )
        if poor := [name for name, weight, count in named if weight < 0.5 and count >= needed]:
            messages.append(
                f"the residual helps little on held-out rows at {', '.join(poor)}, and acts there with weights below "
                "0.5 or not at all; train for more steps, record more and other motions, or improve the model below it"
            )
    for message in messages:
        warnings.warn(message, LogWarning, stacklevel=3)


def _moments(model: ResidualDynamics, parts: Sequence[HeldOut], reaches: Tensor) -> Tensor:
    """Mean products [reaches, 2, parts, n] of the gated torques with themselves and with the residuals."""
    found = []
    for reach in reaches:
        model.domain.reach.copy_(reach)
        gated = [_gate(model, part) * part.torque for part in parts]
        squares = torch.stack([y.square().mean(0) for y in gated])
        products = torch.stack([(y * part.residual).mean(0) for y, part in zip(gated, parts, strict=True)])
        found.append(torch.stack([squares, products]))
    return torch.stack(found)


def _choice(moments: Tensor, variance: Tensor, shared: bool) -> tuple[Tensor, Tensor]:
    """Index of the reach [n], which all joints may share, and weight [n] with the least error on some parts."""
    squares, products = moments.mean(2).unbind(1)  # [reaches, n]
    weights = (products / squares.clamp_min(1e-300)).clamp(0.0, 1.0)
    gains = (2 * weights * products - weights.square() * squares) / variance
    at = (gains.mean(1, keepdim=True).expand_as(gains) if shared else gains).argmax(0)
    return at, weights[at, torch.arange(len(at))]


def _fall_of(moments: Tensor, part: int, variance: Tensor, shared: bool) -> Tensor:
    """How much the squared error [n] of a part falls, by the choice of the other parts."""
    others = [k for k in range(moments.shape[2]) if k != part]
    at, weight = _choice(moments[:, :, others], variance, shared)
    squares, products = moments[at, :, part, torch.arange(len(at))].unbind(1)
    return 2 * weight * products - weight.square() * squares


def _gate(model: ResidualDynamics, part: HeldOut) -> Tensor:
    """Factors [rows, n] of the network, with the reach that the model's domain has."""
    return model.domain.factor(part.squared_distance) * (1 - smooth_step(part.past))


def _set_errors(model: ResidualDynamics, rows: HeldOut, left: Tensor, gate: Tensor, lengths: Sequence[int]) -> Tensor:
    """Share of the torques in the intervals [n], after the model's posterior was set from held-out rows."""
    posterior = model.posterior
    inside = (gate >= 1).double()
    count = inside.sum(0)
    noise = ((left.square() * inside).sum(0) / count.clamp_min(1)).sqrt()
    posterior.noise.copy_(torch.where(count > 0, noise, left.square().mean(0).sqrt()))
    posterior.unexplained.copy_(rows.residual.square().mean(0).sqrt())
    posterior.correlation.copy_(correlation_times(left, lengths).to(left))
    distance = rows.squared_distance.clamp_min(0).sqrt() / model.domain.reach + rows.past.clamp_min(0)
    leverage, distance = (x.expand_as(left) for x in (rows.leverage, distance))
    ratio = left.abs() / posterior.errors(leverage, gate, distance, model.weight).clamp_min(1e-300)
    posterior.quantile.copy_(interval_factors(ratio.split(list(lengths))))
    return (ratio <= posterior.quantile).double().mean(0)
