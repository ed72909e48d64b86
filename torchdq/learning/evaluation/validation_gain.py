"""Validation gain of a residual network: how much its torques lower the error on rows that it was not trained on.

They decide how the network is used at each joint: with the weight, from 0 to 1, that is best on them, and only

* if the squared error falls by more than two standard errors, over blocks of the motions and over regions of the states
  separately: blocks of a motion that repeats itself say nothing about other motions;
* if the rows are as informative as two independent ones for each block: shorter blocks resemble their neighbours, and a
  network that was trained on these shows nothing about its gain at other times.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchdq.base.tables import table
from torchdq.layers.residual import ResidualDynamics
from torchdq.learning.evaluation.statistics import COVERED, correlation_times

CLEAR = 2.0  # standard errors that the squared error must fall by
LEAST = 2  # fewest independent rows of a block, on average


class ValidationGain(NamedTuple):
    """Gain of a residual on held-out rows; errors are root mean squares in units of the torque's spread, [n]."""

    joints: tuple[str, ...]
    without: Tensor  # [n] error of the model alone
    error: Tensor  # [n] error with the residual, at its weight
    weight: Tensor  # [n] from 0 to 1
    gains: Tensor  # [n] decrease of the squared error, over blocks or regions, the smaller; in units of the variance
    standard_errors: Tensor  # [n] standard errors of these gains; infinite if there are fewer than two blocks

    def __str__(self) -> str:
        rows = [
            (name, f"{a:.3f}", f"{b:.3f}", f"{g:.2g} +- {e:.1g}", f"{w:.2f}")
            for name, a, b, w, g, e in zip(self.joints, *(x.tolist() for x in self[1:]), strict=True)
        ]
        heads = ("joint", "without", "with", "decrease of squares", "weight")
        return f"residual on held-out rows\n\n{table(heads, rows)}"


class HeldOut(NamedTuple):
    """Rows that a network was not trained on, in float64."""

    torque: Tensor  # [rows, n] of the network, with weight one [N m or N]
    gate: Tensor  # [rows, n]
    residual: Tensor  # [rows, n] measured torque less the model's [N m or N]


@torch.no_grad()
def validation_gain(
    model: ResidualDynamics, blocks: Sequence[HeldOut], regions: Sequence[HeldOut], variance: Tensor
) -> ValidationGain:
    """Gain of the residual on blocks of the motions, in the order of time, and regions of the states, which share rows.

    Weights and remaining errors of the model are set from it. `variance` is that of the torques [n].
    """
    joints, none = tuple(model.robot.joint_names), torch.zeros_like(variance)
    model.weight.zero_()
    model.remaining.fill_(1.0)
    if len(blocks) < 2:
        return ValidationGain(joints, none + math.nan, none + math.nan, none, none, none + math.inf)
    y, _, r = (torch.cat(x) for x in zip(*blocks, *regions, strict=True))
    weight = ((y * r).sum(0) / y.square().sum(0).clamp_min(1e-300)).clamp(0.0, 1.0)
    means, errors = none.new_empty(2, 1 + bool(regions), len(none))  # of blocks, and of regions
    for k, parts in enumerate(filter(None, (blocks, regions))):
        falls = torch.stack([(weight * x.torque * (2 * x.residual - weight * x.torque)).mean(0) for x in parts])
        means[k], errors[k] = falls.mean(0) / variance, falls.std(0) / len(parts) ** 0.5 / variance

    y, gate, r = (torch.cat(x) for x in zip(*blocks, strict=True))
    independent = len(r) / correlation_times(r - weight * y, [len(x.residual) for x in blocks]).to(r)
    weight = weight * ((means > CLEAR * errors).all(0) & (independent >= LEAST * len(blocks)))
    left, inside = r - weight * y, gate >= 1
    rows = inside | ~inside.any(0)
    width, alone = (x.abs().where(rows, torch.nan).nanquantile(COVERED, 0) for x in (left, r))
    model.weight.copy_(weight)
    model.remaining.copy_((width / alone.clamp_min(1e-300)).clamp(max=1.0))
    without, error = ((x.square().mean(0) / variance).sqrt() for x in (r, left))
    poorest = (means - CLEAR * errors).argmin(0, keepdim=True)
    gains, errors = (x.gather(0, poorest)[0] for x in (means, errors))
    return ValidationGain(joints, without, error, weight, gains, errors)
