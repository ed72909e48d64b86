"""Actions of an environment: offsets of what a controller or a servo follows, torques, or torques on top of it."""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from torchdq.base.checks import and_more, is_number, matching, require_choice, require_tensor, tensor_in
from torchdq.control.frames import FrameLaw, OperationalSpaceControl
from torchdq.control.joints import ComputedTorque
from torchdq.control.law import Law
from torchdq.dq.formulas import computed
from torchdq.effects import Effect
from torchdq.envs.pose_actions import POSITION, ROTATION, PoseActions
from torchdq.envs.tasks import ranges, velocities
from torchdq.errors import ArgumentError
from torchdq.robot import Robot
from torchdq.scene.defaults import nominal_robot
from torchdq.scene.free_base import POSE
from torchdq.scene.scene import Scene

Kind = Literal["reference", "target", "torque", "residual", "pose"]
KP, KD = 100.0, 20.0  # gains of the default controller of joints [1/s^2, 1/s]
RATE = 20.0  # at which the error of a pose decays under that of frames [1/s]
SHARE = {"torque": 1.0, "residual": 0.2}  # full action as a share of the torque limits
OFFSET = 0.25  # full action of a servo's target [rad or m]
HORIZON = 0.2  # time in which a joint at its velocity limit moves by a full reference action [s]


@dataclass(frozen=True, eq=False)
class Actions:
    """Actions in [-1, 1]^k of a number of environments."""

    kind: Kind
    robot: Robot
    joints: tuple[int, ...]  # the k actuated ones, in the order of the columns
    scale: Tensor  # [n] size of a full action, zero for passive joints [N m or N; rad or m]; [k] of a pose
    pose: PoseActions | None = None  # None: actions are of joints

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints, or of the axes, that the numbers of an action move."""
        return tuple([self.robot.joint_names[i] for i in self.joints]) if self.pose is None else self.pose.names

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
        shape = (num_envs, len(self.names))
        if found.shape != shape:
            what = "joint" if shape[1] == self.robot.n else "actuated joint"
            what = what if self.pose is None else f"of {' '.join(self.names)}"
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
            row, number = bad[0, -2:].tolist()
            what = f"{'joint' if self.pose is None else 'axis'} {self.names[number]!r}{and_more(bad)}"
            raise ArgumentError(
                f"actions must be finite, found {actions[tuple(bad[0])].item()} in row {row} for {what}; that step was "
                "not taken"
            )

    def _of_all_joints(self, actions: Tensor) -> Tensor:
        """Actions [N, n] of those of the actuated joints."""
        if self.pose is not None or self.joints == tuple(range(self.robot.n)):  # in the order of the robot
            return actions
        columns = [torch.zeros_like(actions[:, 0])] * self.robot.n
        for joint, column in zip(self.joints, actions.unbind(1), strict=True):
            columns[joint] = column
        return torch.stack(columns, 1)

    def towards(self, poses: Any, reference: Tensor) -> Tensor:
        """Actions [N, k] that move the desired poses [N, 8] to poses [N, 8] or [8], or towards them."""
        if self.pose is None:
            raise ArgumentError(f"pose_action needs an environment with action='pose', found {self.kind!r}")
        goal = torch.as_tensor(tensor_in(poses)).to(reference)
        if goal.shape not in ((8,), reference.shape):
            raise ArgumentError(f"X must have the shape {tuple(reference.shape)} or (8,), found {tuple(goal.shape)}")
        return computed(self.pose.towards, x=reference, goal=goal, scale=self.scale)

    def inputs(self, actions: Tensor, reference: Tensor) -> dict[str, Tensor]:
        """Inputs of a scene for actions [N, n], at the task's reference [N, 3 n]; or [N, k], at a pose [N, 8]."""
        if self.pose is not None:
            X = computed(self.pose.moved, x=reference, action=actions, scale=self.scale)
            return {"reference": torch.nn.functional.pad(X, (0, self.pose.still))}
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
    if passive and action in ("reference", "residual", "pose"):
        raise ArgumentError(
            f"action must be 'torque' or 'target' where joints are passive, found {action!r}: its controller would "
            f"drive {', '.join(passive)}, too"
        )
    return action


def with_controller(scene: Scene, kind: Kind, controller: Law | None) -> Scene:
    """Scene with the controller of the actions; None: one that knows the rigid bodies as described."""
    if kind not in ("reference", "residual", "pose"):
        if controller is not None:
            raise ArgumentError(f"controller must be None for {kind} actions; did you mean action='residual'?")
        return scene
    if controller is not None:
        if isinstance(controller, FrameLaw) != (kind == "pose"):
            wanted = "OperationalSpaceControl" if kind == "pose" else "ComputedTorque"
            raise ArgumentError(
                f"controller must be one of {'a frame' if kind == 'pose' else 'joints'} for {kind} actions, such as "
                f"{wanted}, found {type(controller).__name__}"
            )
        return scene.replace(controller=controller)
    model = nominal_robot(scene)
    if kind != "pose":
        return scene.replace(controller=ComputedTorque(KP, KD, model=model))
    middle = tuple([r.lower + 0.5 * r.span for r in ranges(scene.robot)])
    rate = min(RATE, 0.5 / scene.dt)  # torques that are held for dt would overshoot beyond
    firm = OperationalSpaceControl(rate**2, 2 * rate, expressed="world", q_null=middle, model=model)
    return scene.replace(controller=firm)


def pose_of_actions(controller: Law | None, leash: tuple[float, float]) -> PoseActions | None:
    """Actions on the pose of a controller's frame, with a leash [rad, m]; None: they are of joints."""
    if not (isinstance(leash, Sequence) and len(leash) == 2 and all(is_number(x) and x >= 0 for x in leash)):
        raise ArgumentError(f"leash must be two numbers that are not negative [rad, m], found {leash!r}")
    if not isinstance(controller, FrameLaw) or controller.task is None:
        return None
    return PoseActions(controller.task, (float(leash[0]), float(leash[1])), controller.reference(0) - POSE)


def full(
    robot: Robot,
    kind: Kind,
    scale: float | Sequence[float] | None,
    joints: Sequence[int],
    pose: PoseActions | None = None,
) -> list[float]:
    """Size of a full action of every joint, zero for passive ones, or of a pose; None: from the robot's limits."""
    found, number = [0.0] * robot.n, len(joints if pose is None else pose.names)
    if scale is not None:
        given = scale.tolist() if isinstance(scale, np.ndarray | Tensor) else scale
        numbers = list(given) if isinstance(given, Sequence) else [given] * number
        if len(numbers) != number or not all(is_number(x) and 0 < x < math.inf for x in numbers):
            raise ArgumentError(
                f"scale must be a positive number or {number} of them, one for each "
                f"{'joint in actuated' if pose is None else 'axis'}, found {scale!r}"
            )
    elif pose is not None:
        numbers = [ROTATION if name.startswith("r") else POSITION for name in pose.names]
    elif kind == "target":
        numbers = [OFFSET] * len(joints)
    elif kind == "reference":
        limits = velocities(robot)
        numbers = [HORIZON * limits[i] for i in joints]
    else:
        numbers = [SHARE[kind] * robot.limits.effort[i].item() for i in joints]
    if pose is not None:
        return numbers
    for i, x in zip(joints, numbers, strict=True):
        if not 0 < x < math.inf:
            raise ArgumentError(
                f"scale must be given: joint {robot.joint_names[i]!r} of robot {robot.name!r} has no torque limit that "
                f"actions could be fractions of; for instance scale=10.0"
            )
        found[i] = float(x)
    return found
