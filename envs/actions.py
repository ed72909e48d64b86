"""Actions of an environment: offsets of what a controller or a servo follows, torques, or torques on top of it."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import and_more, is_number, matching, require_choice, require_tensor
from torchdq.effects import Effect
from torchdq.envs.tasks import velocities
from torchdq.errors import ArgumentError
from torchdq.robot import Robot

Kind = Literal["reference", "target", "torque", "residual"]
SHARE = {"torque": 1.0, "residual": 0.2}  # full action as a share of the torque limits
OFFSET = 0.25  # full action of a servo's target [rad or m]
HORIZON = 0.2  # time in which a joint at its velocity limit moves by a full reference action [s]


@dataclass(frozen=True, eq=False)
class Actions:
    """Actions in [-1, 1]^k of a number of environments."""

    kind: Kind
    robot: Robot
    joints: tuple[int, ...]  # the k actuated ones, in the order of the columns
    scale: Tensor  # [n] size of a full action, zero for passive joints [N m or N; rad or m of a reference or target]

    def clipped(self, actions: Any, num_envs: int, looks: bool = True) -> tuple[Tensor, Tensor]:
        """Actions [N, n] within their bounds, zero for passive joints, and the number clipped in each row [N].

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
        shape = (num_envs, len(self.joints))
        if found.shape != shape:
            what = "joint" if shape[1] == self.robot.n else "actuated joint"
            raise ArgumentError(
                f"actions must have the shape {shape}, one row for each environment and one number for each {what} of "
                f"robot {self.robot.name!r}, found {tuple(found.shape)}"
            )
        if looks and torch.compiler.is_compiling():
            raise ArgumentError(
                "a step of an environment cannot be in a graph of torch.compile or torch.export: it depends on values, "
                "of which a graph has none; trace the policy, or scene.step"
            )
        inside = found.clamp(-1.0, 1.0)
        if looks and torch.equal(inside, found):  # false if one is NaN
            return self._of_all_joints(inside), torch.zeros(num_envs, dtype=torch.int64, device=found.device)
        if looks:
            self.require_finite(found)
        return self._of_all_joints(inside), (inside != found).sum(1)

    def require_finite(self, actions: Tensor) -> None:
        """Raise unless actions [..., N, k] are finite."""
        if not math.isfinite(actions.sum().item()) and len(bad := (~actions.isfinite()).nonzero()):
            row, joint = bad[0, -2:].tolist()
            raise ArgumentError(
                f"actions must be finite, found {actions[tuple(bad[0])].item()} in row {row} for joint "
                f"{self.robot.joint_names[self.joints[joint]]!r}{and_more(bad)}; that step was not taken"
            )

    def _of_all_joints(self, actions: Tensor) -> Tensor:
        """Actions [N, n] of those of the actuated joints."""
        if self.joints == tuple(range(self.robot.n)):  # in the order of the robot
            return actions
        columns = [torch.zeros_like(actions[:, 0])] * self.robot.n
        for joint, column in zip(self.joints, actions.unbind(1), strict=True):
            columns[joint] = column
        return torch.stack(columns, 1)

    def inputs(self, actions: Tensor, reference: Tensor) -> dict[str, Tensor]:
        """Inputs of a scene for actions [N, n], at the task's reference [N, 3 n]."""
        scaled = actions * self.scale
        if self.kind == "torque":
            return {"torque": scaled}
        if self.kind == "residual":
            return {"torque": scaled, "reference": reference}
        n = self.robot.n
        moved = reference[:, :n] + scaled
        return {"target": moved} if self.kind == "target" else {"reference": torch.cat([moved, reference[:, n:]], 1)}


def actuated_joints(robot: Robot, actuated: str | Sequence[str] | None) -> tuple[int, ...]:
    """Numbers of the actuated joints, each once, in the order of names or patterns; None: of all joints.

    Those that one pattern or a set names are in the order of the robot.
    """
    if actuated is None:
        return tuple(range(robot.n))
    names = robot.joint_names
    if not matching("actuated", actuated, names, "joint"):
        raise ArgumentError("actuated must name at least one joint, found none")
    words = (actuated,) if isinstance(actuated, str | Set) else actuated
    found = [name for one in words for name in matching("actuated", one, names, "joint")]
    return tuple(map(names.index, dict.fromkeys(found)))


def kind_of(action: Kind | None, robot: Robot, joints: Sequence[int], effects: Sequence[Effect]) -> Kind:
    """Meaning of the actions; None: "target" of a servo, "torque" if joints are passive or the base floats."""
    passive = [name for i, name in enumerate(robot.joint_names) if i not in joints]
    servo = any("target" in effect.inputs(robot.n) for effect in effects)
    if action is None:
        return "target" if servo else "torque" if passive or robot.floating else "reference"
    require_choice("action", action, get_args(Kind))
    if servo != (action == "target"):
        raise ArgumentError(
            f"action must be 'target' where effects have a Servo, and only there, found {action!r}"
            + ("" if servo else "; add effects.Servo(kp, kd)")
        )
    if passive and action in ("reference", "residual"):
        raise ArgumentError(
            f"action must be 'torque' or 'target' where joints are passive, found {action!r}: its controller would "
            f"drive {', '.join(passive)}, too"
        )
    return action


def full(robot: Robot, kind: Kind, scale: float | Sequence[float] | None, joints: Sequence[int]) -> list[float]:
    """Size of a full action of every joint, zero for passive ones; None: derived from the robot's limits."""
    found = [0.0] * robot.n
    if scale is not None:
        given = scale.tolist() if isinstance(scale, np.ndarray | Tensor) else scale
        numbers = list(given) if isinstance(given, Sequence) else [given] * len(joints)
        if len(numbers) != len(joints) or not all(is_number(x) and 0 < x < math.inf for x in numbers):
            raise ArgumentError(
                f"scale must be a positive number or {len(joints)} of them, one for each joint in actuated, found "
                f"{scale!r}"
            )
    elif kind == "target":
        numbers = [OFFSET] * len(joints)
    elif kind == "reference":
        limits = velocities(robot)
        numbers = [HORIZON * limits[i] for i in joints]
    else:
        numbers = [SHARE[kind] * robot.limits.effort[i].item() for i in joints]
    for i, x in zip(joints, numbers, strict=True):
        if not 0 < x < math.inf:
            raise ArgumentError(
                f"scale must be given: joint {robot.joint_names[i]!r} of robot {robot.name!r} has no torque limit that "
                f"actions could be fractions of; for instance scale=10.0"
            )
        found[i] = float(x)
    return found
