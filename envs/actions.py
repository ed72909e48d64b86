"""Actions of an environment: torques, torques on top of a controller, or offsets of the reference that it follows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import and_more, is_number, require_tensor
from torchdq.envs.tasks import velocities
from torchdq.errors import ArgumentError
from torchdq.robot import Robot

Kind = Literal["torque", "residual", "reference"]
SHARE = {"torque": 1.0, "residual": 0.2}  # full action as a share of the torque limits
HORIZON = 0.2  # time in which a joint at its velocity limit moves by a full reference action [s]


@dataclass(frozen=True, eq=False)
class Actions:
    """Actions in [-1, 1]^n of a number of environments."""

    kind: Kind
    robot: Robot
    scale: Tensor  # [n] size of a full action [N m or N; rad or m of a reference]

    def clipped(self, actions: Any, num_envs: int, looks: bool = True) -> tuple[Tensor, Tensor]:
        """Actions [N, n] within their bounds, and the number clipped in each row [N].

        Raises if one is not finite; unless the host `looks` at them, such an action stays NaN.
        """
        if isinstance(actions, Tensor):
            require_tensor("actions", actions)
        try:
            if actions.is_complex() if isinstance(actions, Tensor) else np.iscomplexobj(actions):
                raise TypeError("complex numbers, whose imaginary parts would be dropped")
            found = torch.as_tensor(actions, dtype=self.scale.dtype, device=self.scale.device)
        except (TypeError, ValueError, RuntimeError) as error:
            raise ArgumentError(
                f"actions must be a tensor or an array of numbers, found {type(actions).__name__} ({error})"
            ) from error
        shape = (num_envs, self.robot.n)
        if found.shape != shape:
            raise ArgumentError(
                f"actions must have the shape {shape}, one row for each environment and one number for each joint of "
                f"robot {self.robot.name!r}, found {tuple(found.shape)}"
            )
        if looks and torch.compiler.is_compiling():
            raise ArgumentError(
                "a step of an environment cannot be in a graph of torch.compile or torch.export: it depends on values, "
                "of which a graph has none; trace the policy, or scene.step"
            )
        inside = found.clamp(-1.0, 1.0)
        if looks and torch.equal(inside, found):  # false if one is NaN
            return inside, torch.zeros(num_envs, dtype=torch.int64, device=found.device)
        if looks and not math.isfinite(found.sum().item()) and len(bad := (~found.isfinite()).nonzero()):
            row, joint = bad[0].tolist()
            raise ArgumentError(
                f"actions must be finite, found {found[row, joint].item()} in row {row} for joint "
                f"{self.robot.joint_names[joint]!r}{and_more(bad)}; nothing was stepped"
            )
        return inside, (inside != found).sum(1)

    def inputs(self, actions: Tensor, reference: Tensor) -> dict[str, Tensor]:
        """Inputs of a scene for actions, at the task's reference [N, 3 n]."""
        scaled = actions * self.scale
        if self.kind == "torque":
            return {"torque": scaled}
        if self.kind == "residual":
            return {"torque": scaled, "reference": reference}
        n = self.robot.n
        return {"reference": torch.cat([reference[:, :n] + scaled, reference[:, n:]], 1)}


def full(robot: Robot, kind: Kind, scale: float | Sequence[float] | None) -> list[float]:
    """Size of a full action of every joint; None: derived from the robot's limits."""
    if scale is not None:
        given = scale.tolist() if isinstance(scale, np.ndarray | Tensor) else scale
        numbers = list(given) if isinstance(given, Sequence) else [given] * robot.n
        if len(numbers) != robot.n or not all(is_number(x) and 0 < x < math.inf for x in numbers):
            raise ArgumentError(f"scale must be a positive number or {robot.n} of them, found {scale!r}")
        return [float(x) for x in numbers]
    if kind == "reference":
        return [HORIZON * v for v in velocities(robot)]
    for name, limit in zip(robot.joint_names, robot.limits.effort.tolist(), strict=True):
        if not 0 < limit < math.inf:
            raise ArgumentError(
                f"scale must be given: joint {name!r} of robot {robot.name!r} has no torque limit that actions could "
                f"be fractions of; for instance scale=10.0"
            )
    return [SHARE[kind] * x for x in robot.limits.effort.tolist()]
