"""States that a scene starts from, and those that it should not: not finite, or far outside the joint limits."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchdq.backends.call import batch_of
from torchdq.base.checks import require_tensor, tensor_of
from torchdq.errors import ArgumentError
from torchdq.program.transforms import without_values
from torchdq.robot.arrays import unit
from torchdq.scene.free_base import POSE
from torchdq.scene.recording import Stage
from torchdq.scene.state import State

if TYPE_CHECKING:
    from torchdq.scene.scene import Scene

UNIT = 1e-4  # error of a pose that is taken for a unit dual quaternion: finite differences stay below
OUTSIDE = 0.5  # distance beyond a limit from which its spring throws the joint back at speeds of no real arm [rad or m]


def motion_at_start(scene: Scene, given: Mapping[str, Tensor | None]) -> dict[str, Tensor]:
    """Positions and velocities of a state, by name, with common batch axes; those not given are zero, a pose is 1."""
    require_tensor("q", given["q"])
    present = {name: x for name, x in given.items() if x is not None}
    batch = batch_of(Stage(scene.spec, "start"), present)
    q = present["q"]
    moved = {name: q.new_zeros(width) for name, width in scene.spec.moving.items()}
    if "X_WB" in present:
        _require_unit(present["X_WB"])
    if "X_WB" in moved:
        moved["X_WB"] = torch.eye(1, POSE, dtype=q.dtype, device=q.device)[0]
    # clones, so that later changes of q do not move the state
    return {name: x.clone().expand(*batch, x.shape[-1]) for name, x in {**moved, **present}.items()}


def _require_unit(X_WB: Tensor) -> None:
    """Raise unless poses, those with NaN apart, are unit dual quaternions up to their rounding."""
    if without_values((X_WB,)) or not X_WB.numel():
        return
    wrong = ~(unit(X_WB.detach(), UNIT) | X_WB.isnan().any(-1))
    if bool(wrong.any()):
        found = X_WB[tuple(wrong.nonzero()[0].tolist())].tolist()
        raise ArgumentError(f"X_WB must be unit dual quaternions (see torchdq.dq.normalize), found {found}")


def not_finite(scene: Scene, state: State) -> str:
    """Words for rows of a state that are not finite; "" if there are none."""
    bad = ~scene.finite(state)
    if not bool(bad.any()):
        return ""
    row = tuple(bad.nonzero()[0].tolist())
    found = "what the effects remember"
    for name, x in (("qd", state.qd), ("q", state.q)):
        wrong = ~x[row].isfinite()
        if bool(wrong.any()):
            joint = int(wrong.long().argmax())
            found = f"{name} of joint {scene.robot.joint_names[joint]!r} is {float(x[row][joint]):g}"
    where = f", the first row {', '.join(map(str, row))}, where {found}" if row else f": {found}"
    return f"{int(bad.sum())} of {bad.numel()} rows are not finite at the start{where}; they stay so"


def outside_limits(scene: Scene, q: Tensor) -> str:
    """Words for a position far outside the limits that a scene simulates; "" if there is none."""
    if without_values((q,)) or not q.numel():
        return ""
    limits = [found for effect in scene.effects if (found := effect.free_range()) is not None]
    for bounds in limits:
        low, high = (tensor_of(x).detach() for x in bounds)
        if without_values((low,)) or without_values((high,)):
            continue
        low, high = low.to(q), high.to(q)
        q = q.detach()
        beyond = torch.maximum(low - q, q - high)
        if not bool((beyond > OUTSIDE).any()):
            continue
        rows = (beyond > OUTSIDE).any(-1)
        at = torch.unravel_index(beyond.nan_to_num(0.0).argmax(), beyond.shape)
        at_limit, value = torch.where(q < low, low, high)[at], q.expand_as(beyond)[at]
        name = scene.robot.joint_names[int(at[-1])]
        return (
            f"{int(rows.sum())} of {rows.numel()} rows start far outside their JointLimits: joint {name!r} is at "
            f"{float(value):.3g}, its limit {float(at_limit):.3g}; the spring of the limit throws it back, faster than "
            f"a step can follow. Start within the limits, or give JointLimits(lower, upper) that allow it"
        )
    return ""
