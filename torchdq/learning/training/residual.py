"""Training of a residual network on top of physics that stay as they are, and its cross-validation.

Rows are held out in blocks (`blocks`), and the blocks in a few groups; for each group a copy of the network, with new
weights, is trained on the other rows for as many steps. A motion that repeats itself shows a copy the states of its
block in another part, so where there are fewer than three motions, regions of the states are held out, too (`regions`).
The torques for held-out rows decide how far the network is trusted (`validation_gain`).
"""

import copy
import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchdq.base.progress import Progress
from torchdq.errors import ArgumentError
from torchdq.layers.residual import ResidualDynamics
from torchdq.learning.evaluation.blocks import MotionRows, blocks, regions
from torchdq.learning.logs.errors import LogWarning
from torchdq.learning.logs.samples import Samples, torque_variance
from torchdq.learning.training.loop import History, Training, by_parts, descend, seeded
from torchdq.learning.training.validation_gain import HeldOut, validation_gain

GROUPS = 5  # groups of blocks, each held out from one copy of the network
Rows = tuple[Tensor, Tensor]  # features [rows, 6 n] and residual torques [rows, n]


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
    variance, rows = torque_variance(train.tau).double(), _residuals(model, train)
    unseen = None if valid is None else _residuals(model, valid)
    history = descend(model.network, model.ungated, rows, unseen, variance.to(rows[0]), training, progress.at)
    q, qd, qdd, tau = (x.double().cpu() for x in (train if valid is None else valid))
    motions = MotionRows(q, qd, qdd, tuple(lengths) if valid is None else (len(q),), tau)
    if unseen is None:
        held_out, regional = _cross_validated(model, rows, variance, motions, training, progress)
    else:
        held_out, regional = _predicted(model, unseen, [block.rows for block in blocks(motions)]), []
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


def _cross_validated(
    model: ResidualDynamics, rows: Rows, variance: Tensor, motions: MotionRows, training: Training, progress: Progress
) -> tuple[list[HeldOut], list[HeldOut]]:
    """Torques for blocks and for regions, of copies with new weights that were trained without those."""
    found = blocks(motions)
    groups = [found[k::GROUPS] for k in range(min(GROUPS, len(found)))]
    # rows that a copy predicts, and further ones that it is not trained on, either
    parts: list[tuple[list[Any], list[Any]]] = [
        ([block.rows for block in group], [margin for block in group for margin in block.margins]) for group in groups
    ]
    if found and len(motions.lengths) < 3:
        parts += [([half], []) for pair in regions(motions) for half in pair]
    held_out = list[HeldOut]()
    for k, (some, margins) in enumerate(parts):
        used = torch.ones(len(rows[0]), dtype=torch.bool, device=rows[0].device)
        for left_out in (*some, *margins):
            used[left_out] = False
        x, residual = (part[used] for part in rows)
        copied = copy.deepcopy(model, {id(model.model): model.model})  # beside the same physics
        say = progress.within(f"copy {k + 1} of {len(parts)} for held-out rows")
        with seeded(used.device, training.seed + k):
            for layer in copied.network.modules():
                if callable(reset := getattr(layer, "reset_parameters", None)):
                    reset()
                elif any(True for _ in layer.parameters(recurse=False)):
                    expected = "reset_parameters() in every layer, to train copies of it without the held-out rows"
                    raise ArgumentError(f"network must have {expected}, found {type(layer).__name__}; or give valid")
            descend(copied.network, copied.ungated, (x, residual), None, variance.to(x), training, say)
        copied.domain.cover(copied.state_of(x))
        held_out += _predicted(copied, rows, some)
    return held_out[: len(found)], held_out[len(found) :]


@torch.no_grad()
def _predicted(model: ResidualDynamics, rows: Rows, some: Sequence[slice | Tensor]) -> list[HeldOut]:
    """Torques of a network for sets of rows."""
    model.network.eval()
    x, residual = rows
    torque, gate = by_parts(model.ungated, x).double(), model.gate(x).double()
    return [HeldOut(gate[k] * torque[k], gate[k].expand_as(torque[k]), residual[k].double()) for k in some]


@torch.no_grad()
def _residuals(model: ResidualDynamics, samples: Samples) -> Rows:
    """Features of the network, and torques that the model leaves, in its dtype."""
    q, qd, qdd, tau = samples
    x = model.features(q, qd)
    return x, (tau - by_parts(model.model, q, qd, qdd)).to(x)
