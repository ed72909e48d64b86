"""States that a scene should not start from: rows that are not finite, and positions far outside the joint limits."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchdq.envs.state import State
from torchdq.program.transforms import without_values

if TYPE_CHECKING:
    from torchdq.envs.scene import Scene

OUTSIDE = 0.5  # distance beyond a limit from which its spring throws the joint back at speeds of no real arm [rad or m]


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
    limits = [found for effect in scene.effects if (found := effect.free_range()) is not None]
    if not limits or not q.numel() or without_values((q,)):
        return ""
    for bounds in limits:
        low, high = (torch.as_tensor(x).detach().to(q) for x in bounds)
        if without_values((low, high)):
            continue
        q = q.detach()
        beyond = torch.maximum(low - q, q - high)
        if not bool((beyond > OUTSIDE).any()):
            continue
        rows = (beyond > OUTSIDE).any(-1)
        at = torch.unravel_index(beyond.nan_to_num(0.0).argmax(), beyond.shape)
        at_limit, value = torch.where(q < low, low, high)[at], q.expand_as(beyond)[at]
        name = scene.robot.joint_names[int(at[-1])]
        return (
            f"{int(rows.sum())} of {rows.numel()} rows start far outside their Limits: joint {name!r} is at "
            f"{float(value):.3g}, its limit {float(at_limit):.3g}; the spring of the limit throws it back, faster than "
            f"a step can follow. Start within the limits, or give Limits(lower, upper) that allow it"
        )
    return ""
